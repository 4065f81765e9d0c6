"""Renders thousands of random scenes: no crash, no hang, nothing negative or not finite.

    python -m tests.soak                          10,000 scenes in scalar_rgb, eight by eight pixels
    python -m tests.soak 500 --seed 20000         other scenes
    python -m tests.soak --variant llvm_ad_rgb
    python -m tests.soak --shrink 30              a small scene that fails as number 30 does

Scenes are rendered in child processes. One that crashes or takes longer than the limit is noted,
and the next child goes on behind it. The exit status is 1 if a scene failed.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import gc
import json
import pprint
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path

START, RESULT = "start ", "result "
BATCH = 100
"""Scenes that one child renders: few enough for the memory of compiled kernels not to pile up."""

ROUNDING = 1e-6
"""Share of the brightest value that may be negative: extinctions exceed a grid's maximum so far."""


def complaint(image):
    """What is wrong with the pixels of a rendering, "" if nothing is."""
    import numpy as np

    if not np.isfinite(image).all():
        return f"{(~np.isfinite(image)).sum()} of {image.size} values are not finite"
    negative = image < -ROUNDING * image.max()
    if negative.any():
        return f"{negative.sum()} of {image.size} values are negative"
    return ""


def check(description):
    """Render a description in the current variant; what is wrong with it, "" if nothing is."""
    import mitsuba as mi
    import numpy as np

    from tests.described_scenes import load_any

    scene, integrator = load_any(description)
    spp = description["camera"]["spp"]
    text = complaint(np.array(mi.render(scene, integrator=integrator, spp=spp, seed=1)))
    if text:
        known = mi.load_dict({"type": "volpath" if description["medium"] else "path"})
        with contextlib.suppress(RuntimeError):
            other = complaint(np.array(mi.render(scene, integrator=known, spp=16, seed=1)))
            text += f" ({known.class_name()}: {other or 'fine'})"
    return text


def answer(description):
    """The same, with exceptions in words."""
    try:
        return check(description)
    except Exception as error:
        # Dr.Jit wraps what happens in a render of JIT variants
        cause = error.__cause__ or error
        return f"{type(cause).__name__}: {str(cause).strip().splitlines()[-1]}"


def variant_arguments():
    """What `any_scene` may draw in the current variant."""
    import mitsuba as mi

    jit = "scalar" not in mi.variant()
    return {"spectral": mi.is_spectral, "jit": jit, "sun": not mi.is_monochromatic}


def described(seed):
    """The description of a number, in the current variant."""
    from tests.scene_strategies import Seeded, any_scene

    return any_scene(Seeded(seed), **variant_arguments())


def work(variant):
    """In a child: render what the lines of the standard input are, a seed or a description."""
    import manylights  # noqa: F401
    import mitsuba as mi

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    for line in sys.stdin:
        print(START, flush=True)
        given = json.loads(line)
        text = answer(described(given) if isinstance(given, int) else given)
        # In JIT variants emitters of scenes that are alive are in the kernels of all others
        gc.collect()
        print(RESULT + text, flush=True)


class Child:
    """A process that renders one scene after the other."""

    def __init__(self, variant, limit):
        self.limit = limit
        command = [sys.executable, "-m", "tests.soak", "--worker", "--variant", variant]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(
            command,
            **pipes,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=Path(__file__).parents[1],
        )
        self.lines = queue.Queue()
        self.served = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(line.rstrip("\n"))
        self.lines.put(None)

    def ask(self, given):
        """What is wrong with a scene, "" if nothing is; afterwards the child may be dead."""
        self.served += 1
        try:
            self.process.stdin.write(json.dumps(given) + "\n")
            self.process.stdin.flush()
            # The first scene waits for the imports, too
            deadline = time.monotonic() + self.limit + (60 if self.served == 1 else 0)
            while True:
                line = self.lines.get(timeout=max(0.0, deadline - time.monotonic()))
                if line is None:
                    return f"crash: the process ended with status {self.process.wait()}"
                if line.startswith(RESULT):
                    return line[len(RESULT) :]
        except queue.Empty:
            self.close()
            return f"hang: no image after {self.limit:g} s"
        except BrokenPipeError:
            return f"crash: the process ended with status {self.process.wait()}"

    @property
    def alive(self):
        """Can it be asked for another scene?"""
        return self.process.poll() is None and self.served < BATCH

    def close(self):
        """End the process."""
        self.process.kill()
        self.process.wait()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()


class Children:
    """A context that asks one child after the other: the next one where one has died."""

    def __init__(self, variant, limit):
        self._make = lambda: Child(variant, limit)
        self._child = None

    def __enter__(self):
        return self

    def ask(self, given):
        """What is wrong with a scene, "" if nothing is."""
        if self._child and not self._child.alive:
            self._child.close()
            self._child = None
        self._child = self._child or self._make()
        return self._child.ask(given)

    def __exit__(self, *_):
        if self._child:
            self._child.close()


def kind_of(text):
    """The first words of a complaint, or all of an exception's: what failures are counted by."""
    return text.split(" (")[0].split("values are ")[-1][:160]


def soak(count, seed, variant, limit):
    """Render, print failures as they come and a summary; returns the number of failures."""
    failures = collections.defaultdict(list)
    begin = time.monotonic()
    with Children(variant, limit) as children:
        for number in range(1, count + 1):
            given = seed + number - 1
            text = children.ask(given)
            if text:
                failures[kind_of(text)].append(given)
                print(f"{given}: {text}", flush=True)
            if number % 500 == 0:
                print(f"{number} scenes in {time.monotonic() - begin:.0f} s", flush=True)
    failed = sum(map(len, failures.values()))
    seconds = time.monotonic() - begin
    print(f"{count} scenes from {seed} in {variant}, {seconds:.0f} s: {failed} failed")
    for kind, given in sorted(failures.items(), key=lambda item: -len(item[1])):
        print(f"  {len(given)} times {kind}: {', '.join(map(str, given))}")
    return failed


# -------------------------------------------------------------------------------- smaller scenes

PLAIN = {
    "floor": "diffuse",
    "ball": "diffuse",
    "environment": None,
    "medium": None,
    "instances": None,
    "power": 1.0,
    "crop": False,
    "kind": "perspective",
    "sampler": "independent",
    "spp": 1,
    "border": "cube",
    "g": 0.0,
    "constant": True,
    "spectral": False,
    "surface": "none",
    "flip": False,
    "texture": None,
    "to_uv": [],
    "seed": 0,
    "triangles": 1,
    "normals": False,
    "uv": False,
    "filter": "bilinear",
    "wrap": "repeat",
    "radiance": {"kind": "uniform", "value": 1.0},
}
"""Plain values by their keys, wherever a description has these."""


def simpler(value):
    """All descriptions that are simpler than this one by a single step."""
    if isinstance(value, dict):
        for key in value:
            if key in PLAIN and value[key] != PLAIN[key] and (key != "kind" or "sampler" in value):
                yield value | {key: PLAIN[key]}
            if "type" in value and key not in ("type", "method"):
                yield {other: value[other] for other in value if other != key}
            for smaller in simpler(value[key]):
                yield value | {key: smaller}
    elif isinstance(value, list) and value and isinstance(value[0], (dict, list)):
        for index in range(len(value)):
            yield value[:index] + value[index + 1 :]
        for index, element in enumerate(value):
            for smaller in simpler(element):
                yield [*value[:index], smaller, *value[index + 1 :]]


def shrink(description, variant, limit):
    """The simplest description found that fails in the same way, and how."""
    with Children(variant, limit) as children:
        kind = kind_of(children.ask(description))
        improved = bool(kind)
        while improved:
            improved = False
            for smaller in simpler(description):
                if kind_of(children.ask(smaller)) == kind:
                    description, improved = smaller, True
                    break
    return description, kind


def main(arguments=None):
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=10_000, help="scenes (10,000)")
    parser.add_argument("--seed", type=int, default=0, help="number of the first scene (0)")
    parser.add_argument("--variant", default="scalar_rgb", help="(scalar_rgb)")
    parser.add_argument("--limit", type=float, default=60, help="seconds for one scene (60)")
    parser.add_argument("--shrink", type=int, metavar="SEED", help="make this scene small")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.worker:
        work(chosen.variant)
        return 0
    if chosen.shrink is not None:
        import mitsuba as mi

        mi.set_variant(chosen.variant)
        small, kind = shrink(described(chosen.shrink), chosen.variant, chosen.limit)
        print(kind or "it does not fail")
        pprint.pprint(small, width=100)
        return int(bool(kind))
    return int(soak(chosen.count, chosen.seed, chosen.variant, chosen.limit) > 0)


if __name__ == "__main__":
    sys.exit(main())

"""Hashes of images, to show that a change of the code keeps every bit.

    python -m tests.image_hashes -o before.json
    python -m tests.image_hashes --compare before.json

All scene files and some generators are rendered small, with both integrators, all methods, with and
without learning, on one thread. In JIT variants the kernels of each image are compared, too: how
many there are, and the operations that they consist of. Compare builds with the same compiler and
flags: where calls are inlined differently, scalar variants may round the last bits differently.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights.threads import threads_for_files

SCENES = Path(__file__).parents[1] / "scenes"
VARIANTS = "scalar_rgb,scalar_spectral,llvm_ad_rgb,llvm_ad_mono_polarized"
SIZE = {"width": 32, "height": 24}
METHODS = ("resampled_tree", "talk", "adaptive_splitting", "tree", "exhaustive")
GENERATORS = {
    "city": lambda s: s.city(200, **SIZE, spp=4),
    "city-points": lambda s: s.city(200, kind="points", **SIZE, spp=4),
    "house": lambda s: s.house(200, **SIZE, spp=4),
    "glossy": lambda s: s.glossy(200, **SIZE, spp=4),
    "fog_rooms": lambda s: s.fog_rooms(60, **SIZE, spp=4),
}


def settings(plugin: str) -> list[dict]:
    """The parameters that each scene is rendered with."""
    common = [{"type": plugin, "method": method} for method in METHODS]
    common += [{"type": plugin, "learn_visibility": False}, {"type": plugin, "splitting_rate": 4}]
    depth = {"max_depth": 4} if plugin == "manylights_volpath" else {}
    return [each | depth for each in common]


def load_alike(path: Path):
    """Load a scene file small, its objects always in one order: emitters are numbered by it.

    Threads change the order, and so does merging meshes, which looks at addresses.
    """
    return mi.load_file(str(path), parallel=False, optimize=False, spp=4, resx=32, resy=24)


def scenes() -> dict:
    """Functions without arguments that load a scene, by name."""
    import manylights

    found = {path.stem: lambda path=path: load_alike(path) for path in sorted(SCENES.glob("*.xml"))}
    for name, make in GENERATORS.items():
        found[name] = lambda make=make: mi.load_dict(make(manylights.scenes))
    return found


def kernels(history: list[dict]) -> str:
    """The number of kernels that ran, and the operations of all of them."""
    ran = [each for each in history if each["type"] == dr.KernelType.JIT]
    return f"{len(ran)} kernels of {sum(each['operation_count'] for each in ran)} operations"


def hashes(variant: str, wanted: set[str] | None = None) -> dict[str, str]:
    """SHA-256 of each image and its kernels, by scene and parameters; of all scenes or some.

    Scenes that the variant cannot load (a sky without colours) are left out.
    """
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    jit = not variant.startswith("scalar")
    dr.set_flag(dr.JitFlag.KernelHistory, jit)
    result = {}
    for name, load in scenes().items():
        if wanted and name not in wanted:
            continue
        try:
            # With one thread Mitsuba waits for ever for some files
            with threads_for_files():
                scene = load()
        except RuntimeError as error:
            if "Unsupported spectrum type" not in str(error):
                raise
            continue
        dr.set_thread_count(1)
        for plugin in ("manylights_direct", "manylights_volpath"):
            for each in settings(plugin):
                key = " ".join([variant, name, *(str(value) for value in each.values())])
                dr.kernel_history_clear()
                image = np.array(mi.render(scene, integrator=mi.load_dict(each), spp=4, seed=1))
                if jit:
                    result[f"{key}: kernels"] = kernels(dr.kernel_history())
                result[key] = hashlib.sha256(np.ascontiguousarray(image)).hexdigest()
        print(variant, name, file=sys.stderr, flush=True)
    return result


def main() -> int:
    """Write hashes, or compare them with those of a file; exit status 1 if any differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", default=VARIANTS)
    parser.add_argument("--scenes", help="names, separated by commas; all if not given")
    parser.add_argument("-o", "--output")
    parser.add_argument("--compare")
    options = parser.parse_args()
    found = {}
    for variant in options.variants.split(","):
        found |= hashes(variant, options.scenes and set(options.scenes.split(",")))
    if options.output:
        Path(options.output).write_text(json.dumps(found, indent=1))
    if not options.compare:
        return 0
    before = json.loads(Path(options.compare).read_text())
    # A file of an older version may have no kernels
    known = {key: value for key, value in found.items() if key in before or "kernels" not in key}
    changed = [key for key, value in known.items() if before.get(key) != value]
    print(*(f"differs: {key}: {before.get(key)}, {found[key]}" for key in changed), sep="\n")
    print(f"{len(known) - len(changed)} of {len(known)} images and numbers of kernels are the same")
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())

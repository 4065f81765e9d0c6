"""`manylights render --checkpoint`: what an interruption leaves, and what becomes of it."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from manylights import cli, loading
from manylights.errors import UsageError
from manylights.output import exr
from manylights.progress import Estimate
from manylights.rendering import Job, checkpoint, plan
from manylights.rendering.driver import Driver
from manylights.rendering.state import State

from tests.conftest import heed_ctrl_c, require_variant

pytestmark = pytest.mark.usefixtures("plugin")

SCENES = Path(__file__).parent.parent / "scenes"

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]

#: Small enough for tests, with further channels, and a filter that reaches over the edges of
#: blocks and of the part of the film that is rendered.
WIDE = (
    (SCENES / "aov.xml")
    .read_text()
    .replace('<rfilter type="box"/>', '<rfilter type="gaussian"/>')
    .replace(
        '<film type="hdrfilm">',
        """<film type="hdrfilm">
            <integer name="crop_offset_x" value="3"/>
            <integer name="crop_offset_y" value="2"/>
            <integer name="crop_width" value="20"/>
            <integer name="crop_height" value="12"/>""",
    )
)

#: A render in many short steps.
CHILD = """
import sys
from manylights import cli
from manylights.rendering import plan
plan.SINGLE_STEP_SAMPLES = 0
plan.MOST_SAMPLES = dict.fromkeys(plan.MOST_SAMPLES, 2**15)
{before}
sys.exit(cli.main(sys.argv[1:]))
"""

#: Python for CHILD: the third file is written to one half, then the process is killed.
DIES_WHILE_WRITING = """
import os, signal
from manylights import files
flush, written = files._flush, []
def write_half(path):
    written.append(path)
    if len(written) == 3:
        os.truncate(path, path.stat().st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    flush(path)
files._flush = write_half
"""


def start(scene, out, *arguments, before=""):
    """Start a render in a process of its own."""
    command = [sys.executable, "-c", CHILD.format(before=before), "render", scene, "-o", out]
    return subprocess.Popen(
        list(map(str, [*command, "--checkpoint", "1e-6", *arguments])),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    )


def finish(process):
    """Wait for the end of a process; return its exit status and log."""
    try:
        log = process.communicate(timeout=300)[1]
    finally:
        process.kill()
    return process.returncode, log


def stamp(path):
    """Something that changes when a file is written."""
    return path.stat().st_mtime_ns if path.exists() else None


def pixels(path):
    """The bytes of an image's pixels."""
    return np.array(mi.Bitmap(str(path))).tobytes()


def names(folder):
    """The files in a folder, hidden ones too."""
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def short_steps(monkeypatch):
    """Also small images are rendered in many steps."""
    monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", 0)
    monkeypatch.setattr(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, 2**11))


@pytest.fixture
def wide(tmp_path):
    """The scene with a wide filter, 20 x 12 pixels."""
    path = tmp_path / "scene.xml"
    path.write_text(WIDE.replace('"120"', '"28"').replace('"80"', '"18"'))
    return path


@pytest.fixture
def run(short_steps, wide, tmp_path, capsys):
    """A function that renders in this process and returns the exit status and the log.

    It writes a checkpoint after each step.
    """

    def render(*arguments, variant="scalar_rgb", out="out.exr", scene=wide):
        command = ["render", scene, "-o", tmp_path / out, "--variant", variant]
        command += ["--threads", 1, "--spp", 36, "--checkpoint", 1e-6, *arguments]
        return cli.main(list(map(str, command))), capsys.readouterr().err

    return render


@pytest.fixture
def interrupt(monkeypatch, run):
    """A function that renders with `run` until some steps are done, 3 by default of 5."""

    def render(*arguments, done=3, **options):
        render_step = Driver.render

        def render_first(driver, step, seed, spp, report):
            if step.index == done:
                raise RuntimeError("interrupted by the test")
            return render_step(driver, step, seed, spp, report)

        with monkeypatch.context() as patch:
            patch.setattr(Driver, "render", render_first)
            status, log = run(*arguments, **options)
        assert status == 2 and "interrupted by the test" in log
        return log

    return render


@pytest.mark.parametrize(("variant", "spp"), [("scalar_rgb", 120), ("llvm_ad_rgb", 200)])
def test_killed_renders_go_on_to_the_same_bits(tmp_path, variant, spp):
    """Killed, interrupted by Ctrl-C, and killed again, each time somewhere after a checkpoint."""
    variant = require_variant(variant)
    delays = random.Random(8)
    arguments = (SCENES / "points.xml", tmp_path / "out.exr", "--variant", variant, "--spp", spp)
    arguments += ("-D", "resx=96", "-D", "resy=64")
    kept = tmp_path / "out.checkpoint.exr"
    for number, kind in enumerate((signal.SIGKILL, signal.SIGINT, signal.SIGKILL)):
        before, process = stamp(kept), start(*arguments)
        while stamp(kept) == before:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.002)
        time.sleep(delays.uniform(0.0, 0.05))
        os.kill(process.pid, kind)
        status, log = finish(process)
        assert status == (130 if kind == signal.SIGINT else -signal.SIGKILL), log
        assert ("the render goes on from there" in log) == (number > 0)
        assert ("the same command goes on" in log) == (kind == signal.SIGINT)
    status, log = finish(start(*arguments))
    assert status == 0 and "the render goes on from there" in log
    assert names(tmp_path) == {"out.exr", "out.png"}
    assert_same_as_never_stopped(tmp_path, arguments)


def assert_same_as_never_stopped(folder, arguments):
    """The image of a command has the bits of the same command without interruption."""
    whole = (arguments[0], folder / "whole.exr", *arguments[2:])
    assert finish(start(*whole))[0] == 0
    assert pixels(folder / "out.exr") == pixels(folder / "whole.exr")


def test_kill_while_a_checkpoint_is_written_leaves_the_one_before(tmp_path):
    arguments = (SCENES / "points.xml", tmp_path / "out.exr", "--variant", "scalar_rgb")
    arguments += ("--spp", 20, "-D", "resx=96", "-D", "resy=64")
    status, _ = finish(start(*arguments, before=DIES_WHILE_WRITING))
    assert status == -signal.SIGKILL
    half = names(tmp_path) - {"out.checkpoint.exr"}
    assert len(half) == 1 and half.pop().endswith(".partial")
    status, log = finish(start(*arguments))
    assert status == 0 and "has 8 of 20 samples" in log
    assert names(tmp_path) == {"out.exr", "out.png"}
    assert_same_as_never_stopped(tmp_path, arguments)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_kills_at_any_moment_lose_no_bits(tmp_path, wide, variant):
    """Also while the scene is loaded, kernels are compiled and files are written."""
    variant = require_variant(variant)
    delays = random.Random(5)
    arguments = ("--variant", variant, "--threads", 1, "--spp", 40000)
    assert finish(start(wide, tmp_path / "whole.exr", *arguments))[0] == 0
    logs = []
    for _ in range(20):
        process = start(wide, tmp_path / "out.exr", *arguments)
        time.sleep(delays.uniform(0.0, 4.0))
        process.kill()
        logs.append(finish(process)[1])
    assert sum("goes on from there" in log for log in logs) >= 3
    assert finish(start(wide, tmp_path / "out.exr", *arguments))[0] == 0
    assert pixels(tmp_path / "out.exr") == pixels(tmp_path / "whole.exr")
    left = {"scene.xml", "whole.exr", "whole.png", "out.exr", "out.png"}
    assert names(tmp_path) == left


@pytest.mark.parametrize("variant", VARIANTS)
def test_wide_filters_and_further_channels_go_on_to_the_same_bits(
    run, interrupt, tmp_path, variant
):
    variant = require_variant(variant)
    assert run(variant=variant, out="whole.exr")[0] == 0
    interrupt(variant=variant, done=1)
    interrupt(variant=variant, done=3)
    status, log = run(variant=variant)
    assert status == 0 and "has 24 of 36 samples per pixel" in log
    assert pixels(tmp_path / "out.exr") == pixels(tmp_path / "whole.exr")
    fields = {field.name for field in mi.Bitmap(str(tmp_path / "out.exr")).struct_()}
    assert {"R", "G", "B", "depth.T", "normal.X", "normal.Y", "normal.Z"} <= fields


@pytest.mark.parametrize("variant", VARIANTS)
def test_image_with_checkpoints_is_that_without(run, wide, tmp_path, variant):
    variant = require_variant(variant)
    assert run("--spp", 27, variant=variant)[0] == 0
    plain = ["render", wide, "-o", tmp_path / "plain.exr", "--spp", 27, "--variant", variant]
    assert cli.main(list(map(str, [*plain, "--threads", 1]))) == 0
    assert pixels(tmp_path / "out.exr") == pixels(tmp_path / "plain.exr")


def test_checkpoint_is_a_picture_that_says_what_it_is(interrupt, tmp_path):
    interrupt("--seed", 4294967295, "-D", "spp=4")
    bitmap = mi.Bitmap(str(tmp_path / "out.checkpoint.exr"))
    index = {field.name: number for number, field in enumerate(bitmap.struct_())}
    data = np.array(bitmap)
    weight = data[..., index["checkpoint_sum.W"]]
    for name in ("R", "G", "B", "depth.T"):
        assert data[..., index[name]].mean() > 0
        total = data[..., index[f"checkpoint_sum.{name}"]]
        np.testing.assert_allclose(data[..., index[name]], total / weight, rtol=1e-6)
    start = "manylights."
    facts = {key: value for key, value in bitmap.metadata().items() if key.startswith(start)}
    facts = {key[len(start) :]: json.loads(value) for key, value in facts.items()}
    assert facts["samples_done"] == 24 and facts["spp"] == 36 and facts["sequences"] == 1
    assert (facts["history"]["steps"], facts["history"]["samples"]) == (3, [24])
    assert facts["seed"] == 4294967295 and facts["variant"] == "scalar_rgb"
    assert facts["size"] == "20 x 12" and facts["define"] == {"spp": "4"}
    assert list(facts["files"]) == ["scene.xml"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--spp", 40), "spp 36 and not 40"),
        (("--seed", 7), "seed 0 and not 7"),
        (("--set", "shadow_rays=2"), "set none and not shadow_rays=2"),
        (("-D", "spp=4"), "define none and not spp=4"),
        (("--integrator", "direct"), "integrator none and not direct"),
        (("-D", "resx=36"), "define none and not resx=36"),
    ],
)
def test_checkpoint_of_other_arguments_is_refused(run, interrupt, tmp_path, change, words):
    interrupt()
    kept = tmp_path / "out.checkpoint.exr"
    before = kept.read_bytes()
    status, log = run(*change)
    assert status == 2
    last = log.splitlines()[-1]
    assert str(kept) in last and words in last and "delete it" in last
    assert kept.read_bytes() == before and not (tmp_path / "out.exr").exists()


def test_checkpoint_of_another_variant_is_refused(run, interrupt, llvm):
    interrupt()
    status, log = run(variant=llvm)
    assert status == 2 and f"variant scalar_rgb and not {llvm}" in log


def test_checkpoint_of_another_sensor_is_refused(run, interrupt):
    scene = SCENES / "two_sensors.xml"
    interrupt(scene=scene)
    status, log = run("--sensor", 1, scene=scene)
    assert status == 2 and "sensor 0 and not 1" in log


def test_checkpoint_of_another_version_is_refused(run, interrupt, monkeypatch):
    interrupt()
    monkeypatch.setattr("manylights.__version__", "99")
    status, log = run()
    assert status == 2 and "and not manylights 99" in log


@pytest.mark.parametrize("name", ["scene.xml", "included.xml", "triangle.ply"])
def test_checkpoint_of_a_changed_scene_is_refused(run, interrupt, wide, tmp_path, name):
    """Changed, though the same to the renderer: nobody can tell what a change is for."""
    folder = tmp_path / "parts"
    folder.mkdir()
    (folder / "triangle.ply").write_bytes((SCENES / "data" / "triangle.ply").read_bytes())
    included = '<scene version="3.0.0"><shape type="ply"><string name="filename" value="{}"/>'
    included = included.format("parts/triangle.ply") + "</shape></scene>"
    (folder / "included.xml").write_text(included)
    text = wide.read_text().replace("</scene>", '<include filename="parts/included.xml"/></scene>')
    wide.write_text(text)
    interrupt()
    path = wide if name == "scene.xml" else folder / name
    path.write_bytes(path.read_bytes() + b"\n")
    status, log = run()
    assert status == 2
    changed = log.rpartition("another content of ")[2].strip()
    assert changed == os.path.relpath(path, tmp_path)


def test_job_stays_the_same_in_another_folder(run, interrupt, wide, tmp_path):
    interrupt()
    folder = tmp_path / "moved"
    folder.mkdir()
    for name in ("scene.xml", "out.checkpoint.exr"):
        (tmp_path / name).rename(folder / name)
    status, log = run(scene=folder / "scene.xml", out="moved/out.exr")
    assert status == 0 and "the render goes on from there" in log


@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.999])
def test_truncated_checkpoint_is_an_error(run, interrupt, tmp_path, part):
    interrupt()
    kept = tmp_path / "out.checkpoint.exr"
    data = kept.read_bytes()
    kept.write_bytes(data[: int(part * len(data))])
    status, log = run()
    assert status == 2
    last = log.splitlines()[-1]
    assert f"{kept}: not a whole checkpoint" in last and "delete it" in last
    assert len(kept.read_bytes()) == int(part * len(data))


def test_other_image_is_not_taken_for_a_checkpoint(run, tmp_path):
    kept = tmp_path / "out.checkpoint.exr"
    mi.Bitmap(np.zeros((12, 20, 3), np.float32)).write(str(kept))
    status, log = run()
    assert status == 2 and f"{kept}: not a checkpoint of manylights" in log


def test_checkpoint_left_beside_the_image_does_no_harm(run, monkeypatch, tmp_path):
    """Killed after the image was written and before the checkpoint was removed."""

    def die(self):
        raise RuntimeError("killed by the test")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.Checkpoint, "remove", die)
        assert run()[0] == 2
    assert names(tmp_path) == {"scene.xml", "out.exr", "out.png", "out.checkpoint.exr"}
    before = pixels(tmp_path / "out.exr")
    status, log = run()
    assert status == 0 and "has 32 of 36 samples" in log
    assert names(tmp_path) == {"scene.xml", "out.exr", "out.png"}
    assert pixels(tmp_path / "out.exr") == before


def test_what_killed_processes_left_is_removed(wide, tmp_path):
    """Of the checkpoint even by a render that writes none itself; others may still be writing."""
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    running = f".out.exr.{os.getppid()}.partial"
    for name in (f".out.exr.{killed.pid}.partial", f".out.checkpoint.exr.{killed.pid}.partial"):
        (tmp_path / name).write_bytes(b"half")
    (tmp_path / running).write_bytes(b"half")
    command = ["render", wide, "-o", tmp_path / "out.exr", "--variant", "scalar_rgb"]
    assert cli.main(list(map(str, [*command, "--checkpoint", 1]))) == 0
    assert names(tmp_path) == {"scene.xml", "out.exr", "out.png", running}


def test_checkpoint_that_cannot_be_written_does_not_stop_the_render(run, monkeypatch, tmp_path):
    """Nor does it take the one before away."""
    write, seen = exr.write, []

    def fail_once(target, planes, attributes):
        if target.name == "out.checkpoint.exr":
            seen.append(target.exists())
            if len(seen) == 2:
                raise UsageError("no room, says the test")
        return write(target, planes, attributes)

    monkeypatch.setattr(exr, "write", fail_once)
    status, log = run()
    assert status == 0 and log.count("no checkpoint written, the render goes on: no room") == 1
    assert seen == [False, True, True, True]
    monkeypatch.undo()
    assert (tmp_path / "out.exr").exists()


def test_checkpoints_are_written_when_it_is_time(wide, short_steps, monkeypatch, tmp_path):
    """After the pass that goes past it, counted from the end of the last writing."""
    mi.set_variant("scalar_rgb")
    job = Job.of(loading.load(str(wide)), 0, 36)
    state = State.empty(1)
    now, written = [0.0], []

    def write_slowly(self, state):
        written.append(state.history.steps)
        now[0] += 3.0

    monkeypatch.setattr(checkpoint.Checkpoint, "write", write_slowly)
    kept = checkpoint.Checkpoint(tmp_path / "c.exr", job, 10.0, clock=lambda: now[0])
    for time_of_step in (9.0, 0.5, 1.0, 9.5, 0.6, 30.0):
        now[0] += time_of_step
        state.history.steps += 1
        kept.keep(state)
    assert written == [3, 5, 6]


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf", "soon"])
def test_seconds_are_above_zero(capsys, seconds):
    with pytest.raises(SystemExit) as raised:
        cli.main(["render", "scene.xml", "-o", "out.exr", "--checkpoint", seconds])
    assert raised.value.code == 2
    assert "--checkpoint" in capsys.readouterr().err


def test_bar_starts_at_the_fraction_that_is_done():
    now = [0.0]
    estimate = Estimate(clock=lambda: now[0], begin=0.75)
    assert estimate.fraction() == 0.75 and estimate.seconds_left() is None
    now[0] = 10.0
    assert estimate.fraction() == 0.75
    estimate.report(0.8)
    assert estimate.seconds_left() == pytest.approx(40.0)


def test_tracers_of_particles_are_as_bright_in_passes(run, monkeypatch, tmp_path, llvm):
    """They divide by the samples of a pass themselves."""
    means = []
    for name, single in (("steps", 0), ("whole", 2**20)):
        monkeypatch.setattr(plan, "SINGLE_STEP_SAMPLES", single)
        out = f"{name}.exr"
        arguments = ("--integrator", "ptracer", "--spp", 256, "-D", "resx=24", "-D", "resy=16")
        assert run(*arguments, variant=llvm, out=out, scene=SCENES / "points.xml")[0] == 0
        means.append(np.array(mi.Bitmap(str(tmp_path / out))).mean())
    assert means[0] == pytest.approx(means[1], rel=0.1)

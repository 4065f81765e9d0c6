"""The command ``manylights render``."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path

from manylights import loading
from manylights.cli import options as shared
from manylights.loading import integrators
from manylights.output import images
from manylights.progress import run_with_bar, say, waiting
from manylights.rendering import Job, render
from manylights.rendering.checkpoint import Checkpoint, path_for

HELP = """\
Renders a scene to an OpenEXR file and writes a PNG preview beside it. SCENE is an XML
file of Mitsuba, or a USD stage (.usd, .usda, .usdc, .usdz).

The same scene, variant, number of samples and seed give the same image. Scalar
variants render all samples in one go. JIT variants do so up to 4 million
samples for the whole image; longer renders are split into passes of a power of
two of samples per pixel, at least four passes and at most 16 million samples
each. The first pass uses the seed, the others seeds derived from it, and each
sample counts the same. Stratified samplers stratify within a pass. With a
reconstruction filter wider than a pixel (anything but "box"), threads add to
the same pixel in varying order: the last bits of the image are then the same
from run to run only with --threads 1.

With --checkpoint the state of the render is kept in OUT.checkpoint.exr, a
picture, too, after each pass that ends SECONDS or more after the last one was
written. After a crash, a kill or Ctrl-C the same command goes on from there, and
the image is the same, bit for bit, as without the interruption. The file is
removed when the image is written. One of another job, of a changed scene or of
another version is refused. In JIT variants the image is also the same as without
--checkpoint. Scalar variants render in passes then, of at most 4 million samples
or 4 samples per pixel: the image has other noise than without.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "render",
        parents=[common],
        help="render a scene",
        description=HELP,
        epilog=_parameter_help(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    shared.add_scene(parser)
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="image to write")
    parser.add_argument(
        "--spp", type=shared.positive, default=0, help="samples per pixel (default: the scene's)"
    )
    parser.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    parser.add_argument(
        "--integrator",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_direct "
        "instead of direct, manylights_volpath instead of path, volpath or none, any other stays)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a parameter of the integrator, any number of times (see below)",
    )
    parser.add_argument(
        "--hide-lights",
        action="store_true",
        help="do not show lamps themselves, only what they light: --set hide_emitters=true",
    )
    parser.add_argument(
        "--checkpoint",
        type=shared.seconds,
        metavar="SECONDS",
        help="keep the state every so often; after an interruption the same command goes on",
    )
    shared.add_machine(parser)
    parser.set_defaults(command=_run)


def _parameter_help() -> str:
    """Return the parameters of our integrators as a table for the help."""
    lines = []
    for plugin, parameters in integrators.PARAMETERS.items():
        lines += ["", f"parameters of {plugin}:"]
        lines += [f"  {name:<14}  {parameter}" for name, parameter in parameters.items()]
    return "\n".join(lines[1:])


def _run(options) -> None:
    target = images.check_output(options.output)
    defines = shared.defines(options)
    settings = integrators.parse_assignments(options.set, "--set")
    settings = {name: integrators.parse_value(text) for name, text in settings.items()}
    if options.hide_lights:
        settings["hide_emitters"] = True
    shared.start(options)
    stage = shared.usd_options(options)
    with waiting("loading"):
        loaded = loading.load(options.scene, defines, options.integrator, settings, stage)
    for note in loaded.notes:
        say(note)
    # What changes the image and is not in a file: a checkpoint of other choices is refused.
    choices = {"integrator": options.integrator, "set": settings, "define": defines}
    choices |= {"usd": asdict(stage)} if stage != loading.UsdOptions() else {}
    keeps_state = options.checkpoint is not None
    job = Job.of(loaded, options.sensor, options.spp, options.seed, choices, keeps_state)
    checkpoint = _open_checkpoint(job, target, options.checkpoint) if keeps_state else None
    render_to(job, target, options.threads, checkpoint)


def _open_checkpoint(job: Job, target: Path, seconds: float) -> Checkpoint:
    """Return the checkpoint of a render, and say so if the render goes on from it."""
    found = Checkpoint(path_for(target), job, seconds)
    if found.samples:
        say(f"checkpoint: {found.describe()}, the render goes on from there")
    return found


def render_to(
    job: Job, target: Path, threads: int | None = None, checkpoint: Checkpoint | None = None
) -> float:
    """Render with a progress bar, write the images, and return the seconds of the render."""
    about_files = {}
    if checkpoint is not None:
        about_files = {
            "writing": checkpoint.writing,
            "farewell": checkpoint.farewell,
            "begin": checkpoint.fraction,
        }
    start = time.perf_counter()
    bitmap = run_with_bar(
        "rendering", lambda report: render(job, report, threads, checkpoint), **about_files
    )
    seconds = time.perf_counter() - start
    bitmap = images.exposed(bitmap, job.loaded.exposure)
    written, notes = images.write_images(bitmap, target)
    if checkpoint is not None:
        checkpoint.remove()
    for note in notes:
        say(note)
    names = " and ".join(str(path) for path in written)
    say(f"rendered in {seconds:.1f} s, wrote {names}")
    return seconds

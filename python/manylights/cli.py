"""The command ``manylights``: render scenes, describe their light trees, show a demonstration."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

from manylights.errors import one_line
from manylights.progress import say

#: Exit status of a command that could not do what was asked.
FAILURE = 2

RENDER_HELP = """\
Renders an XML scene to an OpenEXR file and writes a PNG preview beside it.

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

DEMO_HELP = """\
Generates a city at night with thousands of lights, renders it, and says how long that took.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status: 0, 2 for errors, 130 after Ctrl-C.

    ``compare`` returns 1, too, for images that differ.

    Args:
        arguments: what follows the command's name. Default: what the process was started with.
    """
    options = _parser().parse_args(arguments)
    try:
        return options.command(options) or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if options.debug:
            raise
        print(f"manylights: {one_line(error)}", file=sys.stderr)
        return FAILURE


def _parser() -> argparse.ArgumentParser:
    from manylights import __version__
    from manylights.bench.cli import add_bench, add_compare
    from manylights.report.cli import add_report

    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser = argparse.ArgumentParser(
        prog="manylights", description="Renders scenes with very many lights."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    folder = commands.add_parser(
        "plugin-dir", parents=[common], help='print the folder for: mitsuba -a "$(...)" scene.xml'
    )
    folder.set_defaults(command=_plugin_dir)
    _add_render(commands, common)
    _add_tree(commands, common)
    _add_demo(commands, common)
    add_bench(commands, common)
    add_compare(commands, common)
    add_report(commands, common)
    return parser


def _add_render(commands, common) -> None:
    from manylights.bench.cli import seconds

    render = commands.add_parser(
        "render",
        parents=[common],
        help="render an XML scene",
        description=RENDER_HELP,
        epilog=_parameter_help(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    render.add_argument("scene", metavar="SCENE.xml")
    render.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="image to write")
    render.add_argument(
        "--spp", type=_positive, default=0, help="samples per pixel (default: the scene's)"
    )
    render.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    render.add_argument(
        "--integrator",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_direct "
        "instead of direct, manylights_volpath instead of path, volpath or none, any other stays)",
    )
    render.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a parameter of the integrator, any number of times (see below)",
    )
    render.add_argument(
        "--checkpoint",
        type=seconds,
        metavar="SECONDS",
        help="keep the state every so often; after an interruption the same command goes on",
    )
    _add_define(render)
    _add_machine(render)
    render.set_defaults(command=_render)


def _parameter_help() -> str:
    """Return the parameters of our integrators as a table for the help."""
    from manylights.loading.integrators import PARAMETERS

    lines = []
    for plugin, parameters in PARAMETERS.items():
        lines += ["", f"parameters of {plugin}:"]
        lines += [f"  {name:<14}  {meaning}" for name, meaning in parameters.items()]
    return "\n".join(lines[1:])


def _add_tree(commands, common) -> None:
    tree = commands.add_parser(
        "tree", parents=[common], help="describe the lights of an XML scene and their tree"
    )
    tree.add_argument("scene", metavar="SCENE.xml")
    tree.add_argument("--json", action="store_true", help="print one JSON object")
    tree.add_argument("--variant", default="scalar_rgb", help="(default: scalar_rgb)")
    _add_define(tree)
    tree.set_defaults(command=_tree)


def _add_demo(commands, common) -> None:
    demo = commands.add_parser(
        "demo", parents=[common], help="render a city with many lights", description=DEMO_HELP
    )
    demo.add_argument(
        "-o", "--output", default="city", metavar="PREFIX", help="of both images (default: city)"
    )
    demo.add_argument(
        "--lights", type=_positive, default=20000, help="number of lights (default: 20000)"
    )
    demo.add_argument(
        "--spp", type=_positive, help="samples per pixel (default: 64, scalar variants 16)"
    )
    demo.add_argument("--width", type=_positive, default=640, help="in pixels (default: 640)")
    demo.add_argument("--height", type=_positive, default=360, help="in pixels (default: 360)")
    _add_machine(demo)
    demo.set_defaults(command=_demo)


def _add_define(parser) -> None:
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value for a <default> parameter of the scene, any number of times",
    )


def _add_machine(parser) -> None:
    parser.add_argument("--seed", type=_seed, default=0, help="0 to 4294967295 (default: 0)")
    parser.add_argument(
        "--variant", help="Mitsuba's variant (default: llvm_ad_rgb with libLLVM, else scalar_rgb)"
    )
    parser.add_argument(
        "--threads", type=_positive, help="CPU threads of the render (default: all)"
    )


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{text}: must be from 0 to 4294967295")
    return value


def _start(options) -> str:
    """Set the variant asked for, say which it is and why, and return it."""
    from manylights import loading

    variant = loading.set_variant(options.variant)
    if options.variant:
        reason = "as asked for"
    else:
        reason = "libLLVM found" if variant == "llvm_ad_rgb" else "no usable libLLVM found"
    say(f"variant: {variant} ({reason})")
    return variant


def _plugin_dir(options) -> None:
    import manylights

    print(manylights.plugin_dir())


def _render(options) -> None:
    from manylights import loading
    from manylights.loading import integrators
    from manylights.output import images
    from manylights.rendering import Job

    target = images.check_output(options.output)
    defines = integrators.parse_assignments(options.define, "-D")
    settings = integrators.parse_assignments(options.set, "--set")
    settings = {name: integrators.parse_value(text) for name, text in settings.items()}
    _start(options)
    loaded = loading.load(options.scene, defines, options.integrator, settings)
    for note in loaded.notes:
        say(note)
    # What changes the image and is not in a file: a checkpoint of other choices is refused.
    choices = {"integrator": options.integrator, "set": settings, "define": defines}
    keeps_state = options.checkpoint is not None
    job = Job.of(loaded, options.sensor, options.spp, options.seed, choices, keeps_state)
    checkpoint = _open_checkpoint(job, target, options.checkpoint) if keeps_state else None
    _render_to(job, target, options.threads, checkpoint)


def _open_checkpoint(job, target, seconds: float):
    """Return the checkpoint of a render, and say so if the render goes on from it."""
    from manylights.rendering.checkpoint import Checkpoint, path_for

    found = Checkpoint(path_for(target), job, seconds)
    if found.samples:
        say(f"checkpoint: {found.describe()}, the render goes on from there")
    return found


def _render_to(job, target, threads: int | None = None, checkpoint=None) -> float:
    """Render with a progress bar, write the images, and return the seconds of the render."""
    from manylights.output import images
    from manylights.progress import run_with_bar
    from manylights.rendering import render

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
    written, notes = images.write_images(bitmap, target)
    if checkpoint is not None:
        checkpoint.remove()
    for note in notes:
        say(note)
    names = " and ".join(str(path) for path in written)
    say(f"rendered in {seconds:.1f} s, wrote {names}")
    return seconds


def _tree(options) -> None:
    from manylights import loading, tree
    from manylights.loading import integrators

    loading.set_variant(options.variant)
    defines = integrators.parse_assignments(options.define, "-D")
    description = tree.describe(options.scene, defines)
    print(json.dumps(description) if options.json else tree.format_report(description))


def _demo(options) -> None:
    import mitsuba as mi

    from manylights import loading, scenes, tree
    from manylights.loading import integrators
    from manylights.output import images
    from manylights.rendering import Job

    target = images.check_output(f"{options.output}.exr")
    variant = _start(options)
    spp = options.spp or (16 if variant.startswith("scalar") else 64)
    description = scenes.city(
        options.lights,
        seed=options.seed,
        width=options.width,
        height=options.height,
        spp=spp,
        integrator={"type": integrators.DIRECT, "block_size": integrators.BLOCK_SIZE},
    )
    loaded = loading.LoadedScene(mi.load_dict(description), 1, [])
    lights = sum(tree.count_kinds(loaded.scene).values())
    say(f"lights: {lights:,}")
    job = Job.of(loaded, spp=spp, seed=options.seed)
    seconds = _render_to(job, target, options.threads)
    print(f"{lights:,} lights, {options.width}x{options.height}, {spp} spp: {seconds:.1f} s")


if __name__ == "__main__":
    sys.exit(main())

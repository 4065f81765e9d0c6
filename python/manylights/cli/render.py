"""The command ``manylights render``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from manylights import loading
from manylights.cli import options as shared
from manylights.errors import UsageError
from manylights.loading import integrators
from manylights.output import channels, denoise, images
from manylights.progress import NOTHING_WRITTEN, Bar, run_with_bar, say, waiting
from manylights.rendering import Progress, RenderResult, live, render
from manylights.rendering.checkpoint import path_for
from manylights.rendering.parts import Part
from manylights.rendering.render import part_path

HELP = """\
Renders a scene to an OpenEXR file and writes a PNG preview beside it. SCENE is an XML
file of Mitsuba, or a USD stage (.usd, .usda, .usdc, .usdz).

The same scene, variant, number of samples and seed give the same image, bit for bit, with
any number of threads. Long renders go in steps of some seconds; each pixel has one
sequence of random numbers for all of them, and visibility is learnt once. That needs the
sampler manylights_sobol, which replaces independent. With others each step has a sequence
of its own, and steps are few and large.

--until-noise X renders until the noise is X: the root of the mean relative variance of
the pixels, without the worst 0.1 %; 0.02 is 2 %. Four independent images are rendered in
turn, their differences tell the noise, and how many samples will be needed is predicted.
--for TIME renders for so long. --spp is the limit of both (65536 without). The noise is
in the attribute manylights.noise of the file.

The file has one part. Colours and alpha have the film's number format, layers 32 bits:
--aov albedo,normal,position,depth,uv gives albedo.R, normal.X, P.X, Z, uv.U and so on, of
the surfaces in sight and from the same rays; parameters counts=true gives counts.*;
--until-noise and --for give variance.*; with layers there is samples. --denoise adds
denoised.*, best with a box filter, and leaves the image as it is.

With --checkpoint the state of the render is kept in OUT.checkpoint.exr, a picture, too,
after each step that ends SECONDS or more after the last one was written. After a crash, a
kill or Ctrl-C the same command goes on from there, and the image is the same, bit for
bit, as without interruption or checkpoint (but not with --for, which looks at the clock).
The file is removed when the image is written. One of another job, of a changed scene or
of another version is refused.

--part 3/16 renders the third of 16 shares of the same steps, on any machine, and writes
OUT.part-03-of-16.exr, a picture, too. manylights merge OUT.part-*.exr -o OUT.exr adds them
to the image, the same, bit for bit, as without parts. Each part first learns what the first
step teaches, or takes it from a part that is there with --learnt FILE. With --checkpoint
a part keeps its state in its own file.
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
        "--spp", type=shared.positive, help="samples per pixel (default: the scene's)"
    )
    _add_targets(parser)
    parser.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    parser.add_argument(
        "--integrator",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_direct "
        "instead of direct, manylights_volpath instead of path, volpath or none, any other stays)",
    )
    parser.add_argument(
        "--sampler",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_sobol "
        "instead of independent or none, any other stays)",
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
    _add_layers(parser)
    _add_parts(parser)
    shared.add_machine(parser)
    parser.set_defaults(command=_run)


def _add_layers(parser) -> None:
    parser.add_argument(
        "--aov",
        metavar="NAMES",
        help="layers that describe the surfaces in sight, with commas between: "
        + ", ".join(channels.AOVS),
    )
    parser.add_argument(
        "--denoise",
        action="store_true",
        help="add layers denoised.* by Open Image Denoise and show them in the PNG; implies "
        "--aov albedo,normal,emission (needs manylights[denoise])",
    )
    parser.add_argument(
        "--exposure",
        type=shared.stops,
        default=0.0,
        metavar="EV",
        help="stops by which the PNG is brighter (default: 0)",
    )
    parser.add_argument(
        "--tev",
        nargs="?",
        const="",
        metavar="HOST:PORT",
        help=f"show the picture after each step in tev (default: {live.HOST}:{live.PORT}; needs "
        "manylights[tev])",
    )


def _add_parts(parser) -> None:
    parser.add_argument(
        "--part",
        type=shared.part,
        metavar="K/N",
        help="render share K of N of the steps, for manylights merge",
    )
    parser.add_argument(
        "--learnt",
        metavar="FILE",
        help="with --part: take what is learnt from this part or checkpoint of the same render",
    )


def _add_targets(parser) -> None:
    parser.add_argument(
        "--until-noise",
        type=shared.share,
        metavar="X",
        help="render until the noise is X (0.02 is 2 %%) or --spp is reached",
    )
    parser.add_argument(
        "--for",
        dest="seconds",
        type=shared.duration,
        metavar="TIME",
        help="render for so long (60s, 10m, 1h) or until --spp is reached",
    )


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
    if options.denoise:
        denoise.check_installed()
    aovs = denoise.with_guides(options.aov) if options.denoise else options.aov
    if aovs is not None:
        settings["aovs"] = channels.aov_list(aovs, "--aov")
        if options.aov is None:
            settings["aovs"] = integrators.Wish(settings["aovs"])
    shared.start(options)
    stage = shared.usd_options(options)
    with waiting("loading"):
        loaded = loading.load(
            options.scene, defines, options.integrator, settings, stage, options.sampler
        )
    for note in loaded.notes:
        say(note)
    count = len(loaded.scene.sensors())
    if not 0 <= options.sensor < count:
        raise UsageError(f"--sensor {options.sensor}: the scene has {count}, counted from 0")
    names = ("spp", "seed", "sensor", "until_noise", "seconds", "threads")
    names += ("denoise", "exposure", "tev")
    wanted = {name: getattr(options, name) for name in names}
    wanted |= {"part": _part(options), "learnt": options.learnt}
    if options.checkpoint is not None:
        path = part_path(target, options.part) if options.part else path_for(target)
        wanted |= {"checkpoint": path, "checkpoint_seconds": options.checkpoint}
    render_to(loaded, target, wanted)


def _part(options) -> Part | None:
    """Return the part that was asked for, with the command line without it."""
    if options.part is None:
        return None
    words, kept = iter(options.arguments), []
    for word in words:
        name, is_whole, _ = word.partition("=")
        # Options can be abbreviated.
        if not ("--part".startswith(name) and len(name) > 2):
            kept.append(word)
        elif not is_whole:
            next(words)
    return replace(options.part, command=tuple(kept))


def render_to(loaded: loading.LoadedScene, target: Path, wanted: dict) -> RenderResult:
    """Render with a progress bar, and write the images.

    Args:
        loaded: the scene.
        target: the OpenEXR file.
        wanted: arguments of ``rendering.render``.
    """
    seen: list[Progress] = []

    def work(bar: Bar) -> RenderResult:
        def report(progress: Progress) -> None:
            if not seen and progress.kept:
                say(f"checkpoint: {progress.kept}, the render goes on from there")
                bar.begin(progress.fraction)
            seen[:] = [progress]
            if progress.noise is not None:
                bar.text = f"noise {progress.noise:.3g}, {progress.samples} spp"
            bar.report(progress.fraction)

        return render(loaded, output=target, progress=report, **wanted)

    def farewell() -> str:
        kept = seen[0].kept if seen else None
        return f"interrupted, {kept}; the same command goes on" if kept else NOTHING_WRITTEN

    result = run_with_bar("rendering", work, farewell)
    for note in result.notes[len(loaded.notes) :]:
        say(note)
    names = " and ".join(str(path) for path in result.files)
    noise = "" if result.noise is None else f", noise {result.noise:.3g}"
    how_many = f"{result.samples} samples per pixel{noise}"
    say(f"rendered in {result.seconds:.1f} s, {how_many}, wrote {names}")
    return result

"""The command ``manylights render``."""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import replace
from pathlib import Path

from manylights import loading
from manylights.cli import options as shared
from manylights.errors import UsageError
from manylights.loading import ours
from manylights.output import channels, images
from manylights.progress import NOTHING_WRITTEN, Bar, run_with_bar, say, waiting
from manylights.rendering import Progress, RenderResult, live, render
from manylights.rendering.arguments import check_together
from manylights.rendering.checkpoint import path_for
from manylights.rendering.extras import Extras
from manylights.rendering.parts import Part
from manylights.rendering.render import part_path

#: Seconds between two writings of a checkpoint of workers, if nobody asks for one.
CHECKPOINT_SECONDS = 60.0

#: Options that exclude or need each other.
TOGETHER = ("part", "until_noise", "seconds", "learnt", "ship")

#: Those of what is shown beside the image.
SHOWN = ("denoise", "exposure", "tev")

HELP = """\
examples:
  manylights render scene.xml -o image.exr --spp 64
  manylights render scene.usdc -o image.exr --until-noise 0.02 --checkpoint 300
  manylights render scene.xml -o image.exr --for 10m --set splitting_rate=2

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
denoised.*, best with a box filter, and leaves the image as it is. --exposure is for the PNG.

--light-groups 'key=lamp_*,windows=facade' gives RGBA_key.R, RGBA_windows.R, RGBA_rest.R and
so on: the light of emitters whose id, or that of their shape, fits the pattern, and of all
others. The image is the sum of these layers. manylights mix OUT.exr key=2 windows=0 -o
OTHER.exr makes the one group brighter and switches the other off, without rendering again.

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

--workers local:4 renders with four processes on this machine, --workers tcp://HOST:8786 (or
tls://HOST:8786, or scheduler.json) with all workers of a scheduler of Dask distributed, which
pip install 'manylights[dask]' installs. Workers may come, go and crash: the image is that of
one process, bit for bit. They need the same version and the same files at the same path;
--ship sends the files. The state is kept as with --checkpoint 60; Ctrl-C keeps what has
arrived. tcp:// to another machine is for networks where everybody is trusted.
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
        "--sensor", type=shared.index, default=0, help="index of the sensor (default: 0)"
    )
    _add_targets(parser)
    method = parser.add_argument_group("integrator and sampler")
    method.add_argument(
        "--integrator",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_direct "
        "instead of direct, manylights_volpath instead of path, volpath or none, any other stays)",
    )
    method.add_argument(
        "--sampler",
        metavar="NAME",
        help="keep: the scene's own; any other name: that plugin (default: manylights_sobol "
        "instead of independent or none, any other stays)",
    )
    method.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a parameter of the integrator, any number of times (see below)",
    )
    method.add_argument(
        "--hide-lights",
        action="store_true",
        help="do not show lamps themselves, only what they light: --set hide_emitters=true",
    )
    interruptions = parser.add_argument_group("interruptions")
    interruptions.add_argument(
        "--checkpoint",
        type=shared.seconds,
        metavar="SECONDS",
        help="keep the state every so often; after an interruption the same command goes on",
    )
    _add_layers(parser)
    _add_parts(parser)
    shared.add_usd(parser)
    shared.add_machine(parser)
    parser.set_defaults(command=_run)


def _add_layers(parser) -> None:
    group = parser.add_argument_group("layers and pictures")
    group.add_argument(
        "--aov",
        metavar="NAMES",
        help="layers that describe the surfaces in sight, with commas between: "
        + ", ".join(channels.AOVS),
    )
    group.add_argument(
        "--light-groups",
        metavar="NAME=PATTERN,...",
        help="write the light of groups of lamps to layers, by the ids of emitters or shapes: "
        "key=lamp_*,windows=facade (the others are the group rest), of USD by the paths of prims "
        "or of their instancers, or by names: key=/World/Lamps/* (* fits / too); see manylights "
        "mix",
    )
    group.add_argument(
        "--denoise",
        action="store_true",
        help="add layers denoised.* by Open Image Denoise and show them in the PNG; implies "
        "--aov albedo,normal,emission (needs manylights[denoise])",
    )
    shared.add_exposure(group)
    group.add_argument(
        "--tev",
        nargs="?",
        const="",
        metavar="HOST:PORT",
        help=f"show the picture after each step in tev (default: {live.HOST}:{live.PORT}; needs "
        "manylights[tev])",
    )


def _add_workers(group) -> None:
    group.add_argument(
        "--workers",
        metavar="ADDRESS",
        help="render with workers of Dask: local:N, tcp://HOST:PORT, tls://HOST:PORT or "
        "scheduler.json; --threads is for each of them",
    )
    group.add_argument(
        "--ship",
        action="store_true",
        help="with --workers: send them the scene's files (default: they have the same folder)",
    )


def _add_parts(parser) -> None:
    group = parser.add_argument_group("several machines")
    group.add_argument(
        "--part",
        type=shared.part,
        metavar="K/N",
        help="render share K of N of the steps, for manylights merge",
    )
    group.add_argument(
        "--learnt",
        metavar="FILE",
        help="with --part: take what is learnt from this part or checkpoint of the same render",
    )
    _add_workers(group)


def _add_targets(parser) -> None:
    group = parser.add_argument_group("samples, noise or time")
    group.add_argument(
        "--spp", type=shared.positive, help="samples per pixel (default: the scene's)"
    )
    group.add_argument(
        "--until-noise",
        type=shared.share,
        metavar="X",
        help="render until the noise is X (0.02 is 2 %%) or --spp is reached",
    )
    group.add_argument(
        "--for",
        dest="seconds",
        type=shared.duration,
        metavar="TIME",
        help="render for so long (60s, 10m, 1h) or until --spp is reached",
    )


def _parameter_help() -> str:
    """Return the parameters of our integrators as a table for the help."""
    lines = []
    for plugin, parameters in ours.PARAMETERS.items():
        lines += ["", f"parameters of {plugin}:"]
        width = max(map(len, parameters))
        for name, parameter in parameters.items():
            wrapped = textwrap.wrap(str(parameter), 86 - width)
            names = [name, *[""] * (len(wrapped) - 1)]
            lines += [f"  {first:<{width}}  {text}" for first, text in zip(names, wrapped)]
    return "\n".join(lines[1:])


def _run(options) -> None:
    target = images.check_output(options.output)
    defines = shared.defines(options)
    settings = ours.parse_assignments(options.set, "--set")
    settings = {name: ours.parse_value(text) for name, text in settings.items()}
    if options.hide_lights:
        settings = ours.joined(settings, {"hide_emitters": True})
    given = {name: getattr(options, name) for name in ("light_groups", *SHOWN)}
    extras = Extras.of({"aovs": options.aov, **given}, options.part)
    settings = ours.joined(settings, extras.parameters())
    together = {name: getattr(options, name) for name in TOGETHER}
    check_together(client=options.workers, **together)
    shared.start(options)
    arguments = (options.scene, defines, options.integrator, settings)
    arguments += (shared.usd_options(options), options.sampler)
    loading.check_arguments(*arguments)
    if options.workers is None:
        _load_and_render(options, target, arguments)
        return
    if options.checkpoint is None:
        options.checkpoint = CHECKPOINT_SECONDS
    from manylights.rendering import workers

    with workers.Connection(options.workers, options.threads) as connection:
        _load_and_render(options, target, arguments, connection)


def _load_and_render(options, target: Path, arguments: tuple, connection=None) -> None:
    """Render what ``loading.load`` makes of its arguments."""
    with waiting("loading"):
        loaded = loading.load(*arguments)
    for note in loaded.notes:
        say(note)
    count = len(loaded.scene.sensors())
    if options.sensor >= count:
        has = f"0 to {count - 1} are there" if count > 1 else "there is number 0 alone"
        raise UsageError(
            f"--sensor {options.sensor}: {has}" if count else f"{options.scene}: has no sensor"
        )
    names = ("spp", "seed", "sensor", "until_noise", "seconds", "threads")
    wanted = {name: getattr(options, name) for name in (*names, *SHOWN)}
    wanted |= {"part": _part(options), "learnt": options.learnt}
    if options.checkpoint is not None:
        path = part_path(target, options.part) if options.part else path_for(target)
        wanted |= {"checkpoint": path, "checkpoint_seconds": options.checkpoint}
    if connection is not None:
        wanted |= {"client": connection.client(), "ship": options.ship}
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
            bar.lines = progress.workers
            if bar.interrupted.is_set():
                raise KeyboardInterrupt

        return render(loaded, output=target, progress=report, **wanted)

    def farewell() -> str:
        kept = seen[0].kept if seen else None
        return f"interrupted, {kept}; the same command goes on" if kept else NOTHING_WRITTEN

    result = run_with_bar("rendering", work, farewell, patient="client" in wanted)
    for note in result.notes[len(loaded.notes) :]:
        say(note)
    names = " and ".join(str(path) for path in result.files)
    noise = "" if result.noise is None else f", noise {result.noise:.3g}"
    how_many = f"{result.samples} samples per pixel{noise}"
    say(f"rendered in {result.seconds:.1f} s, {how_many}, wrote {names}")
    return result

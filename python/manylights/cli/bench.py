"""The command ``manylights bench``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from manylights import loading
from manylights.bench import (
    extras,
    folder,
    methods,
    records,
    reference,
    runner,
    scene_source,
    standard,
)
from manylights.cli import options as shared
from manylights.errors import UsageError, argument
from manylights.loading.parsing import USD_ENDINGS
from manylights.output import denoise
from manylights.progress import run_with_bar, say

HELP = """\
Renders scenes with several methods of choosing lights and measures times and errors.

SCENE is an XML file, a USD stage, or a generator of manylights.scenes:
NAME[:LIGHTS][,KEY=VALUE]..., as in city:1000,kind=points or
rooms:1000,integrator=path,max_depth=6. Pictures of generators have 160 x 90 pixels unless
width and height say otherwise. The scene's own sampler does not matter: our methods have
manylights_sobol, Mitsuba's integrators the best of independent, multijitter, orthogonal and
ldsampler.

A method is NAME[:PARAMETER=VALUE]..., as in talk:splitting_rate=4:split_function=far.
uniform and power are Mitsuba's own direct, path or volpath, which choose emitters with the
scene's weights, or in proportion to their power. Methods of ours are resampled_tree, talk,
adaptive_splitting, tree and exhaustive.

Each method is rendered with several numbers of samples and seeds, and once with as many
samples as take the time budget. Times are those of later renders; that of the first one,
with compilation, and that of building the tree are kept apart. Dr.Jit takes kernels that it
compiled in earlier processes from ~/.drjit; run "env -u HOME manylights bench ..." to have
all of them compiled.

DIR/results.json has all numbers. Ctrl-C keeps what was measured, and the same command goes
on: the same scene, variant, method, samples and seed are not rendered again. To add
methods, scenes or seeds to a folder, ask for them.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "bench",
        parents=[common],
        help="measure times and errors of several methods",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scenes(parser)
    parser.add_argument(
        "--methods", metavar="METHOD,...", help="what to compare (default: every method)"
    )
    parser.add_argument(
        "--spp",
        type=_sample_counts,
        metavar="N,...",
        help="samples per pixel (default: 1, 4, 16, ... as the budget allows)",
    )
    parser.add_argument(
        "--time-budget",
        type=shared.seconds,
        metavar="SECONDS",
        help="of one render (default: 0.5, with --quick 0.15)",
    )
    parser.add_argument("--seeds", type=_seeds, default=10, help="number of seeds (default: 10)")
    parser.add_argument(
        "--denoise",
        action="store_true",
        help="measure denoised images, too, from renders with albedo and normals (needs "
        "manylights[denoise])",
    )
    parser.add_argument("--variant", help=shared.VARIANT_HELP)
    parser.add_argument(
        "--reference",
        metavar="R.exr",
        help="compare with this image, for one SCENE (default: one of 64 times the samples)",
    )
    parser.add_argument(
        "--out", default="bench", metavar="DIR", help="folder of the results (default: bench)"
    )
    parser.set_defaults(command=_run)


def _add_scenes(parser) -> None:
    parser.add_argument(
        "scene", nargs="*", metavar="SCENE", help="XML file, USD stage or generator"
    )
    sets = parser.add_mutually_exclusive_group()
    sets.add_argument("--standard", action="store_true", help="add the standard scenes (an hour)")
    sets.add_argument("--quick", action="store_true", help="add a few small scenes (5 minutes)")
    parser.add_argument(
        "--also",
        action="append",
        default=[],
        metavar="SCENE",
        help="a scene whose pictures must not be published, any number of times",
    )
    shared.add_define(parser)
    shared.add_usd(parser)


def _run(options) -> None:
    extras.require("flip_evaluator", "flip-evaluator")
    if options.denoise:
        denoise.check_installed()
    variant = loading.set_variant(options.variant)
    say(f"variant: {variant}")
    tasks = _tasks(options)
    found = folder.open_folder(options.out, variant)
    settings = runner.Settings(options.spp, _budget(options), options.seeds, options.denoise)
    run_with_bar(
        "measuring",
        lambda bar: runner.run(tasks, settings, found, bar.report),
        lambda: f"interrupted, what was measured is in {found.folder}; the same command goes on",
    )
    say(f"wrote {found.folder / records.FILE}")


def _budget(options) -> float:
    default = standard.QUICK_BUDGET if options.quick else standard.STANDARD_BUDGET
    return default if options.time_budget is None else options.time_budget


def _tasks(options) -> list[runner.Task]:
    """Return what is to be measured.

    Raises:
        UsageError: no scene, an unknown one, an unknown method, a reference for several scenes.
    """
    defines, stage = shared.defines(options), shared.usd_options(options)
    names = [text.lower() for text in options.scene + options.also]
    if defines and not any(name.endswith(".xml") for name in names):
        raise UsageError(f"-D {next(iter(defines))}: no SCENE is an XML file, only these have them")
    if stage.given() and not any(name.endswith((".xml", *USD_ENDINGS)) for name in names):
        raise UsageError(f"{argument(stage.given()[0])}: no SCENE is a USD stage, that is for them")
    chosen = _methods(options.methods)
    tasks = standard.standard() if options.standard else standard.quick() if options.quick else []
    if chosen is not None:
        tasks = [replace(task, methods=chosen) for task in tasks]
    for text, private in [*((s, False) for s in options.scene), *((s, True) for s in options.also)]:
        source = scene_source.find(text, defines, stage)
        tasks.append(runner.Task(source, chosen or standard.all_methods(), private=private))
    if not tasks:
        raise UsageError("bench: name a SCENE, --standard or --quick")
    methods.check_values([method for task in tasks for method in task.methods])
    if options.reference is None:
        return tasks
    if len(tasks) != 1:
        raise UsageError(f"--reference {options.reference}: needs one SCENE, not {len(tasks)}")
    if Path(options.out).resolve() in Path(options.reference).resolve().parents:
        raise UsageError(
            f"--reference {options.reference}: is in the folder --out {options.out}, pictures of "
            "which are written anew, choose another folder"
        )
    # Errors against another reference are other numbers: the scene is measured again.
    source = tasks[0].source
    digest = f"{source.fingerprint} {reference.fingerprint(options.reference)}"
    source = replace(source, fingerprint=digest)
    return [replace(tasks[0], source=source, reference=options.reference)]


def _methods(text: str | None) -> list[methods.Method] | None:
    """Return the methods of a list with commas, each once, None for None."""
    if text is None:
        return None
    found = [methods.parse(item.strip()) for item in text.split(",")]
    return list({method.spec: method for method in found}.values())


def _sample_counts(text: str) -> list[int]:
    try:
        counts = sorted({int(item) for item in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: must be integers with commas between") from None
    if counts[0] < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return counts


def _seeds(text: str) -> int:
    return shared.integer(text, 1, None, "at least 1, the number of seeds")

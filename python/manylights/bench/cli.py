"""The commands ``manylights bench`` and ``manylights compare``."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

BENCH_HELP = """\
Renders scenes with several methods of choosing lights and measures times and errors.

SCENE is an XML file, or a generator of manylights.scenes: NAME[:LIGHTS][,KEY=VALUE]...,
as in city:1000,kind=points or rooms:1000,integrator=path,max_depth=6. Pictures of
generators have 160 x 90 pixels unless width and height say otherwise. All samplers become
"independent".

A method is NAME[:PARAMETER=VALUE]..., as in talk:splitting_rate=4:split_function=far.
uniform and power are Mitsuba's own direct, path or volpath, which choose emitters with the
scene's weights, or in proportion to their power; the others are methods of ours.

Each method is rendered with several numbers of samples and seeds, and once with as many
samples as take the time budget. Times are those of later renders; that of the first one,
with compilation, and that of building the tree are kept apart. Dr.Jit takes kernels that it
compiled in earlier processes from ~/.drjit; run "env -u HOME manylights bench ..." to have
all of them compiled.

DIR/results.json has all numbers. Ctrl-C keeps what was measured, and the same command goes
on: the same scene, variant, method, samples and seed are not rendered again. To add
methods, scenes or seeds to a folder, ask for them.
"""

COMPARE_HELP = """\
Compares A with B: relative mean squared error, the same without the worst pixels, root mean
squared error, difference of the means, and FLIP, a model of what a person sees. Relative
errors are those of A in relation to B.

The exit status is 0 if the trimmed relative mean squared error is at most the threshold, 1
if it is larger, 2 for bad input. The default threshold lets rounding pass; images of
different seeds need a larger one, or --reference.

With --reference both images are compared with R, and the ratios of the errors of A to those
of B are printed. The exit status is 0 if that of the trimmed relative mean squared error is
at most the threshold, 1.1 by default: A is as good as B.
"""


def add_bench(commands, common) -> None:
    """Add the command ``bench`` to the subparsers ``commands``."""
    bench = commands.add_parser(
        "bench",
        parents=[common],
        help="measure times and errors of several methods",
        description=BENCH_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    bench.add_argument("scene", nargs="*", metavar="SCENE", help="XML file or generator")
    sets = bench.add_mutually_exclusive_group()
    sets.add_argument("--standard", action="store_true", help="add the standard scenes (an hour)")
    sets.add_argument("--quick", action="store_true", help="add a few small scenes (5 minutes)")
    bench.add_argument(
        "--also",
        action="append",
        default=[],
        metavar="SCENE",
        help="a scene whose pictures must not be published, any number of times",
    )
    bench.add_argument(
        "--methods", metavar="METHOD,...", help="what to compare (default: every method)"
    )
    bench.add_argument(
        "--spp",
        type=_sample_counts,
        metavar="N,...",
        help="samples per pixel (default: 1, 4, 16, ... as the budget allows)",
    )
    bench.add_argument(
        "--time-budget",
        type=seconds,
        metavar="SECONDS",
        help="of one render (default: 0.5, with --quick 0.15)",
    )
    bench.add_argument("--seeds", type=_seeds, default=10, help="number of seeds (default: 10)")
    bench.add_argument(
        "--variant", help="Mitsuba's variant (default: llvm_ad_rgb with libLLVM, else scalar_rgb)"
    )
    bench.add_argument(
        "--reference",
        metavar="R.exr",
        help="compare with this image, for one SCENE (default: one of 64 times the samples)",
    )
    bench.add_argument(
        "--out", default="bench", metavar="DIR", help="folder of the results (default: bench)"
    )
    bench.add_argument(
        "-D",
        "--define",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value for a <default> parameter of XML scenes, any number of times",
    )
    bench.set_defaults(command=_bench)


def add_compare(commands, common) -> None:
    """Add the command ``compare`` to the subparsers ``commands``."""
    compare = commands.add_parser(
        "compare",
        parents=[common],
        help="measure how much two images differ",
        description=COMPARE_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    compare.add_argument("first", metavar="A.exr")
    compare.add_argument("second", metavar="B.exr")
    compare.add_argument("--reference", metavar="R.exr", help="compare both with this image")
    compare.add_argument(
        "--threshold",
        type=_limit,
        help="of the trimmed relative mean squared error (default: 1e-6), with --reference of the "
        "ratio of A's to B's (default: 1.1)",
    )
    compare.add_argument(
        "--trim",
        type=_share,
        default=None,
        help="share of the worst pixels that the trimmed error leaves out (default: 0.001)",
    )
    compare.add_argument(
        "-o",
        "--output",
        metavar="DIFF.png",
        help="picture of the relative difference of A from B or the reference: red is brighter, "
        "blue darker",
    )
    compare.add_argument("--json", action="store_true", help="print one JSON object")
    compare.set_defaults(command=_compare)


def _bench(options) -> None:
    from manylights import loading
    from manylights.bench import extras, results, runner
    from manylights.progress import run_with_bar, say

    extras.require("flip_evaluator", "flip-evaluator")
    variant = loading.set_variant(options.variant)
    say(f"variant: {variant}")
    jobs = _jobs(options)
    found = results.open_folder(options.out, variant)
    settings = runner.Settings(options.spp, _budget(options), options.seeds)
    run_with_bar(
        "measuring",
        lambda report: runner.run(jobs, settings, found, report),
        found.writing,
        lambda: f"interrupted, what was measured is in {found.folder}; the same command goes on",
    )
    say(f"wrote {found.folder / results.NAME}")


def _budget(options) -> float:
    from manylights.bench import standard

    default = standard.QUICK_BUDGET if options.quick else standard.STANDARD_BUDGET
    return default if options.time_budget is None else options.time_budget


def _jobs(options) -> list:
    """Return what is to be measured.

    Raises:
        UsageError: no scene, an unknown one, an unknown method, a reference for several scenes.
    """
    from manylights.bench import methods, reference, scene_source, standard
    from manylights.bench.runner import Job
    from manylights.errors import UsageError
    from manylights.loading import integrators

    defines = integrators.parse_assignments(options.define, "-D")
    chosen = _methods(options.methods)
    jobs = standard.standard() if options.standard else standard.quick() if options.quick else []
    if chosen is not None:
        jobs = [replace(job, methods=chosen) for job in jobs]
    for text, private in [*((s, False) for s in options.scene), *((s, True) for s in options.also)]:
        source = scene_source.find(text, defines)
        jobs.append(Job(source, chosen or standard.all_methods(), private=private))
    if not jobs:
        raise UsageError("bench: name a SCENE, --standard or --quick")
    methods.check_values([method for job in jobs for method in job.methods])
    if options.reference is None:
        return jobs
    if len(jobs) != 1:
        raise UsageError(f"--reference {options.reference}: needs one SCENE, not {len(jobs)}")
    # Errors against another reference are other numbers: the scene is measured again.
    source = jobs[0].source
    digest = f"{source.fingerprint} {reference.fingerprint(options.reference)}"
    source = replace(source, fingerprint=digest)
    return [replace(jobs[0], source=source, reference=options.reference)]


def _methods(text: str | None) -> list | None:
    """Return the methods of a list with commas, each once, None for None."""
    from manylights.bench import methods

    if text is None:
        return None
    found = [methods.parse(item.strip()) for item in text.split(",")]
    return list({method.spec: method for method in found}.values())


def _compare(options) -> int:
    import json

    import mitsuba as mi

    from manylights import files
    from manylights.bench import compare, metrics
    from manylights.output import channels

    mi.set_variant("scalar_rgb")
    names = [options.first, options.second]
    names += [options.reference] if options.reference else []
    images = [channels.read_colors(name) for name in names]
    for name, image in zip(names, images):
        compare.check_size(image, name, images[0], names[0])
    trim = metrics.TRIM if options.trim is None else options.trim
    target = None
    if options.output:
        target = files.check_output(options.output, "the picture is a PNG file", ".png")
    found, equal = compare.compare(*images, threshold=options.threshold, trim=trim)
    if target is not None:
        compare.write_picture(images[0], images[-1], target)
    print(json.dumps({**found, "equal": equal}) if options.json else compare.as_text(found, equal))
    return 0 if equal else compare.DIFFERENT


def _sample_counts(text: str) -> list[int]:
    try:
        counts = sorted({int(item) for item in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: must be integers with commas between") from None
    if counts[0] < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return counts


def _seeds(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1, the number of seeds")
    return int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def seconds(text: str) -> float:
    value = _number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be seconds above 0")
    return value


def _limit(text: str) -> float:
    value = _number(text)
    if not value >= 0.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number of at least 0")
    return value


def _share(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text}: must be from 0 to below 1")
    return value

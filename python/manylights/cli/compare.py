"""The command ``manylights compare``."""

from __future__ import annotations

import argparse
import json

import mitsuba as mi

from manylights import files
from manylights.bench import compare, metrics
from manylights.cli import options as shared
from manylights.output import channels

HELP = """\
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


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "compare",
        parents=[common],
        help="measure how much two images differ",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("first", metavar="A.exr")
    parser.add_argument("second", metavar="B.exr")
    parser.add_argument("--reference", metavar="R.exr", help="compare both with this image")
    parser.add_argument(
        "--threshold",
        type=_limit,
        help="of the trimmed relative mean squared error (default: 1e-6), with --reference of the "
        "ratio of A's to B's (default: 1.1)",
    )
    parser.add_argument(
        "--trim",
        type=_share,
        default=metrics.TRIM,
        help="share of the worst pixels that the trimmed error leaves out (default: 0.001)",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIFF.png",
        help="picture of the relative difference of A from B or the reference: red is brighter, "
        "blue darker",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=_run)


def _run(options) -> int:
    mi.set_variant("scalar_rgb")
    names = [options.first, options.second]
    names += [options.reference] if options.reference else []
    target = None
    if options.output:
        target = files.check_output(options.output, "the picture is a PNG file", ".png")
        files.check_apart(target, names)
    pictures = [channels.read_colors(name) for name in names]
    for name, picture in zip(names, pictures):
        compare.check_size(picture, name, pictures[0], names[0])
    found, equal = compare.compare(*pictures, threshold=options.threshold, trim=options.trim)
    if target is not None:
        compare.write_picture(pictures[0], pictures[-1], target)
    print(json.dumps({**found, "equal": equal}) if options.json else compare.as_text(found, equal))
    return 0 if equal else compare.DIFFERENT


def _limit(text: str) -> float:
    value = shared.number(text)
    if not value >= 0.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number of at least 0")
    return value


def _share(text: str) -> float:
    value = shared.number(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text}: must be from 0 to below 1")
    return value

"""The command ``manylights merge``."""

from __future__ import annotations

import argparse

import mitsuba as mi

from manylights.cli import options as shared
from manylights.output import images
from manylights.progress import say
from manylights.rendering.merge import merge

HELP = """\
examples:
  manylights merge image.part-*.exr -o image.exr
  manylights merge image.part-*.exr -o preview.exr --partial
  manylights merge seed0.exr seed1.exr -o mean.exr

Adds the parts of a render, and writes its image with a PNG preview beside it. The parts are
those that manylights render --part K/N wrote, checkpoints, or files of earlier mergings. The
image is that of one render without parts, bit for bit, whatever their number, order and
grouping. The scene is not needed.

Parts of another scene, plan, version or variant are refused, and so are parts that come
twice. If parts are missing nothing is written; --partial writes the image of what is there,
which is as bright but noisier. Its file keeps the sums: it can be merged with others again.

Finished images of one scene that differ in the seed are averaged, weighted by their samples.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "merge",
        parents=[common],
        help="add the parts of a render",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="+", metavar="PART.exr", help="in any order")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="image to write")
    parser.add_argument(
        "--partial", action="store_true", help="write what is there, also if parts are missing"
    )
    parser.add_argument(
        "--denoise",
        action="store_true",
        help="add layers denoised.* and show them in the PNG, as manylights render does",
    )
    shared.add_exposure(parser)
    parser.set_defaults(command=_run)


def _run(options) -> None:
    mi.set_variant("scalar_rgb")
    images.check_output(options.output)
    merged = merge(
        options.parts, options.output, options.partial, options.denoise, options.exposure
    )
    for note in merged.notes:
        say(note)
    names = " and ".join(str(path) for path in merged.files)
    missing = f" (missing: {merged.missing})" if merged.missing else ""
    count = f"{len(options.parts)} file{'s' * (len(options.parts) > 1)}"
    say(f"merged {count}, {merged.samples} samples per pixel{missing}, wrote {names}")

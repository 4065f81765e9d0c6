"""The command ``manylights mix``."""

from __future__ import annotations

import argparse
import math

import mitsuba as mi

from manylights.cli import options as shared
from manylights.errors import UsageError
from manylights.loading import ours
from manylights.output import images
from manylights.progress import say
from manylights.rendering.mix import mix

HELP = """\
examples:
  manylights render scene.xml -o image.exr --light-groups 'key=lamp_*,windows=facade'
  manylights mix image.exr key=0.5 windows=2,1.6,1 -o evening.exr
  manylights mix image.exr rest=0 -o alone.exr

Makes lamps brighter, darker or coloured in a finished image, without rendering again. The
image is one that manylights render --light-groups wrote. GROUP=X multiplies the light of a
group by X, GROUP=R,G,B its channels by a number each; 0 switches it off. Groups that are not
named stay as they are; manylights info IMAGE.exr lists them.

All is exact, in single precision: each layer is multiplied, and the image is the sum of the
layers in the order of their names. The output has the layers, too, and can be mixed again.
What belongs to the render alone (variance, emission, a denoised image) is left out.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "mix",
        parents=[common],
        help="make lamps of an image brighter, darker or coloured",
        description=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("image", metavar="IMAGE.exr", help="an image with light groups")
    parser.add_argument(
        "weights", nargs="+", metavar="GROUP=X", help="factor of a group's light, or GROUP=R,G,B"
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="image to write")
    shared.add_exposure(parser)
    parser.set_defaults(command=_run)


def _run(options) -> None:
    mi.set_variant("scalar_rgb")
    images.check_output(options.output)
    texts = ours.parse_assignments(options.weights, "group")
    if len(texts) < len(options.weights):
        raise UsageError("mix: a group is given twice")
    weights = {name: _weight(name, text) for name, text in texts.items()}
    mixed = mix(options.image, weights, options.output, options.exposure)
    for note in mixed.notes:
        say(note)
    say(f"mixed {options.image}, wrote {' and '.join(str(path) for path in mixed.files)}")


def _weight(name: str, text: str) -> float | list[float]:
    numbers = [shared.number(part) for part in text.split(",")]
    if any(math.isnan(number) for number in numbers):
        raise UsageError(f"{name}={text}: must be a number, or three with commas in between")
    return numbers[0] if len(numbers) == 1 else numbers

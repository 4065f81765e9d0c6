"""Options that several commands share, and what their values may be."""

from __future__ import annotations

import argparse
import math

import shtab

from manylights import loading
from manylights.loading import ours
from manylights.loading.parsing import MOST_SUBDIVISION
from manylights.progress import say
from manylights.rendering.parts import MOST_PARTS, Part
from manylights.threads import MOST_THREADS

VARIANT_HELP = "Mitsuba's variant (default: llvm_ad_rgb with libLLVM, else scalar_rgb)"


def add_scene(parser) -> None:
    """Add SCENE and ``-D``; ``defines`` gives that back. How stages are read is ``add_usd``."""
    scene = parser.add_argument("scene", metavar="SCENE", help="XML file or USD stage")
    scene.complete = shtab.FILE
    add_define(parser)


def add_define(parser) -> None:
    """Add ``-D``."""
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value for a <default> parameter of XML scenes, any number of times",
    )


def add_usd(parser) -> None:
    """Add how USD stages are read; ``usd_options`` gives it back."""
    group = parser.add_argument_group("USD stages")
    group.add_argument(
        "--camera", metavar="PATH", help="prim of the camera (default: the stage's choice)"
    )
    group.add_argument(
        "--time", type=time_code, metavar="T", help="time code (default: the stage's start time)"
    )
    group.add_argument(
        "--subdivision",
        type=levels,
        metavar="N",
        help="refine meshes without an authored scheme N times (default: their cages)",
    )
    group.add_argument(
        "--default-light", action="store_true", help="light stages that have no light, evenly"
    )
    group.add_argument(
        "--legacy-lights", action="store_true", help="read lights written before USD 21.05"
    )
    group.add_argument(
        "--blender-light-units", action="store_true", help="read lights as Blender exports them"
    )


def add_scalar_variant(parser) -> None:
    """Add the variant of a command that renders next to nothing."""
    what = "Mitsuba's variant (default: scalar_rgb)"
    parser.add_argument("--variant", default="scalar_rgb", help=what)


def add_machine(parser) -> None:
    """Add what a render is done with: seed, variant, threads."""
    group = parser.add_argument_group("random numbers and machine")
    group.add_argument("--seed", type=seed, default=0, help="0 to 4294967295 (default: 0)")
    group.add_argument("--variant", help=VARIANT_HELP)
    group.add_argument("--threads", type=threads, help="CPU threads of the render (default: all)")


def add_exposure(parser) -> None:
    """Add how bright the PNG is."""
    parser.add_argument(
        "--exposure",
        type=stops,
        default=0.0,
        metavar="EV",
        help="stops by which the PNG is brighter (default: 0)",
    )


def defines(options) -> dict[str, str]:
    """Return the values of ``-D`` by name.

    Raises:
        UsageError: one is not NAME=VALUE.
    """
    return ours.parse_assignments(options.define, "-D")


def usd_options(options) -> loading.UsdOptions:
    """Return how a USD stage is to be read."""
    return loading.UsdOptions(
        time=options.time,
        camera=options.camera,
        subdivision=options.subdivision,
        default_light=options.default_light,
        legacy_lights=options.legacy_lights,
        blender_light_units=options.blender_light_units,
    )


def start(options) -> str:
    """Set the variant asked for, say which it is and why, and return it."""
    variant = loading.set_variant(options.variant)
    if options.variant:
        reason = "as asked for"
    else:
        reason = "libLLVM found" if variant == "llvm_ad_rgb" else "no usable libLLVM found"
    say(f"variant: {variant} ({reason})")
    return variant


# --- Types of values, for argparse ------------------------------------------------------------


def positive(text: str) -> int:
    """An integer of at least 1."""
    return integer(text, 1, None, "an integer of at least 1")


def seed(text: str) -> int:
    """A seed of 32 bits."""
    return integer(text, 0, 2**32 - 1, "an integer from 0 to 4294967295")


def threads(text: str) -> int:
    """A number of threads."""
    return integer(text, 1, MOST_THREADS, f"an integer from 1 to {MOST_THREADS}")


def index(text: str) -> int:
    """A place in a list."""
    return integer(text, 0, None, "an integer of at least 0")


def integer(text: str, least: int, most: int | None, allowed: str) -> int:
    """An integer in a range, which is said in words."""
    try:
        value = int(text)
        if least <= value and (most is None or value <= most):
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text}: must be {allowed}")


def levels(text: str) -> int:
    """A number of refinements: each makes four times as many faces."""
    return integer(text, 0, MOST_SUBDIVISION, f"an integer from 0 to {MOST_SUBDIVISION}")


def time_code(text: str) -> float:
    """Any finite number."""
    value = number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a number")
    return value


def number(text: str) -> float:
    """Any number, NaN for text that is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def share(text: str) -> float:
    """A number above 0."""
    value = number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0, 0.02 is 2 %")
    return value


def stops(text: str) -> float:
    """Factors of two, of both signs."""
    value = number(text)
    if not -64.0 <= value <= 64.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number from -64 to 64")
    return value


def part(text: str) -> Part | None:
    """A part of several: 3/16."""
    numbers = text.split("/")
    if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
        raise argparse.ArgumentTypeError(f"{text}: must be K/N, 3/16 is the third of 16")
    try:
        return Part.of((int(numbers[0]), int(numbers[1])))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text}: must be K/N, 1 <= K <= N <= {MOST_PARTS}"
        ) from error


def duration(text: str) -> float:
    """A time above 0, in seconds, or with its unit: 60, 60s, 10m, 1.5h."""
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    unit = text[-1:] if text[-1:] in units else ""
    value = number(text.removesuffix(unit)) * units.get(unit, 1.0)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be a time above 0, as 60s, 10m or 1h")
    return value


def seconds(text: str) -> float:
    """A time above 0."""
    value = number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be seconds above 0")
    return value

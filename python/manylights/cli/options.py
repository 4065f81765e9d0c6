"""Options that several commands share, and what their values may be."""

from __future__ import annotations

import argparse
import math

from manylights import loading
from manylights.loading import integrators
from manylights.progress import say

VARIANT_HELP = "Mitsuba's variant (default: llvm_ad_rgb with libLLVM, else scalar_rgb)"


def add_scene(parser) -> None:
    """Add SCENE and the options that say how it is read; ``defines`` and others give them back."""
    parser.add_argument("scene", metavar="SCENE", help="XML file or USD stage")
    add_define(parser)
    # Options of USD stages belong here, and into usd_options() below.


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


def add_machine(parser) -> None:
    """Add what a render is done with: seed, variant, threads."""
    parser.add_argument("--seed", type=seed, default=0, help="0 to 4294967295 (default: 0)")
    parser.add_argument("--variant", help=VARIANT_HELP)
    parser.add_argument("--threads", type=positive, help="CPU threads of the render (default: all)")


def defines(options) -> dict[str, str]:
    """Return the values of ``-D`` by name.

    Raises:
        UsageError: one is not NAME=VALUE.
    """
    return integrators.parse_assignments(options.define, "-D")


def usd_options(options) -> loading.UsdOptions:
    """Return how a USD stage is to be read."""
    return loading.UsdOptions()


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
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value


def seed(text: str) -> int:
    """A seed of 32 bits."""
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{text}: must be from 0 to 4294967295")
    return value


def number(text: str) -> float:
    """Any number, NaN for text that is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def seconds(text: str) -> float:
    """A time above 0."""
    value = number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be seconds above 0")
    return value

"""Our integrators and their parameters: what they may be, how users type them, who sets them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from manylights.errors import UsageError, argument, is_integer, shown, typed
from manylights.loading import light_groups
from manylights.output import channels

#: Our plugins: direct light on surfaces, and paths through surfaces and media.
DIRECT, VOLPATH = "manylights_direct", "manylights_volpath"

#: Values of the parameter ``method``, the default first.
METHODS = ("resampled_tree", "talk", "adaptive_splitting", "tree", "exhaustive")


@dataclass(frozen=True)
class Parameter:
    """What a parameter of ours may be, for help and error messages. The plugins check values.

    Attributes:
        allowed: type and range, in words.
        default: of the plugins.
        remark: what else is to be known.
        symbol: in formulas, for charts of parameters that are swept.
    """

    allowed: str
    default: Any
    remark: str = ""
    symbol: str = ""

    def __str__(self) -> str:
        remark = f", {self.remark}" if self.remark else ""
        return f"{self.allowed}, default {value_text(self.default) or 'none'}{remark}"


class Wish(str):
    """A value to set on our integrators, which others do without."""


BOOLEAN = "true or false"
HIDE_EMITTERS = Parameter(BOOLEAN, False)

#: What both plugins accept to steer and to watch the choice of lights.
SAMPLING_PARAMETERS = {
    "splitting_rate": Parameter("float >= 0 or inf", 1.0, symbol="gamma"),
    "reservoirs": Parameter("integer from 1 to 64", 16, symbol="m"),
    "shadow_rays": Parameter("integer from 1 to the number of reservoirs", 16, symbol="s"),
    "method": Parameter(f"{', '.join(METHODS[:-1])} or {METHODS[-1]}", METHODS[0]),
    "split_function": Parameter("near or far", "near", "for method=talk only"),
    "learn_visibility": Parameter("true, false or keep", True, f"for method={METHODS[0]} only"),
    "counts": Parameter(BOOLEAN, False, f"adds channels {', '.join(channels.COUNTS)}"),
    "light_groups": Parameter("text", "", "layers with their light, as key=lamp_*,windows=facade"),
}

#: Channels that describe the surfaces in sight.
AOVS = Parameter(
    "NAME:TYPE between commas with the TYPE albedo, depth, position, uv, geo_normal, sh_normal, "
    "dp_du, dp_dv, duv_dx, duv_dy, prim_index, shape_index or emission",
    "",
)

#: What each plugin accepts.
PARAMETERS = {
    DIRECT: {
        **SAMPLING_PARAMETERS,
        "aovs": AOVS,
        "bsdf_samples": Parameter("integer from 0 to 1024", 1),
        "hide_emitters": HIDE_EMITTERS,
    },
    VOLPATH: {
        "max_depth": Parameter("integer, -1 for no limit", -1),
        "rr_depth": Parameter("integer >= 1", 5),
        **SAMPLING_PARAMETERS,
        "aovs": AOVS,
        "hide_emitters": HIDE_EMITTERS,
    },
}

#: Parameters of Mitsuba's own base classes, accepted too.
BASE_PARAMETERS = ("block_size", "samples_per_pass", "timeout")


def parse_value(text: str) -> bool | int | float | str:
    """Interpret the right-hand side of ``--set name=value``.

    ``true`` and ``false`` give booleans; then integers, floats (``inf`` included) and plain text
    are tried in this order.
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def value_text(value: Any) -> str:
    """Return a value as it is typed after ``--set name=``."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def parse_assignments(items: list[str], option: str) -> dict[str, str]:
    """Turn ``["a=1", "b=2"]`` into a dictionary of texts.

    Raises:
        UsageError: an item has no ``=`` or no name before it; ``option`` is named in the text.
    """
    result = {}
    for item in items:
        name, separator, value = item.partition("=")
        if not separator or not name:
            raise UsageError(f"{option} {item}: write it as NAME=VALUE")
        result[name] = value
    return result


def called(name: str) -> str:
    """Return what the user calls a parameter of the integrator."""
    return argument(name) if name in ("aovs", light_groups.PARAMETER) else as_setting(name)


def as_setting(name: str) -> str:
    """Return how the user sets a parameter of the integrator by itself."""
    return typed(f'integrator["{name}"]', f"--set {name}")


def check_type(name: str, value: Any, parameter: Parameter) -> None:
    """Raise ``UsageError`` for a value of a wrong type; the plugins check the others."""
    kind = type(parameter.default)
    fits = {
        bool: isinstance(value, (bool, np.bool_)),
        int: is_integer(value),
        float: is_integer(value) or isinstance(value, Real),
        str: isinstance(value, str),
    }[kind]
    allowed = parameter.allowed
    word = isinstance(value, str) and value in ("inf", "keep") and value in allowed.split()
    if not fits and not word:
        article = {"integer": "an ", "float": "a "}.get(allowed.split()[0], "")
        raise UsageError(f"{called(name)} {shown(value)}: must be {article}{allowed}")


def with_wish(text: str, value: Any) -> Any:
    """Return a value to set; of a wish for channels what a text with others lacks is added."""
    if not isinstance(value, Wish) or not text:
        return value
    known = [pair.partition(":")[0] for pair in re.split(r"[,\s]+", text)]
    added = [pair for pair in value.split(",") if pair.partition(":")[0] not in known]
    return ",".join([text, *added])


def joined(settings: dict[str, Any], added: dict[str, Any]) -> dict[str, Any]:
    """Return parameters with those that options of their own ask for.

    Raises:
        UsageError: one of them has another value already.
    """
    result = dict(settings)
    for name, value in added.items():
        if name in settings and not isinstance(value, Wish):
            other = as_setting(name)
            raise UsageError(f"{argument(name)}: {other} is the same, give one of them")
        result[name] = with_wish(settings.get(name, ""), value)
    return result

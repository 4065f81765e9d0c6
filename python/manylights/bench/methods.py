"""The methods that are compared, and the integrator of each for a scene.

A method is written ``NAME[:PARAMETER=VALUE]...``, as in ``talk:splitting_rate=4``. ``uniform`` and
``power`` are Mitsuba's own integrators, which choose an emitter with the weights of the scene or in
proportion to its power. The other names are values of the parameter ``method`` of our integrators,
and the parameters are those that these have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from manylights.errors import UsageError, one_line
from manylights.loading import ours
from manylights.output import channels, denoise


@dataclass(frozen=True)
class About:
    """What is told about a method.

    Attributes:
        meaning: for readers of a report.
        color: of its lines, one that colour-blind readers tell apart (Okabe and Ito 2008).
        marker: of its points, as matplotlib names it.
    """

    meaning: str
    color: str
    marker: str


#: All methods, in the order of charts. A new one of ours is added to ``ours.METHODS``, too.
ABOUT = {
    "resampled_tree": About(
        "ours with its default settings: equidistant points descend the tree, and the lights they "
        "find get shadow rays",
        "#D55E00",
        "o",
    ),
    "talk": About(
        "the algorithm of the talk as published: stochastic splitting of a binary tree",
        "#0072B2",
        "s",
    ),
    "adaptive_splitting": About(
        "deterministic splitting: a node is split where it looks large, so neighbouring pixels "
        "can have different cuts of the tree",
        "#009E73",
        "^",
    ),
    "tree": About("one light by a random descent of the tree", "#CC79A7", "D"),
    "exhaustive": About("every light at every point", "#000000", "X"),
    "uniform": About("Mitsuba's own integrator, emitters chosen uniformly", "#56B4E9", "v"),
    "power": About(
        "Mitsuba's own integrator, emitters chosen in proportion to their power", "#E69F00", "P"
    ),
}

#: Names of methods: values of our parameter ``method``, and Mitsuba's integrators.
OURS = ours.METHODS
MITSUBAS = tuple(name for name in ABOUT if name not in OURS)
NAMES = (*MITSUBAS, *OURS)

#: Parameters that sweeps are made of.
SWEPT = {
    name: parameter for name, parameter in ours.SAMPLING_PARAMETERS.items() if parameter.symbol
}

#: More lights would take hours with ``exhaustive``, which evaluates them all at every point.
EXHAUSTIVE_LIGHTS = 10_000

#: Parameters that a method may have: what makes up the method, not what is measured about it.
PARAMETERS = {
    name: parameter
    for name, parameter in ours.SAMPLING_PARAMETERS.items()
    if name not in ("method", "counts")
}


@dataclass(frozen=True)
class Method:
    """A name of ``NAMES`` and parameters of our integrators."""

    name: str
    parameters: dict[str, Any] = field(default_factory=dict)

    @property
    def is_ours(self) -> bool:
        """Is it one of ours, and not Mitsuba's?"""
        return self.name in OURS

    @property
    def spec(self) -> str:
        """The method as text, always the same for the same method."""
        return ":".join(
            [self.name, *(f"{k}={ours.value_text(v)}" for k, v in self.parameters.items())]
        )

    @property
    def key(self) -> str:
        """The method as a part of file names."""
        return self.spec.replace(":", "-").replace("=", "-")


@dataclass(frozen=True)
class Kind:
    """What a scene's integrator computes, whoever chooses the lights.

    Attributes:
        peer: Mitsuba's integrator, ``direct``, ``path``, ``volpath`` or ``volpathmis``.
        parameters: those of ``max_depth``, ``rr_depth`` and ``hide_emitters`` that are set.
    """

    peer: str
    parameters: dict[str, Any] = field(default_factory=dict)

    @property
    def ours(self) -> str:
        """Our integrator for this."""
        return ours.DIRECT if self.peer == "direct" else ours.VOLPATH

    @property
    def max_depth(self) -> int | None:
        """Number of edges of the longest path, 2 for direct light, None without a limit."""
        if self.peer == "direct":
            return 2
        depth = int(self.parameters.get("max_depth", -1))
        return None if depth < 0 else depth


def parse(text: str, option: str = "--methods") -> Method:
    """Interpret ``NAME[:PARAMETER=VALUE]...``.

    Raises:
        UsageError: unknown name or parameter, or a parameter of Mitsuba's own.
    """
    name, *items = text.split(":")
    if name not in NAMES:
        raise UsageError(f"{option} {text}: unknown method {name!r}, choose from {_listed(NAMES)}")
    if items and name in MITSUBAS:
        raise UsageError(f"{option} {text}: {name} is Mitsuba's own and has no parameters here")
    parameters = {}
    for item in items:
        key, separator, value = item.partition("=")
        if not separator or key not in PARAMETERS:
            raise UsageError(
                f"{option} {text}: {item!r} is not PARAMETER=VALUE of {_listed(PARAMETERS)}"
            )
        parameters[key] = _value(key, value)
    return Method(name, parameters)


def check_values(methods: list[Method], option: str = "--methods") -> None:
    """Make each of our methods once, which checks the values of its parameters.

    Raises:
        UsageError: a value is out of range; the text is that of the plugin.
    """
    for method in methods:
        try:
            mi.load_dict(integrator_for(method, Kind("direct")))
        except RuntimeError as error:
            raise UsageError(f"{option} {method.spec}: {one_line(error)}") from error


def kind_of(plugin: str, parameters: dict[str, Any], media: bool) -> Kind:
    """Return what the integrator of a scene computes.

    Paths take media into account if there are some, even where the scene says ``path``, which
    ignores them: ours does not.

    Args:
        plugin: name of the scene's integrator.
        parameters: of that integrator.
        media: does the scene have participating media?

    Raises:
        UsageError: neither direct light nor paths.
    """
    known = ("max_depth", "rr_depth", "hide_emitters")
    kept = {name: parameters[name] for name in known if name in parameters}
    if plugin in ("direct", ours.DIRECT):
        hidden = {name: value for name, value in kept.items() if name == "hide_emitters"}
        return Kind("direct", hidden)
    if plugin == "volpathmis" and media:
        return Kind("volpathmis", kept)
    if plugin in ("path", "volpath", "volpathmis", ours.VOLPATH):
        return Kind("volpath" if media else "path", kept)
    raise UsageError(
        f"integrator {plugin}: can compare direct, path, volpath, volpathmis, "
        f"{ours.DIRECT} and {ours.VOLPATH} only"
    )


def integrator_for(method: Method, kind: Kind) -> dict[str, Any]:
    """Return the dictionary of the integrator for ``mi.load_dict``."""
    if not method.is_ours:
        return {"type": kind.peer, **kind.parameters}
    return {"type": kind.ours, "method": method.name, **method.parameters, **kind.parameters}


def with_guides(integrator: dict[str, Any]) -> dict[str, Any]:
    """Return the dictionary of an integrator that also gives what the denoiser wants to know.

    Ours has the parameter ``aovs``; Mitsuba's are nested in its ``aov``, with paths that end at the
    first surface for the emission in sight.
    """
    if integrator["type"] in ours.PARAMETERS:
        return {**integrator, "aovs": channels.aov_list((denoise.EMISSION, *denoise.GUIDES))}
    peer = "path" if integrator["type"] == "direct" else integrator["type"]
    sight = {**integrator, "type": peer, "max_depth": 1}
    aovs = channels.aov_list(denoise.GUIDES)
    return {"type": "aov", "aovs": aovs, "inner": integrator, denoise.EMISSION: sight}


def _value(name: str, text: str) -> Any:
    value = ours.parse_value(text)
    if isinstance(value, float) and math.isinf(value):
        # As text, which the plugins read, since JSON has no infinity.
        return "inf"
    is_number = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_number and PARAMETERS[name].allowed.startswith("float") else value


def _listed(names) -> str:
    return ", ".join(names)

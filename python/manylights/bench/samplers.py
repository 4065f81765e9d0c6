"""The sampler of each method: ours have one, Mitsuba's integrators the best of Mitsuba's.

A scene in memory has a sensor for each sampler, all alike otherwise. Which of Mitsuba's samplers is
best is measured in each scene: error times time with the largest of a few numbers of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.bench import metrics

#: What our methods are rendered with, and Mitsuba's integrators, the first of them by default.
OURS = "manylights_sobol"
MITSUBAS = ("independent", "multijitter", "orthogonal", "ldsampler")
NAMES = (*MITSUBAS, OURS)

#: Samples per pixel with which Mitsuba's samplers are compared, at most.
COMPARED = 64


def add_sensors(state) -> None:
    """Give a parsed scene one sensor for each sampler, instead of its own ones."""
    sensors = _children(state, state.root.props, mi.ObjectType.Sensor)
    if not sensors:
        return
    # A copy: nodes move when others are appended
    first = mi.Properties(state.nodes[state.root.props[sensors[0]].index()].props)
    for name in sensors:
        del state.root.props[name]
    for sampler in NAMES:
        props = mi.Properties(first)
        for name in _children(state, first, mi.ObjectType.Sampler):
            del props[name]
        props["sampler"] = _append(state, mi.ObjectType.Sampler, mi.Properties(sampler))
        state.root.props[f"sensor_{sampler}"] = _append(state, mi.ObjectType.Sensor, props)


def _children(state, props, kind) -> list[str]:
    """Return the names of the properties that are objects of a kind."""
    return [
        name
        for name, value in props.items()
        if isinstance(value, mi.Properties.ResolvedReference)
        and state.nodes[value.index()].type == kind
    ]


def _append(state, kind, props) -> mi.Properties.ResolvedReference:
    node = mi.parser.SceneNode()
    node.type, node.props = kind, props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def with_sensors(description: dict[str, Any]) -> dict[str, Any]:
    """Return the dictionary of a scene with one sensor for each sampler instead of its only one."""
    rest = {name: value for name, value in description.items() if name != "sensor"}
    for sampler in NAMES:
        rest[f"sensor_{sampler}"] = {**description["sensor"], "sampler": {"type": sampler}}
    return rest


def allowed(sampler, spp: int) -> int:
    """Return the largest number of samples, at most ``spp``, that a sampler does not round.

    It is 1 if there is none.
    """
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        for count in range(spp, 0, -1):
            sampler.set_sample_count(count)
            if sampler.sample_count() == count:
                return count
    finally:
        mi.set_log_level(level)
    return 1


def choose(sensors: dict[str, Any], spps: list[int], draw: Callable[[str, int, int], Any]) -> str:
    """Return the best of Mitsuba's samplers that take all numbers of samples but 1 unrounded.

    Args:
        sensors: one for each sampler.
        spps: numbers of samples that are measured.
        draw: renders with a sampler, a number of samples, and seed 0 or 1; returns a ``Drawing``.
    """
    apt = [
        name
        for name in MITSUBAS
        if all(allowed(sensors[name].sampler(), spp) == spp for spp in spps if spp > 1)
    ]
    few = [spp for spp in spps if 1 < spp <= COMPARED]
    if not few:
        return MITSUBAS[0]
    costs = {}
    for name in apt:
        draw(name, max(few), 0)  # compiles
        pair = [draw(name, max(few), number) for number in (0, 1)]
        mean = np.mean([drawing.image for drawing in pair], axis=0)
        errors = metrics.relative_errors(pair[0].image, pair[1].image) if mean.any() else mean
        costs[name] = metrics.trimmed_mean(errors) * min(drawing.seconds for drawing in pair)
    return min(costs, key=lambda name: costs[name])

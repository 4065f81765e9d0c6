"""Decides which series are shown together: lines of a chart, sweeps, families of scenes."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from manylights.bench.methods import SWEPT
from manylights.bench.records import Results, Scene, Series
from manylights.loading.ours import value_text
from manylights.report.statistics import cost, gain

#: A sweep with fewer values is no curve.
MIN_SWEEP = 3


def label(series: Series, without: str = "") -> str:
    """Name a series for people, leaving out the parameter ``without``."""
    name = f"{series.method} (ours)" if series.ours else series.method
    if series.mitsubas:
        name = f"{series.method} (Mitsuba)"
    settings = [f"{key} {value_text(value)}" for key, value in series.parameters.items()]
    return ", ".join([name] + [text for text in settings if text.split()[0] != without])


def ours(scene: Scene) -> Series | None:
    """The series that all peers are compared with: our method with the fewest parameters set."""
    candidates = [series for series in scene.series if series.ours]
    return min(candidates, key=lambda series: len(series.parameters), default=None)


def best(candidates: list[Series], scene: Scene) -> Series:
    """The series with the lowest error after the same time as ours, if there is one."""
    reference = ours(scene)

    def price(series: Series) -> float:
        if reference is None:
            return cost(series, scene).value
        return gain(series, reference, scene).value

    return min(candidates, key=price)


def one_a_method(scene: Scene) -> list[Series]:
    """Ours as it comes, and each peer with its best setting."""
    methods = defaultdict(list)
    for series in scene.series:
        methods[series.method].append(series)
    chosen = [best(group, scene) for group in methods.values() if not group[0].ours]
    return [series for series in [ours(scene)] if series] + chosen


def as_they_come(scene: Scene) -> list[Series]:
    """Each method with the fewest parameters set: the same setting in all scenes of a family."""
    methods: dict[str, Series] = {}
    for series in sorted(scene.series, key=lambda series: len(series.parameters)):
        methods.setdefault(series.method, series)
    return list(methods.values())


def shown(scene: Scene) -> list[Series]:
    """Series for the charts of one scene: of a sweep just the default, and a peer's best."""
    groups = defaultdict(list)
    for series in scene.series:
        groups[_without(series, tuple(SWEPT))].append(series)
    keep = one_a_method(scene)
    for group in groups.values():
        if not group[0].ours:
            keep += [series for series in group if not set(series.parameters) & set(SWEPT)]
    # A peer's best may be its default under another name: the longer name is left out.
    distinct = {}
    for series in sorted(keep, key=lambda series: len(series.parameters)):
        distinct.setdefault(_without(series, ()), series)
    order = list(dict.fromkeys(series.method for series in keep))
    return sorted(distinct.values(), key=lambda series: order.index(series.method))


def peers(scene: Scene) -> list[Series]:
    """All series of other methods, sweeps included."""
    return [series for series in scene.series if not series.ours]


def sweeps(scene: Scene, parameter: str) -> list[list[tuple[Any, Series]]]:
    """Series that differ in ``parameter`` only, as lists of (value, series) with rising values."""
    groups = defaultdict(dict)
    # A series that names the default comes later and replaces the one that does not.
    for series in sorted(scene.series, key=lambda series: len(series.parameters)):
        if not series.mitsubas:
            value = series.parameters.get(parameter, SWEPT[parameter].default)
            groups[_without(series, (parameter,))][float(value)] = (value, series)
    long = [group for group in groups.values() if len(group) >= MIN_SWEEP]
    return [[group[value] for value in sorted(group)] for group in long]


def families(results: Results) -> dict[str, list[Scene]]:
    """Scenes that differ in the number of lights only, by that number."""
    groups = defaultdict(list)
    for scene in results.scenes:
        if scene.family:
            groups[scene.family].append(scene)
    return {
        family: sorted(scenes, key=lambda scene: scene.lights)
        for family, scenes in groups.items()
        if len({scene.lights for scene in scenes}) > 1
    }


def _without(series: Series, names: tuple[str, ...]) -> tuple:
    """What identifies a series apart from the parameters ``names``, and from defaults."""
    left = {
        key: str(value)
        for key, value in series.parameters.items()
        if key not in names and not (key in SWEPT and value == SWEPT[key].default)
    }
    return (series.method, *sorted(left.items()))

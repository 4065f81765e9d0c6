"""Rows of the tables: efficiency, where it does not win, bias, build times."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from manylights.bench.records import Results, Scene, Series
from manylights.report import grouping
from manylights.report.statistics import (
    Interval,
    bias,
    gain,
    is_limited,
    last_clear_point,
    nanoseconds_per_sample,
)


@dataclass(frozen=True)
class Efficiency:
    """Error of a peer over ours after the same time; ``untrimmed`` is the same with all pixels."""

    scene: Scene
    peer: str
    method: str
    trimmed: Interval
    untrimmed: Interval
    limited: str

    @property
    def verdict(self) -> str:
        """Who is better, or level if the interval holds 1 or there is none."""
        if self.trimmed.known and self.trimmed.low > 1:
            return "ours"
        return "peer" if self.trimmed.known and self.trimmed.high < 1 else "level"

    @property
    def lost(self) -> bool:
        return self.trimmed.value < 1 or self.untrimmed.value < 1


@dataclass(frozen=True)
class Summary:
    """Efficiency over one peer's best settings in all scenes."""

    method: str
    scenes: int
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Bias:
    """Difference of the mean of all pixels from the reference's, relative to that."""

    scene: Scene
    label: str
    spp: int
    seeds: int
    mean: float
    difference: Interval

    @property
    def holds_zero(self) -> bool | None:
        if not self.difference.known:
            return None
        return self.difference.low <= 0 <= self.difference.high


@dataclass(frozen=True)
class Times:
    """Seconds of a series; ``busy`` is CPU time over wall-clock time of the longest renders."""

    scene: Scene
    label: str
    build: float
    first: float
    sample: Interval
    busy: float


def efficiencies(results: Results, every: bool = False) -> list[Efficiency]:
    """Compare ours with the peers of each scene: those in charts, or ``every`` one measured."""
    rows = []
    for scene in results.scenes:
        ours = grouping.ours(scene)
        chosen = grouping.peers(scene)
        if not every:
            shown = grouping.shown(scene)
            chosen = [series for series in chosen if series in shown]
        if ours:
            rows += [_efficiency(scene, peer, ours) for peer in chosen]
    return rows


def _efficiency(scene: Scene, peer: Series, ours: Series) -> Efficiency:
    limited = [
        name
        for name, series in (("ours", ours), ("peer", peer))
        if is_limited(last_clear_point(series, scene), scene)
    ]
    ratios = [gain(peer, ours, scene, metric) for metric in ("error_trimmed", "error")]
    return Efficiency(scene, grouping.label(peer), peer.method, *ratios, " and ".join(limited))


def summaries(results: Results) -> list[Summary]:
    """Efficiency over each method, its best setting in each scene."""
    ratios: dict[str, list[float]] = {}
    for scene in results.scenes:
        ours = grouping.ours(scene)
        for peer in grouping.one_a_method(scene):
            if ours and not peer.ours:
                ratios.setdefault(peer.method, []).append(gain(peer, ours, scene).value)
    return [
        Summary(method, len(values), statistics.median(values), min(values), max(values))
        for method, values in ratios.items()
    ]


def biases(results: Results) -> list[Bias]:
    """Bias of each series that is in the charts, from its longest renders."""
    rows = []
    for scene in results.scenes:
        for series in grouping.shown(scene):
            point = series.points[-1]
            mean, seeds = float(point.mean.mean()), len(point.mean)
            label = grouping.label(series)
            rows.append(Bias(scene, label, point.spp, seeds, mean, bias(series, scene)))
    return rows


def times(results: Results) -> list[Times]:
    """Times of each series that is in the charts."""
    rows = []
    for scene in results.scenes:
        for series in grouping.shown(scene):
            point = series.points[-1]
            busy = point.cpu_seconds.sum() / (point.seconds.sum() or math.nan)
            sample = nanoseconds_per_sample(point, scene)
            label = grouping.label(series)
            build, first = series.build_seconds, series.first_seconds
            rows.append(Times(scene, label, build, first, sample, float(busy)))
    return rows

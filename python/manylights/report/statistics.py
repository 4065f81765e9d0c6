"""Means over seeds, their 95 % intervals, ratios, bias, and the time that an error takes.

Errors and times are positive and compared by factors, so their intervals are made for the
logarithm of the mean: its standard error is that of the mean divided by the mean (delta method),
and the interval uses Student's t distribution. Ratios add the variances of both logarithms, with
Welch's degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from manylights.bench.calibration import LEAST_SLOPE
from manylights.bench.records import Point, Scene, Series

#: Two-sided level of all intervals.
LEVEL = 0.95

#: The measured error contains the reference's own. Below this multiple of it, it is not
#: "clearly above": more than a tenth of it may be the reference's.
CLEARLY_ABOVE = 10.0

#: How far beyond its measurements a series is continued, with error times time constant.
MAX_EXTRAPOLATION = 10.0


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its interval, which are nan if there is only one seed."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def known(self) -> bool:
        return not math.isnan(self.low)


@dataclass(frozen=True)
class SampleMean:
    """An estimated mean (or its logarithm), its variance, and the degrees of freedom of that."""

    value: float
    variance: float
    freedom: float

    def __add__(self, other: SampleMean) -> SampleMean:
        """The sum of two independent estimates, after Welch and Satterthwaite."""
        total = self.variance + other.variance
        parts = self.variance**2 / self.freedom + other.variance**2 / other.freedom
        freedom = total**2 / parts if parts > 0 else math.inf
        return SampleMean(self.value + other.value, total, freedom)

    def __sub__(self, other: SampleMean) -> SampleMean:
        return self + other.scaled(-1)

    def scaled(self, factor: float) -> SampleMean:
        return SampleMean(factor * self.value, factor**2 * self.variance, self.freedom)

    def interval(self) -> Interval:
        quantile = float(stdtrit(min(self.freedom, 1e9), (1 + LEVEL) / 2))
        half = quantile * math.sqrt(self.variance)
        return Interval(self.value, self.value - half, self.value + half)

    def exp_interval(self) -> Interval:
        inner = self.interval()
        return Interval(math.exp(inner.value), math.exp(inner.low), math.exp(inner.high))


def mean_of(values: np.ndarray) -> SampleMean:
    """SampleMean the mean of independent values."""
    count = len(values)
    if count == 1:
        return SampleMean(float(values[0]), math.nan, 1)
    return SampleMean(float(values.mean()), float(values.var(ddof=1)) / count, count - 1)


def log_mean_of(values: np.ndarray) -> SampleMean:
    """SampleMean the logarithm of the mean of independent positive values."""
    mean = mean_of(values)
    return SampleMean(math.log(mean.value), mean.variance / mean.value**2, mean.freedom)


def error_interval(point: Point) -> Interval:
    """The trimmed error of a point, the one that charts show."""
    return log_mean_of(point.error_trimmed).exp_interval()


def is_limited(point: Point, scene: Scene) -> bool:
    """Whether much of the error of a point may be the reference's own."""
    return point.error_trimmed.mean() < CLEARLY_ABOVE * scene.reference["error"]


def clear_points(series: Series, scene: Scene) -> list[Point]:
    """The renderings not limited by the reference, the shortest first."""
    return [point for point in series.points if not is_limited(point, scene)]


def last_clear_point(series: Series, scene: Scene) -> Point:
    """The longest rendering not limited by the reference; if all are, the shortest."""
    return (clear_points(series, scene) or series.points[:1])[-1]


def cost(series: Series, scene: Scene, metric: str = "error_trimmed") -> SampleMean:
    """The logarithm of error times time, without what does not grow with the samples.

    It is the error after one second if that falls as 1 / time.
    """
    return _point_cost(last_clear_point(series, scene), series, metric)


def gain(peer: Series, ours: Series, scene: Scene, metric: str = "error_trimmed") -> Interval:
    """Error of ``peer`` divided by that of ``ours`` after the same time: above 1, ours is better.

    The time is that of the longest renderings of ours, without what does not grow with the samples.
    The error of a peer is a power of the time between its measurements and falls as 1 / time
    outside of them.
    """
    time = math.exp(sample_seconds(ours).value) * last_clear_point(ours, scene).spp
    return (_cost_at(time, peer, scene, metric) - cost(ours, scene, metric)).exp_interval()


def _seconds(point: Point) -> float:
    return float(point.seconds.mean())


def sample_seconds(series: Series) -> SampleMean:
    """The logarithm of the seconds of one more sample per pixel.

    It is the slope between the two longest renderings, so that what they take before their first
    sample does not count. Noise must not make samples free: a tenth of the mean is the least.
    """
    whole = log_mean_of(series.points[-1].seconds / series.points[-1].spp)
    if len(series.points) == 1:
        return whole
    slope, mean = _slope(series), math.exp(whole.value)
    value = min(max(slope.value, LEAST_SLOPE * mean), mean)
    return SampleMean(math.log(value), slope.variance / value**2, slope.freedom)


def sample_nanoseconds(series: Series, scene: Scene) -> Interval:
    """The same for one sample of one pixel."""
    seconds = sample_seconds(series).exp_interval()
    ends = (seconds.value, seconds.low, seconds.high)
    return Interval(*(1e9 * end / scene.pixels for end in ends))


def is_mostly_preparation(series: Series) -> bool:
    """Whether the renderings are too short to tell what one more sample takes."""
    last = series.points[-1]
    mean = _seconds(last) / last.spp
    return len(series.points) > 1 and _slope(series).value < LEAST_SLOPE * mean


def _slope(series: Series) -> SampleMean:
    """Seconds per sample between the two longest renderings."""
    before, last = series.points[-2:]
    count = min(len(before.seconds), len(last.seconds))
    return mean_of((last.seconds[:count] - before.seconds[:count]) / (last.spp - before.spp))


def _point_cost(point: Point, series: Series, metric: str) -> SampleMean:
    error = log_mean_of(getattr(point, metric))
    return error + sample_seconds(series) + SampleMean(math.log(point.spp), 0.0, math.inf)


def _cost_at(time: float, series: Series, scene: Scene, metric: str) -> SampleMean:
    """The logarithm of error times time; that of the error is linear in it: see :func:`gain`."""
    points = clear_points(series, scene) or series.points[:1]
    seconds = sample_seconds(series)
    times = [math.exp(seconds.value) * point.spp for point in points]
    if not times[0] < time < times[-1]:
        return _point_cost(points[0 if time <= times[0] else -1], series, metric)
    first = int(np.searchsorted(times, time)) - 1
    place = math.log(time / times[first]) / math.log(times[first + 1] / times[first])
    before, after = (log_mean_of(getattr(point, metric)) for point in points[first : first + 2])
    error = before.scaled(1 - place) + after.scaled(place)
    # The slope's own error moves the place between the two points
    return error + SampleMean(math.log(time), seconds.variance, seconds.freedom)


def bias(series: Series, scene: Scene) -> Interval:
    """Mean of all pixels relative to the reference's, minus 1, with the errors of both."""
    reference = scene.reference
    truth = SampleMean(reference["mean"], reference["mean_error"] ** 2, math.inf)
    difference = (mean_of(series.points[-1].mean) - truth).interval()
    scale = reference["mean"] or math.nan
    return Interval(*(end / scale for end in (difference.value, difference.low, difference.high)))


def nanoseconds_per_sample(point: Point, scene: Scene) -> Interval:
    """Time of a render divided by its samples in all pixels."""
    seconds = log_mean_of(point.seconds / (point.spp * scene.pixels)).exp_interval()
    return Interval(1e9 * seconds.value, 1e9 * seconds.low, 1e9 * seconds.high)


@dataclass(frozen=True)
class Reach:
    """Seconds until an error is reached; ``measured`` is false beyond the measurements."""

    seconds: Interval
    measured: bool


def time_to_reach(target: float, series: Series, scene: Scene) -> Reach | None:
    """Find when a series reaches the error ``target``; None if far from what was measured."""
    points = clear_points(series, scene)
    if not points:
        return None
    times = np.array([_seconds(point) for point in points])
    errors = [error_interval(point) for point in points]
    value, measured = _crossing(times, np.array([error.value for error in errors]), target)
    if value is None:
        return None
    ends = [
        _crossing(times, np.array([getattr(error, end) for error in errors]), target)[0]
        for end in ("low", "high")
    ]
    return Reach(Interval(value, *(math.nan if end is None else end for end in ends)), measured)


def _crossing(times, errors, target: float) -> tuple[float | None, bool]:
    """Return when ``errors`` first reach ``target``, and if that is between two measurements."""
    if np.isnan(errors).any():
        return None, False
    reached = np.flatnonzero(errors <= target)
    if len(reached) and reached[0] > 0:
        pair = slice(reached[0] - 1, reached[0] + 1)
        # np.interp wants rising positions: the logarithms of falling errors are negated.
        time = np.interp(-math.log(target), -np.log(errors[pair]), np.log(times[pair]))
        return math.exp(time), True
    end = 0 if len(reached) else -1
    factor = errors[end] / target
    exact = errors[end] == target
    if not 1 / MAX_EXTRAPOLATION <= factor <= MAX_EXTRAPOLATION:
        return None, False
    return float(times[end] * factor), bool(exact)

"""Finds out how long a method takes, and how many samples fit into a time.

Every kind of render is done once before it counts: Mitsuba compiles a kernel for powers of two of
samples and another one for all other numbers. Noise of the machine only ever makes a render slower,
so the shorter of two times is used where it matters.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

#: The render time of one sample, in budgets, from which on a method is not measured.
PATIENCE = 20.0

#: Renders of more samples than this are long enough to be measured once.
FEW_SAMPLES = 4

#: The render time of the second number of samples, in budgets, up to which it is measured.
SECOND = 4.0

#: An equal-time rendering is made if one sample takes at most so many times the time.
TOLERANCE = 1.5

#: One more sample takes at least this share of a render's mean time: noise must not make it free.
LEAST_SLOPE = 0.1

#: From the number of samples to the seconds of a render.
Measure = Callable[[int], float]


def steady_seconds(measure: Measure, spp: int) -> float:
    """Return the render time of ``spp`` samples, without compilation."""
    seconds = measure(spp)
    return min(seconds, measure(spp)) if spp <= FEW_SAMPLES else seconds


def ladder(measure: Measure, budget: float, largest: int | None = None) -> dict[int, float]:  # pyright: ignore[reportReturnType]
    """Measure 1, 4, 16, ... samples as long as a render takes at most ``budget`` seconds.

    One sample is always measured, and four if they take at most ``SECOND`` budgets: one number
    of samples says nothing about how the error falls.

    Args:
        measure: renders once.
        budget: seconds.
        largest: number of samples, at most. Default: no limit.

    Returns:
        The seconds for each number of samples.
    """
    times = {1: steady_seconds(measure, 1)}
    for power in itertools.count(1):
        spp = 4**power
        limit = budget * (SECOND if power == 1 else 1.0)
        too_many = largest is not None and spp > largest
        if too_many or _lower_bound(times, spp) > limit:
            return times
        seconds = steady_seconds(measure, spp)
        if seconds > limit:
            seconds = min(seconds, measure(spp))
        if seconds > limit:
            return times
        times[spp] = seconds


def samples_in(times: dict[int, float], seconds: float) -> int:
    """Return how many samples take that many seconds, at least 1.

    Args:
        times: measured seconds for numbers of samples.
        seconds: what to fill.
    """
    intercept, slope = _line(times)
    return max(1, round((seconds - intercept) / slope))


def predict(times: dict[int, float], spp: int) -> float:
    """Return the seconds that ``spp`` samples are expected to take."""
    if spp in times:
        return times[spp]
    intercept, slope = _line(times)
    return intercept + slope * spp


def _lower_bound(times: dict[int, float], spp: int) -> float:
    """Return seconds that ``spp`` samples take at least, up to noise.

    After one measurement it is unknown how much of it was preparation, which does not grow.
    """
    return predict(times, spp) if len(times) > 1 else max(times.values())


def _line(times: dict[int, float]) -> tuple[float, float]:
    """Return intercept and slope through the two largest numbers of samples."""
    points = sorted(times.items())[-2:]
    if len(points) == 1:
        ((spp, seconds),) = points
        return 0.0, seconds / spp
    (few, low), (many, high) = points
    slope = max((high - low) / (many - few), LEAST_SLOPE * high / many)
    return max(high - slope * many, 0.0), slope

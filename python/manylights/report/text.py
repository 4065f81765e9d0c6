"""Numbers as text, the same on the page and in the README."""

from __future__ import annotations

from typing import Any

import numpy as np

from manylights.report.statistics import Interval


def number(value: Any) -> str:
    """Write a number with three digits, without needless zeros in the exponent."""
    if value is None or not np.isfinite(value):
        return "n/a"
    text = f"{value:,.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("e-0", "e-").replace("e+0", "e")


def ratio(interval: Interval) -> str:
    """Write a ratio with its interval."""
    if not interval.known:
        return f"{number(interval.value)} (one seed)"
    return f"{number(interval.value)} ({number(interval.low)} to {number(interval.high)})"


def percent(value: float) -> str:
    """Write a difference as a percentage with its sign."""
    sign = "-" if value < 0 else "+"
    return "n/a" if not np.isfinite(value) else f"{sign}{number(abs(100 * value))} %"

"""What passes add up to, exactly, whatever their order and grouping."""

from __future__ import annotations

import numpy as np

#: How many numbers in single precision stand for one sum: 72 bits.
PARTS = 3

#: Numbers that are added at a time: what is computed with them stays in the cache.
CHUNK = 1 << 13


class Sums:
    """Sums of the film's channels, each number kept as three in single precision.

    The first is the sum rounded to single precision, the second what that left over, the third what
    is left of this. As long as the values of a channel of a pixel, and their sum, are within a
    factor of 2^48 (3e14) of each other, or zero, all 72 bits of the sum are there: the same passes
    give the same bits in any order and any grouping, and so do files that keep the three numbers.
    Beyond, the smallest bits are rounded away. A sum that is infinite or not a number stays so; one
    that exceeds single precision becomes infinite, when depends on the order.

    Attributes:
        parts: shape (3, height, width, channels); None if nothing was added.
    """

    def __init__(self, parts: np.ndarray | None = None) -> None:
        self.parts = parts

    @property
    def rounded(self) -> np.ndarray:
        """The sums in single precision, shape (height, width, channels)."""
        return self.parts[0]

    def add(self, *raws: np.ndarray) -> None:
        """Add the raw films of passes, shape (height, width, channels), single precision."""
        films = [np.ascontiguousarray(raw, np.float32) for raw in raws]
        if self.parts is None:
            self.parts = np.zeros((PARTS, *films[0].shape), np.float32)
        flat = self.parts.reshape(PARTS, -1)
        values = [raw.reshape(-1) for raw in films]
        # Channels may be infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            for begin in range(0, flat.shape[1], CHUNK):
                part = slice(begin, begin + CHUNK)
                flat[:, part] = _added(flat[:, part], [value[part] for value in values])

    def merge(self, *others: Sums) -> None:
        """Add other sums."""
        parts = [part for other in others if other.parts is not None for part in other.parts]
        if parts:
            self.add(*parts)


def _added(parts: np.ndarray, raws: list[np.ndarray]) -> np.ndarray:
    """Return the three parts of the sums of three parts and of further numbers.

    Two numbers in double precision hold the sum on the way, more than three in single precision.
    """
    first, second, third = parts.astype(np.float64)
    high, low = _fast_two_sum(first, second)
    high, low = _fast_two_sum(high, low + third)
    for raw in raws:
        high, rest = _two_sum(high, raw.astype(np.float64))
        high, low = _fast_two_sum(high, low + rest)
    result = np.empty(parts.shape, np.float32)
    for index in range(PARTS):
        result[index] = high
        # Exact: what the rounding left over, and what was too small for it.
        high, low = _fast_two_sum(high - result[index], low)
    if not np.isfinite(result[0]).all():
        plain = np.sum([parts[0], *raws], axis=0, dtype=np.float32)
        broken = ~np.isfinite(result[0])
        result[0] = np.where(broken, plain, result[0])
        result[1:] = np.where(broken, 0.0, result[1:])
    return result


def _two_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rounded sum of two numbers, and what the rounding left over (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _fast_two_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Do the same where ``a`` is zero or not smaller than ``b`` (Dekker)."""
    total = a + b
    return total, b - (total - a)

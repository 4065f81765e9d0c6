"""What passes add up to, exact to 48 bits."""

from __future__ import annotations

import numpy as np


class Sums:
    """The film's sums over passes, each number kept as two in single precision.

    Together they have 48 bits, so that long renders lose nothing, and files can hold them as they
    are: a render that goes on from a file computes with the same bits as one that never stopped.

    Attributes:
        passes: how many were added.
        high: the sums, rounded to single precision; shape (height, width, channels).
        low: what the rounding left over.
    """

    def __init__(self, passes: int = 0, high=0.0, low=0.0) -> None:
        self.passes, self.high, self.low = passes, high, low

    def add(self, raw: np.ndarray) -> None:
        """Add the raw film of a pass."""
        # Channels may be infinite; nothing is left over of those.
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.low + raw.astype(np.float64) + self.high
            self.high = total.astype(np.float32)
            rest = total - self.high
            self.low = np.where(np.isfinite(rest), rest, 0.0).astype(np.float32)
        self.passes += 1

"""What a render has so far."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from manylights.rendering.develop import Spread, spread
from manylights.rendering.plan import Step
from manylights.rendering.sums import Sums
from manylights.rendering.targets import History


@dataclass
class State:
    """The sums of all steps, and what the next ones depend on.

    Attributes:
        sums: of each independent sequence.
        history: samples, noises and seconds so far.
        channels: names of the film's channels, empty before the first step.
        learnt: counts of what was learnt, integers (``Driver.learnt``).
        processors: names of those that it was rendered on.
    """

    sums: list[Sums]
    history: History
    channels: list[str] = field(default_factory=list)
    learnt: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint32))
    processors: list[str] = field(default_factory=list)

    @staticmethod
    def empty(sequences: int) -> State:
        """Return the state before the first step."""
        return State([Sums() for _ in range(sequences)], History([0] * sequences))

    def end_round(self, adjoint: bool) -> None:
        """Add the noise of a round that is complete to the history."""
        spread = self.spread(adjoint)
        self.history.noises.append(spread.noise if spread else float("nan"))

    def add(self, step: Step, raw: np.ndarray, seconds: float) -> None:
        """Add the film's sums of a step that took so long."""
        self.sums[step.scramble].add(raw)
        self.history.add(step, seconds)

    def spread(self, adjoint: bool) -> Spread | None:
        """Return the noise of the mean of all, None if it is not known."""
        parts = [(sums, spp) for sums, spp in zip(self.sums, self.history.samples) if spp]
        return spread(parts, self.channels, adjoint)

    def total(self, adjoint: bool) -> np.ndarray:
        """Return the film's sums of all steps in single precision, rounded once."""
        total = self.sums[0]
        if len(self.sums) > 1:
            total = Sums()
            total.merge(*self.sums)
        spp = np.float32(max(self.history.spp, 1))
        return total.rounded / spp if adjoint else total.rounded

    def rough_total(self, adjoint: bool) -> np.ndarray:
        """Return the same in a hurry, for pictures on the way."""
        total = sum(sums.rounded for sums in self.sums if sums.parts is not None)
        return total / np.float32(max(self.history.spp, 1)) if adjoint else total

"""Which steps nobody has yet, and how many of them a worker gets at a time. Numbers only."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from manylights.rendering.plan import Step

#: Seconds that a run takes, as far as is known: long enough that sending a film costs little,
#: short enough that little is lost with a worker.
RUN_SECONDS = 30.0

#: A step that so many workers did not survive is the reason.
MOST_LOSSES = 3


@dataclass
class Share:
    """Consecutive steps that one worker renders.

    Attributes:
        steps: with their numbers.
    """

    steps: list[tuple[int, Step]] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        """The numbers of the steps, from 0."""
        return [number for number, _ in self.steps]

    @property
    def spp(self) -> int:
        """Samples per pixel of all steps."""
        return sum(step.spp for _, step in self.steps)

    def words(self) -> str:
        """Return the steps for people, counted from 1."""
        first, last = self.numbers[0] + 1, self.numbers[-1] + 1
        return f"step {first}" if first == last else f"steps {first} to {last}"


class Shares:
    """The steps that are still to be given out.

    Args:
        steps: with their numbers.
    """

    def __init__(self, steps: Iterable[tuple[int, Step]]) -> None:
        self.steps = dict(steps)
        self.open = sorted(self.steps)
        self.losses: Counter[int] = Counter()

    def __len__(self) -> int:
        return len(self.open)

    def take(self, pace: float | None, workers: int) -> Share:
        """Return the next steps for a worker.

        At the end all workers should stop at once, so nobody gets more than a half of an even share
        of what is left. A step that a worker did not survive is a run of its own.

        Args:
            pace: seconds that a step takes, None if the worker has not rendered one yet.
            workers: how many there are.
        """
        even = len(self.open) // (2 * max(workers, 1))
        most = 1 if pace is None else max(min(int(RUN_SECONDS / max(pace, 1e-3)), even), 1)
        numbers = [heapq.heappop(self.open)]
        while self.open and len(numbers) < most and self._follows(numbers[-1]):
            numbers.append(heapq.heappop(self.open))
        return Share([(number, self.steps[number]) for number in numbers])

    def give_back(self, share: Share) -> None:
        """Take back what was not rendered."""
        for number in share.numbers:
            heapq.heappush(self.open, number)

    def lose(self, share: Share) -> bool:
        """Take back what a worker did not survive; return whether it is the reason."""
        self.give_back(share)
        self.losses.update(share.numbers)
        return any(self.losses[number] >= MOST_LOSSES for number in share.numbers)

    def _follows(self, number: int) -> bool:
        following = self.open[0]
        return following == number + 1 and not self.losses[number] and not self.losses[following]

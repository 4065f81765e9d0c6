"""Parts of a render: which steps each of several machines has. Numbers only, no Mitsuba.

Part 3 of 16 has the steps 2, 18, 34 ... of the same plan that one machine would follow. How many
parts there are is a matter of who renders, and not of the image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from manylights.errors import check, is_integer

#: Digits of the numbers in the names of files, at least: sorted by name they are in their order.
DIGITS = 2

#: There may be so many parts.
MOST_PARTS = 2**20


@dataclass(frozen=True)
class Part:
    """One of several shares of a render.

    Attributes:
        number: from 1.
        count: of all parts.
        command: what renders it, without the part: words of a command line, for messages.
    """

    number: int = 1
    count: int = 1
    command: tuple[str, ...] = field(default=(), compare=False)

    @staticmethod
    def of(value: Part | tuple[int, int] | None) -> Part | None:
        """Check a part that somebody asked for; None is none.

        Raises:
            UsageError: not two integers, 1 <= number <= count.
        """
        if value is None or isinstance(value, Part):
            return value
        pair = isinstance(value, (tuple, list)) and len(value) == 2 and all(map(is_integer, value))
        fits = pair and 1 <= value[0] <= value[1] <= MOST_PARTS
        what = f"two integers, 1 <= K <= N <= {MOST_PARTS}, (3, 16) is the third of 16"
        check("part", value, fits, what)
        return Part(*map(int, value))

    def step(self, done: int) -> int:
        """Return the index of the step after so many of this part."""
        return self.number - 1 + done * self.count

    def steps(self, total: int) -> int:
        """Return how many of the steps of a render this part has."""
        return len(range(self.number - 1, total, self.count))

    def name(self) -> str:
        """Return what is added to the name of a file: ``part-03-of-16``."""
        digits = max(len(str(self.count)), DIGITS)
        return f"part-{self.number:0{digits}}-of-{self.count:0{digits}}"

    def words(self) -> str:
        """Return "part 3 of 16"."""
        return f"part {self.number} of {self.count}"

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


#: The only part of a render without parts.
WHOLE = Part()


@dataclass(frozen=True)
class Run:
    """The first steps of a part: what its file has so far.

    Attributes:
        part: whose.
        done: how many steps.
    """

    part: Part
    done: int

    def words(self, total: int) -> str:
        """Return which steps these are, for people."""
        steps = self.part.steps(total)
        return self.part.words() + (
            "" if self.done == steps else f" ({self.done} of its {steps} steps)"
        )


def steps_of(runs: Iterable[Run], total: int) -> np.ndarray:
    """Return how often each of all steps is in some runs, shape (total,)."""
    times = np.zeros(total, np.uint32)
    for run in runs:
        first, stride = run.part.step(0), run.part.count
        times[first : first + run.done * stride : stride] += 1
    return times


@dataclass(frozen=True)
class Gaps:
    """What some runs lack of all steps.

    Attributes:
        parts: that have none of their steps.
        unfinished: runs that have some.
    """

    parts: list[Part]
    unfinished: list[Run]

    def __bool__(self) -> bool:
        return bool(self.parts or self.unfinished)

    def words(self, total: int) -> str:
        """Return the gaps for people: "parts 7 and 9 of 16"."""
        texts = []
        if self.parts:
            numbers = [str(part.number) for part in self.parts]
            listed = " and ".join([", ".join(numbers[:-1]), numbers[-1]][len(numbers) < 2 :])
            texts.append(f"part{'s' * (len(numbers) > 1)} {listed} of {self.parts[0].count}")
        texts += [f"the rest of {run.words(total)}" for run in self.unfinished]
        return ", ".join(texts)


def gaps(runs: list[Run], total: int) -> Gaps:
    """Return what is missing, as parts of those sizes that the runs have."""
    missing = steps_of(runs, total) == 0
    unfinished = [run for run in runs if 0 < run.done < run.part.steps(total)]
    found = []
    for count in sorted({run.part.count for run in runs}, reverse=True):
        parts = [Part(number, count) for number in range(1, min(count, total) + 1)]
        parts = [part for part in parts if missing[part.step(0) :: count].all()]
        if sum(part.steps(total) for part in parts) == missing.sum():
            return Gaps(parts, [])
        found = found or parts
    return Gaps(found, unfinished)

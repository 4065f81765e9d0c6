"""How many samples a noise or a time needs: predictions from what was rendered. Numbers only.

A few independent sequences (``plan.SEQUENCES``) take turns. In each round all of them get as many
samples as they have, so the noise is known of 1, 2, 4 ... times the samples of the pilot. Once the
number of samples for the noise asked for is in reach of the next round, all of them are rendered,
and nobody looks again: who stops when the image looks good gets images that look good by chance,
and these are too dark.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from manylights.rendering import plan as plans
from manylights.rendering.parts import WHOLE, Part
from manylights.rendering.plan import Limits, Step

#: Variance falls with the number of samples to this power, at least and at most: what is measured
#: beyond is chance.
EXPONENTS = 0.75, 2.5

#: The last round has a multiple of this part of the samples before it.
GRAIN = 8

#: Of a time that is asked for: the most that one step takes, and what is too little to go on.
STEP_SHARE, LEAST_SHARE = 1 / 20, 1 / 50

#: Samples per pixel of a render with a target, at most, if nobody says how many.
MOST_SPP = 2**16


@dataclass
class Course:
    """The steps of a render, each from what came before: a fixed number of samples, or a target.

    Attributes:
        spp: samples per pixel, at most if there is a target.
        limits: for the sizes of steps.
        noise: the target, relative; ``None`` for none.
        seconds: the same for the time.
        part: whose steps these are; those of all, as a rule.
    """

    spp: int
    limits: Limits
    noise: float | None = None
    seconds: float | None = None
    part: Part = WHOLE

    @property
    def has_target(self) -> bool:
        """Is the number of samples not known beforehand?"""
        return self.noise is not None or self.seconds is not None

    @property
    def sequences(self) -> int:
        """How many independent sequences the samples come from."""
        return min(plans.SEQUENCES, self.spp) if self.has_target else 1

    def next_step(self, done: History) -> Step | None:
        """Return the first step that is not done, None at the end."""
        if done.ahead:
            return next((step for _, step in self.open_steps(done)), None)
        if self.has_target:
            return self._towards_target(done)
        return plans.step_at(self.part.step(done.steps), self.spp, self.limits)

    def open_steps(self, done: History) -> Iterator[tuple[int, Step]]:
        """Yield what can be rendered now, in any order: numbers and steps that are not done.

        Steps are numbered from 0 in their order. With a noise as the target they are those of the
        round; the next one depends on its noise. There are none with a time as the target: each
        step depends on the one before.
        """
        if self.seconds is not None:
            return
        for number, step in self._round(done) if self.has_target else self._all(done.steps):
            if number >= done.steps and number not in done.ahead:
                yield number, step

    def _all(self, begin: int) -> Iterator[tuple[int, Step]]:
        for number in range(begin, self.part.steps(self.step_count)):
            yield number, plans.step_at(self.part.step(number), self.spp, self.limits)

    def _round(self, done: History) -> Iterator[tuple[int, Step]]:
        """Yield all steps of the round that the noises so far lead to."""
        goals = [0, *(self.goal(done.noises[:count])[0] for count in range(len(done.noises)))]
        largest = self.limits.largest()
        steps = sum(-(-(goal - before) // largest) for before, goal in zip(goals, goals[1:]))
        trial = History([goals[-1]] * self.sequences, done.noises, steps * self.sequences)
        while (step := self._towards_target(trial)) is not None:
            yield trial.steps, step
            trial.add(step, 0.0)

    @property
    def step_count(self) -> int | None:
        """How many steps all parts have together; None if nobody knows."""
        return None if self.has_target else plans.step_count(self.spp, self.limits)

    def training(self, done: History) -> Step | None:
        """Return what a part has to learn from that others begin with, None if nothing."""
        if self.has_target or self.part.step(0) == 0 or self.next_step(done) is None:
            return None
        return self.lesson()

    def lesson(self) -> Step | None:
        """Return a step of the training passes alone, None if there are none.

        Its film is not part of the image: it teaches those who do not render the first step.
        """
        if not self.has_target and plans.is_single(self.spp, self.limits):
            return None
        first = Course(self.spp, self.limits, self.noise, self.seconds).next_step(
            History([0] * self.sequences)
        )
        passes = tuple(one for one in first.passes if one.role == plans.TRAIN)
        return Step(passes, first.spp, 0, 0) if passes else None

    def goal(self, noises: list[float]) -> tuple[int, bool]:
        """Return the samples of each sequence at the end of the round after these noises.

        Also: is it the last round? After it the goal is what was reached.
        """
        most = self.spp // self.sequences
        pilot = plans.PILOT_SAMPLES // (self.sequences * self.limits.pixels)
        goals = [min(max(plans.power_of_two(pilot), plans.LEAST_PILOT_SPP), most)]
        last = goals[0] == most
        for index in range(len(noises)):
            if last:
                break
            wanted, last = self._next_goal(goals, noises[: index + 1])
            goals.append(min(wanted, most))
            last = last or goals[-1] == most
        return goals[-1], last

    def round_is_complete(self, done: History) -> bool:
        """Have all sequences reached the goal, and nobody has looked at the noise yet?"""
        if not self.has_target:
            return False
        goal, _ = self.goal(done.noises)
        before = self.goal(done.noises[:-1])[0] if done.noises else 0
        return goal > before and min(done.samples) == goal

    def predicted_spp(self, noises: list[float]) -> int:
        """Return the samples per pixel that there will be, as far as is known."""
        if not self.has_target:
            return self._spp_of_part()
        goal, last = self.goal(noises)
        if last:
            return goal * self.sequences
        if self.noise is None or not noises:
            return self.spp
        before = self.goal(noises[:-1])[0]
        wanted = before * (noises[-1] / self.noise) ** 2
        return int(min(wanted * self.sequences, self.spp)) if wanted == wanted else self.spp

    def _spp_of_part(self) -> int:
        """Return the samples per pixel of its steps; all have the same but the last one."""
        count = self.step_count
        steps, size = self.part.steps(count), plans.step_size(self.spp, self.limits)
        has_last = steps > 0 and self.part.step(steps - 1) == count - 1
        return steps * size - (count * size - self.spp if has_last else 0)

    def _next_goal(self, goals: list[int], noises: list[float]) -> tuple[int, bool]:
        twice = 2 * goals[-1]
        if self.noise is None:
            return twice, False
        if len(noises) < 2:
            return twice, False
        law = PowerLaw.of(goals, noises)
        grain = max(goals[-1] // GRAIN, 1)
        enough = (n for n in range(goals[-1], twice + 1, grain) if law.noise(n) <= self.noise)
        goal = next(enough, None)
        return (twice, False) if goal is None else (goal, True)

    def _towards_target(self, done: History) -> Step | None:
        goal, _ = self.goal(done.noises)
        first = min(done.samples)
        if first >= goal:
            return None
        scramble = done.samples.index(first)
        count = min(goal - first, self.limits.largest())
        if self.seconds is not None:
            count = min(count, self._in_time(done))
            if not count:
                return None
        passes = plans.passes(first, count, self.limits)
        if scramble > 0 and first == 0:
            passes = [plans.Pass(0, count)]
        return Step.of(passes, scramble, done.steps)

    def _in_time(self, done: History) -> int:
        """Return the samples per pixel of a step that the time is enough for, 0 for none."""
        left = self.seconds - done.seconds
        if not done.steps:
            return plans.LEAST_PILOT_SPP
        if left < self.seconds * LEAST_SHARE:
            return 0
        per_sample = done.last_seconds / done.last_spp
        if left < per_sample / 2:
            return 0
        return plans.power_of_two(int(min(left, self.seconds * STEP_SHARE) / per_sample))


@dataclass
class History:
    """What was rendered.

    Attributes:
        samples: per pixel, of each sequence.
        noises: after each round.
        steps: how many are done without a gap.
        last_spp: samples per pixel of the last step.
        seconds: that all of it took.
        last_seconds: that the last step took.
        ahead: numbers of steps that are done beyond the first gap, in their order.
    """

    samples: list[int]
    noises: list[float] = field(default_factory=list)
    steps: int = 0
    last_spp: int = 0
    seconds: float = 0.0
    last_seconds: float = 0.0
    ahead: list[int] = field(default_factory=list)

    def add(self, step: Step, seconds: float, number: int | None = None) -> None:
        """Add a step that took so long; its number, if it is not the first that is missing."""
        self.samples[step.scramble] += step.spp
        self.ahead = sorted([*self.ahead, self.steps if number is None else number])
        while self.ahead and self.ahead[0] == self.steps:
            self.steps += 1
            del self.ahead[0]
        self.last_spp = step.spp
        self.seconds += seconds
        self.last_seconds = seconds

    def add_seconds(self, seconds: float) -> None:
        """Count more time as that of the last step."""
        self.seconds += seconds
        self.last_seconds += seconds

    @property
    def spp(self) -> int:
        """Samples per pixel of all steps."""
        return sum(self.samples)


@dataclass(frozen=True)
class PowerLaw:
    """How noise falls with the number of samples of a sequence, as far as two rounds tell.

    At 2, 4, 8 ... times the samples the variance falls as a power of their number. In between, a
    sequence is a whole number of blocks whose errors have little in common: variances of their sums
    add up. Low-discrepancy sequences gain little there: a small block has much of the error.

    Attributes:
        samples: of the last round.
        variance: relative, at its end.
        exponent: of the power.
    """

    samples: int
    variance: float
    exponent: float

    @staticmethod
    def of(samples: list[int], noises: list[float]) -> PowerLaw:
        """Return the law of the last two rounds; each has twice the samples of the one before."""
        exponent = EXPONENTS[0]
        if noises[-1] > 0.0:
            exponent = 2.0 * math.log2(noises[-2] / noises[-1])
        least, most = EXPONENTS
        return PowerLaw(samples[-1], noises[-1] ** 2, min(max(exponent, least), most))

    def noise(self, samples: int) -> float:
        """Return the noise of so many samples, once to twice those of the last round.

        >>> law = PowerLaw(16, 0.01, 2.0)
        >>> [round(law.noise(samples), 4) for samples in (16, 24, 32)]
        [0.1, 0.0943, 0.05]
        """
        total, left, block = 0.0, samples, 2 * self.samples
        while left:
            if block <= left:
                total += block**2 * self.variance * (block / self.samples) ** -self.exponent
                left -= block
            else:
                block = max(block // 2, 1)
        return math.sqrt(total) / samples

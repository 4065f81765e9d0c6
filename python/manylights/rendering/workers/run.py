"""Gives a team the steps of a job, and adds what comes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from manylights.errors import UsageError, check
from manylights.progress import say
from manylights.rendering.checkpoint import Checkpoint
from manylights.rendering.job import FILMS, Job
from manylights.rendering.parts import MOST_PARTS
from manylights.rendering.state import State
from manylights.rendering.workers.shares import MOST_LOSSES, Shares
from manylights.rendering.workers.team import Member, Outcome, Team

#: Takes samples per pixel that are done but not added, the seconds since the last ones were, and
#: lines about what workers do.
Report = Callable[[float, float, list[str]], None]


def run(
    job: Job,
    state: State,
    store: Checkpoint | None,
    facts: dict,
    client,
    report: Report,
    threads: int | None = None,
    ship: bool = False,
) -> None:
    """Have workers render the steps of a job that the state does not have, and add them to it.

    Args:
        job: what is rendered.
        state: what there is already.
        store: where to keep the state, also if the render ends early.
        facts: of the job.
        client: ``distributed.Client``.
        report: called several times a second. What it raises ends the render.
        threads: of Mitsuba on each worker. Default: as many as Dask says it has.
        ship: send the scene's files?

    Raises:
        UsageError: not such a job, or no worker can take part.
        RuntimeError: a worker cannot render something, or the scheduler is gone.
    """
    check_job(job, client)
    team = Team(client, job, facts, threads, ship)
    foreman = Foreman(job, state, store, team, report)
    try:
        with team:
            foreman.run()
    except BaseException:
        foreman.keep()
        raise


def check_job(job: Job, client) -> None:
    """Raise ``UsageError`` if workers cannot render a job."""
    fits = not getattr(client, "asynchronous", True)
    check("client", client, fits, "a synchronous distributed.Client")
    film = job.film.class_name()
    if film not in FILMS:
        raise UsageError(f"workers: films of a {film} cannot be added, only of an hdrfilm")
    count = job.course.step_count
    if count is not None and count > MOST_PARTS:
        raise UsageError(f"workers: {count} steps, and at most {MOST_PARTS} can be shared out")


class Foreman:
    """Renders one job with a team.

    Args:
        job, state, store, team, report: as for :func:`run`.
    """

    def __init__(self, job: Job, state: State, store, team: Team, report: Report) -> None:
        self.job, self.state, self.store = job, state, store
        self.team, self.report = team, report
        self.start, self.before = time.perf_counter(), state.history.seconds
        self.shares, self.has_said = Shares([]), False

    def run(self) -> None:
        """Render all rounds: one without a noise as the target."""
        course, history = self.job.course, self.state.history
        # Also without a step the film has its size and channels.
        self.job.add_nothing(self.state)
        while steps := list(course.open_steps(history)):
            self._run_round(steps)
            if course.round_is_complete(history):
                self.state.end_round(self.job.driver.adjoint)
        history.seconds = self.before + self._spent()

    def keep(self) -> None:
        """Write the state now, and say so: the render ends early."""
        if self.store is None or not self.state.history.spp:
            return
        self.store.keep(self.state, at_once=True)
        with suppress(BaseException):
            self._tell()
        if kept := self.store.describe():
            say(f"checkpoint: {kept}, the same command goes on from there")

    def _run_round(self, steps) -> None:
        self.shares, team = Shares(steps), self.team
        while len(self.shares) or team.rendering:
            for outcome in team.look():
                self._settle(outcome)
            self._say_if_few(len(steps))
            self._give_out()
            outcome = team.wait()
            # Who has given back something goes on while it is added.
            self._give_out()
            if outcome is not None:
                self._settle(outcome)
            self._tell()

    def _say_if_few(self, count: int) -> None:
        """Say once that there are more workers than steps; with a noise later rounds have more."""
        if self.has_said or self.job.course.has_target or len(self.team.members) <= count:
            return
        self.has_said = True
        steps = "1 step" if count == 1 else f"{count} steps"
        say(f"workers: this render has {steps}, at most {count} share the work")

    def _give_out(self) -> None:
        for member in self.team.idle():
            if len(self.shares):
                share = self.shares.take(member.pace, self.team.size)
                self.team.begin(member, share, self._wants_learnt())

    def _wants_learnt(self) -> bool:
        """Should the next one who renders send what was learnt? All learn the same."""
        asked = any(member.wants_learnt for member in self.team.rendering)
        return not self.state.learnt.size and not asked

    def _settle(self, outcome: Outcome) -> None:
        """Add what a worker gives back, or have others render it."""
        member, share, result = outcome.member, outcome.share, outcome.result
        if result is None:
            if outcome.is_lost and self.shares.lose(share):
                raise RuntimeError(
                    f"workers: {share.words()} ended {MOST_LOSSES} workers, the last one was "
                    f"{member.label}. Out of memory or a crash, see their logs"
                )
            if not outcome.is_lost:
                self.shares.give_back(share)
            return
        self._add(member, share, result)
        if self.store is not None and (len(self.shares) or self.team.rendering):
            self.store.keep(self.state)

    def _add(self, member: Member, share, result) -> None:
        state = self.state
        for number, arrays in result["films"]:
            if arrays[0].shape != state.sums[0].rounded.shape:
                shapes = f"{arrays[0].shape} and not {state.sums[0].rounded.shape}"
                raise RuntimeError(f"worker {member.label}: a film of the shape {shapes}")
            state.sums[number].add(*arrays)
        for number, step in share.steps:
            state.history.add(step, 0.0, number)
        state.history.seconds = self.before + self._spent()
        if result["learnt"] is not None and not state.learnt.size:
            state.learnt = result["learnt"]
        if result["processor"] not in state.processors:
            state.processors.append(result["processor"])

    def _tell(self) -> None:
        begun = sum(
            member.share.spp * min(member.done / len(member.share.steps), 1.0)
            for member in self.team.rendering
        )
        spent = self.before + self._spent() - self.state.history.seconds
        self.report(begun, spent, self.team.words())

    def _spent(self) -> float:
        return time.perf_counter() - self.start

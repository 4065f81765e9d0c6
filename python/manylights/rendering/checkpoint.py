"""Keeps the state of a long render in a file, so that the render can go on after it was killed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from manylights import files
from manylights.errors import UsageError, one_line
from manylights.progress import say
from manylights.rendering import metadata, state_file
from manylights.rendering.job import Job, differences
from manylights.rendering.parts import Part, Run
from manylights.rendering.state import State
from manylights.rendering.state_file import Saved
from manylights.rendering.targets import History
from manylights.threads import processor

REMEDY = "delete it to start anew, or choose another output"


def path_for(target: Path) -> Path:
    """Return where the checkpoint of an image is: beside it, ``OUT.checkpoint.exr``."""
    return target.with_suffix(".checkpoint.exr")


class Checkpoint:
    """The file of one render's state.

    Attributes:
        path: the file.
        samples: per pixel, those that are in the file.
    """

    def __init__(
        self,
        path: Path,
        job: Job,
        seconds: float = 60.0,
        clock: Callable[[], float] = time.monotonic,
        facts: dict[str, Any] | None = None,
    ) -> None:
        """Know the job.

        Args:
            path: the file.
            job: what is rendered.
            seconds: at least between two writings.
            clock: for tests.
            facts: of the job, if they are known.
        """
        self.path, self.job, self.seconds, self.clock = path, job, seconds, clock
        self.facts = facts or job.facts()
        self.samples, self.last = 0, clock()

    def restore(self) -> State | None:
        """Read the state from the file, None if there is no file.

        Raises:
            UsageError: the file cannot be read, or it belongs to another job.
        """
        if not self.path.exists():
            return None
        state = self._read()
        self.samples = state.history.spp
        return state

    def describe(self) -> str | None:
        """Return what the file holds, for people; None if there is nothing yet."""
        if not self.samples:
            return None
        course = self.job.course
        of = "" if course.has_target else f" of {course.predicted_spp([])}"
        return f"{self.path} has {self.samples}{of} samples per pixel"

    def keep(self, state: State, at_once: bool = False) -> None:
        """Write the state if the last time was long enough ago, or at once.

        A file that cannot be written costs a message and not the render: the one before it stays.
        """
        if not at_once and self.clock() - self.last < self.seconds:
            return
        try:
            self.write(state)
            self.samples = state.history.spp
        except Exception as error:
            say(f"no checkpoint written, the render goes on: {one_line(error)}")
        # Also where writing takes longer than the time between two.
        self.last = self.clock()

    def remove(self) -> None:
        """Remove the file, once the image is there."""
        self.path.unlink(missing_ok=True)
        files.remove_leftovers(self.path)

    def write(self, state: State) -> None:
        """Write the state, however long ago the last time was."""
        part = self.job.course.part
        name = processor()
        state.processors += [] if name in state.processors else [name]
        runs, shown = self._runs(state.history), self.job.driver.shown()
        facts = {**self.facts, "parameters": metadata.parameters(self.job.driver.integrator)}
        standard = metadata.standard(self.job, self.facts["version"])
        saved = Saved(self.path, facts, runs, state, shown, list(part.command), standard)
        state_file.write(saved)

    def _runs(self, history: History) -> list[Run]:
        """Return which steps there are; of each beyond the first gap a part of its own has it."""
        course = self.job.course
        runs, count = [Run(course.part, history.steps)], course.step_count
        if count is not None:
            indices = [course.part.step(number) for number in history.ahead]
            runs += [Run(Part(index + 1, count), 1) for index in indices]
        return runs

    def _read(self) -> State:
        saved, _ = state_file.read(self.path, "checkpoint", f", {REMEDY}")
        if saved.state is None:
            raise UsageError(f"{self.path}: not a checkpoint of manylights, {REMEDY}")
        changes = "; ".join(differences(saved.facts, self.facts))
        if changes:
            raise UsageError(f"{self.path}: of another render, {REMEDY}. It has {changes}")
        return saved.state


def learnt(path: Path, job: Job, facts: dict) -> np.ndarray:
    """Return what the render of a part or a checkpoint of the same job has learnt.

    Args:
        path: the file.
        job: the job.
        facts: its own.

    Raises:
        UsageError: the file cannot be read, is of another job, or has learnt nothing.
    """
    saved, _ = state_file.read(path, "part or checkpoint", "")
    if saved.state is None:
        raise UsageError(f"{path}: an image, and not a part or a checkpoint: nothing was learnt")
    changes = "; ".join(differences(saved.facts, facts, but=("part",)))
    if changes:
        raise UsageError(f"{path}: of another render. It has {changes}")
    if not saved.state.learnt.size and job.course.training(History([0])) is not None:
        raise UsageError(f"{path}: nothing was learnt yet")
    return saved.state.learnt

"""Keeps the state of a long render in a file, so that the render can go on after it was killed.

The file is an OpenEXR image that any viewer shows: the picture so far in its own channels, the
two parts of the film's sums in channels of their own (``output.channels``), and in the attributes
``manylights.*`` what was rendered, as JSON. It is written under another name and then renamed:
whoever is killed while writing leaves the one before.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.errors import UsageError, one_line
from manylights.output import channels, images
from manylights.output.channels import REST, SUM
from manylights.progress import say
from manylights.rendering.job import Job, differences
from manylights.rendering.passes import develop
from manylights.rendering.sums import Sums

#: Prefix of the file's attributes.
ATTRIBUTE = "manylights."

REMEDY = "delete it to start anew, or choose another output"


def path_for(target: Path) -> Path:
    """Return where the checkpoint of an image is: beside it, ``OUT.checkpoint.exr``."""
    return target.with_suffix(".checkpoint.exr")


class Checkpoint:
    """The state of one render, in memory and in its file.

    Attributes:
        path: the file.
        sums: the film's sums so far.
        samples: per pixel, those that are in the file.
        writing: held while the file is written; who ends the process takes it first.
    """

    def __init__(
        self,
        path: Path,
        job: Job,
        seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Read the state from the file if there is one.

        Args:
            path: the file.
            job: what is rendered, with a plan that keeps its state.
            seconds: at least between two writings.
            clock: for tests.

        Raises:
            UsageError: the file cannot be read, or it belongs to another job.
        """
        self.path, self.job, self.seconds, self.clock = path, job, seconds, clock
        self.facts = job.facts()
        self.writing = threading.RLock()
        self.sums = self._read() if path.exists() else Sums()
        self.samples, self.last = self._samples_done(), clock()

    @property
    def fraction(self) -> float:
        """What share of the render is in the file, from 0 to 1."""
        return self.samples / self.job.plan.spp

    def describe(self) -> str:
        """Return what the file holds, for people."""
        return f"{self.path} has {self.samples} of {self.job.plan.spp} samples per pixel"

    def farewell(self) -> str:
        """Return what to say after Ctrl-C."""
        if not self.samples:
            return "interrupted, nothing written"
        return f"interrupted, {self.describe()}; the same command goes on"

    def keep(self) -> None:
        """Write the sums if the last time was long enough ago.

        A file that cannot be written costs a message and not the render: the one before it stays.
        """
        if self.clock() - self.last < self.seconds:
            return
        try:
            self._write()
        except Exception as error:
            say(f"no checkpoint written, the render goes on: {one_line(error)}")
        # Also where writing takes longer than the time between two.
        self.last = self.clock()

    def remove(self) -> None:
        """Remove the file, once the image is there."""
        self.path.unlink(missing_ok=True)
        files.remove_leftovers(self.path)

    def _samples_done(self) -> int:
        return self.job.plan.samples_after(self.sums.passes)

    def _write(self) -> None:
        film = self.job.film
        picture = develop(film, self.sums)
        summed = channels.names(film.bitmap(raw=True))
        colors = np.array(picture).reshape(*self.sums.high.shape[:2], -1)
        names = channels.names(picture) + [part + name for part in (SUM, REST) for name in summed]
        bitmap = channels.join(names, colors, self.sums.high, self.sums.low)
        done = {"passes": self.sums.passes, "samples_done": self._samples_done()}
        for name, value in {**self.facts, **done, "channels": summed}.items():
            bitmap.metadata()[ATTRIBUTE + name] = json.dumps(value)
        with self.writing:
            images.write_whole(bitmap, self.path, mi.Bitmap.FileFormat.OpenEXR)
            self.samples = self._samples_done()

    def _read(self) -> Sums:
        try:
            bitmap = channels.read(self.path)
            facts = {
                name[len(ATTRIBUTE) :]: json.loads(value)
                for name, value in bitmap.metadata().items()
                if name.startswith(ATTRIBUTE)
            }
        except (UsageError, ValueError) as error:
            text = f"{self.path}: not a whole checkpoint, {REMEDY} ({one_line(error)})"
            raise UsageError(text) from error
        if "channels" not in facts:
            raise UsageError(f"{self.path}: not a checkpoint of manylights, {REMEDY}")
        changes = "; ".join(differences(facts, self.facts))
        if changes:
            raise UsageError(f"{self.path}: of another render, {REMEDY}. It has {changes}")
        found = channels.split(bitmap)
        parts = (
            np.stack([found[part + name] for name in facts["channels"]], axis=-1)
            for part in (SUM, REST)
        )
        return Sums(facts["passes"], *parts)

"""Keeps the state of a long render in a file, so that the render can go on after it was killed.

The file is an OpenEXR image that any viewer shows: the picture so far in its own channels, the
two parts of the film's sums in channels of their own (``output.channels``), and in the attributes
``manylights.*`` what was rendered, as JSON. It is written under another name and then renamed:
whoever is killed while writing leaves the one before.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files, rendering
from manylights.errors import UsageError, one_line
from manylights.loading import LoadedScene
from manylights.output import channels, images
from manylights.output.channels import REST, SUM
from manylights.progress import say

#: Prefix of the file's attributes.
ATTRIBUTE = "manylights."

REMEDY = "delete it to start anew, or choose another output"


def path_for(target: Path) -> Path:
    """Return where the checkpoint of an image is: beside it, ``OUT.checkpoint.exr``."""
    return target.with_suffix(".checkpoint.exr")


def describe_job(
    loaded: LoadedScene, sensor: int, spp: int, seed: int, choices: dict[str, Any]
) -> dict[str, Any]:
    """Return all that the image depends on, for JSON.

    Args:
        loaded: the scene.
        sensor: its index.
        spp: samples per pixel, or 0 for what the scene's sampler says.
        seed: of the random numbers.
        choices: what else was chosen on the command line, by the name of the option.

    Raises:
        UsageError: there is no such sensor.
    """
    from manylights import __version__

    chosen, spp = rendering.resolve(loaded, sensor, spp)
    width, height = map(int, chosen.film().crop_size())
    return {
        "version": f"manylights {__version__}, Mitsuba {mi.__version__}",
        "variant": mi.variant(),
        "spp": spp,
        "seed": seed,
        "sensor": sensor,
        "size": f"{width} x {height}",
        "samples_per_pass": rendering.checkpointed_sizes(chosen.film(), spp)[0],
        **choices,
        "files": _digests(loaded.files),
    }


def _digests(paths: list[Path]) -> dict[str, str]:
    """Return SHA-256 of the files by their names, seen from the folder of the first."""
    folder = paths[0].parent if paths else ""
    return {
        os.path.relpath(path, folder): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in dict.fromkeys(paths)
    }


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
        job: dict[str, Any],
        seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Read the state from the file if there is one.

        Args:
            path: the file.
            job: what ``describe_job`` returned.
            seconds: at least between two writings.
            clock: for tests.

        Raises:
            UsageError: the file cannot be read, or it belongs to another job.
        """
        self.path, self.job, self.seconds, self.clock = path, job, seconds, clock
        self.writing = threading.RLock()
        self.sums = self._read() if path.exists() else rendering.Sums()
        self.samples, self.last = self._samples_done(), clock()

    @property
    def fraction(self) -> float:
        """What share of the render is in the file, from 0 to 1."""
        return self.samples / self.job["spp"]

    def describe(self) -> str:
        """Return what the file holds, for people."""
        return f"{self.path} has {self.samples} of {self.job['spp']} samples per pixel"

    def farewell(self) -> str:
        """Return what to say after Ctrl-C."""
        if not self.samples:
            return "interrupted, nothing written"
        return f"interrupted, {self.describe()}; the same command goes on"

    def keep(self, film) -> None:
        """Write the sums if the last time was long enough ago.

        A file that cannot be written costs a message and not the render: the one before it stays.
        """
        if self.clock() - self.last < self.seconds:
            return
        try:
            self._write(film)
        except Exception as error:
            say(f"no checkpoint written, the render goes on: {one_line(error)}")
        # Also where writing takes longer than the time between two.
        self.last = self.clock()

    def remove(self) -> None:
        """Remove the file, once the image is there."""
        self.path.unlink(missing_ok=True)
        files.remove_leftovers(self.path)

    def _samples_done(self) -> int:
        return min(self.sums.passes * self.job["samples_per_pass"], self.job["spp"])

    def _write(self, film) -> None:
        picture = rendering.develop(film, self.sums)
        summed = channels.names(film.bitmap(raw=True))
        colors = np.array(picture).reshape(*self.sums.high.shape[:2], -1)
        names = channels.names(picture) + [part + name for part in (SUM, REST) for name in summed]
        bitmap = channels.join(names, colors, self.sums.high, self.sums.low)
        done = {"passes": self.sums.passes, "samples_done": self._samples_done()}
        for name, value in {**self.job, **done, "channels": summed}.items():
            bitmap.metadata()[ATTRIBUTE + name] = json.dumps(value)
        with self.writing:
            images.write_whole(bitmap, self.path, mi.Bitmap.FileFormat.OpenEXR)
            self.samples = self._samples_done()

    def _read(self) -> rendering.Sums:
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
        changes = _differences(facts, self.job)
        if changes:
            changes = "; ".join(changes)
            raise UsageError(f"{self.path}: of another render, {REMEDY}. It has {changes}")
        found = channels.split(bitmap)
        parts = (
            np.stack([found[part + name] for name in facts["channels"]], axis=-1)
            for part in (SUM, REST)
        )
        return rendering.Sums(facts["passes"], *parts)


def _differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return in words what two jobs do not share, the old one's value first."""
    changed = [name for name in new if old.get(name) != new[name]]
    changes = [
        f"{name} {_words(old.get(name))} and not {_words(new[name])}"
        for name in changed
        if name != "files"
    ]
    if "files" in changed:
        before, now = old.get("files", {}), new["files"]
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        changes.append(f"another content of {', '.join(names)}")
    return changes


def _words(value: Any) -> str:
    """Return a value of a job for people: options that are given several times as typed."""
    if isinstance(value, dict):
        return " ".join(f"{name}={item}" for name, item in value.items()) or "none"
    return "none" if value is None else str(value)

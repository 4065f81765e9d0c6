"""Keeps the state of a long render in a file, so that the render can go on after it was killed.

The file is an OpenEXR image that any viewer shows: the picture so far in its own channels, the
parts of the film's sums in channels of their own (``output.channels``), and in the attributes
``manylights.*`` what was rendered and learnt, as JSON. It is written under another name and then
renamed: whoever is killed while writing leaves the one before.
"""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.errors import UsageError, one_line
from manylights.output import channels, images
from manylights.progress import say
from manylights.rendering.develop import WEIGHT, picture
from manylights.rendering.job import Job, differences
from manylights.rendering.state import State
from manylights.rendering.sums import Sums
from manylights.rendering.targets import History

#: Prefix of the file's attributes.
ATTRIBUTE = "manylights."

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
        seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Know the job.

        Args:
            path: the file.
            job: what is rendered.
            seconds: at least between two writings.
            clock: for tests.
        """
        self.path, self.job, self.seconds, self.clock = path, job, seconds, clock
        self.facts = job.facts()
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
        of = "" if self.job.course.has_target else f" of {self.job.course.spp}"
        return f"{self.path} has {self.samples}{of} samples per pixel"

    def keep(self, state: State) -> None:
        """Write the state if the last time was long enough ago.

        A file that cannot be written costs a message and not the render: the one before it stays.
        """
        if self.clock() - self.last < self.seconds:
            return
        try:
            self._write(state)
            self.samples = state.history.spp
        except Exception as error:
            say(f"no checkpoint written, the render goes on: {one_line(error)}")
        # Also where writing takes longer than the time between two.
        self.last = self.clock()

    def remove(self) -> None:
        """Remove the file, once the image is there."""
        self.path.unlink(missing_ok=True)
        files.remove_leftovers(self.path)

    def _write(self, state: State) -> None:
        summed = state.channels
        shown = [index for index, name in enumerate(summed) if name != WEIGHT]
        image = picture(state.rough_total(self.job.driver.adjoint), summed)[..., shown]
        names, parts = [summed[index] for index in shown], [image]
        for prefix, part in zip(channels.sums(len(state.sums)), _parts(state.sums)):
            names += [prefix + name for name in summed]
            parts.append(part)
        bitmap = channels.join(names, *parts)
        done = {"history": asdict(state.history), "channels": summed}
        done["learnt"] = _packed(state.learnt)
        done |= {"sequences": len(state.sums), "samples_done": state.history.spp}
        for name, value in {**self.facts, **done}.items():
            bitmap.metadata()[ATTRIBUTE + name] = json.dumps(value)
        images.write_whole(bitmap, self.path, mi.Bitmap.FileFormat.OpenEXR)

    def _read(self) -> State:
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
        return _state(channels.split(bitmap), facts)


def _parts(sums: list[Sums]):
    """Yield the parts of the sums of all sequences, zeros where there are none yet."""
    zeros = np.zeros_like(sums[0].parts)
    for one in sums:
        yield from zeros if one.parts is None else one.parts


def _state(found: dict[str, np.ndarray], facts: dict[str, Any]) -> State:
    prefixes = channels.sums(facts["sequences"])
    parts = [
        np.stack([found[prefix + name] for name in facts["channels"]], axis=-1)
        for prefix in prefixes
    ]
    count = len(prefixes) // facts["sequences"]
    sums = [Sums(np.stack(parts[at : at + count])) for at in range(0, len(parts), count)]
    history = History(**facts["history"])
    return State(sums, history, facts["channels"], _unpacked(facts["learnt"]))


def _packed(counts: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(counts.astype("<u4").tobytes())).decode()


def _unpacked(text: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), "<u4").astype(np.uint32)

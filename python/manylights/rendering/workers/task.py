"""What a worker does, in its process, when Dask calls it.

Only names of these functions, numbers, texts and arrays travel: the package is installed there.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import threading
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from time import perf_counter
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import loading
from manylights.errors import UsageError, one_line
from manylights.rendering.job import Job, differences
from manylights.rendering.plan import Step
from manylights.rendering.sums import Sums
from manylights.threads import processor, thread_count


@dataclass
class Engagement:
    """A job that this process renders steps of.

    Attributes:
        job: the same as the client's.
        variant: of Mitsuba.
        threads: of Mitsuba.
        folder: where its files are, if they came from the client.
        taught: is what the first step teaches known?
    """

    job: Job
    variant: str
    threads: int | None
    folder: str | None = None
    taught: bool = False


#: The jobs of this process by their keys. Several clients may share a worker.
engagements: dict[str, Engagement] = {}

#: Keys of jobs whose clients have gone.
left: set[str] = set()

#: Mitsuba and its scenes have one state for the process: one task at a time.
busy = threading.Lock()


def arrive(order: dict[str, Any], files: list[np.ndarray]) -> dict[str, Any]:
    """Load the scene of an order, and compare all that its image depends on.

    Args:
        order: ``Team.order``.
        files: contents of ``order["names"]``, bytes.

    Returns:
        ``label``, the worker's name for people, and ``problem``, why it cannot take part.
    """
    own = _worker()
    label = _label(own)
    with busy:
        _forget(order["key"])
        folder, problem = None, None
        try:
            if order["names"]:
                folder = _unpack(order["names"], files, own and own.local_directory)
            threads = order["threads"] or (own and own.state.nthreads)
            with thread_count(threads):
                job = _job(order, folder)
            changes = differences(job.facts(), order["facts"])
            problem = f"it has {'; '.join(changes)}" if changes else None
        except Exception as error:
            problem = one_line(error)
        if order["key"] in left:
            problem = "its client has gone"
        if problem is None:
            engagements[order["key"]] = Engagement(job, order["variant"], threads, folder)
        elif folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
    return {"label": label, "problem": problem}


def render(key: str, steps: list[Step], wants_learnt: bool) -> dict[str, Any] | None:
    """Render steps of a job.

    Args:
        key: of the job.
        steps: in their order.
        wants_learnt: return what was learnt, too?

    Returns:
        ``films``: of each sequence its number and arrays to add up; ``checksum`` of them;
        ``learnt``; ``seconds``; ``processor``. Or ``problem`` alone, in words. None if this process
        does not know the job (any more).
    """
    with busy:
        engagement = engagements.get(key)
        if engagement is None:
            return None
        mi.set_variant(engagement.variant)
        begin = perf_counter()
        try:
            with thread_count(engagement.threads):
                sums = _render(key, engagement, steps)
        except Exception as error:
            kind = "out of memory, " if isinstance(error, MemoryError) else ""
            return {"problem": kind + one_line(error)}
        if sums is None:
            return None
        films = [(number, _arrays(one)) for number, one in sorted(sums.items())]
        learnt = engagement.job.driver.learnt() if wants_learnt else None
        seconds = perf_counter() - begin
    result = {"films": films, "checksum": checksum(films), "learnt": learnt}
    return {**result, "seconds": seconds, "processor": processor()}


def leave(key: str) -> None:
    """Forget a job, after the step that is being rendered, and delete its files."""
    left.add(key)
    _forget(key)


def _forget(key: str) -> None:
    engagement = engagements.pop(key, None)
    if engagement is not None and engagement.folder is not None:
        shutil.rmtree(engagement.folder, ignore_errors=True)


def checksum(films: list[tuple[int, list[np.ndarray]]]) -> int:
    """Return CRC-32 of films: they travel."""
    result = 0
    for number, arrays in films:
        for array in arrays:
            result = zlib.crc32(np.ascontiguousarray(array), zlib.crc32(b"%d" % number, result))
    return result


def topic(key: str) -> str:
    """Return the name of the events in which workers tell how far they are."""
    return f"manylights-{key}"


def _job(order: dict[str, Any], folder: str | None) -> Job:
    loading.set_variant(order["variant"])
    path = order["path"] if folder is None else os.path.join(folder, order["scene"])
    return Job.of(loading.load(path, **order["load"]), **order["job"])


def _render(key: str, engagement: Engagement, steps: list[Step]) -> dict[int, Sums] | None:
    """Return the sums of each sequence, None if the client has gone meanwhile."""
    job, own = engagement.job, _worker()
    if not engagement.taught and not steps[0].trains:
        lesson = job.course.lesson()
        if lesson is not None:
            job.render(lesson)
    engagement.taught = True
    result: dict[int, Sums] = {}
    for index, step in enumerate(steps):
        if key not in engagements:
            return None
        tell = _teller(own, key, index)
        tell(0.0)
        result.setdefault(step.scramble, Sums()).add(job.render(step, tell))
    return result


def _teller(own, key: str, index: int) -> Callable[[float], None]:
    """Return a function that tells the client which fraction of a step is done, once a second."""
    last = [-np.inf]

    def tell(fraction: float) -> None:
        if own is not None and perf_counter() - last[0] > 1.0:
            last[0] = perf_counter()
            own.log_event(topic(key), {"worker": own.address, "done": index + fraction})

    return tell


def _arrays(sums: Sums) -> list[np.ndarray]:
    """Return the parts of sums that are not zero, at least one."""
    return [sums.parts[0], *(part for part in sums.parts[1:] if part.any())]


def _unpack(names: list[str], files: list[np.ndarray], parent: str | None) -> str:
    """Write files to a new folder, and return it."""
    folder = tempfile.mkdtemp(prefix="manylights-", dir=parent)
    try:
        for name, content in zip(names, files):
            relative = PurePosixPath(name)
            if relative.is_absolute() or ".." in relative.parts:
                raise UsageError(f"{name}: not a name within the scene's folder")
            path = Path(folder, relative)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(memoryview(content))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _worker():
    """Return Dask's object of this worker, None outside of one."""
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:
        return None


def _label(own) -> str:
    host = socket.gethostname()
    if own is None:
        return host
    name = str(own.name)
    return own.address.partition("://")[2] if "://" in name else f"{name} on {host}"

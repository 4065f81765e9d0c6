"""The workers of a client of Dask: which there are, what each does and what it gives back.

Each task is meant for one worker, and each worker has one task: Dask would run as many at a time as
a worker has threads, which Mitsuba needs itself. So who is gone is found out here, too.
"""

from __future__ import annotations

import asyncio
import queue
import time
import uuid
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from manylights.errors import UsageError, one_line
from manylights.progress import say
from manylights.rendering.job import Job
from manylights.rendering.workers import task
from manylights.rendering.workers.shares import MOST_LOSSES, Share
from manylights.rendering.workers.shipping import Cargo

#: Seconds between two looks at who is there.
LOOK_SECONDS = 1.0

#: Seconds without any worker after which that is said.
LONELY_SECONDS = 20.0

#: Seconds that a wait for results takes at most: the progress is told in between.
WAIT_SECONDS = 0.2


@dataclass
class Member:
    """A worker.

    Attributes:
        address: Dask's.
        label: its name for people.
        share: what it renders, None for nothing.
        future: Dask's, of what it does.
        ready: has it the scene?
        problem: why it cannot take part, if so.
        pace: seconds that a step took it.
        done: how many steps of its share, as far as it has told.
        wants_learnt: is it to send what was learnt, too?
    """

    address: str
    label: str
    share: Share | None = None
    future: Any = None
    ready: bool = False
    problem: str | None = None
    pace: float | None = None
    done: float = 0.0
    wants_learnt: bool = False

    @property
    def is_idle(self) -> bool:
        """Could it render something?"""
        return self.ready and self.future is None

    def words(self) -> str:
        """Return what it does, for people."""
        if self.problem is not None:
            return f"{self.label}: not used"
        if not self.ready:
            return f"{self.label}: loading"
        if self.share is None:
            return f"{self.label}: idle"
        count = len(self.share.steps)
        done = f", {int(self.done)} of {count} done" if count > 1 else ""
        return f"{self.label}: {self.share.words()}{done}"


@dataclass
class Outcome:
    """What became of a share.

    Attributes:
        member: who had it.
        share: what it was.
        result: of ``task.render``; None if the share has to be rendered again.
        is_lost: is the worker's process gone?
    """

    member: Member
    share: Share
    result: dict[str, Any] | None = None
    is_lost: bool = False


class Team:
    """The workers that one job is rendered with.

    Args:
        client: ``distributed.Client``.
        job: what is rendered.
        facts: of the job.
        threads: of Mitsuba on each worker. Default: as many as Dask says it has.
        ship: send the scene's files?

    Raises:
        UsageError: the scene was not read from a file, or cannot be sent.
    """

    def __init__(self, client, job: Job, facts: dict, threads: int | None, ship: bool) -> None:
        self.client, self.key = client, uuid.uuid4().hex[:16]
        self.cargo = Cargo(client, job.loaded, ship)
        self.order = {**order_of(job, facts, threads), **self.cargo.order(), "key": self.key}
        self.members: dict[str, Member] = {}
        self.ended: queue.SimpleQueue = queue.SimpleQueue()
        self.looked, self.killed = -LOOK_SECONDS, []
        self.lonely_since: float | None = None

    def __enter__(self) -> Team:
        self.client.subscribe_topic(task.topic(self.key), self._heard)
        return self

    def __exit__(self, *_) -> None:
        """Have the workers stop after the step that they render, and forget the job."""
        for member in self.members.values():
            if member.future is not None:
                self._drop(member)
        self.cargo.release()
        if self.client.status != "running":
            return
        ready = [member.address for member in self.members.values() if member.problem is None]
        with suppress(Exception):
            self.client.unsubscribe_topic(task.topic(self.key))
            if ready:
                self.client.run(task.leave, self.key, workers=ready, on_error="ignore")

    def idle(self) -> list[Member]:
        """Return who could render something."""
        return [member for member in self.members.values() if member.is_idle]

    @property
    def size(self) -> int:
        """How many take part."""
        return sum(member.ready for member in self.members.values())

    @property
    def rendering(self) -> list[Member]:
        """Who renders something."""
        return [member for member in self.members.values() if member.share is not None]

    def words(self) -> list[str]:
        """Return lines about what each does."""
        return [member.words() for member in self.members.values()] or ["no workers yet"]

    def begin(self, member: Member, share: Share, wants_learnt: bool) -> None:
        """Have a worker render steps."""
        steps = [step for _, step in share.steps]
        member.share, member.done, member.wants_learnt = share, 0.0, wants_learnt
        self._send(member, task.render, self.key, steps, wants_learnt)

    def look(self) -> list[Outcome]:
        """Greet who came, and return what those had who are gone.

        Raises:
            RuntimeError: the scheduler is gone, or loading the scene ends workers.
            UsageError: no worker is of use.
        """
        if time.monotonic() - self.looked < LOOK_SECONDS:
            return []
        self._check_scheduler()
        try:
            there = self.client.nthreads()
        except Exception as error:
            raise self._lost_scheduler() from error
        self.looked = time.monotonic()
        gone = [member for address, member in self.members.items() if address not in there]
        outcomes = [outcome for member in gone for outcome in self._lose(member)]
        for address in there:
            if address not in self.members:
                self._greet(Member(address, address.partition("://")[2]))
        self._say_if_lonely()
        refused = [member for member in self.members.values() if member.problem is not None]
        if refused and len(refused) == len(self.members):
            texts = [f"worker {member.label}: {member.problem}" for member in refused]
            raise UsageError("; ".join(texts))
        return outcomes

    def wait(self) -> Outcome | None:
        """Return what became of a share, None if nothing has for a moment.

        Raises:
            RuntimeError: a worker could not render its share; the text names both.
        """
        try:
            member, future, waiting = self.ended.get(timeout=WAIT_SECONDS)
        except queue.Empty:
            return None
        if member.future is not future:
            return None
        share, member.share, member.future = member.share, None, None
        try:
            result = waiting.result()
        except (CancelledError, asyncio.CancelledError):
            self._check_scheduler()
            return self._failed(member, share, None)
        except Exception as error:
            return self._failed(member, share, error)
        if share is None:
            self._arrived(member, result)
            return None
        return self._rendered(member, share, result)

    def _rendered(self, member: Member, share: Share, result) -> Outcome:
        is_lost = result is None
        if is_lost:
            # A new process under the same address.
            self._greet(member)
        elif "problem" in result:
            raise RuntimeError(f"worker {member.label}, {share.words()}: {result['problem']}")
        elif task.checksum(result["films"]) != result["checksum"]:
            say(f"worker {member.label}: a film was damaged on its way, it is rendered again")
            result = None
        else:
            member.pace = result["seconds"] / len(share.steps)
        return Outcome(member, share, result, is_lost)

    def _failed(self, member: Member, share: Share | None, error) -> Outcome | None:
        """Tell what a task that raised something means."""
        from distributed.scheduler import KilledWorker

        if error is None or isinstance(error, KilledWorker):
            if share is None:
                self._count_killed(member)
            self._greet(member)
            return None if share is None else Outcome(member, share, None, is_lost=True)
        if share is None:
            self._arrived(member, {"label": member.label, "problem": one_line(error)})
            return None
        raise RuntimeError(f"worker {member.label}, {share.words()}: {one_line(error)}") from error

    def _arrived(self, member: Member, answer: dict[str, Any]) -> None:
        member.label, member.problem = answer["label"], answer["problem"]
        member.ready = member.problem is None
        if member.ready:
            self.killed.clear()
        else:
            say(f"worker {member.label} is not used: {member.problem}")
            self.looked = -LOOK_SECONDS

    def _greet(self, member: Member) -> None:
        """Have a worker load the scene."""
        member.ready = False
        self.members[member.address] = member
        self._send(member, task.arrive, self.order, self.cargo.files())

    def _lose(self, member: Member) -> list[Outcome]:
        """Forget a worker that is gone."""
        del self.members[member.address]
        share = member.share
        if member.future is not None:
            self._drop(member)
        if share is not None:
            say(f"worker {member.label} is gone, others render its {share.words()}")
            return [Outcome(member, share, None, is_lost=True)]
        if not member.ready and member.problem is None:
            self._count_killed(member)
        return []

    def _count_killed(self, member: Member) -> None:
        self.killed.append(member.label)
        if len(self.killed) >= MOST_LOSSES:
            names = ", ".join(self.killed)
            raise RuntimeError(f"loading the scene ended {MOST_LOSSES} workers: {names}")

    def _say_if_lonely(self) -> None:
        now = time.monotonic()
        if self.members:
            self.lonely_since = None
        elif self.lonely_since is None:
            self.lonely_since = now
        elif now - self.lonely_since > LONELY_SECONDS:
            say("workers: there are none, the render waits for some")
            self.lonely_since = float("inf")

    def _send(self, member: Member, function: Callable, *arguments) -> None:
        """Have a worker, and no other, call a function of this package."""
        future = self.client.submit(
            function,
            *arguments,
            key=f"manylights-{uuid.uuid4().hex}",
            workers=[member.address],
            allow_other_workers=False,
            pure=False,
        )
        waiting = asyncio.run_coroutine_threadsafe(_result(future), self.client.loop.asyncio_loop)
        member.future = future
        waiting.add_done_callback(lambda done: self.ended.put((member, future, done)))

    def _drop(self, member: Member) -> None:
        """Have nobody wait for what a worker does.

        Dask's future alone is cancelled, which ends the wait for it: a wait that is cancelled
        itself while Dask fetches results leaves the client unable to fetch any others.
        """
        future = member.future
        member.share, member.future = None, None
        with suppress(Exception):
            future.cancel()

    def _heard(self, event) -> None:
        """Take note of how far a worker is."""
        _, told = event
        member = self.members.get(told["worker"])
        if member is not None:
            member.done = float(told["done"])

    def _check_scheduler(self) -> None:
        if self.client.status != "running":
            raise self._lost_scheduler()

    def _lost_scheduler(self) -> RuntimeError:
        return RuntimeError(f"workers: the scheduler {self.client.scheduler.address} is gone")


async def _result(future) -> Any:
    """Wait for a future of Dask, and fetch its result, in the client's event loop."""
    return await future


def order_of(job: Job, facts: dict, threads: int | None) -> dict[str, Any]:
    """Return what a worker needs to make the same job.

    Raises:
        UsageError: the scene was not read from a file.
    """
    load = dict(job.loaded.arguments)
    if not load or job.driver.integrator is not job.loaded.scene.integrator():
        raise UsageError("workers: load the scene themselves, so it has to be that of a file")
    del load["path"]
    course, part = job.course, job.part
    return {
        "variant": facts["variant"],
        "load": load,
        "job": {
            "sensor": job.index,
            "spp": course.spp,
            "seed": job.seed,
            "noise": course.noise,
            "part": None if part is None else (part.number, part.count),
        },
        "threads": threads,
        "facts": facts,
    }

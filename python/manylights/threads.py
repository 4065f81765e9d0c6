"""The number of threads that Mitsuba computes with."""

from __future__ import annotations

import drjit as dr


class thread_count:
    """Context in which Mitsuba computes with ``count`` threads, ``None`` for no change."""

    def __init__(self, count: int | None) -> None:
        self.count = count

    def __enter__(self) -> None:
        self.before = dr.thread_count()
        if self.count is not None:
            dr.set_thread_count(self.count)

    def __exit__(self, *_) -> None:
        if self.count is not None:
            dr.set_thread_count(self.before)


def threads_for_files() -> thread_count:
    """Context for reading and writing images: Mitsuba 3.9 never ends to do so with one thread."""
    return thread_count(2 if dr.thread_count() < 2 else None)

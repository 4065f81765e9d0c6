"""What Mitsuba computes with: variant, number of threads, processor."""

from __future__ import annotations

import platform
from pathlib import Path

import drjit as dr
import mitsuba as mi

#: More are no use, and Linux does not start them.
MOST_THREADS = 4096


def require_variant() -> None:
    """Raise RuntimeError if no variant is set, where Mitsuba itself would not say so."""
    if mi.variant() is None:
        raise RuntimeError(
            "no variant of Mitsuba is set: call "
            'mitsuba.set_variant("llvm_ad_rgb") or another one first'
        )


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


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()

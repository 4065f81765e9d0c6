"""What a measurement ran on: the machine and the versions."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from manylights.threads import processor


def versions() -> dict[str, str]:
    """Return the versions of all that computes."""
    from manylights import __version__

    return {
        "manylights": __version__,
        "mitsuba": str(mi.__version__),
        "drjit": str(dr.__version__),  # pyright: ignore[reportAttributeAccessIssue]
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def describe() -> dict[str, Any]:
    """Return processor, cores, threads, memory and system, for JSON."""
    text = _text_of("/proc/cpuinfo")
    return {
        "processor": processor(),
        "cores": _cores(text),
        "threads": dr.thread_count(),
        "memory_gib": _memory_gib(),
        "system": " ".join([platform.system(), platform.machine(), *platform.libc_ver()]).strip(),
    }


def _cores(cpuinfo: str) -> int:
    """Return the number of cores, of processors where the system does not say."""
    chips = [line for line in cpuinfo.splitlines() if line.startswith(("physical id", "core id"))]
    pairs = set(zip(chips[::2], chips[1::2]))
    return len(pairs) or os.cpu_count() or 1


def _memory_gib() -> float | None:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (OSError, ValueError, AttributeError):
        return None
    return round(size / 2**30, 1)


def _text_of(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""

"""Results that are computed once in a run of tests, whichever of its processes needs them first."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

FOLDER = "MANYLIGHTS_TEST_RESULTS"
"""The environment variable by which processes of a run know its folder."""


def begin():
    """Make the folder of a run; to be called before its other processes start."""
    os.environ[FOLDER] = tempfile.mkdtemp(prefix="manylights-tests-")


def end():
    """Remove it."""
    shutil.rmtree(os.environ.pop(FOLDER), ignore_errors=True)


def shared(function):
    """Keep the arrays that a function returns, by the text of its arguments.

    Two processes that need the same at the same time both compute it: waiting takes as long.
    """

    @functools.cache
    @functools.wraps(function)
    def call(*arguments, **named):
        if FOLDER not in os.environ:
            return function(*arguments, **named)
        key = repr((function.__module__, function.__name__, arguments, sorted(named.items())))
        path = Path(os.environ[FOLDER], hashlib.sha256(key.encode()).hexdigest() + ".npy")
        if not path.exists():
            result = function(*arguments, **named)
            made = path.with_suffix(f".{os.getpid()}.npy")
            np.save(made, result)
            made.replace(path)
            return result
        return np.load(path)

    return call

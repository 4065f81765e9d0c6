"""The command `manylights`: in the process of the tests, or in one of its own.

What a command says and writes and how it ends is the same in both, and a new process takes half a
second to import what it needs. So tests call `manylights`; `manylights_process` is for what only a
process has: the way it is started, its limits and signals, its end where it may crash.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import traceback

import mitsuba as mi
from manylights import cli


def manylights(*arguments):
    """Run the command in this process; return what `manylights_process` returns.

    The current variant stays as it was.
    """
    command = list(map(str, arguments))
    with contextlib.ExitStack() as stack:
        files = [stack.enter_context(tempfile.TemporaryFile("w+", buffering=1)) for _ in range(2)]
        with same_variant(), written_to(1, files[0]), written_to(2, files[1]):
            status = run(command)
        texts = []
        for file in files:
            file.seek(0)
            texts.append(file.read())
    return subprocess.CompletedProcess(command, status, *texts)


def manylights_process(*arguments, **options):
    """Run the command in a new process; return the finished process with its output as text."""
    command = [sys.executable, "-m", "manylights", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)


def assert_fails(process, *words):
    """The command ended with status 2 and one line that has all the words."""
    assert process.returncode == 2, process.stderr
    lines = process.stderr.strip().splitlines()
    assert "Traceback" not in process.stderr
    for word in words:
        assert word in lines[-1]


def run(command):
    """Run the command as Python runs a program; return the exit status."""
    try:
        return cli.main(command)
    except SystemExit as end:
        return end.code
    except Exception:
        traceback.print_exc()
        return 1


@contextlib.contextmanager
def same_variant():
    """Make the current variant of Mitsuba, if there is one, the current one again."""
    before = mi.variant()
    try:
        yield
    finally:
        if before is not None and mi.variant() != before:
            mi.set_variant(before)


@contextlib.contextmanager
def written_to(number, file):
    """Let a file have what Python and C++ write to stdout (1) or stderr (2)."""
    redirect = {1: contextlib.redirect_stdout, 2: contextlib.redirect_stderr}[number]
    kept = os.dup(number)
    try:
        os.dup2(file.fileno(), number)
        with redirect(file):
            yield
    finally:
        os.dup2(kept, number)
        os.close(kept)

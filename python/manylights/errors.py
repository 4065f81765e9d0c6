"""Errors that the command line shows as one line, and what it calls the arguments of functions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

#: Options that are not called as the arguments are in Python.
OPTIONS = {
    "output": "-o",
    "defines": "-D",
    "aovs": "--aov",
    "seconds": "--for",
    "client": "--workers",
}

_in_shell = False


class UsageError(ValueError):
    """The user asked for something impossible; the text says what is allowed instead."""


def one_line(error: BaseException) -> str:
    """Return the message of ``error`` on one line, without Mitsuba's "[file.cpp:12]" prefixes."""
    text = re.sub(r"\[[\w.]+:\d+\] ", "", str(error))
    text = " ".join(text.split())
    return text or type(error).__name__


@contextmanager
def in_shell() -> Iterator[None]:
    """Context in which messages are for who typed a command, and not for who called a function.

    That of the whole process: renders have threads of their own.
    """
    global _in_shell
    before, _in_shell = _in_shell, True
    try:
        yield
    finally:
        _in_shell = before


def typed(python: str, shell: str) -> str:
    """Return how the user would type something: in Python, or in the shell."""
    return shell if _in_shell else python


def argument(name: str) -> str:
    """Return what the user calls an argument: ``light_groups``, or ``--light-groups``."""
    return typed(name, OPTIONS.get(name, f"--{name.replace('_', '-')}"))

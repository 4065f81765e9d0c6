"""Errors of users, which the command shows as one line: what they typed, and what is allowed."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any

#: Options that are not called as the arguments are in Python.
OPTIONS = {
    "output": "-o",
    "defines": "-D",
    "aovs": "--aov",
    "seconds": "--for",
    "client": "--workers",
    "hide_emitters": "--hide-lights",
}

#: Characters of a value in a message, at most.
MOST_SHOWN = 60

#: Names that a message lists, at most.
MOST_NAMES = 8

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


def shown(value: Any) -> str:
    """Return a value as the user typed it; objects on one line that is not too long."""
    if _in_shell:
        return str(value) or "''"
    if isinstance(value, (os.PathLike, str)):
        return repr(str(value))
    text = " ".join(repr(value).split())
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def check(name: str, value: Any, allowed: bool, what: str) -> None:
    """Raise ``UsageError`` with argument, value and what it must be, unless it is allowed."""
    if not allowed:
        raise UsageError(f"{argument(name)} {shown(value)}: must be {what}")


def near(name: Any, known: Iterable[str]) -> str:
    """Return, for a message, which of the known names are like one that is not known.

    >>> near("lamp_7", ["floor", "lamp_1", "lamp_2"])
    'near ones are lamp_2, lamp_1'
    >>> near("sun", ["floor", "lamp_1"])
    'it has floor, lamp_1'
    """
    known = list(dict.fromkeys(known))
    if alike := get_close_matches(str(name), known):
        return f"near {'ones are' if len(alike) > 1 else 'is'} {', '.join(alike)}"
    more = ", ..." if len(known) > MOST_NAMES else ""
    return f"it has {', '.join(known[:MOST_NAMES]) or 'none'}{more}"


def is_integer(value: Any) -> bool:
    """Is it an integer of any kind, as of NumPy, and not True or False?"""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Is it a real number of any kind, as of NumPy, and not True or False?"""
    return isinstance(value, Real) and not isinstance(value, bool)


def integer(name: str, value: Any, least: int, most: int) -> int:
    """Return an integer of any kind as one of Python.

    Raises:
        UsageError: none, or one that is not in ``least`` to ``most``.
    """
    allowed = is_integer(value) and least <= int(value) <= most
    check(name, value, allowed, f"an integer from {least} to {most}")
    return int(value)


def number(name: str, value: Any, allowed: Callable[[Any], bool], what: str) -> float:
    """Return a real number of any kind, as of NumPy, as one of Python.

    Raises:
        UsageError: none, as ``True``, or one that is not allowed; ``what`` says which are.
    """
    check(name, value, is_real(value) and allowed(value), what)
    return float(value)

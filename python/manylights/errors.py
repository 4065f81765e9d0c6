"""Errors that the command line shows as one line."""

from __future__ import annotations

import re


class UsageError(ValueError):
    """The user asked for something impossible; the text says what is allowed instead."""


def one_line(error: BaseException) -> str:
    """Return the message of ``error`` on one line, without Mitsuba's "[file.cpp:12]" prefixes."""
    text = re.sub(r"\[[\w.]+:\d+\] ", "", str(error))
    text = " ".join(text.split())
    return text or type(error).__name__

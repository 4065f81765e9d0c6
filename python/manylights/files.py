"""Writes files so that they are there whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from manylights.errors import UsageError


def check_output(path: str, kind: str = "", ending: str = "") -> Path:
    """Return ``path``, the value of ``-o``, if a file can be written there.

    Args:
        path: where to write.
        kind: what the file is, for the message about its ending: "the image is an OpenEXR file".
        ending: how the name has to end, as in ".exr". Default: any.

    Raises:
        UsageError: another ending, no such folder, a folder of that name, or no permission.
    """
    target = Path(path)
    if ending and target.suffix.lower() != ending:
        raise UsageError(f"-o {path}: {kind}, end the name in {ending}")
    if not target.parent.is_dir():
        raise UsageError(f"-o {path}: there is no folder {target.parent}")
    if target.is_dir() or not os.access(target.parent, os.W_OK):
        raise UsageError(f"-o {path}: not writable")
    return target


@contextmanager
def written_whole(target: Path):
    """Context that yields another name to write to; at the end the file gets its own name.

    If the writing fails nothing is left, and a file that was there before stays.
    """
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)

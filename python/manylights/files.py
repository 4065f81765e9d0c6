"""Writes files so that they are there whole or not at all."""

from __future__ import annotations

import glob
import os
import tempfile
import threading
from collections.abc import Iterable
from contextlib import contextmanager
from pathlib import Path

from manylights.errors import UsageError, argument, check


def path_of(name: str, value: str | Path) -> Path:
    """Return the path that an argument is.

    Raises:
        UsageError: something else.
    """
    check(name, value, isinstance(value, (str, os.PathLike)), "a path")
    return Path(value)


def require(path: str | Path, prefix: str = "") -> None:
    """Raise ``UsageError`` unless there is such a file; the prefix is for the message."""
    if not Path(path).is_file():
        raise UsageError(f"{prefix}{path}: no such file")


def check_output(path: str, kind: str = "", ending: str = "", named: bool = True) -> Path:
    """Return ``path``, the argument ``output``, if a file can be written there.

    Args:
        path: where to write.
        kind: what the file is, for the message about its ending: "the image is an OpenEXR file".
        ending: how the name has to end, as in ".exr". Default: any.
        named: does the command have an option for it, which messages name?

    Raises:
        UsageError: another ending, no such folder, a folder of that name, or no permission.
    """
    target, name = Path(path), f"{argument('output')} " if named else ""
    if ending and target.suffix.lower() != ending:
        raise UsageError(f"{name}{path}: {kind}, end the name in {ending}")
    if not target.parent.is_dir():
        raise UsageError(f"{name}{path}: there is no folder {target.parent}")
    if target.is_dir():
        raise UsageError(f"{name}{path}: not writable, it is a folder")
    # Permissions do not tell: nothing binds root, and not all that root may is possible.
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            return target
    except OSError as error:
        raise UsageError(f"{name}{path}: not writable ({error.strerror})") from error


def is_same(path: str | Path, other: str | Path) -> bool:
    """Are both the same file, perhaps by links? One that is not there is not."""
    try:
        return os.path.samefile(path, other)
    except OSError:
        return False


def check_apart(target: Path, sources: Iterable[str | Path]) -> None:
    """Check that what is written is none of the files that are read.

    Raises:
        UsageError: it is.
    """
    for source in sources:
        if is_same(target, source):
            name = "" if str(source) == str(target) else f" ({source})"
            raise UsageError(
                f"{argument('output')} {target}: would overwrite a file that is read{name}, "
                "choose another name"
            )


#: Held while a file is written; who ends the process takes it first.
writing = threading.RLock()


@contextmanager
def written_whole(target: Path):
    """Context that yields another name to write to; at the end the file gets its own name.

    If the writing fails nothing is left, and a file that was there before stays.

    Raises:
        UsageError: the system does not write; the text has its reason.
    """
    with writing:
        remove_leftovers(target)
        partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
        try:
            yield partial
            _flush(partial)
            os.replace(partial, target)
        except OSError as error:
            raise UsageError(f"{target}: not written ({error.strerror})") from error
        finally:
            partial.unlink(missing_ok=True)


def remove_leftovers(target: Path) -> None:
    """Remove what processes that were killed while they wrote ``target`` have left."""
    for path in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        process = path.name.split(".")[-2]
        if process.isdigit() and not _is_running(int(process)):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _flush(path: Path) -> None:
    """Have the system write the file now: after a power cut its name must not stand for less."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

"""OpenEXR files with layers: one part, scan lines, ZIP; named channels and attributes.

Mitsuba writes the colours of one image. Layers of several number formats, attributes that are
numbers and matrices, and headers without pixels are left to the OpenEXR package.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from manylights import files
from manylights.errors import UsageError, one_line

#: Prefix of our own attributes, which other programs show as they are.
OURS = "manylights."

#: The first bytes of each file of the format.
MAGIC = b"\x76\x2f\x31\x01"

#: Lines of a chunk, with ZIP.
LINES = 16

#: Attributes of the format itself, which say nothing about a render.
FORMAT = ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "type")


def write(path: Path, channels: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> Path:
    """Write a file, whole or not at all, and return its path.

    Args:
        path: of the file.
        channels: by name, shape (height, width) each, as float16, float32 or uint32.
        attributes: numbers, texts and matrices of shape (4, 4) as they are, chromaticities as a
            tuple of eight numbers; lists, dictionaries, booleans and None as JSON.

    Raises:
        UsageError: the system does not write; the text has its reason.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {name: _attribute(value) for name, value in attributes.items()}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with files.written_whole(path) as partial:
        try:
            with OpenEXR.File(header, planes) as file:
                file.write(str(partial))
        except RuntimeError as error:
            raise UsageError(f"{path}: not written ({one_line(error)})") from error
        _check_end(partial, len(next(iter(channels.values()))))
    return path


def _check_end(path: Path, height: int) -> None:
    """Raise OSError if the end of a file that was just written did not reach the disk.

    The OpenEXR package does not look. Behind the header, attributes up to one without a name, is
    the place of each chunk of 16 lines; a chunk begins with its first line and its size.
    """
    with path.open("r+b") as file:
        end = file.seek(0, 2)
        file.seek(8)
        while (name := _text(file)) is not None and name:
            _text(file)
            file.seek(int.from_bytes(file.read(4), "little"), 1)
        places = np.frombuffer(file.read(8 * -(-height // LINES)), "<u8")
        last = int(places.max(initial=0))
        file.seek(last + 4)
        size = int.from_bytes(file.read(4), "little")
        if not places.all() or last + 8 + size > end or not places.size:
            # Says why, as the system has it
            file.seek(0, 2)
            file.write(bytes(1 << 16))
            file.flush()
            raise OSError(errno.EIO, os.strerror(errno.EIO))


def _text(file) -> bytes | None:
    """Return the text up to the next zero, None at the end of the file."""
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte:
            return None
        text += byte
    return text


def read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the channels of a file by name, shape (height, width) each, and its attributes.

    Raises:
        UsageError: no such file, or not a whole OpenEXR image of one part.
    """
    with _opened(path) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
        return channels, _attributes(file.header())


def read_header(path: str | Path) -> tuple[list[str], tuple[int, int], dict[str, Any]]:
    """Return the names of a file's channels, its width and height, and its attributes.

    Raises:
        UsageError: no such file, or not an OpenEXR image.
    """
    with _opened(path, header_only=True) as file:
        header = file.header()
        low, high = header["dataWindow"]
        names = [channel.name for channel in header["channels"]]
        width, height = (int(b - a + 1) for a, b in zip(low, high))
        return names, (width, height), _attributes(header)


def fact(value: Any) -> Any:
    """Return what an attribute of ours stands for: JSON, or a number or text as it is."""
    if not isinstance(value, str):
        return value
    try:
        return json.loads(value)
    except ValueError:
        return value


def _opened(path: str | Path, **how):
    import OpenEXR

    files.require(path)
    try:
        with open(path, "rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError("it does not begin as one")
        # Otherwise rows that are missing are read as black
        if not OpenEXR.InputFile(str(path)).isComplete():
            raise ValueError("its end is missing")
        file = OpenEXR.File(str(path), separate_channels=True, **how)
        if not file.parts:
            raise ValueError("it has no part that can be read")
        return file
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(f"{path}: not a whole OpenEXR image ({one_line(error)})") from error


def _attribute(value: Any) -> Any:
    """Return a value as the package takes it."""
    if isinstance(value, (bool, list, dict, type(None))):
        return json.dumps(value)
    if isinstance(value, int) and not -(2**31) <= value < 2**31:
        return str(value)
    return value


def _attributes(header: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in header.items() if name not in FORMAT}

"""Channels of OpenEXR files: what they are called, and how they are read and written."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from manylights.errors import UsageError, one_line
from manylights.threads import threads_for_files

#: Colours of pictures, as every viewer expects them.
RGB = ("R", "G", "B")

#: What the parameter ``counts`` adds to the film, as headings of pictures.
COUNTS = {
    "candidates": "Candidates (N')",
    "node_visits": "Node visits",
    "expected": "Expected light",
}

#: Those that count work, for each sample.
WORK = ("candidates", "node_visits")

#: The film's sums in a checkpoint, in the parts of ``rendering.sums.Sums``: a prefix each.
SUM_PARTS = ("sum", "rest", "tail")

_formats = mi.Bitmap.PixelFormat


def sums(sequences: int) -> list[str]:
    """Return the prefixes of the channels of a checkpoint: the parts of the sums of a sequence,
    then those of the next one.
    """
    numbers = ["", *(str(number) for number in range(1, sequences))]
    return [f"checkpoint{number}_{part}." for number in numbers for part in SUM_PARTS]


def read(path: str | Path, prefix: str = ""):
    """Return the ``mi.Bitmap`` of an image file.

    Args:
        path: a file of a format that Mitsuba reads.
        prefix: what to write before the file's name in messages.

    Raises:
        UsageError: no such file, or not a whole image.
    """
    if not Path(path).is_file():
        raise UsageError(f"{prefix}{path}: no such file")
    try:
        with threads_for_files():
            return mi.Bitmap(str(path))
    except RuntimeError as error:
        raise UsageError(f"{prefix}{path}: not a readable image ({one_line(error)})") from error


def split(bitmap) -> dict[str, np.ndarray]:
    """Return the channels of a bitmap by name, shape (height, width) each, single precision."""
    pixels = np.array(bitmap).astype(np.float32, copy=False)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    return {name: pixels[..., index] for index, name in enumerate(names(bitmap))}


def names(bitmap) -> list[str]:
    """Return the names of a bitmap's channels, in their order."""
    return [field.name for field in bitmap.struct_()]


def join(channels: list[str], *parts: np.ndarray):
    """Return a bitmap with these names for the channels of all parts, one after the other.

    Args:
        channels: as many as the parts have together.
        parts: of shape (height, width, channels).
    """
    # Made of an array, a bitmap calls its channels Y and A or R, G and B.
    size = [parts[0].shape[1], parts[0].shape[0]]
    kind = mi.Struct.Type.Float32
    bitmap = mi.Bitmap(_formats.MultiChannel, kind, size, len(channels), list(channels))
    pixels = np.array(bitmap, copy=False).reshape(*parts[0].shape[:2], -1)
    np.concatenate(parts, axis=2, out=pixels)
    return bitmap


def colors(bitmap):
    """Return a bitmap of the colour channels alone, ``None`` if there are none."""
    if bitmap.pixel_format() == _formats.MultiChannel:
        bitmap = dict(bitmap.split()).get("<root>", bitmap)
    return None if bitmap.pixel_format() == _formats.MultiChannel else bitmap


def read_colors(path: str | Path, prefix: str = "") -> np.ndarray:
    """Return the colours of an image file, linear, shape (height, width, 3), single precision.

    Raises:
        UsageError: not readable, no colours, or pixels that are not finite.
    """
    bitmap = colors(read(path, prefix))
    if bitmap is None:
        raise UsageError(f"{prefix}{path}: has no colour channels (R, G, B or Y)")
    image = np.array(bitmap.convert(_formats.RGB, mi.Struct.Type.Float32, srgb_gamma=False))
    broken = int(np.sum(~np.isfinite(image).all(axis=2)))
    if broken:
        raise UsageError(f"{prefix}{path}: {broken} pixels are infinite or not a number")
    return image

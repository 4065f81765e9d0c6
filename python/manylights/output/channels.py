"""Channels of OpenEXR files: what they are called, and how they are read and written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.errors import UsageError, argument, check, one_line
from manylights.output import exr
from manylights.threads import threads_for_files

#: Colours of pictures, as every viewer expects them.
RGB = ("R", "G", "B")

#: Channels that make a picture, those that are looked for first in front.
COLORS = (RGB, ("X", "Y", "Z"), ("Y",))

#: From CIE XYZ to linear colours of ITU-R BT.709, as Mitsuba has it.
TO_RGB = np.array(
    [
        [3.240479, -1.537150, -0.498535],
        [-0.969256, 1.875991, 0.041556],
        [0.055648, -0.204043, 1.057311],
    ],
    np.float32,
)

#: Layers of finished images: the number of samples, and the first part of names.
SAMPLES, VARIANCE, DENOISED = "samples", "variance.", "denoised."

#: What the parameter ``counts`` adds to the film, as headings of pictures.
COUNTS = {
    "candidates": "Candidates (N')",
    "node_visits": "Node visits",
    "expected": "Expected light",
}

#: What describes the surfaces in sight, by the name that users ask for: the first part of the
#: channels' names and the type in the parameter ``aovs`` of our integrators.
AOVS = {
    "albedo": ("albedo", "albedo"),
    "normal": ("normal", "sh_normal"),
    "geo_normal": ("geo_normal", "geo_normal"),
    "position": ("P", "position"),
    "depth": ("Z", "depth"),
    "uv": ("uv", "uv"),
    "shape_index": ("shape_index", "shape_index"),
    "prim_index": ("prim_index", "prim_index"),
    **{name: (name, name) for name in ("dp_du", "dp_dv", "duv_dx", "duv_dy", "emission")},
}

#: The types in which merged lamps would not be what they were.
INDEX_TYPES = ("shape_index", "prim_index")

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


def is_sum(name: str) -> bool:
    """Is this channel a part of the sums that a checkpoint has, and no picture?"""
    return re.match(rf"checkpoint\d*_({'|'.join(SUM_PARTS)})\.", name) is not None


def aov_list(names: str | Sequence[str]) -> str:
    """Return the parameter ``aovs`` of our integrators for these names.

    Args:
        names: of ``AOVS``, or ``NAME:TYPE`` as the parameter has them; a text has commas between.

    Raises:
        UsageError: an unknown name, or one that comes twice.
    """
    listed = isinstance(names, (str, list, tuple))
    check("aovs", names, listed, "a text with commas between names, or a list of them")
    words = names.split(",") if isinstance(names, str) else names
    words = [str(word).strip() for word in words]
    for index, word in enumerate(words):
        if word not in AOVS and ":" not in word:
            raise UsageError(f"{argument('aovs')} {word!r}: must be one of {', '.join(AOVS)}")
        if word in words[:index]:
            raise UsageError(f"{argument('aovs')} {word!r}: comes twice")
    return ",".join(word if ":" in word else ":".join(AOVS[word]) for word in words)


def aov_types(text: str) -> list[str]:
    """Return the types in a parameter ``aovs``, which may have commas or spaces between."""
    return [pair.rpartition(":")[2] for pair in re.split(r"[,\s]+", text)]


def is_beauty(name: str) -> bool:
    """Is this channel of a film a part of the image itself, its alpha, too?"""
    return "." not in name and name not in COUNTS


def shown(names: Sequence[str]) -> list[str]:
    """Return which channels of a file are those of the image, in the order of a film."""
    depth = () if "X" in names else ("Z",)
    known = [name for name in (*RGB, *"XYZ", "A") if name in names and name not in depth]
    return known or [name for name in names if is_beauty(name) and name not in depth]


def colors_in(names: Sequence[str]) -> tuple[str, ...] | None:
    """Return which of these channels are a picture, ``None`` if none are."""
    return next((found for found in COLORS if all(name in names for name in found)), None)


def is_averaged(name: str) -> bool:
    """Is the mean of this channel of some files that of their image?"""
    return name != SAMPLES and not name.startswith(DENOISED)


def color_layers(prefix: str, image: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return channels of an array of colours, shape (height, width, 3 or 1); none of ``None``."""
    if image is None:
        return {}
    names = RGB if image.shape[2] == 3 else ("Y",)
    planes = np.moveaxis(image, 2, 0).astype(np.float32, copy=False)
    return {prefix + name: plane for name, plane in zip(names, planes)}


def samples_layer(shape: tuple[int, ...], samples: int) -> dict[str, np.ndarray]:
    """Return the channel with the number of samples of each pixel of an image."""
    return {SAMPLES: np.full(shape[:2], samples, np.float32)}


def names_in_files(names: Sequence[str]) -> list[str]:
    """Return what channels of a film are called in files.

    The depth is ``Z``, as compositors expect it, and counts are named as such.
    """
    known = {"Z.T": "Z", **{name: f"counts.{name}" for name in COUNTS}}
    return [name if known.get(name, name) in names else known.get(name, name) for name in names]


def read(path: str | Path, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the channels of an image file by name, linear, shape (height, width) each.

    All are in single precision.

    Args:
        path: an OpenEXR file, or one of a format that Mitsuba reads.
        prefix: what to write before the file's name in messages.

    Raises:
        UsageError: no such file, or not a whole image.
    """
    files.require(path, prefix)
    try:
        if Path(path).suffix.lower() == ".exr":
            planes = exr.read(path)[0]
            return {name: plane.astype(np.float32, copy=False) for name, plane in planes.items()}
        with threads_for_files():
            bitmap = mi.Bitmap(str(path))
    except (UsageError, RuntimeError) as error:
        reason = one_line(error).removeprefix(f"{path}: ")
        raise UsageError(f"{prefix}{path}: not a readable image ({reason})") from error
    linear = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    return split(linear)


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
    size: Any = [parts[0].shape[1], parts[0].shape[0]]
    kind = mi.Struct.Type.Float32
    bitmap = mi.Bitmap(_formats.MultiChannel, kind, size, len(channels), list(channels))
    pixels = np.array(bitmap, copy=False).reshape(*parts[0].shape[:2], -1)
    np.concatenate(parts, axis=2, out=pixels)
    return bitmap


def colors(bitmap):
    """Return a bitmap of the colour channels alone, ``None`` if there are none."""
    if bitmap.pixel_format() != _formats.MultiChannel:
        return bitmap
    known = names(bitmap)
    chosen = colors_in(known)
    if chosen is None:
        return None
    pixels = np.array(bitmap, copy=False)[..., [known.index(name) for name in chosen]]
    return mi.Bitmap(pixels, getattr(_formats, "".join(chosen)))


def read_colors(path: str | Path, prefix: str = "") -> np.ndarray:
    """Return the colours of an image file, linear, shape (height, width, 3), single precision.

    Raises:
        UsageError: not readable, no colours, or pixels that are not finite.
    """
    planes = read(path, prefix)
    chosen = colors_in(list(planes))
    if chosen is None:
        raise UsageError(f"{prefix}{path}: has no colour channels (R, G, B or Y)")
    image = np.stack([planes[name] for name in chosen], axis=-1)
    if chosen == ("X", "Y", "Z"):
        image = image @ TO_RGB.T
    # A copy: the view of a broadcast cannot be written, which FLIP insists on
    image = np.broadcast_to(image, (*image.shape[:2], 3)).copy()
    broken = int(np.sum(~np.isfinite(image).all(axis=2)))
    if broken:
        raise UsageError(f"{prefix}{path}: {broken} pixels are infinite or not a number")
    return image

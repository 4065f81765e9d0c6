"""Writes images so that a file is there whole or not at all."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.errors import number
from manylights.output import channels, exr, light_groups
from manylights.threads import threads_for_files


def check_output(path: str) -> Path:
    """Return ``path`` if an EXR file can be written there.

    Raises:
        UsageError: another ending, no such folder, a folder of that name, or no permission.
    """
    return files.check_output(path, "the image is an OpenEXR file", ".exr")


def check_stops(value: float) -> None:
    """Check the stops by which a PNG is brighter.

    Raises:
        UsageError: no number from -64 to 64.
    """
    number("exposure", value, lambda stops: -64.0 <= stops <= 64.0, "a number from -64 to 64")


def write_images(
    bitmap,
    target: Path,
    layers: Mapping[str, np.ndarray] | None = None,
    attributes: Mapping[str, Any] | None = None,
    number: type = np.float32,
    samples: int | None = None,
    shown: np.ndarray | None = None,
    stops: float = 0.0,
) -> tuple[list[Path], list[str]]:
    """Write ``bitmap`` as EXR to ``target`` and as PNG (8 bits, sRGB) beside it.

    Each file is written under another name first and then renamed, so it is there whole or not
    at all. Beside the image that takes the memory of two copies of its pixels.

    Args:
        bitmap: the image.
        target: the EXR file.
        layers: further channels by name, shape (height, width) each. Default: none.
        attributes: of the EXR file (``exr.write``). Default: none.
        number: of the image's colours and alpha in the file (``number_of``); all else has 32 bits,
            and so has an image with layers of light groups.
        samples: per pixel, for a channel beside other layers. Default: none.
        shown: colours of the PNG, shape (height, width, 3 or 1). Default: those of the image.
        stops: factors of two by which the PNG is brighter. Default: none.

    Returns:
        The written files, and lines for the log about what could not be written as it is.
    """
    # Layers of light groups add up to the bit.
    number = np.float32 if light_groups.groups(channels.names(bitmap)) else number
    planes, notes = _planes(bitmap, number)
    planes |= {**light_groups.alphas(planes), **(layers or {})}
    if samples is not None and any(not channels.is_beauty(name) for name in planes):
        # An image alone says so in its attributes
        planes |= channels.samples_layer(next(iter(planes.values())).shape, samples)
    written = [exr.write(target, planes, attributes or {})]
    previews, more = write_preview(bitmap, target, shown, stops)
    return written + previews, notes + more


def _planes(bitmap, number: type) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the channels of a bitmap as files have them, and lines about what does not fit."""
    pixels = np.array(bitmap, copy=False)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    names, planes, overflows = channels.names(bitmap), {}, 0
    for index, (name, known) in enumerate(zip(names, channels.names_in_files(names))):
        plane = pixels[..., index]
        with np.errstate(over="ignore"):
            planes[known] = plane.astype(number if channels.is_beauty(name) else np.float32)
        overflows += int((np.isinf(planes[known]) & np.isfinite(plane)).sum())
    return planes, _about_overflows(overflows)


def write_preview(
    bitmap, target: Path, shown: np.ndarray | None = None, stops: float = 0.0
) -> tuple[list[Path], list[str]]:
    """Write the PNG of :func:`write_images` alone, beside ``target``."""
    if shown is not None:
        bitmap = mi.Bitmap(np.ascontiguousarray(shown, np.float32))
    preview = _preview(bitmap, 2.0**stops)
    if preview is None:
        return [], ["preview: the film has no colour channels, no PNG written"]
    return [write_whole(preview, target.with_suffix(".png"), mi.Bitmap.FileFormat.PNG)], []


def number_of(film) -> type:
    """Return the numbers that a film of Mitsuba writes: single precision if it does not say."""
    halves = re.search(r"component_format = float16\b", str(film))
    return np.float16 if halves else np.float32


def _about_overflows(count: int) -> list[str]:
    """Return a line about numbers that became infinite."""
    if not count:
        return []
    remedy = 'give the film <string name="component_format" value="float32"/>'
    return [f"{count} values exceed 65504, the largest in 16 bits, and are infinite: {remedy}"]


def exposed(bitmap, factor: float):
    """Return a bitmap with the colour channels (R, G, B, Y) multiplied by ``factor``.

    Those of layers of light groups are, too, and the image is the sum of these.
    """
    names = channels.names(bitmap)
    layers = light_groups.all_channels(names)
    if factor == 1.0 and not layers:
        return bitmap
    pixels = np.array(bitmap, dtype=np.float32)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    for index, name in enumerate(names):
        if name in (*channels.RGB, "Y", *layers):
            pixels[..., index] *= factor
    light_groups.add_up(pixels, names)
    return channels.join(names, pixels)


def _preview(bitmap, factor: float):
    """Return an 8-bit sRGB version of the colour channels, None if there are none."""
    picture = channels.colors(bitmap)
    if picture is None:
        return None
    if factor != 1.0:
        linear = picture.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
        picture = mi.Bitmap(np.array(linear) * np.float32(factor))
    picture = picture.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    # Without what the image's attributes say of the render
    return mi.Bitmap(np.array(picture))


def write_whole(bitmap, target: Path, file_format) -> Path:
    """Write ``bitmap`` to ``target``, under another name first, and return ``target``.

    Mitsuba writes to memory: it does not look whether the end of a file reaches the disk.
    """
    stream = mi.MemoryStream()
    with threads_for_files():
        bitmap.write(stream, file_format)
    with files.written_whole(target) as partial:
        partial.write_bytes(stream.raw_buffer())
    return target

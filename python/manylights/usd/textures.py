"""Images of a stage as Mitsuba's textures: color spaces, channels, wrapping, tiles, packages."""

from __future__ import annotations

import os
import struct
import tempfile

import mitsuba as mi
import numpy as np
from pxr import Ar, UsdShade

from manylights.usd.color import decode, encoding_of, lamp_spectrum, peak_of
from manylights.usd.shading import Lookup, file_path

MOST_PIXELS = 1 << 28
"""Larger images are not read: their header may be a lie, and memory ends there."""

MOST_ATLAS_PIXELS = 1 << 26
"""Of the image that the tiles of a texture become."""

FLIP = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
"""From texture coordinates of USD (origin at the bottom) to Mitsuba's, and back."""

#: What values of a texture may be, by what it is for: ``None`` means that there is no limit
LIMITS = {"color": (0, 1), "data": (0, 1), "emission": (0, None)}


def to_mitsuba_uv(uv: np.ndarray) -> np.ndarray:
    """Return texture coordinates with v from the top row, as Mitsuba's bitmaps have it.

    The one place where meshes are turned over; matrices of lookups follow it (``FLIP``).
    """
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


class Textures:
    """Reads images once and makes textures of them."""

    def __init__(self, context) -> None:
        self.context = context
        self.pixels: dict[str, np.ndarray | None] = {}
        self.made: dict[tuple, dict] = {}

    def make(self, lookup: Lookup, role: str):
        """Return a texture as a dictionary, or a number or three of them where there is no image.

        Args:
            lookup: which image, and how.
            role: ``"color"``, ``"emission"``, ``"data"`` (one number) or ``"normal"``.
        """
        path, resolved, layer = file_path(lookup, self.context)
        if not path:
            text = "a texture has no file, its fallback value is used"
            self.context.notes.add("texture without a file", text, lookup.node)
        if path and UsdShade.UdimUtils.IsUdimIdentifier(path):
            pixels, lookup.to_uv = self._tiles(lookup, path, layer)
        else:
            pixels = self._read(path, resolved, lookup.node)
        if pixels is None:
            return _fit(lookup.of_channel(lookup.fallback), role)
        numbers = (lookup.scale, lookup.bias, lookup.to_uv)
        key = (str(resolved or path), role, lookup.channel, lookup.wrap, lookup.color_space)
        key += (lookup.threshold, *(tuple(np.ravel(part)) for part in numbers))
        if key not in self.made:
            self.made[key] = self._texture(lookup, role, pixels, path)
        return dict(self.made[key])

    def _texture(self, lookup: Lookup, role: str, pixels: np.ndarray, path: str) -> dict:
        notes, channel = self.context.notes, lookup.channel
        if role == "normal" and pixels.dtype.kind == "u" and _is_unscaled(lookup):
            text = "normal maps without scale and bias are read with the scale 2 and the bias -1"
            notes.add("normal map", text, lookup.node.GetPath())
            lookup.scale, lookup.bias = np.full(4, 2.0), np.full(4, -1.0)
        encoding = encoding_of(lookup, pixels, role, path, notes)
        pixels = with_channels(pixels)
        plain = _is_unscaled(lookup) and role != "normal" and lookup.threshold <= 0
        if plain and channel == "rgb" and pixels.dtype == np.uint8 and encoding != "acescg":
            image, gamma = pixels[..., :3], encoding == "srgb"
        elif plain and channel != "rgb" and encoding == "linear" and pixels.dtype == np.uint8:
            image, gamma = pixels[..., "rgba".index(channel), None], False
        else:
            values = decode(pixels, encoding) * lookup.scale + lookup.bias
            chosen = slice(3) if channel == "rgb" else ["rgba".index(channel)]
            image = values[..., chosen]
            image = (image + 1) / 2 if role == "normal" else np.clip(image, *LIMITS[role])
            image = image >= lookup.threshold if lookup.threshold > 0 else image
            # Half precision holds what 8 bits or a half were
            half = pixels.dtype in (np.uint8, np.float16) and np.abs(image).max() < 60_000
            image, gamma = image.astype(np.float16 if half else np.float32), False
        if role == "data" and image.shape[2] == 3:
            image, gamma = _luminance(image, gamma), False
        if role in ("color", "emission") and image.shape[2] == 1:
            image = np.repeat(image, 3, axis=2)
        return _dictionary(lookup, np.ascontiguousarray(image), gamma, role)

    def _read(self, path, resolved, node) -> np.ndarray | None:
        """Return the pixels of an image, ``None`` and a note if that cannot be done."""
        if not path:
            return None
        key = str(resolved or path)
        if key not in self.pixels:
            self.pixels[key] = self._decode_file(path, resolved, node)
        return self.pixels[key]

    def _decode_file(self, path: str, resolved, node) -> np.ndarray | None:
        notes, where = self.context.notes, node.GetPath()
        try:
            pixels = read_image(str(resolved or ""))
        except (RuntimeError, ValueError, MemoryError) as error:
            reason = " ".join(str(error).split())
            text = f"texture {path} cannot be read ({reason}), its fallback value is used"
            notes.add("broken texture", text, where)
            return None
        if pixels is None:
            text = f"texture {path} is missing, its fallback value is used"
            notes.add("missing texture", text, where)
            return None
        return _at_least_two(pixels[..., None] if pixels.ndim == 2 else pixels)

    def _tiles(self, lookup: Lookup, path: str, layer):
        """Return one image of all tiles of a texture, and the matrix that leads into it."""
        found = UsdShade.UdimUtils.ResolveUdimTilePaths(path, layer) if layer else []
        tiles = {}
        for resolved, number in found:
            pixels = self._read(resolved, resolved, lookup.node)
            if pixels is not None:
                tiles[(int(number) - 1001) % 10, (int(number) - 1001) // 10] = pixels
        if not tiles:
            text = f"texture {path}: no tile is there, its fallback value is used"
            self.context.notes.add("missing texture", text, lookup.node.GetPath())
            return None, lookup.to_uv
        first = np.min(list(tiles), axis=0)
        columns, rows = np.max(list(tiles), axis=0) - first + 1
        height, width = np.max([tile.shape[:2] for tile in tiles.values()], axis=0)
        shrink = np.sqrt(min(1, MOST_ATLAS_PIXELS / (height * width * rows * columns)))
        height, width = max(int(height * shrink), 1), max(int(width * shrink), 1)
        if shrink < 1:
            text = f"the tiles of texture {path} are scaled down to {width} x {height} pixels"
            self.context.notes.add("udim", text, lookup.node.GetPath())
        kind = next(iter(tiles.values())).dtype
        atlas = np.zeros((rows * height, columns * width, 4), dtype=kind)
        for (u, v), tile in tiles.items():
            tile = with_channels(tile)
            y = (np.arange(height) + 0.5) * tile.shape[0] // height
            x = (np.arange(width) + 0.5) * tile.shape[1] // width
            top, left = (rows - 1 - (v - first[1])) * height, (u - first[0]) * width
            part = tile[y.astype(int)[:, None], x.astype(int)]
            atlas[top : top + height, left : left + width] = part.astype(kind)
        lookup.wrap = ("clamp", "clamp")
        into = np.array([[1, 0, -first[0]], [0, 1, -first[1]], [0, 0, 1]])
        return atlas, np.diag([1 / columns, 1 / rows, 1]) @ into @ lookup.to_uv


def _is_unscaled(lookup: Lookup) -> bool:
    return bool((lookup.scale == 1).all() and (lookup.bias == 0).all())


def _dictionary(lookup: Lookup, image: np.ndarray, gamma: bool, role: str) -> dict:
    """Return Mitsuba's texture for an image that is ready."""
    wrap = mitsuba_wrap(lookup.wrap)
    matrix = lookup.to_uv
    if wrap == "black" and role == "normal":
        wrap = "clamp"
    if wrap == "black":
        height, width = image.shape[:2]
        image, wrap = np.pad(image, ((1, 1), (1, 1), (0, 0))), "clamp"
        matrix = np.array([[width, 0, 1], [0, height, 1], [0, 0, 1]]) @ matrix
        matrix = np.diag([1 / (width + 2), 1 / (height + 2), 1]) @ matrix
    in_spectra = role == "emission" and "spectral" in (mi.variant() or "")
    peak = peak_of(image) if in_spectra and image.dtype != np.uint8 else 1.0
    bitmap = mi.Bitmap(image if peak == 1 else image / np.float32(peak))
    bitmap.set_srgb_gamma(gamma)
    texture = {"type": "bitmap", "bitmap": bitmap, "wrap_mode": wrap}
    if lookup.threshold > 0:
        texture["filter_type"] = "nearest"
    if role in ("data", "normal"):
        texture["raw"] = True
    matrix = FLIP @ matrix @ FLIP
    if not np.allclose(matrix, np.eye(3)):
        texture["to_uv"] = mi.ScalarTransform3f(matrix)
    return lamp_spectrum(texture, peak) if in_spectra else texture


def scaled(radiance: dict, factor) -> dict:
    """Return a material's emission times a factor, or one for each channel.

    Args:
        radiance: as ``Material.emission`` has it.
        factor: a number, or three.
    """
    three = np.broadcast_to(np.asarray(factor, dtype=np.float32), 3)
    if radiance["type"] == "rgb":
        values = np.asarray(radiance["value"]) * three
        return {**radiance, "value": [float(value) for value in values]}
    if radiance["type"] == "d65":
        peak = max(float(three.max()), 1e-30)
        nested = scaled(radiance["nested"], three / peak)
        return {**radiance, "nested": nested, "scale": radiance["scale"] * peak}
    if radiance["type"] != "bitmap":
        return radiance
    old = radiance["bitmap"]
    pixels = with_channels(np.atleast_3d(np.array(old)))
    pixels = decode(pixels, "srgb" if old.srgb_gamma() else "linear")[..., :3] * three
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32))
    bitmap.set_srgb_gamma(False)
    return {**radiance, "bitmap": bitmap}


def mitsuba_wrap(wrap: tuple[str, str]) -> str:
    """Return the wrap mode of both directions: the first that means something, or ``"black"``."""
    names = [{"useMetadata": "repeat", "periodic": "repeat"}.get(name, name) for name in wrap]
    if "black" in names:
        return "black"
    return names[0] if names[0] in ("repeat", "mirror", "clamp") else "repeat"


def read_image(path: str) -> np.ndarray | None:
    """Return the pixels of a file, also of one inside of a package; ``None`` if it is not there.

    Raises:
        RuntimeError: Mitsuba cannot read it.
        ValueError: it is too large.
    """
    if os.path.isfile(path):
        with open(path, "rb") as file:
            check_size(*size_of_png(file.read(24)))
        return np.array(mi.Bitmap(path))
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)) if path else None
    if not asset:
        return None
    # Not from memory: Mitsuba's reader of broken OpenEXR files does not end there
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, os.path.basename(path).rstrip("]"))
        with open(file, "wb") as copy:
            copy.write(asset.GetBuffer())
        try:
            return read_image(file)
        except RuntimeError as error:
            raise RuntimeError(str(error).replace(file, path)) from None


def check_size(width: int, height: int) -> None:
    """Raise a ``ValueError`` if an image claims to be larger than any."""
    if width * height > MOST_PIXELS:
        raise ValueError(f"{width} x {height} pixels are more than {MOST_PIXELS}")


def size_of_png(data: bytes) -> tuple[int, int]:
    """Return the width and height that a PNG file claims, ``(0, 0)`` for other files."""
    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        return 0, 0
    return struct.unpack(">II", data[16:24])


def _at_least_two(pixels: np.ndarray) -> np.ndarray:
    """Repeat images of one pixel, of which Mitsuba makes a warning."""
    times = [2 if size == 1 else 1 for size in pixels.shape[:2]]
    return np.tile(pixels, (*times, 1)) if max(times) > 1 else pixels


def with_channels(pixels: np.ndarray) -> np.ndarray:
    """Return four channels: grey ones repeated, with an opaque alpha where there is none."""
    channels = pixels.shape[2]
    if channels == 4:
        return pixels
    whole = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    alpha = pixels[..., 1:2] if channels == 2 else np.full_like(pixels[..., :1], whole)
    color = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    return np.concatenate([color, alpha], axis=2)


def _luminance(image: np.ndarray, gamma: bool) -> np.ndarray:
    """Return one channel of three, for inputs that want a number."""
    values = decode(with_channels(image), "srgb" if gamma else "linear")[..., :3]
    return (values @ [0.2126, 0.7152, 0.0722]).astype(np.float32)[..., None]


def _fit(value, role: str):
    """Return a constant as the role wants it: a number, or three."""
    if role == "data" and np.ndim(value):
        return float(np.dot(value, [0.2126, 0.7152, 0.0722]))
    if role != "data" and not np.ndim(value):
        return (value,) * 3
    return value

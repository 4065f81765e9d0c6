"""Pictures on lights, read from files and from the inside of usdz archives."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from pxr import Ar, Sdf, Usd

from manylights.usd.context import Context

#: What Mitsuba reads.
EXTENSIONS = (".exr", ".hdr", ".rgbe", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm")


@dataclass
class Image:
    """A picture, linear.

    Attributes:
        pixels: ``(height, width, 3)`` float32, the top row first.
        name: of its file.
    """

    pixels: np.ndarray
    name: str

    def texture(self, scale) -> dict:
        """Return the picture times three factors as a texture of radiance."""
        pixels = (self.pixels * np.asarray(scale)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "wrap_mode": "clamp"}


def read_image(asset: Sdf.AssetPath, prim: Usd.Prim, context: Context) -> Image | None:
    """Read the picture that a light names; None and a note with its name if that fails."""
    path = asset.resolvedPath
    name = asset.path
    try:
        if not path:
            raise ValueError("is missing")
        inner = path.rstrip("]").lower()
        if not inner.endswith(EXTENSIONS):
            raise ValueError(f"is none of {', '.join(EXTENSIONS)}")
        pixels = _linear(_bitmap(path))
        if not np.isfinite(pixels).all():
            raise ValueError("has values that are not finite")
        return Image(pixels, path)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        text = f"the picture {name} of a light was left out, the light is plain: it {reason}"
        context.notes.add(f"picture {name}", text, prim)
        return None


def _bitmap(path: str) -> mi.Bitmap:
    if "[" not in path:
        return mi.Bitmap(path)
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not asset:
        raise ValueError("is not in its archive")
    with asset:
        data = bytes(asset.GetBuffer())
    return mi.Bitmap(mi.MemoryStream(data))


def _linear(bitmap: mi.Bitmap) -> np.ndarray:
    """Return three linear channels; only pictures of 8 bits are in sRGB."""
    if bitmap.component_format() not in (mi.Struct.Type.UInt8, mi.Struct.Type.Int8):
        bitmap.set_srgb_gamma(False)
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    pixels = np.array(bitmap, copy=True)
    if pixels.size == 0:
        raise ValueError("is empty")
    return pixels

"""Pictures on lights, read from files and from the inside of usdz archives."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from pxr import Ar, Sdf, Usd

from manylights.usd.context import Context
from manylights.usd.stage import NAMED_FILES

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

    def texture(self, scale, to_uv) -> dict:
        """Return the picture times three factors as a texture of radiance."""
        return emissive(self.pixels * np.asarray(scale), wrap_mode="clamp", to_uv=to_uv)


def emissive(pixels: np.ndarray, **parameters) -> dict:
    """Return linear pixels as a texture of radiance; ``parameters`` are those of a ``bitmap``.

    Mitsuba's ``bitmap`` has reflectances in spectral variants: above 1 it cuts them off.
    """
    spectral = "spectral" in mi.variant()
    peak = max(float(pixels.max()), np.finfo(np.float32).tiny) if spectral else 1.0
    bitmap = mi.Bitmap((pixels / peak).astype(np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": not spectral, **parameters}
    return {"type": "d65", "nested": texture, "scale": peak} if spectral else texture


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
        named = sum(note.kind.startswith("picture ") for note in context.notes)
        kind = f"picture {name}" if named < NAMED_FILES else "pictures"
        context.notes.add(kind, text, prim)
        return None


def _bitmap(path: str) -> mi.Bitmap:
    if "[" not in path:
        return mi.Bitmap(path)
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not asset:
        raise ValueError("is not in its archive")
    with asset:
        data = bytes(asset.GetBuffer())
    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    return mi.Bitmap(stream)


def _linear(bitmap: mi.Bitmap) -> np.ndarray:
    """Return three linear channels; only pictures of 8 bits are in sRGB."""
    if bitmap.component_format() not in (mi.Struct.Type.UInt8, mi.Struct.Type.Int8):
        bitmap.set_srgb_gamma(False)
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    pixels = np.array(bitmap, copy=True)
    if pixels.size == 0:
        raise ValueError("is empty")
    return pixels

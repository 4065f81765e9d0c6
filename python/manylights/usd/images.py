"""Pictures on lights, read from files and from the inside of usdz archives."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from pxr import Sdf, Usd

from manylights.usd import textures
from manylights.usd.color import decode, lamp_spectrum, peak_of
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
        pixels = self.pixels * np.asarray(scale)
        spectral = "spectral" in mi.variant()
        peak = peak_of(pixels) if spectral else 1.0
        texture = {
            "type": "bitmap",
            "bitmap": mi.Bitmap((pixels / peak).astype(np.float32)),
            "raw": not spectral,
            "wrap_mode": "clamp",
            "to_uv": to_uv,
        }
        return lamp_spectrum(texture, peak) if spectral else texture


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
        pixels = _linear(textures.read_image(path))
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


def _linear(pixels: np.ndarray | None) -> np.ndarray:
    """Return three linear channels; only pictures of 8 bits are in sRGB."""
    if pixels is None:
        raise ValueError("is not in its archive")
    if pixels.size == 0:
        raise ValueError("is empty")
    encoding = "srgb" if pixels.dtype == np.uint8 else "linear"
    pixels = textures.with_channels(np.atleast_3d(pixels))
    return np.ascontiguousarray(decode(pixels, encoding)[..., :3])

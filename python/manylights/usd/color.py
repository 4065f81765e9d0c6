"""Color spaces of images."""

from __future__ import annotations

import numpy as np

#: From ACEScg (AP1, D60) to linear Rec. 709 (D65), by Bradford's adaptation
ACESCG_TO_REC709 = np.array(
    [
        [1.70505099, -0.62179212, -0.08325887],
        [-0.13025642, 1.14080474, -0.01054832],
        [-0.02400336, -0.12896898, 1.15297234],
    ]
)


def lamp_spectrum(texture: dict, peak: float) -> dict:
    """Return a texture of radiance for spectral variants, of one with values up to 1.

    Those are reflectances there: above 1 they are cut off, and they lack the white of lamps, D65.

    Args:
        texture: of radiance over ``peak``.
        peak: the largest radiance.
    """
    return {"type": "d65", "nested": texture, "scale": peak}


def peak_of(radiance: np.ndarray) -> float:
    """Return the factor for :func:`lamp_spectrum`: the largest value, never 0."""
    return max(float(radiance.max()), float(np.finfo(np.float32).tiny))


def encoding_of(lookup, pixels: np.ndarray, role: str, path: str, notes) -> str:
    """Return how an image's values are stored: ``"srgb"``, ``"linear"`` or ``"acescg"``.

    Automatic ones are sRGB if they have 8 bits and three or four channels, data never.
    """
    name = lookup.color_space.lower()
    if name not in ("", "auto"):
        found = _named(name)
        if found:
            return found
        text = f"the color space {lookup.color_space} is not known and read as automatic"
        notes.add("color space", text, lookup.node.GetPath())
    if "acescg" in str(path).lower():
        return "acescg" if role in ("color", "emission") else "linear"
    byte_color = pixels.dtype == np.uint8 and pixels.shape[2] >= 3
    if role in ("data", "normal"):
        if byte_color and lookup.channel != "a":
            text = "data in images without an authored color space are read as raw"
            notes.add("data color space", text, lookup.node.GetPath())
        return "linear"
    return "srgb" if byte_color else "linear"


def _named(name: str) -> str | None:
    """Return the encoding of an authored name, in lower case."""
    if "acescg" in name or "ap1" in name:
        return "acescg"
    if any(part in name for part in ("raw", "lin", "data", "identity", "none")):
        return "linear"
    return "srgb" if any(part in name for part in ("srgb", "g22", "g18", "rec709")) else None


def decode(pixels: np.ndarray, encoding: str) -> np.ndarray:
    """Return four channels as linear Rec. 709 numbers; the fourth is never encoded."""
    if pixels.dtype.kind == "u":
        pixels = pixels / np.float32(np.iinfo(pixels.dtype).max)
    pixels = pixels.astype(np.float32)
    color = pixels[..., :3]
    if encoding == "srgb":
        high = ((np.maximum(color, 0.04045) + 0.055) / 1.055) ** 2.4
        color = np.where(color <= 0.04045, color / 12.92, high)
    elif encoding == "acescg":
        color = color @ ACESCG_TO_REC709.T.astype(np.float32)
    return np.concatenate([color, pixels[..., 3:]], axis=2).astype(np.float32)

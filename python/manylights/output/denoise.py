"""Denoises finished images with Open Image Denoise, which the package mitsuba-oidn has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manylights.errors import UsageError
from manylights.output import channels

#: What the denoiser wants to know of the surfaces in sight, as users name it.
GUIDES = ("albedo", "normal")

MISSING = "denoise: needs the package mitsuba-oidn, type: pip install 'manylights[denoise]'"


def check_installed() -> None:
    """Import the denoiser.

    Raises:
        UsageError: it is not there; the text says what to install.
    """
    try:
        import mitsuba_oidn  # noqa: F401
    except ImportError as error:
        raise UsageError(MISSING) from error


def with_guides(names: str | Sequence[str] | None) -> list[str]:
    """Return the names of channels that are asked for with those that the denoiser wants."""
    words = names.split(",") if isinstance(names, str) else list(names or ())
    words = [str(word).strip() for word in words]
    return words + [name for name in GUIDES if name not in words]


def denoised(image: np.ndarray, names: list[str]) -> np.ndarray:
    """Return the colours of an image without noise.

    Args:
        image: shape (height, width, channels), linear. It is not changed.
        names: of its channels. Albedo and normals are used if they are among them.

    Returns:
        Shape (height, width, 3), or (height, width, 1) of images of luminance.

    Raises:
        UsageError: the denoiser is not installed, or there are no colours.
    """
    check_installed()
    import mitsuba_oidn

    found = channels.colors_in(names)
    if found is None or found == ("X", "Y", "Z"):
        raise UsageError("denoise: the film has no colour channels (R, G, B or Y)")
    planes = _planes(image, names, found)
    color = np.ascontiguousarray(np.broadcast_to(planes, (*image.shape[:2], 3)))
    guides = {}
    for guide, letters in zip(GUIDES, ("RGB", "XYZ")):
        wanted = [f"{guide}.{letter}" for letter in letters]
        if all(name in names for name in wanted):
            guides[guide] = _planes(image, names, wanted)
    result = np.array(mitsuba_oidn.denoise(color, hdr=True, **guides), np.float32)
    return result if len(found) == 3 else result.mean(axis=2, keepdims=True)


def _planes(image: np.ndarray, names: list[str], wanted: Sequence[str]) -> np.ndarray:
    chosen = [names.index(name) for name in wanted]
    return np.ascontiguousarray(image[..., chosen], np.float32)

"""Denoises finished images with Open Image Denoise, which the package mitsuba-oidn has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manylights.errors import UsageError, argument, one_line
from manylights.output import channels

#: What the denoiser wants to know of the surfaces in sight, as users name it.
GUIDES = ("albedo", "normal")

#: What is left out of the denoising: lamps in sight have little noise, and are so bright that
#: something of them would be left on the dark pixels beside.
EMISSION = "emission"

#: How bright a channel is.
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)

MISSING = "needs the package mitsuba-oidn, type: pip install 'manylights[denoise]'"


def check_installed() -> None:
    """Import the denoiser.

    Raises:
        UsageError: it is not there; the text says what to install.
    """
    try:
        import mitsuba_oidn  # noqa: F401
    except ImportError as error:
        # It may be there, and lack something itself
        absent = getattr(error, "name", None) == "mitsuba_oidn"
        more = "" if absent else f" ({one_line(error)})"
        raise UsageError(f"{argument('denoise')}: {MISSING}{more}") from error


def with_guides(names: str | Sequence[str] | None) -> list[str]:
    """Return the names of channels that are asked for with those that the denoiser wants."""
    words = names.split(",") if isinstance(names, str) else list(names or ())
    words = [str(word).strip() for word in words]
    return words + [name for name in (*GUIDES, EMISSION) if name not in words]


def picture_in(names: Sequence[str]) -> tuple[str, ...]:
    """Return which channels of a film the denoiser takes.

    Raises:
        UsageError: none of them.
    """
    found = channels.colors_in(names)
    if found is None or found == ("X", "Y", "Z"):
        raise UsageError(f"{argument('denoise')}: the film has no colour channels (R, G, B or Y)")
    return found


def denoised(image: np.ndarray, names: list[str], exposure: float = 1.0) -> np.ndarray:
    """Return the colours of an image without noise.

    Args:
        image: shape (height, width, channels), linear. It is not changed.
        names: of its channels. Albedo, normals and emission are used if they are among them.
        exposure: factor that the colours have, and the emission has not.

    Returns:
        Shape (height, width, 3), or (height, width, 1) of images of luminance.

    Raises:
        UsageError: the denoiser is not installed, or there are no colours.
    """
    check_installed()
    import mitsuba_oidn

    found = picture_in(names)
    planes = _planes(image, names, found)
    color = np.ascontiguousarray(np.broadcast_to(planes, (*image.shape[:2], 3)))
    guides = {}
    for guide, letters in zip(GUIDES, ("RGB", "XYZ")):
        wanted = [f"{guide}.{letter}" for letter in letters]
        # It takes normals with the albedo alone
        if all(name in names for name in wanted) and (guide == GUIDES[0] or guides):
            guides[guide] = _planes(image, names, wanted)
    emitted = _emitted(image, names, exposure, color)
    color = np.ascontiguousarray(color - emitted)
    result = np.array(mitsuba_oidn.denoise(color, hdr=True, **guides), np.float32) + emitted
    return result if len(found) == 3 else result.mean(axis=2, keepdims=True)


def _emitted(image: np.ndarray, names: list[str], exposure: float, color: np.ndarray):
    """Return the part of the colours that lamps in sight emit, no more than there is."""
    wanted = [f"{EMISSION}.{letter}" for letter in channels.RGB]
    if not all(name in names for name in wanted):
        return np.float32(0.0)
    emitted = _planes(image, names, wanted) * np.float32(exposure)
    if channels.colors_in(names) == ("Y",):
        emitted = (emitted @ LUMINANCE)[..., np.newaxis]
    return np.clip(emitted, 0.0, np.maximum(color, 0.0))


def _planes(image: np.ndarray, names: list[str], wanted: Sequence[str]) -> np.ndarray:
    chosen = [names.index(name) for name in wanted]
    return np.ascontiguousarray(image[..., chosen], np.float32)

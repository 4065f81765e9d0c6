"""Makes images of sums."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from manylights.output import channels, images, light_groups
from manylights.rendering.noise import noise, variance_of_mean
from manylights.rendering.sums import Sums

#: The film's channel of the filter's weights, and that of opacity.
WEIGHT, ALPHA = "W", "A"


@dataclass
class Spread:
    """What independent images say about the noise of their mean.

    Attributes:
        mean: of the pixels, shape (height, width, colours).
        variance: of the mean, of the same shape.
        noise: relative, of the whole image (``noise.noise``).
    """

    mean: np.ndarray
    variance: np.ndarray
    noise: float


def picture(sums: np.ndarray, names: list[str]) -> np.ndarray:
    """Return the film's sums divided by the weights, in single precision.

    Where there is no weight the sums stay as they are, as in films of tracers of particles.
    """
    if WEIGHT not in names:
        return sums
    weight = sums[..., names.index(WEIGHT), np.newaxis]
    return np.divide(sums, weight, out=sums.copy(), where=weight != 0)


def colors(names: list[str]) -> list[int]:
    """Return which of the film's channels are colours."""
    known = [names.index(name) for name in (*channels.RGB, "Y") if name in names]
    return known or [i for i, name in enumerate(names) if name not in (WEIGHT, ALPHA)]


def spread(parts: list[tuple[Sums, int]], names: list[str], adjoint: bool) -> Spread | None:
    """Return the noise of the mean of independent renders, None for less than two.

    Args:
        parts: the sums of each, and its samples per pixel.
        names: of the film's channels.
        adjoint: have the sums to be divided by the samples?
    """
    if len(parts) < 2:
        return None
    chosen = colors(names)
    images = np.stack(
        [
            picture(sums.rounded / np.float32(spp) if adjoint else sums.rounded, names)[..., chosen]
            for sums, spp in parts
        ]
    )
    spp = np.array([spp for _, spp in parts], np.float32)
    weights = spp / spp.sum()
    mean = np.tensordot(weights, images, 1)
    variance = variance_of_mean(images, weights)
    return Spread(mean, variance, noise(mean, variance))


def develop(film, raw: np.ndarray, exposure: float = 1.0):
    """Return the film's image of these sums: an array and an ``mi.Bitmap``, weights divided out.

    The film holds the sums then: it is what was rendered last. Colours are multiplied by
    ``exposure``. An image with layers of light groups is their sum.
    """
    film.clear()
    film.put_block(mi.ImageBlock(mi.TensorXf(raw), film.crop_offset()))
    bitmap = images.exposed(film.bitmap(), exposure)
    image, names = np.array(film.develop()), channels.names(bitmap)
    if exposure != 1.0:
        layers = light_groups.all_channels(names)
        chosen = [*colors(names), *(names.index(name) for name in layers)]
        image[..., chosen] *= np.float32(exposure)
    light_groups.add_up(image, names)
    return image, bitmap

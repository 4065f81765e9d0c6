"""Errors of images, arrays of shape (height, width, channels), against a reference."""

from __future__ import annotations

import numpy as np

from manylights.bench import extras
from manylights.rendering.noise import EPSILON, TRIM, divide, squared_scale, trimmed_mean

__all__ = [
    "EPSILON",
    "TRIM",
    "flip_error",
    "relative_errors",
    "relative_mse",
    "rmse",
    "squared_scale",
    "trimmed_mean",
    "variance_error",
]


def relative_errors(
    image: np.ndarray, reference: np.ndarray, epsilon: float = EPSILON
) -> np.ndarray:
    """Return the relative squared error of each pixel, shape (height, width).

    It is the mean over the channels of (x - r)^2 / (r_bar^2 + (epsilon mean r)^2), where r_bar is
    the mean over the pixel's channels. Where both are zero in an all black reference it is zero.
    """
    difference = np.asarray(image, dtype=float) - np.asarray(reference, dtype=float)
    return divide(np.mean(difference**2, axis=2), squared_scale(reference, epsilon))


def relative_mse(image: np.ndarray, reference: np.ndarray, trim: float = 0.0) -> float:
    """Return the relative mean squared error, without the worst share ``trim`` of the pixels."""
    return trimmed_mean(relative_errors(image, reference), trim)


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the root of the mean squared difference."""
    difference = np.asarray(image, dtype=float) - np.asarray(reference, dtype=float)
    return float(np.sqrt(np.mean(difference**2)))


def variance_error(variance: np.ndarray, reference: np.ndarray) -> float:
    """Return the relative mean squared error that an image of this variance is expected to have.

    Args:
        variance: of each pixel and channel.
        reference: estimate of the expected image.
    """
    return float(divide(np.mean(variance, axis=2), squared_scale(reference)).mean())


def flip_error(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the mean of HDR-FLIP, from 0 for equal images to 1.

    It is a model of the difference that a person sees who flips between the two (Andersson et al.
    2021), seen at 67 pixels per degree and at several exposures, which follow from the reference,
    or from the image if the reference is black.

    Raises:
        UsageError: the package flip-evaluator is not installed.
    """
    flip = extras.require("flip_evaluator", "flip-evaluator")
    # Copies: arrays that may not be written to are refused
    pair = [np.array(array, dtype=np.float32, order="C") for array in (reference, image)]
    if pair[0].max() <= 0.0:
        pair.reverse()
    brightest = float(pair[0].max())
    if brightest <= 0.0:
        return 0.0
    # Where no exposure fits flip ends the process
    if not 1e-3 <= brightest <= 1e6:
        pair = [np.float32(array / brightest) for array in pair]
    _, mean, _ = flip.evaluate(*pair, "HDR", applyMagma=False)
    return float(mean)

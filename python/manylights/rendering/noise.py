"""How noisy an image is: the variance of its pixels, and one number for all of them.

The variance comes from a few images of the same scene whose random numbers are independent. Within
one low-discrepancy sequence the samples are not: the variance between its parts is too high.
"""

from __future__ import annotations

import numpy as np

#: Added to a pixel that errors are divided by, as a share of the image's mean: where the image is
#: dark, an error counts in relation to this, not to almost nothing.
EPSILON = 0.05

#: The share of pixels with the largest errors that a trimmed mean leaves out: the mean of squares
#: hangs on very few pixels in scenes where single samples are bright.
TRIM = 0.001


def squared_scale(reference: np.ndarray, epsilon: float = EPSILON) -> np.ndarray:
    """Return what squared differences of each pixel are divided by, shape (height, width)."""
    reference = np.asarray(reference, dtype=float)
    return reference.mean(axis=2) ** 2 + (epsilon * reference.mean()) ** 2


def trimmed_mean(errors: np.ndarray, trim: float = TRIM) -> float:
    """Return the mean without the largest values, the share ``trim`` of all, rounded up."""
    errors = np.ravel(errors)
    kept = errors.size - int(np.ceil(trim * errors.size))
    if not kept:
        return float(errors.mean())
    return float(np.partition(errors, kept - 1)[:kept].mean())


def divide(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return a quotient that is zero for 0 / 0 and infinite for all else over zero."""
    zero = np.where(numerator > 0.0, np.inf, 0.0)
    return np.divide(numerator, denominator, out=zero, where=denominator > 0.0)


def variance_of_mean(images: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the variance of the weighted mean of independent images.

    Args:
        images: shape (images, ...), two or more.
        weights: of each image in the mean, shape (images,), sum 1.
    """
    count = len(images)
    mean = np.tensordot(weights, images, 1)
    squares = np.tensordot(weights**2, (images - mean) ** 2, 1)
    return squares * (count / (count - 1))


def noise(mean: np.ndarray, variance: np.ndarray) -> float:
    """Return the root of the mean relative variance of the pixels, without the worst 0.1 % of them.

    It is the error that the image is expected to have against the true one, relative to the pixels:
    0.02 is 2 %. The relative variance of a pixel is the mean over its colours of the variance,
    divided by ``squared_scale``. Pixels that are not finite are left out.

    Args:
        mean: the image, shape (height, width, colours).
        variance: of its pixels, of the same shape.
    """
    usable = np.isfinite(mean).all(axis=2) & np.isfinite(variance).all(axis=2)
    if not usable.any():
        return float("nan")
    colors = mean[usable][np.newaxis]
    relative = divide(variance[usable].mean(axis=1), squared_scale(colors)[0])
    return float(np.sqrt(trimmed_mean(relative)))

"""How much two images differ, as numbers and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.bench import metrics
from manylights.errors import UsageError
from manylights.output import images

#: Exit status for images that differ.
DIFFERENT = 1

#: Without --threshold: rounding is no difference. Threads that add to the same pixel in another
#: order change the last bits.
LARGEST_ERROR = 1e-6

#: Without --threshold, with a reference: how many times the error of B that of A may be.
LARGEST_RATIO = 1.1


def check_size(image: np.ndarray, name: str, first: np.ndarray, first_name: str) -> None:
    """Raise UsageError unless an image has the size of the first one."""
    if image.shape != first.shape:
        size, wanted = (f"{shape[1]} x {shape[0]}" for shape in (image.shape, first.shape))
        raise UsageError(f"{name}: has {size} pixels, {first_name} has {wanted}")


def write_picture(image: np.ndarray, reference: np.ndarray, target: Path) -> None:
    """Write the picture of the difference as PNG, whole or not at all."""
    pixels = np.round(255.0 * difference_picture(image, reference)).astype(np.uint8)
    images.write_whole(mi.Bitmap(pixels), target, mi.Bitmap.FileFormat.PNG)


def errors(image: np.ndarray, reference: np.ndarray, trim: float) -> dict[str, float]:
    """Return all errors of an image by name, in the order in which they are shown."""
    return {
        "relative_mse": metrics.relative_mse(image, reference),
        "relative_mse_trimmed": metrics.relative_mse(image, reference, trim),
        "rmse": metrics.rmse(image, reference),
        "mean_difference": float(image.mean(dtype=float) - reference.mean(dtype=float)),
        "flip": metrics.flip_error(image, reference),
    }


def compare(
    image: np.ndarray,
    other: np.ndarray,
    reference: np.ndarray | None = None,
    threshold: float | None = None,
    trim: float = metrics.TRIM,
) -> tuple[dict[str, Any], bool]:
    """Compare two images with each other, or both with a reference.

    Args:
        image, other: the images A and B.
        reference: what both are compared with. Default: A is compared with B.
        threshold: of the trimmed relative mean squared error, with a reference of the ratio of
            that of A to that of B. Default: ``LARGEST_ERROR`` or ``LARGEST_RATIO``.
        trim: share of the worst pixels that the trimmed error leaves out.

    Returns:
        The errors, and whether they are within the threshold.
    """
    if reference is None:
        limit = LARGEST_ERROR if threshold is None else threshold
        found = errors(image, other, trim)
        return {**found, "threshold": limit}, found["relative_mse_trimmed"] <= limit
    limit = LARGEST_RATIO if threshold is None else threshold
    first, second = errors(image, reference, trim), errors(other, reference, trim)
    names = ("relative_mse", "relative_mse_trimmed", "rmse", "flip")
    ratio = {name: _ratio(first[name], second[name]) for name in names}
    equal = first["relative_mse_trimmed"] <= limit * second["relative_mse_trimmed"]
    return {"a": first, "b": second, "ratio": ratio, "threshold": limit}, equal


def difference_picture(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the relative difference as colours from 0 to 1, shape (height, width, 3).

    Black is equal, red is brighter than the reference, blue is darker; full colour stands for a
    difference of the reference's own size or more.
    """
    difference = (image.astype(float) - reference.astype(float)).mean(axis=2)
    scale = np.sqrt(metrics.squared_scale(reference))
    relative = np.divide(difference, scale, out=np.sign(difference), where=scale > 0.0)
    red, blue = np.clip(relative, 0.0, 1.0), np.clip(-relative, 0.0, 1.0)
    return np.stack([red, 0.25 * (red + blue), blue], axis=2)


def as_text(found: dict[str, Any], equal: bool) -> str:
    """Return what ``compare`` found as lines of text."""
    limit = f"{found['threshold']:g}"
    if "ratio" not in found:
        lines = [
            f"{name:<22}{value:>14.6g}" for name, value in found.items() if name != "threshold"
        ]
        verdict = "equal" if equal else "different"
        return "\n".join([*lines, f"{verdict} (threshold {limit} of relative_mse_trimmed)"])
    lines = [f"{'':<22}{'A':>14}{'B':>14}{'A / B':>14}"]
    for name, value in found["a"].items():
        ratio = found["ratio"].get(name)
        last = "" if ratio is None else f"{ratio:>14.4g}"
        lines.append(f"{name:<22}{value:>14.6g}{found['b'][name]:>14.6g}{last}")
    verdict = "A is as good as B" if equal else "A is worse than B"
    return "\n".join(
        [*lines, f"{verdict} (threshold {limit} of the ratio of relative_mse_trimmed)"]
    )


def _ratio(first: float, second: float) -> float | None:
    return first / second if second > 0.0 else None

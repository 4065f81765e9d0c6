"""The image that errors are measured against: rendered with many samples, or given as a file.

It is rendered with our integrator and its default method, with random numbers that no measurement
uses. If that were biased, the error of ``uniform`` would not fall in proportion to the samples, and
its mean would differ from the reference's by more than both standard errors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from manylights import files
from manylights.bench import methods, metrics, samplers
from manylights.bench.drawing import draw
from manylights.bench.moments import Moments
from manylights.bench.scene_source import MeasuredScene
from manylights.errors import UsageError
from manylights.output import channels

#: Samples of the reference for each sample of the largest measurement, and independent renders of
#: that many samples which its own error is taken from.
PASSES = 64

#: Seeds of a reference start here, those of measurements at 1.
FIRST_SEED = 2**31


def render(
    loaded: MeasuredScene, spp: int, advance: Callable[[float], None]
) -> tuple[np.ndarray, dict[str, Any]]:
    """Render a reference of ``PASSES`` times ``spp`` samples.

    Args:
        loaded: the scene.
        spp: the largest number of samples that is measured.
        advance: called with the seconds of each finished pass.

    Returns:
        The image, and the entry for the file of results.
    """
    method = methods.Method(methods.OURS[0])
    description = methods.integrator_for(method, loaded.kind)
    integrator = mi.load_dict(description)
    draw(loaded, integrator, spp, FIRST_SEED + PASSES, samplers.OURS)
    moments, means, seconds = Moments(), [], 0.0
    for index in range(PASSES):
        drawing = draw(loaded, integrator, spp, FIRST_SEED + index, samplers.OURS)
        moments.add(index, drawing.image)
        means.append(float(drawing.image.mean(dtype=float)))
        seconds += drawing.seconds
        advance(drawing.seconds)
    image = np.asarray(moments.mean, dtype=np.float32)
    return image, {
        "integrator": description["type"],
        "spp": PASSES * spp,
        "seconds": seconds,
        "error": metrics.variance_error(moments.variance() / PASSES, image),
        "mean": float(np.mean(means)),
        "mean_error": float(np.std(means, ddof=1) / np.sqrt(PASSES)),
    }


def read(path: str, size: tuple[int, int]) -> tuple[np.ndarray, dict[str, Any]]:
    """Read a reference from a file. It is taken as exact: errors and samples of it are 0.

    Args:
        path: an image.
        size: width and height that it must have.

    Raises:
        UsageError: not readable, of another size, or with pixels that are not numbers.
    """
    image = channels.read_colors(path, "--reference ")
    height, width = image.shape[:2]
    if (width, height) != size:
        raise UsageError(
            f"--reference {path}: has {width} x {height} pixels, the scene has "
            f"{size[0]} x {size[1]}"
        )
    exact = {"integrator": Path(path).name, "spp": 0, "seconds": 0.0, "error": 0.0}
    return image, {**exact, "mean": float(image.mean(dtype=float)), "mean_error": 0.0}


def fingerprint(path: str | None) -> str:
    """Return a text that differs for references that differ, empty without one."""
    if path is None:
        return ""
    files.require(path, "--reference ")
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()

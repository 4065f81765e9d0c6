"""What a finished file says about how its image was made."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.output import exr

#: Primaries and white of what Mitsuba calls RGB: those of ITU-R BT.709.
CHROMATICITIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)

#: Attributes of the OpenEXR standard that say how an image was made.
STANDARD = ("software", "chromaticities", "worldToCamera", "worldToNDC")

#: Facts of parts and checkpoints that are for the program alone.
HIDDEN = ("learnt", "channels", "shown", "runs")

#: Columns of names in what ``describe`` returns.
INDENT = 20


def attributes(job, result, software: str) -> dict[str, Any]:
    """Return the attributes of the file of ``result`` (``RenderResult``) by name.

    Those of the OpenEXR standard have its names, others begin with ``manylights.``. The facts of
    the job are not among them (``state_file.sign``).

    Args:
        job: what was rendered.
        result: its ``RenderResult``.
        software: the versions, as the facts of the job have them.
    """
    noise = {} if result.noise is None else {f"{exr.OURS}noise": result.noise}
    told = own(result.samples, result.seconds, parameters(job.driver.integrator))
    return standard(job, software) | told | noise


def standard(job, software: str) -> dict[str, Any]:
    """Return those of the OpenEXR standard, which parts and checkpoints have, too."""
    camera = camera_matrices(job.driver.sensor)
    return {"software": software, "chromaticities": CHROMATICITIES, **camera}


def own(samples: int, seconds: float, parameters: str) -> dict[str, Any]:
    """Return those of ours that are not facts of the job: what it took, and by which integrator."""
    told = {"samples": samples, "seconds_taken": round(seconds, 3), "parameters": parameters}
    return {exr.OURS + name: value for name, value in told.items()}


def shared(files: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the attributes that are the same in all of some files."""
    first, *others = files
    return {
        name: value
        for name, value in first.items()
        if all(name in other and np.array_equal(value, other[name]) for other in others)
    }


def parameters(integrator) -> str:
    """Return an integrator with its parameters as Mitsuba prints it, without what was measured."""
    return re.sub(r",\n *tree = .*", "", str(integrator))


def camera_matrices(sensor) -> dict[str, np.ndarray]:
    """Return ``worldToCamera``, and ``worldToNDC`` of perspective cameras, shape (4, 4) each.

    As the OpenEXR standard has it they are multiplied by row vectors from the left. The camera's
    space is Mitsuba's; in NDC (0, 0) is the upper left corner of the image and (1, 1) the lower
    right one. Empty for sensors that are not at one place.
    """
    try:
        to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        to_camera = np.linalg.inv(to_world)
    except (ValueError, np.linalg.LinAlgError):
        return {}
    result = {"worldToCamera": to_camera}
    parameters = dict(mi.traverse(sensor))
    if "x_fov" in parameters and sensor.class_name() in ("PerspectiveCamera", "ThinLensCamera"):
        result["worldToNDC"] = _projection(sensor, parameters) @ to_camera
    return {name: matrix.T.astype(np.float32) for name, matrix in result.items()}


def _projection(sensor, parameters: dict[str, Any]) -> np.ndarray:
    """Return the matrix from the camera's space to NDC, for column vectors."""
    film = sensor.film()
    fov = float(np.ravel(parameters["x_fov"])[0])
    near, far = float(sensor.near_clip()), float(sensor.far_clip())
    size, crop, begin = film.size(), film.crop_size(), film.crop_offset()
    matrix = mi.perspective_projection(size, crop, begin, fov, near, far).matrix
    shift = np.eye(4)
    for axis, name in enumerate("xy"):
        offset = parameters.get(f"principal_point_offset_{name}", 0.0)
        shift[axis, 3] = -float(np.ravel(offset)[0]) * int(size[axis]) / int(crop[axis])
    return shift @ np.array(matrix, np.float64).reshape(4, 4)


def describe(attributes: dict[str, Any]) -> list[str]:
    """Return the attributes of a file for people, a line or more each, our own first.

    Facts without a value are left out, and those for the program alone.
    """
    ordered = sorted(attributes.items(), key=lambda item: not item[0].startswith(exr.OURS))
    lines = []
    for name, value in ordered:
        if name.startswith(exr.OURS) and name.removeprefix(exr.OURS) in HIDDEN:
            continue
        if name == f"{exr.OURS}command" and (words := exr.fact(value)):
            value = shlex.join(["manylights", *words])
        if text := _text(value):
            first, *rest = text.splitlines()
            lines.append(f"{name.removeprefix(exr.OURS) + ':':<{INDENT - 1}} {first}")
            lines += [" " * INDENT + line for line in rest]
    return lines


def _text(value: Any) -> str:
    """Return a value for people; of dictionaries a line for each item, nothing of none."""
    if isinstance(value, str):
        value = exr.fact(value)
    if isinstance(value, dict):
        return "\n".join(f"{key} = {item}" for key, item in value.items())
    if isinstance(value, np.ndarray):
        return np.array2string(value, precision=6, suppress_small=True)
    if isinstance(value, (tuple, list)):
        return ", ".join(f"{item:.4g}" if isinstance(item, float) else str(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "" if value is None else str(value)

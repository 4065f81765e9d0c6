"""What a finished file says about how its image was made."""

from __future__ import annotations

import json
import re
from typing import Any

import mitsuba as mi
import numpy as np

from manylights.output import exr

#: Primaries and white of what Mitsuba calls RGB: those of ITU-R BT.709.
CHROMATICITIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)

#: Columns of names in what ``describe`` returns.
INDENT = 20

#: Facts of a job that only tell whether a state belongs to it.
OF_STATES = ("format", "steps", "until_noise", "seconds", "spp", "size")


def attributes(job, result) -> dict[str, Any]:
    """Return the attributes of the file of ``result`` (``RenderResult``) by name.

    Those of the OpenEXR standard have its names, all others begin with ``manylights.``: scene and
    digests of its files, samples, seed, noise, integrator with all parameters, variant, versions.
    """
    facts = {name: value for name, value in job.facts().items() if name not in OF_STATES}
    facts |= {
        "samples": result.samples,
        "seconds": round(result.seconds, 3),
        "noise": result.noise,
        "integrator": _parameters(job.driver.integrator),
    }
    if job.loaded.files:
        facts["scene"] = str(job.loaded.files[0].name)
    known = {name: value for name, value in facts.items() if value not in (None, {}, "")}
    return {
        "software": facts["version"],
        "chromaticities": CHROMATICITIES,
        **camera_matrices(job.driver.sensor),
        **{exr.OURS + name: value for name, value in known.items()},
    }


def _parameters(integrator) -> str:
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
    """Return the attributes of a file for people, a line or more each, our own first."""
    ordered = sorted(attributes.items(), key=lambda item: not item[0].startswith(exr.OURS))
    lines = []
    for name, value in ordered:
        first, *rest = _text(value).splitlines() or [""]
        lines.append(f"{name.removeprefix(exr.OURS) + ':':<{INDENT - 1}} {first}")
        lines += [" " * INDENT + line for line in rest]
    return lines


def _text(value: Any) -> str:
    """Return a value for people; dictionaries, which files keep as JSON, a line for each item."""
    if isinstance(value, str) and value.startswith("{"):
        return "\n".join(f"{key} = {item}" for key, item in json.loads(value).items())
    if isinstance(value, np.ndarray):
        return np.array2string(value, precision=6, suppress_small=True)
    if isinstance(value, tuple):
        return ", ".join(f"{number:.4g}" for number in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)

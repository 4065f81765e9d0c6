"""Shapes of Mitsuba from matrices of unit shapes, and which of them Mitsuba has exactly.

A unit shape of a rectangle is the unit square, of the others what has radius and length 1.
Matrices are for row vectors.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from manylights.usd import tessellation as shapes

#: Radius over the size of the scene below which Mitsuba's spheres lose accuracy.
SMALLEST_SPHERE = 0.005


def scaled(matrices: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return np.array([[x], [y], [z], [1.0]]) * matrices


def corners(matrices: np.ndarray) -> np.ndarray:
    """Return two opposite corners, of eight, of unit cubes: enough for the size of a scene."""
    diagonal = np.abs(matrices[:, :3, :3]).sum(axis=1)
    centres = matrices[:, 3, :3]
    return np.concatenate([centres - diagonal, centres + diagonal])


def transform(matrix: np.ndarray):
    """Return a matrix for row vectors as a transform of Mitsuba."""
    return mi.ScalarTransform4f(np.ascontiguousarray(matrix.T))


def facing(matrix: np.ndarray):
    """Return the transform of a ``rectangle`` or ``disk`` over the unit square that faces -Z.

    Mitsuba's mirrored rectangles face the other way: here a mirrored one is mirrored once more.
    """
    x, y = matrix[0, :3] / 2, matrix[1, :3] / 2
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    normal = np.cross(y, x) if not mirrored else np.cross(x, y)
    if mirrored:
        x = -x
    length = np.linalg.norm(normal)
    rows = np.stack([x, -y, normal / max(length, np.finfo(float).tiny)])
    result = np.eye(4)
    result[:3, :3], result[3, :3] = rows, matrix[3, :3]
    return transform(result), mirrored


def unmirrored(mirrored: bool):
    """Return the ``to_uv`` with which a picture is not mirrored."""
    if mirrored:
        return mi.ScalarTransform4f()
    return mi.ScalarTransform4f().translate([1, 0, 0]) @ mi.ScalarTransform4f().scale([-1, 1, 1])


def _as_sphere(matrix) -> dict:
    radius = float(shapes.scale_of(matrix[None, :3, :3])[0])
    return {"kind": "sphere", "center": matrix[3, :3].tolist(), "radius": radius}


def _as_rectangle(matrix) -> dict:
    return {"kind": "rectangle", "to_world": facing(matrix)[0]}


def _as_disk(matrix) -> dict:
    return {"kind": "disk", "to_world": facing(scaled(matrix[None], 2, 2, 1)[0])[0]}


def _as_cylinder(matrix) -> dict:
    half, centre = matrix[0, :3] / 2, matrix[3, :3]
    radius = float(np.linalg.norm(matrix[1, :3]))
    ends = {"p0": (centre - half).tolist(), "p1": (centre + half).tolist()}
    return {"kind": "cylinder", "radius": radius, **ends}


def _exact_spheres(matrices, size: float) -> np.ndarray:
    linear = matrices[:, :3, :3]
    large = shapes.scale_of(linear) >= SMALLEST_SPHERE * size
    return shapes.is_uniform(linear) & large


def _exact_rects(matrices, size: float) -> np.ndarray:
    return np.ones(len(matrices), dtype=bool)


def _exact_disks(matrices, size: float) -> np.ndarray:
    x, y = matrices[:, 0, :3], matrices[:, 1, :3]
    return _round(x, y)


def _exact_cylinders(matrices, size: float) -> np.ndarray:
    axis, y, z = (matrices[:, row, :3] for row in range(3))
    lengths = np.linalg.norm(axis, axis=1), np.linalg.norm(y, axis=1), np.linalg.norm(z, axis=1)
    lean = np.abs((axis * y).sum(axis=1)) / (lengths[0] * lengths[1])
    lean += np.abs((axis * z).sum(axis=1)) / (lengths[0] * lengths[2])
    return _round(y, z) & (lean < shapes.ROUNDING)


def _round(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Are these pairs of vectors orthogonal and of one length?"""
    square = (x**2).sum(axis=1)
    difference = np.abs(square - (y**2).sum(axis=1)) + np.abs((x * y).sum(axis=1))
    return difference <= shapes.ROUNDING * square


def _disk_areas(linear: np.ndarray) -> np.ndarray:
    return np.pi * shapes.flat_areas(linear)


AREAS = {
    "sphere": shapes.sphere_areas,
    "rect": shapes.flat_areas,
    "disk": _disk_areas,
    "cylinder": shapes.tube_areas,
}
EXACT = {
    "sphere": _exact_spheres,
    "rect": _exact_rects,
    "disk": _exact_disks,
    "cylinder": _exact_cylinders,
}
SHAPES = {
    "sphere": _as_sphere,
    "rect": _as_rectangle,
    "disk": _as_disk,
    "cylinder": _as_cylinder,
}

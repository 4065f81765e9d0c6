"""Copies of a surface as one mesh."""

from __future__ import annotations

import numpy as np

from manylights.usd.description import MeshShape, copied_faces, transformed
from manylights.usd.mitsuba_meshes import with_directions
from manylights.usd.surface import Surface
from manylights.usd.textures import to_mitsuba_uv


def copies(surface: Surface, bsdf: dict | None, matrices: np.ndarray) -> MeshShape:
    """Return copies of a surface, one for each ``(4, 4)``, in the space that these lead to."""
    count, vertices = len(matrices), len(surface.positions)
    faces = copied_faces(surface.faces.astype(np.int64), vertices, matrices).reshape(-1, 3)
    positions = transformed(surface.positions, matrices).reshape(-1, 3)
    mesh = MeshShape(positions.astype(np.float32), faces.astype(np.uint32), bsdf=bsdf)
    if surface.normals is not None:
        mesh.normals = _normals(with_directions(surface), matrices)
    if surface.uv is not None:
        mesh.uv = np.tile(to_mitsuba_uv(surface.uv), (count, 1)).astype(np.float32)
    for name, rows in (("color", surface.colors), ("opacity", surface.opacity)):
        if rows is not None:
            per = getattr(surface, "colors_per" if name == "color" else "opacity_per")
            mesh.attributes[f"{per}_{name}"] = np.tile(rows, (count, 1))
    return mesh


def _normals(normals: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Return the normals of copies, on the outside also where a matrix mirrors."""
    linear = matrices[:, :3, :3]
    # The cofactors are the inverse transposed times the determinant, and exist without it
    x, y, z = (linear[:, row] for row in range(3))
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    cofactors *= np.where(np.linalg.det(linear) < 0, -1.0, 1.0)[:, None, None]
    result = (normals @ cofactors).reshape(-1, 3)
    lengths = np.linalg.norm(result, axis=1, keepdims=True)
    return (result / np.maximum(lengths, np.finfo(float).tiny)).astype(np.float32)

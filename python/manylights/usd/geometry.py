"""Meshes as fans of triangles; other prims of geometry have no surfaces yet."""

from __future__ import annotations

import numpy as np
from pxr import UsdGeom

from manylights.usd.surface import Surface


def surfaces_of(prim, context) -> list[Surface]:
    """Return the surface of a mesh."""
    mesh = UsdGeom.Mesh(prim)
    if not mesh:
        return []
    points = context.value(mesh.GetPointsAttr())
    counts = context.value(mesh.GetFaceVertexCountsAttr())
    indices = context.value(mesh.GetFaceVertexIndicesAttr())
    if not points or not counts or not indices:
        return []
    indices, faces, begin = np.array(indices), [], 0
    for count in counts:
        corners = indices[begin : begin + count]
        faces += [(corners[0], corners[i], corners[i + 1]) for i in range(1, count - 1)]
        begin += count
    faces = np.array(faces, dtype=np.uint32)
    if context.value(mesh.GetOrientationAttr()) == "leftHanded":
        faces = faces[:, ::-1]
    double = bool(context.value(mesh.GetDoubleSidedAttr(), False))
    positions = np.array(points, dtype=np.float32)
    return [Surface(positions, faces, double_sided=double, binding=prim)]

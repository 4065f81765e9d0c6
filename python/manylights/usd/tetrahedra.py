"""TetMesh prims: their outside as surfaces."""

from __future__ import annotations

import numpy as np
from pxr import UsdGeom

from manylights.usd.meshes import polygons_of, surface_of
from manylights.usd.surface import Surface
from manylights.usd.triangulation import triangulate


def surfaces_of_tetrahedra(prim, context) -> list[Surface]:
    """Return the outer triangles of a TetMesh."""
    mesh = UsdGeom.TetMesh(prim)
    faces = context.value(mesh.GetSurfaceFaceVertexIndicesAttr())
    if faces is None or not len(faces):
        faces = UsdGeom.TetMesh.ComputeSurfaceFaces(mesh, context.time)
    indices = np.asarray(faces if faces is not None else []).ravel()
    counts = np.full(len(indices) // 3, 3)
    polygons = polygons_of(prim, context.value(mesh.GetPointsAttr()), counts, indices, context)
    if polygons is None:
        return []
    corners, faces = triangulate(polygons.points, polygons.counts, polygons.indices)
    if context.value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded:
        corners = corners[:, [0, 2, 1]]
    surface = surface_of(polygons, corners, faces, prim)
    surface.double_sided = bool(context.value(mesh.GetDoubleSidedAttr(), False))
    return [surface]

"""Prims of geometry as surfaces, whatever their type."""

from __future__ import annotations

from pxr import UsdGeom

from manylights.usd.curves import surfaces_of_curves
from manylights.usd.gprims import SHAPES, surfaces_of_gprim, surfaces_of_points
from manylights.usd.meshes import surfaces_of_mesh
from manylights.usd.surface import Surface
from manylights.usd.tetrahedra import surfaces_of_tetrahedra

READERS = {
    "Mesh": surfaces_of_mesh,
    "Points": surfaces_of_points,
    "BasisCurves": surfaces_of_curves,
    "TetMesh": surfaces_of_tetrahedra,
    **dict.fromkeys(SHAPES, surfaces_of_gprim),
}


def surfaces_of(prim, context) -> list[Surface]:
    """Return the surfaces of a prim, in its own space: one for each material it is bound to.

    Broken prims, and geometry of other types, have none and are noted.
    """
    kind = str(prim.GetTypeName())
    reader = READERS.get(kind)
    if reader is not None:
        return reader(prim, context)
    if prim.IsA(UsdGeom.Gprim):
        context.notes.add(kind, f"prims of type {kind} are left out", prim)
    return []

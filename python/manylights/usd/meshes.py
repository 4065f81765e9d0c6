"""Mesh prims as surfaces: faces of any shape, subsets, and primvars of every interpolation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pxr import UsdGeom, UsdShade

from manylights.usd import primvars
from manylights.usd.primvars import PER_POINT, Sizes, Values
from manylights.usd.subdivision import cage_of, levels_of, refine
from manylights.usd.surface import Surface
from manylights.usd.triangulation import triangulate

LARGEST_COORDINATE = 1e30
"""Points further away overflow single precision as soon as their distance is squared."""


@dataclass
class Polygons:
    """A mesh before it is cut into triangles.

    Attributes:
        points: ``(n, 3)`` float32.
        counts: ``(f,)`` int64 corners of each face.
        indices: ``(c,)`` int64 point of each corner.
        face_of: ``(f,)`` authored face of each face: another one only where it was refined.
        normals: with their interpolation, or ``None``.
        uv: texture coordinates by name.
        colors: displayColor.
        opacity: displayOpacity.
    """

    points: np.ndarray
    counts: np.ndarray
    indices: np.ndarray
    face_of: np.ndarray
    normals: Values | None = None
    uv: dict[str, Values] = field(default_factory=dict)
    colors: Values | None = None
    opacity: Values | None = None

    @property
    def sizes(self) -> Sizes:
        """How many values each interpolation has."""
        return Sizes(len(self.counts), len(self.points), len(self.indices))


def surfaces_of_mesh(prim, context) -> list[Surface]:
    """Return the triangles of a mesh, one surface for each material it is bound to."""
    mesh = UsdGeom.Mesh(prim)
    polygons = _read_topology(mesh, context)
    if polygons is None:
        return []
    count = len(polygons.counts)
    holes = _indices(context.value(mesh.GetHoleIndicesAttr()), count, prim, context)
    whole = _cut(mesh, _refined(mesh, polygons, context), holes, context)
    return _split(whole, prim, count, context) if len(whole.faces) else []


def polygons_of(prim, points, counts, indices, context) -> Polygons | None:
    """Return faces with the primvars of a prim, ``None`` and a note if they are not a mesh.

    Args:
        prim: whose primvars they have.
        points: anything that is an array of three numbers a row.
        counts: corners of each face.
        indices: point of each corner.
        context: of the stage.
    """
    points = primvars.as_rows(points if points is not None else [], 3)
    if points is None or not len(points):
        context.notes.add("empty mesh", "a mesh without points is left out", prim)
        return None
    counts = primvars.integers(counts)
    indices = primvars.integers(indices)
    problem = _problem(points, counts, indices)
    if problem:
        kind = "empty mesh" if not len(counts) else "broken mesh"
        context.notes.add(kind, f"a mesh is left out: {problem}", prim)
        return None
    polygons = Polygons(points, counts, indices, np.arange(len(counts)))
    polygons.uv = primvars.texture_coordinates(prim, polygons.sizes, context)
    polygons.colors, polygons.opacity = primvars.display_color(prim, polygons.sizes, context)
    return polygons


def _problem(points, counts, indices) -> str | None:
    """Return what makes a mesh useless."""
    if not len(counts):
        return "it has no faces"
    if counts.min() < 0:
        return f"faceVertexCounts has {counts.min()}"
    if counts.sum() != len(indices):
        return f"faceVertexCounts add up to {counts.sum()}, faceVertexIndices has {len(indices)}"
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        wrong = indices.min() if indices.min() < 0 else indices.max()
        return f"faceVertexIndices has {wrong}, there are {len(points)} points"
    return None


def _read_topology(mesh, context) -> Polygons | None:
    prim, value = mesh.GetPrim(), context.value
    polygons = polygons_of(
        prim,
        value(mesh.GetPointsAttr()),
        value(mesh.GetFaceVertexCountsAttr()),
        value(mesh.GetFaceVertexIndicesAttr()),
        context,
    )
    if polygons is None:
        return None
    polygons = _without_bad_points(polygons, prim, context)
    polygons.normals = _normals(mesh, polygons.sizes, context)
    return polygons


def _without_bad_points(polygons: Polygons, prim, context) -> Polygons:
    """Empty the faces that have a point which is not finite."""
    bad = ~(np.abs(polygons.points) < LARGEST_COORDINATE).all(axis=1)
    if bad.any():
        hit = np.repeat(np.arange(len(polygons.counts)), polygons.counts)[bad[polygons.indices]]
        polygons.face_of[hit] = -1  # _cut leaves these out
        text = "faces with points that are NaN, infinite or above 1e30 are left out"
        context.notes.add("points not finite", text, prim)
        polygons.points = np.where(bad[:, None], np.float32(0), polygons.points)
    return polygons


def _normals(mesh, sizes: Sizes, context) -> Values | None:
    """Return authored normals: ``primvars:normals`` rather than ``normals``."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    found = primvars.read_primvar(primvar, 3, sizes, context)
    if found is None:
        attribute = mesh.GetNormalsAttr()
        rows = context.value(attribute)
        rows = None if rows is None else primvars.as_rows(rows, 3)
        if rows is None or not len(rows):
            return None
        path = attribute.GetPath()
        interpolation = mesh.GetNormalsInterpolation()
        found = primvars.fitting(rows, interpolation, sizes, str(path), context.notes)
    if found is not None and not np.isfinite(found.array).all():
        context.notes.add("normals not finite", "normals with NaN are not used", mesh.GetPrim())
        return None
    return found


def _refined(mesh, polygons: Polygons, context) -> Polygons:
    """Return the mesh after the subdivision that its scheme and the choices ask for."""
    scheme, levels = levels_of(mesh, len(polygons.counts), context)
    if not levels:
        return polygons
    return refine(polygons, cage_of(mesh, scheme, context), levels)


def _cut(mesh, polygons: Polygons, holes: np.ndarray, context) -> Surface:
    """Return the triangles of all faces that are shown."""
    corners, faces = triangulate(polygons.points, polygons.counts, polygons.indices)
    if context.value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded:
        corners = corners[:, [0, 2, 1]]
    shown = polygons.face_of[faces] >= 0
    if len(holes):
        shown &= ~np.isin(polygons.face_of[faces], holes)
    whole = surface_of(polygons, corners[shown], faces[shown], mesh.GetPrim())
    whole.double_sided = bool(context.value(mesh.GetDoubleSidedAttr(), False))
    if not len(whole.faces):
        text = "a mesh is left out: all its faces are holes or have fewer than three corners"
        context.notes.add("empty mesh", text, mesh.GetPrim())
    return whole


def surface_of(polygons: Polygons, corners, faces, prim) -> Surface:
    """Return a surface of triangles that are given by their corners and faces.

    Points stay shared unless something differs from corner to corner of one point.
    """
    smooth = [polygons.normals, *polygons.uv.values()]
    smooth = [values for values in smooth if values is not None]
    colors = [values for values in (polygons.colors, polygons.opacity) if values is not None]
    split = any(values.interpolation in ("uniform", "faceVarying") for values in smooth)
    split = split or any(values.interpolation == "faceVarying" for values in colors)

    def spread(values: Values | None):
        if values is None:
            return None
        if not split:
            count = len(polygons.points)
            rows = values.array
            return rows if values.interpolation in PER_POINT else np.repeat(rows[:1], count, axis=0)
        return values.on_corners(polygons.counts, polygons.indices)

    def spread_color(values: Values | None):
        if values is None or values.interpolation in (*PER_POINT, "faceVarying"):
            return spread(values), "vertex"
        rows = values.array[faces if values.interpolation == "uniform" else np.zeros_like(faces)]
        return rows, "face"

    positions = polygons.points[polygons.indices] if split else polygons.points
    triangles = corners if split else polygons.indices[corners]
    sets = {name: spread(values) for name, values in polygons.uv.items()}
    surface = Surface(
        positions=positions,
        faces=triangles.astype(np.uint32),
        normals=spread(polygons.normals),
        uv=next(iter(sets.values()), None),
        face_of=polygons.face_of[faces].astype(np.int32),
        binding=prim,
        uv_sets=sets,
    )
    surface.colors, surface.colors_per = spread_color(polygons.colors)
    surface.opacity, surface.opacity_per = spread_color(polygons.opacity)
    return surface


def _split(whole: Surface, prim, face_count: int, context) -> list[Surface]:
    """Return the parts of a mesh that subsets bind to materials, then the rest."""
    subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
    if not subsets:
        return [whole]
    owner = np.full(face_count, -1)
    for number, subset in enumerate(subsets):
        element = context.value(subset.GetElementTypeAttr(), "face")
        if element != "face":
            text = f"the material of a subset of elements of the type {element} is left out"
            context.notes.add("subset type", text, subset.GetPrim())
            continue
        faces = context.value(subset.GetIndicesAttr())
        faces = _indices(faces, face_count, subset.GetPrim(), context)
        if (owner[faces] >= 0).any():
            text = "faces in several subsets keep the first one's material"
            context.notes.add("subsets overlap", text, subset.GetPrim())
        owner[faces[owner[faces] < 0]] = number
    parts = []
    for number in (*range(len(subsets)), -1):
        chosen = owner[whole.face_of] == number
        if chosen.any():
            part = whole.part(chosen)
            part.binding = prim if number < 0 else subsets[number].GetPrim()
            parts.append(part)
    return parts


def _indices(value, count: int, prim, context) -> np.ndarray:
    """Return indices of faces, those out of range left out with a note."""
    if value is None or not len(value):
        return np.zeros(0, dtype=np.int64)
    faces = primvars.integers(value)
    inside = (faces >= 0) & (faces < count)
    if not inside.all():
        text = f"indices of faces that are not in 0..{count - 1} are left out"
        context.notes.add("face indices", text, prim)
    return np.unique(faces[inside])

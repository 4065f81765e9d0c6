"""Meshes refined by their subdivision scheme, with all their values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from manylights.usd.primvars import Values, integers
from manylights.usd.refinement import Cage, Level

MOST_FACES = 4_000_000
"""Of a mesh after its refinement."""


def cage_of(mesh, scheme: str, context) -> Cage:
    """Read creases and corners; those that do not fit the mesh are noted and left out."""

    def whole(attribute):
        return integers(context.value(attribute))

    def real(attribute):
        return np.asarray(context.value(attribute, []), dtype=np.float64)

    count = len(context.value(mesh.GetPointsAttr()))
    lengths = whole(mesh.GetCreaseLengthsAttr())
    points = whole(mesh.GetCreaseIndicesAttr())
    sharpness = real(mesh.GetCreaseSharpnessesAttr())
    corners = np.zeros(count)
    where = whole(mesh.GetCornerIndicesAttr())
    sharp = real(mesh.GetCornerSharpnessesAttr())
    edges = np.zeros((0, 2), dtype=np.int64)
    try:
        corners[where] = sharp
        edges, sharpness = _crease_edges(lengths, points, sharpness, count)
    except (IndexError, ValueError):
        sharpness = np.zeros(0)
        text = "creases or corners do not fit the mesh and are left out"
        context.notes.add("creases", text, mesh.GetPrim())
    rule = context.value(mesh.GetInterpolateBoundaryAttr(), "edgeAndCorner")
    return Cage(scheme, edges, sharpness, corners, rule == "edgeAndCorner")


def _crease_edges(lengths, points, sharpness, count: int):
    """Return ``(k, 2)`` edges of creases and their sharpness, given per crease or per edge."""
    if lengths.sum() != len(points) or (len(lengths) and lengths.min() < 2):
        raise ValueError("lengths")
    if len(points) and (points.min() < 0 or points.max() >= count):
        raise IndexError("points")
    last = np.cumsum(lengths) - 1
    inner = np.setdiff1d(np.arange(len(points)), last)
    edges = np.stack([points[inner], points[inner + 1]], axis=1) if len(inner) else points[:0]
    if len(sharpness) == len(lengths):
        sharpness = np.repeat(sharpness, lengths - 1)
    if len(sharpness) != len(edges):
        raise ValueError("sharpness")
    return edges.reshape(-1, 2), sharpness


def levels_of(mesh, faces: int, context) -> tuple[str, int]:
    """Return a mesh's scheme and how often it is refined.

    An authored scheme is refined once, twice on small cages; others if it is asked for.
    """
    attribute = mesh.GetSubdivisionSchemeAttr()
    scheme = context.value(attribute, "catmullClark")
    asked = context.value(mesh.GetPrim().GetAttribute("mitsuba:subdivision_level"))
    if scheme not in ("catmullClark", "loop"):
        return scheme, 0  # bilinear ones are their cages
    levels = context.subdivision if asked is None else int(asked)
    if levels is None:
        authored = attribute.HasAuthoredValue() and attribute.Get() is not None
        levels = (2 if faces <= 500 else 1) if authored else 0
    fits = [level for level in range(max(levels, 0) + 1) if faces * 4**level <= MOST_FACES]
    if levels > 0 and (fits[-1] if fits else 0) < levels:
        text = f"a mesh is refined less than {levels} times: it has too many faces"
        context.notes.add("subdivision", text, mesh.GetPrim())
    counts = np.asarray(context.value(mesh.GetFaceVertexCountsAttr()))
    if scheme == "loop" and levels > 0 and (counts != 3).any():
        context.notes.add("loop", "loop subdivision needs triangles: kept as cage", mesh.GetPrim())
        return scheme, 0
    return scheme, fits[-1] if fits else 0


def refine(polygons, cage: Cage, levels: int):
    """Return ``meshes.Polygons`` refined some times, with smooth normals."""
    keep = polygons.counts >= 3
    if not keep.any():
        return polygons
    primvars = _all_values(polygons)
    smooth = [name for name, values in primvars.items() if values.interpolation == "vertex"]
    corner = [
        name
        for name, values in primvars.items()
        if values.interpolation in ("varying", "faceVarying")
    ]
    starts = {
        name: values.on_corners(polygons.counts, polygons.indices)
        for name, values in primvars.items()
    }
    on_points = np.concatenate([polygons.points, *(primvars[n].array for n in smooth)], axis=1)
    empty = np.zeros((len(polygons.indices), 0))
    kept = np.repeat(keep, polygons.counts)
    on_corners = np.concatenate([empty, *(starts[n] for n in corner)], axis=1)[kept]
    level = Level(polygons.counts[keep], polygons.indices[kept], len(polygons.points), cage)
    faces = np.flatnonzero(keep)
    for _ in range(levels):
        on_corners = level.split_corners(on_corners)
        on_points = level.points(on_points.astype(np.float64))
        faces = level.split_faces(faces)
        level = level.next()
    result = replace(
        polygons,
        points=on_points[:, :3].astype(np.float32),
        counts=level.counts,
        indices=level.indices,
        face_of=polygons.face_of[faces],
    )
    result.normals = level.normals(result.points)
    parts = _parts(primvars, smooth, on_points[:, 3:], "vertex")
    parts.update(_parts(primvars, corner, on_corners, "faceVarying"))
    for name, values in primvars.items():
        if values.interpolation == "uniform":
            parts[name] = Values(values.array[faces], "uniform")
    parts = {**primvars, **parts}
    result.uv = {name: parts["uv", name] for name in polygons.uv}
    result.colors = parts.get(("color", ""))
    result.opacity = parts.get(("opacity", ""))
    return result


def _all_values(polygons) -> dict[tuple[str, str], Values]:
    found = {("uv", name): values for name, values in polygons.uv.items()}
    found["color", ""], found["opacity", ""] = polygons.colors, polygons.opacity
    return {key: values for key, values in found.items() if values is not None}


def _parts(primvars, names, rows: np.ndarray, interpolation: str) -> dict:
    """Take columns apart again."""
    result, begin = {}, 0
    for name in names:
        end = begin + primvars[name].array.shape[1]
        result[name] = Values(rows[:, begin:end].astype(np.float32), interpolation)
        begin = end
    return result

"""BasisCurves prims as thin tubes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom

from manylights.usd import primvars
from manylights.usd.primvars import Values
from manylights.usd.surface import Surface
from manylights.usd.vectors import cross, unit

#: Weights of four control points (columns) for 1, t, t^2, t^3 (rows)
BASES = {
    "bezier": np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=float),
    "bspline": np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6,
    "catmullRom": np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]) / 2,
}


@dataclass
class Pieces:
    """The segments of all curves.

    Attributes:
        control: ``(s, 4)`` points of each segment, ``(s, 2)`` of linear ones; those beyond the
            authored ones are ``phantoms``.
        phantoms: ``(p, 2)`` points of which the p-th additional one is 2 a - b (``pinned`` ends).
        ends: ``(s, 2)`` where values of interpolation ``varying`` are.
        curve: ``(s,)`` which curve they belong to.
        curves: number of curves.
        points: number of their points.
        varying: number of ``varying`` values.
    """

    control: np.ndarray
    phantoms: np.ndarray
    ends: np.ndarray
    curve: np.ndarray
    curves: int
    points: int
    varying: int

    def of(self, interpolation: str) -> int:
        """Return the number of values of an interpolation, as ``primvars.Sizes`` does."""
        names = {"constant": 1, "uniform": self.curves, "vertex": self.points}
        return names.get(interpolation, self.varying)

    def controls(self, rows: np.ndarray) -> np.ndarray:
        """Return values at the control points of each segment, ``(s, 4, k)``."""
        a, b = self.phantoms[:, 0], self.phantoms[:, 1]
        return np.concatenate([rows, 2 * rows[a] - rows[b]])[self.control]


def surfaces_of_curves(prim, context) -> list[Surface]:
    """Return all curves of a prim as tubes of one surface."""
    curves = UsdGeom.BasisCurves(prim)
    points = primvars.as_rows(context.value(curves.GetPointsAttr(), []), 3)
    points = np.zeros((0, 3)) if points is None else points
    counts = primvars.integers(context.value(curves.GetCurveVertexCountsAttr()))
    if not len(counts) or counts.sum() != len(points) or counts.min() < 0:
        shown = f"curveVertexCounts adds up to {counts.sum()}, there are {len(points)} points"
        context.notes.add("broken curves", f"curves are left out: {shown}", prim)
        return []
    linear = context.value(curves.GetTypeAttr(), "cubic") == "linear"
    basis = context.value(curves.GetBasisAttr(), "bezier")
    pieces = _pieces(counts, linear, basis, context.value(curves.GetWrapAttr(), "nonperiodic"))
    if not len(pieces.control) or not np.isfinite(points).all():
        text = "curves are left out: too few points for a segment, or points with NaN"
        context.notes.add("broken curves", text, prim)
        return []
    if curves.GetNormalsAttr().HasAuthoredValue():
        context.notes.add("ribbons", "curves with normals (ribbons) are drawn as tubes", prim)
    return [
        _tubes(prim, curves, points.astype(np.float64), pieces, BASES.get(basis), linear, context)
    ]


def _pieces(counts: np.ndarray, linear: bool, basis: str, wrap: str) -> Pieces:
    """Return the segments of curves with these numbers of points."""
    total, begins = int(counts.sum()), np.cumsum(counts) - counts
    periodic, pinned = wrap == "periodic", wrap == "pinned" and not linear and basis != "bezier"
    width, step = (2, 1) if linear else (4, 3 if basis == "bezier" else 1)
    longer = counts + (2 if pinned else width - step if periodic else 0)
    segments = np.where(counts > 1, np.maximum((longer - width) // step + 1, 0), 0)
    values = segments if periodic else segments + 1
    varying = np.cumsum(values) - values
    parts, phantoms, ends, owner = [np.zeros((0, width), dtype=np.int64)], [], [], []
    for count in np.unique(counts[segments > 0]):
        chosen = np.flatnonzero(counts == count)
        number = segments[chosen[0]]
        indices = begins[chosen, None] + np.arange(count)
        if pinned:
            first = total + 2 * (sum(map(len, phantoms)) // 2 + np.arange(len(chosen)))
            phantoms.append(indices[:, [0, 1, -1, -2]].reshape(-1, 2))
            indices = np.concatenate([first[:, None], indices, first[:, None] + 1], axis=1)
        if periodic:
            # Modulo: two points of a B-spline are gone round more than once
            indices = indices[:, np.arange(count + width - step) % count]
        places = step * np.arange(number)[:, None] + np.arange(width)
        parts.append(indices[:, places].reshape(-1, width))
        along = (np.arange(number)[:, None] + np.arange(2)) % values[chosen[0]]
        ends.append((varying[chosen, None, None] + along).reshape(-1, 2))
        owner.append(np.repeat(chosen, number))
    return Pieces(
        control=np.concatenate(parts),
        phantoms=np.concatenate([np.zeros((0, 2), dtype=np.int64), *phantoms]),
        ends=np.concatenate([np.zeros((0, 2), dtype=np.int64), *ends]),
        curve=np.concatenate([np.zeros(0, dtype=np.int64), *owner]),
        curves=len(counts),
        points=total,
        varying=int(values.sum()),
    )


def _tubes(prim, curves, points, pieces: Pieces, basis, linear: bool, context) -> Surface:
    steps, sides = _resolution(len(pieces.control), linear)
    t = np.linspace(0, 1, steps + 1)
    powers = np.stack([np.ones_like(t), t, t**2, t**3], axis=1)
    weights = np.stack([1 - t, t], axis=1) if linear else powers @ basis

    def on_rings(values: Values) -> np.ndarray:  # (s, steps + 1, k)
        if values.interpolation == "vertex":
            return np.einsum("tc,sck->stk", weights, pieces.controls(values.array))
        if values.interpolation in ("varying", "faceVarying"):
            linear_weights = np.stack([1 - t, t], axis=1)
            return np.einsum("tc,sck->stk", linear_weights, values.array[pieces.ends])
        rows = values.array[pieces.curve if values.interpolation == "uniform" else 0 * pieces.curve]
        return np.repeat(rows[:, None], steps + 1, axis=1)

    center = on_rings(Values(points, "vertex"))
    slopes = np.stack([0 * t, np.ones_like(t), 2 * t, 3 * t**2], axis=1)
    slopes = np.tile([-1, 1], (len(t), 1)) if linear else slopes @ basis
    tangent = np.einsum("tc,sck->stk", slopes, pieces.controls(points))
    widths = _widths(curves, pieces, context)
    radius = np.maximum(on_rings(widths), 0) / 2
    ring, faces = _rings(center, tangent, sides)
    # The facets have the area of the round tube
    radius = radius * (np.pi / sides / np.sin(np.pi / sides))
    positions = center[:, :, None] + radius[:, :, None] * ring

    def per_vertex(values):
        return np.repeat(on_rings(values)[:, :, None], sides, axis=2).reshape(
            -1, values.array.shape[1]
        )

    color, opacity = primvars.display_color(prim, pieces, context)
    sets = primvars.texture_coordinates(prim, pieces, context)
    sets = {name: per_vertex(values).astype(np.float32) for name, values in sets.items()}
    return Surface(
        positions=positions.reshape(-1, 3).astype(np.float32),
        faces=faces.astype(np.uint32),
        normals=ring.reshape(-1, 3).astype(np.float32),
        uv=next(iter(sets.values()), None),
        colors=None if color is None else per_vertex(color).astype(np.float32),
        opacity=None if opacity is None else per_vertex(opacity).astype(np.float32),
        face_of=np.repeat(pieces.curve, 2 * sides * steps).astype(np.int32),
        colors_per="vertex",
        opacity_per="vertex",
        binding=prim,
        uv_sets=sets,
    )


def _resolution(segments: int, linear: bool) -> tuple[int, int]:
    """Return steps along a segment and sides of a tube, fewer where there are many."""
    steps, sides = (8, 12) if segments <= 2_000 else (4, 6) if segments <= 50_000 else (2, 3)
    return (1 if linear else steps), sides


def _widths(curves, pieces: Pieces, context) -> Values:
    attribute = curves.GetWidthsAttr()
    value = context.value(attribute)
    rows = None if value is None else primvars.as_rows(value, 1)
    found = None
    if rows is not None and len(rows):
        rows = np.where(np.isfinite(rows), rows, 0)
        where = str(attribute.GetPath())
        found = primvars.fitting(
            rows, curves.GetWidthsInterpolation(), pieces, where, context.notes
        )
    if found is None:
        context.notes.add("widths", "curves without widths have the width 1", curves.GetPrim())
        found = Values(np.ones((1, 1), dtype=np.float32), "constant")
    return found


def _rings(center: np.ndarray, tangent: np.ndarray, sides: int):
    """Return unit circles around each place, ``(s, t, sides, 3)``, and triangles between them."""
    tangent = unit(tangent)
    chord = unit(center[:, -1:] - center[:, :1])
    tangent = np.where(np.linalg.norm(tangent, axis=-1, keepdims=True) > 0.5, tangent, chord)
    across = _perpendicular(tangent[:, 0])
    frames = []
    for step in range(tangent.shape[1]):
        # What is left of the last one turns the least
        axis = tangent[:, step]
        across = unit(across - (across * axis).sum(-1, keepdims=True) * axis)
        frames.append(np.stack([across, cross(axis, across)], axis=1))
    frames = np.stack(frames, axis=1)
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.einsum("ak,stkc->stac", circle, frames)
    i = np.arange(sides)
    j = (i + 1) % sides
    band = np.concatenate([np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)])
    segments, count = tangent.shape[0], tangent.shape[1]
    starts = count * np.arange(segments)[:, None] + np.arange(count - 1)
    return rings, (band + sides * starts.reshape(-1, 1, 1)).reshape(-1, 3)


def _perpendicular(axis: np.ndarray) -> np.ndarray:
    least = np.eye(3)[np.abs(axis).argmin(axis=1)]
    return unit(cross(axis, least))

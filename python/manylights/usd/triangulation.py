"""Polygons of any shape as triangles."""

from __future__ import annotations

import numpy as np

from manylights.usd.vectors import cross, unit


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray):
    """Cut faces into triangles.

    Args:
        points: ``(n, 3)``.
        counts: ``(f,)`` corners of each face; faces with fewer than three have no triangles.
        indices: ``(c,)`` point of each corner.

    Returns:
        ``(m, 3)`` int64 corners of each triangle and ``(m,)`` its face, in the order of faces.
    """
    starts = np.cumsum(counts) - counts
    if len(counts) and counts[0] >= 3 and (counts == counts[0]).all():
        corners = np.arange(len(indices)).reshape(len(counts), -1)
        faces = np.repeat(np.arange(len(counts)), counts[0] - 2)
        return _cut(points, indices, corners).reshape(-1, 3), faces
    triangles, faces = [], []
    for count in np.unique(counts[counts >= 3]):
        chosen = np.flatnonzero(counts == count)
        corners = starts[chosen, None] + np.arange(count)
        triangles.append(_cut(points, indices, corners).reshape(-1, 3))
        faces.append(np.repeat(chosen, count - 2))
    if not triangles:
        return np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
    triangles, faces = np.concatenate(triangles), np.concatenate(faces)
    order = np.argsort(faces, kind="stable")
    return triangles[order], faces[order]


def _cut(points, indices, corners: np.ndarray) -> np.ndarray:
    """Cut faces with the same number of corners, ``(f, k)``; returns ``(f, k - 2, 3)``."""
    count = corners.shape[1]
    if count == 3:
        return corners[:, None]
    turns = _turns(points[indices[corners]].astype(np.float64))
    concave = (turns < -1e-9).any(axis=1)
    if count == 4:
        # A fan from its only reflex corner cuts a concave quadrangle rightly
        first = np.where(concave, turns.argmin(axis=1), 0)
        corners = np.take_along_axis(corners, (first[:, None] + np.arange(4)) % 4, axis=1)
    steps = np.arange(1, count - 1)
    fan = np.stack([np.zeros_like(steps), steps, steps + 1], axis=1)
    result = corners[:, fan]
    if count > 4:
        for face in np.flatnonzero(concave):
            result[face] = corners[face][ear_clip(_flatten(points[indices[corners[face]]]))]
    return result


def _turns(polygons: np.ndarray) -> np.ndarray:
    """Return by how much each corner turns to the inside, relative to squared edges; ``(f, k)``."""
    following = np.arange(1, polygons.shape[1] + 1) % polygons.shape[1]
    after = polygons[:, following] - polygons
    normals = _normals(polygons)[:, None]
    turn = (cross(after[:, following - 2], after) * normals).sum(axis=-1)
    size = np.maximum((after * after).sum(axis=-1).max(axis=1), 1e-300)
    return turn / size[:, None]


def _normals(polygons: np.ndarray) -> np.ndarray:
    """Return unit normals of polygons (Newell's, also if not flat), zero for those without area."""
    relative = polygons - polygons[:, :1]
    return unit(cross(relative[:, :-1], relative[:, 1:]).sum(axis=1))


def _flatten(polygon: np.ndarray) -> np.ndarray:
    """Project a polygon onto its plane; it runs counter-clockwise there."""
    normal = _normals(polygon[None].astype(np.float64))[0]
    axis = int(np.argmax(np.abs(normal)))
    plane = np.delete(polygon.astype(np.float64), axis, axis=1)
    mirrored = (normal[axis] < 0) != (axis == 1)
    return plane * [-1, 1] if mirrored else plane


def ear_clip(polygon: np.ndarray) -> np.ndarray:
    """Cut a simple polygon that runs counter-clockwise, ``(k, 2)``, into ``(k - 2, 3)`` triangles.

    One that crosses itself gives triangles, too, though not those of its area.
    """
    left, triangles, start = np.arange(len(polygon)), [], 0
    while len(left) > 3:
        places, count = polygon[left], len(left)
        turns = ((start + i) % count for i in range(count))
        ear = next((i for i in turns if _is_ear(places, i)), start % count)
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % count]))
        left = np.delete(left, ear)
        start = ear
    return np.array([*triangles, tuple(left)])


def _is_ear(places: np.ndarray, i: int) -> bool:
    """Does the corner turn to the inside, with no other corner in its triangle?"""
    a, b, c = places[i - 1], places[i], places[(i + 1) % len(places)]
    if _side(a, b, c) <= 0:
        return False
    inside = (_side(a, b, places) >= 0) & (_side(b, c, places) >= 0) & (_side(c, a, places) >= 0)
    others = places[inside]
    # Corners that meet those of the triangle (a bridge to a hole) do not lie in it
    same = (others == a).all(-1) | (others == b).all(-1) | (others == c).all(-1)
    return bool(same.all())


def _side(a, b, points):
    """Return twice the area of the triangle of two points and each of ``points``."""
    return (b[0] - a[0]) * (points[..., 1] - a[1]) - (b[1] - a[1]) * (points[..., 0] - a[0])

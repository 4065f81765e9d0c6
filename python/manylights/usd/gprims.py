"""Cube, Sphere, Cylinder, Cone, Capsule, Plane and Points prims as surfaces."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from pxr import UsdGeom

from manylights.usd import primvars
from manylights.usd.primvars import Sizes
from manylights.usd.surface import Surface
from manylights.usd.vectors import area_vectors

SEGMENTS = 64
"""Corners of a circle."""

#: What turns +Z into an axis, without a mirror; the width of a plane stays along X and its length
#: along Y where the axis leaves them
AXES = {
    "X": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=np.float64),
    "Y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=np.float64),
    "Z": np.eye(3),
}


def surfaces_of_gprim(prim, context) -> list[Surface]:
    """Return the surface of a Cube, Sphere, Cylinder, Cone, Capsule or Plane."""

    def number(name, fallback):
        value = context.value(prim.GetAttribute(name), fallback)
        return float(value)

    kind = prim.GetTypeName()
    maker, names = SHAPES[kind]
    fallbacks = {"size": 2.0, "radius": 0.5 if kind.startswith("Capsule") else 1.0}
    fallbacks.update(
        height={"Capsule": 1.0, "Capsule_1": 1.0}.get(kind, 2.0), width=2.0, length=2.0
    )
    fallbacks.update(radiusTop=fallbacks["radius"], radiusBottom=fallbacks["radius"])
    sizes = [number(name, fallbacks[name]) for name in names]
    if not np.isfinite(sizes).all() or min(sizes) < 0 or max(sizes) == 0:
        shown = ", ".join(f"{name} {size:g}" for name, size in zip(names, sizes))
        context.notes.add("empty gprim", f"a {kind} is left out: {shown}", prim)
        return []
    positions, faces, normals = maker(*sizes)
    axis = context.value(prim.GetAttribute("axis"), "Z") if prim.HasAttribute("axis") else "Z"
    turn = AXES.get(axis, AXES["Z"])
    surface = Surface(
        positions=(positions @ turn.T).astype(np.float32),
        faces=faces.astype(np.uint32),
        normals=None if normals is None else (normals @ turn.T).astype(np.float32),
        face_of=np.zeros(len(faces), dtype=np.int32),
        double_sided=bool(context.value(UsdGeom.Gprim(prim).GetDoubleSidedAttr(), False)),
        binding=prim,
    )
    if context.value(UsdGeom.Gprim(prim).GetOrientationAttr()) == UsdGeom.Tokens.leftHanded:
        surface.faces = np.ascontiguousarray(surface.faces[:, [0, 2, 1]])
    _add_constant_color(surface, prim, context)
    return [surface]


def _add_constant_color(surface: Surface, prim, context) -> None:
    """Set displayColor and displayOpacity, of which implicit surfaces have one value."""
    color, opacity = primvars.display_color(prim, Sizes(1, 1, 1), context)
    count = len(surface.faces)
    if color is not None:
        surface.colors = np.repeat(color.array[:1], count, axis=0)
    if opacity is not None:
        surface.opacity = np.repeat(opacity.array[:1], count, axis=0)


def revolve(profile: np.ndarray, normals: np.ndarray, segments: int = SEGMENTS):
    """Turn a profile about Z.

    Args:
        profile: ``(k, 2, 2)``: radius and z of both ends of each of its pieces, from bottom to top.
        normals: ``(k, 2, 2)``: radial and z part of the outside there.
        segments: corners of a circle.

    Returns:
        Positions, triangles and normals.
    """
    angle = 2 * np.pi * np.arange(segments + 1) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    circle[-1] = circle[0]

    def turned(ends):  # (k, 2, segments + 1, 3)
        around = ends[..., None, :1] * circle
        return np.concatenate(
            [around, np.broadcast_to(ends[..., None, 1:], (*around.shape[:3], 1))], -1
        )

    positions, outside = turned(profile), turned(normals)
    row = segments + 1
    i = np.arange(segments)
    low, high = np.stack([i, i + 1], 1), np.stack([i, i + 1], 1) + row
    piece = np.concatenate(
        [
            np.stack([low[:, 0], low[:, 1], high[:, 1]], 1),
            np.stack([low[:, 0], high[:, 1], high[:, 0]], 1),
        ]
    )
    faces = (piece + 2 * row * np.arange(len(profile))[:, None, None]).reshape(-1, 3)
    positions = positions.reshape(-1, 3)
    area = np.linalg.norm(area_vectors(positions, faces), axis=1)
    faces = faces[area > 1e-12 * max(area.max(), 1e-300)]
    return positions, faces, outside.reshape(-1, 3)


def _pieces(radius, z, radial, up):
    """Return a chain of pieces, smooth where they meet."""
    line, normal = np.stack([radius, z], -1), np.stack([radial, up], -1)
    return np.stack([line[:-1], line[1:]], 1), np.stack([normal[:-1], normal[1:]], 1)


def _arc(radius: float, center: float, begin: float, end: float, steps: int):
    """Return a part of a circle about the axis, by angles from the equator."""
    angle = np.linspace(begin, end, steps + 1)
    across = np.cos(angle)
    across[np.abs(across) < 1e-9] = 0
    return _pieces(radius * across, center + radius * np.sin(angle), across, np.sin(angle))


def _lid(radius: float, z: float, up: int):
    """Return a flat end."""
    ends = [[0, z], [radius, z]] if up < 0 else [[radius, z], [0, z]]
    return np.array([ends], dtype=float), np.array([[[0, up], [0, up]]], dtype=float)


def _joined(*parts):
    return revolve(np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts]))


def cube(size: float):
    """Return a cube with normals of its faces."""
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            square = np.array([[-1, -1, sign], [1, -1, sign], [1, 1, sign], [-1, 1, sign]])
            square = square[::sign]
            sides.append(np.roll(square, axis + 1, axis=1))
    positions = np.concatenate(sides) * (size / 2)
    fan = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (fan + 4 * np.arange(6)[:, None, None]).reshape(-1, 3)
    return positions, faces, None


def sphere(radius: float):
    """Return a sphere of facets with the area of the round one."""
    result = _joined(_arc(radius, 0, -np.pi / 2, np.pi / 2, SEGMENTS // 2))
    area = np.linalg.norm(area_vectors(*result[:2]), axis=1).sum()
    return result[0] * np.sqrt(4 * np.pi * radius**2 / area), result[1], result[2]


def cylinder(height: float, radius: float):
    """Return a cylinder with its caps."""
    return frustum(height, radius, radius)


def frustum(height: float, top: float, bottom: float):
    """Return a cylinder whose ends may differ."""
    slant = max(np.hypot(height, bottom - top), 1e-300)
    radial, up = np.full(2, height / slant), np.full(2, (bottom - top) / slant)
    side = _pieces(np.array([bottom, top]), np.array([-height / 2, height / 2]), radial, up)
    return _joined(_lid(bottom, -height / 2, -1), side, _lid(top, height / 2, 1))


def cone(height: float, radius: float):
    """Return a cone with its base."""
    return frustum(height, 0.0, radius)


def capsule(height: float, radius: float):
    """Return a cylinder with round ends."""
    return capsule_of_two(height, radius, radius)


def capsule_of_two(height: float, top: float, bottom: float):
    """Return a cylinder with round ends of two radii."""
    steps = SEGMENTS // 4
    ends = np.array([bottom, top]), np.array([-height / 2, height / 2])
    side = [_pieces(*ends, np.ones(2), np.zeros(2))] if height > 0 else []
    low = _arc(bottom, -height / 2, -np.pi / 2, 0, steps)
    high = _arc(top, height / 2, 0, np.pi / 2, steps)
    return _joined(low, *side, high)


def plane(width: float, length: float):
    """Return a rectangle that faces +Z: X is its width, Y its length."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return corners * [width / 2, length / 2, 0], np.array([[0, 1, 2], [0, 2, 3]]), None


@lru_cache(maxsize=4)
def ball(subdivisions: int):
    """Return positions and triangles of a refined icosahedron with the area of the unit sphere."""
    golden = (1 + 5**0.5) / 2
    points = np.array([[0, a, b * golden] for a in (-1, 1) for b in (-1, 1)])
    points = np.concatenate([np.roll(points, turn, axis=1) for turn in range(3)])
    points /= np.linalg.norm(points[0])
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 1.2
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = [t for t in triples if near[t[0], t[1]] and near[t[1], t[2]] and near[t[0], t[2]]]
    corners = points[np.array(faces)]
    inward = np.linalg.det(corners) < 0
    corners[inward] = corners[inward][:, [0, 2, 1]]
    for _ in range(subdivisions):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
        corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
    positions, faces = np.unique(corners.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    area = np.linalg.norm(area_vectors(positions, faces), axis=1).sum()
    return positions * np.sqrt(4 * np.pi / area), faces


def surfaces_of_points(prim, context) -> list[Surface]:
    """Return the points of a Points prim as small spheres, all in one surface."""
    points = UsdGeom.Points(prim)
    centers = primvars.as_rows(context.value(points.GetPointsAttr(), []), 3)
    if centers is None or not len(centers):
        context.notes.add("empty points", "a Points prim without points is left out", prim)
        return []
    count = len(centers)
    rows = primvars.as_rows(context.value(points.GetWidthsAttr(), [1.0]), 1)
    sizes = Sizes(1, count, count)
    where = str(points.GetWidthsAttr().GetPath())
    widths = primvars.fitting(rows, points.GetWidthsInterpolation(), sizes, where, context.notes)
    widths = np.ones((1, 1)) if widths is None else widths.array
    radius = np.broadcast_to(widths, (count, 1)) / 2
    good = np.isfinite(centers).all(axis=1) & (radius[:, 0] > 0) & np.isfinite(radius[:, 0])
    if not good.all():
        context.notes.add("points", "points without a place or a width are left out", prim)
    positions, faces = ball(2 if count <= 500 else 1 if count <= 20_000 else 0)
    inside = positions * radius[good, None] + centers[good, None]
    surface = Surface(
        positions=inside.reshape(-1, 3).astype(np.float32),
        faces=_copies(faces, len(positions), good.sum()),
        normals=np.tile(
            positions / np.linalg.norm(positions, axis=1, keepdims=True), (good.sum(), 1)
        ),
        face_of=np.repeat(np.flatnonzero(good), len(faces)).astype(np.int32),
        binding=prim,
    )
    surface.normals = surface.normals.astype(np.float32)
    color, opacity = primvars.display_color(prim, sizes, context)
    if color is not None:
        surface.colors = np.broadcast_to(color.array, (count, 3))[surface.face_of]
    if opacity is not None:
        surface.opacity = np.broadcast_to(opacity.array, (count, 1))[surface.face_of]
    return [surface] if good.any() else []


def _copies(faces: np.ndarray, vertices: int, count: int) -> np.ndarray:
    """Return the triangles of several copies of a mesh, one after the other."""
    return (faces + vertices * np.arange(count)[:, None, None]).reshape(-1, 3).astype(np.uint32)


#: How each type is made, and of which attributes
SHAPES = {
    "Cube": (cube, ("size",)),
    "Sphere": (sphere, ("radius",)),
    "Cylinder": (cylinder, ("height", "radius")),
    "Cylinder_1": (frustum, ("height", "radiusTop", "radiusBottom")),
    "Cone": (cone, ("height", "radius")),
    "Capsule": (capsule, ("height", "radius")),
    "Capsule_1": (capsule_of_two, ("height", "radiusTop", "radiusBottom")),
    "Plane": (plane, ("width", "length")),
}

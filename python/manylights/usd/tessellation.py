"""Small meshes of the shapes that lights have, and the exact areas of these shapes.

All are in the space of the light and face where it emits. Points are row vectors, ``p @ M``.
"""

from __future__ import annotations

import functools

import numpy as np

#: Relative deviation of a transform from a rotation with uniform scale that is rounding.
ROUNDING = 1e-4


@functools.cache
def icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a unit sphere of ``20 * 4**level`` triangles."""
    golden = (1 + 5**0.5) / 2
    points = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    points = [np.roll(point, shift) for shift in range(3) for point in points]
    points = np.array(points) / np.hypot(1, golden)
    triples = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    a, b, c = (points[triples[:, corner]] for corner in range(3))
    edge = 2 / np.hypot(1, golden)
    sides = (np.linalg.norm(a - b, axis=1), np.linalg.norm(b - c, axis=1))
    sides = np.stack([*sides, np.linalg.norm(c - a, axis=1)])
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0
    first = (triples[:, 0] < triples[:, 1]) & (triples[:, 0] < triples[:, 2])
    faces = triples[(np.abs(sides - edge) < 1e-6).all(axis=0) & outward & first]
    for _ in range(level):
        points, faces = _subdivide(points, faces)
    return points, faces


def _subdivide(points, faces):
    """Split each triangle of a unit sphere into four."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = points[edges].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (inverse.reshape(-1, 3) + len(points)).T
    a, b, c = faces.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return np.concatenate([points, middles]), faces


@functools.cache
def square() -> tuple[np.ndarray, np.ndarray]:
    """Return the unit square around the origin, facing -Z."""
    points = np.array([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)])
    return points, np.array([(0, 2, 1), (0, 3, 2)])


@functools.cache
def circle(segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit disk as a polygon, facing -Z."""
    angles = 2 * np.pi * np.arange(segments) / segments
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    index = np.arange(1, segments - 1)
    return points, np.stack([0 * index, index + 1, index], axis=1)


@functools.cache
def tube(segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a cylinder along X of radius and length 1, without caps."""
    angles = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([0 * angles, np.cos(angles), np.sin(angles)], axis=1)
    a = np.arange(segments)
    b, c, d = (a + 1) % segments, a + segments, (a + 1) % segments + segments
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    half = np.array([0.5, 0, 0])
    points = np.concatenate([ring - half, ring + half])
    # The winding that faces outwards
    corner = points[faces[0]]
    if np.dot(np.cross(corner[1] - corner[0], corner[2] - corner[0]), corner.mean(axis=0)) < 0:
        faces = faces[:, ::-1]
    return points, faces


def is_uniform(linear: np.ndarray) -> np.ndarray:
    """Are these ``(n, 3, 3)`` rotations, also mirrored ones, times a scale?"""
    gram = linear @ np.swapaxes(linear, 1, 2)
    square = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 3
    return np.abs(gram - square * np.eye(3)).max(axis=(1, 2)) <= ROUNDING * square[:, 0, 0]


def scale_of(linear: np.ndarray) -> np.ndarray:
    """Return the scale of uniform transforms, ``(n, 3, 3)`` to ``(n,)``."""
    return np.sqrt((linear**2).sum(axis=(1, 2)) / 3)


def sphere_areas(linear: np.ndarray) -> np.ndarray:
    """Return the areas of transformed unit spheres, exact for ellipsoids."""
    areas = 4 * np.pi * scale_of(linear) ** 2
    other = ~is_uniform(linear)
    if other.any():
        lengths = np.linalg.svd(linear[other], compute_uv=False)
        values, inverse = np.unique(np.round(lengths, 12), axis=0, return_inverse=True)
        areas[other] = np.array([_ellipsoid(*axes) for axes in values])[np.ravel(inverse)]
    return areas


def _ellipsoid(a: float, b: float, c: float) -> float:
    """Return the area of an ellipsoid with these half axes: an integral over the unit sphere."""
    x, weights = np.polynomial.legendre.leggauss(200)
    # Nodes crowd at the ends, where the integrand of flat and of long ellipsoids is sharp
    z = np.sin(0.25 * np.pi * (x + 1))
    weights = weights * 0.25 * np.pi * np.cos(0.25 * np.pi * (x + 1))
    angles = 0.5 * np.pi * (np.arange(200) + 0.5) / 200
    rho = np.sqrt(1 - z**2)[:, None]
    parts = (b * c * rho * np.cos(angles)) ** 2 + (a * c * rho * np.sin(angles)) ** 2
    norms = np.sqrt(parts + (a * b * z[:, None]) ** 2)
    return float(8 * (weights[:, None] * norms).sum() * 0.5 * np.pi / 200)


def flat_areas(linear: np.ndarray) -> np.ndarray:
    """Return the areas of the transformed unit square in X and Y."""
    return np.linalg.norm(np.cross(linear[:, 0], linear[:, 1]), axis=1)


def tube_areas(linear: np.ndarray) -> np.ndarray:
    """Return the areas of transformed tubes of radius and length 1 along X."""
    angles = 2 * np.pi * np.arange(256) / 256
    around = np.stack([-np.sin(angles), np.cos(angles)], axis=1) @ linear[:, 1:]
    norms = np.linalg.norm(np.cross(linear[:, None, 0], around), axis=2)
    return 2 * np.pi * norms.mean(axis=1)


def random_rotations(count: int) -> np.ndarray:
    """Return rotations, always the same, so that the facets of many lamps average out."""
    quaternions = np.random.default_rng(0).normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)

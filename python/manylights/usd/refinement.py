"""One level of Catmull-Clark or Loop subdivision, with creases, corners and boundaries.

The rules are those of OpenSubdiv (uniform creasing): https://graphics.pixar.com/opensubdiv/docs.
Values on corners (texture coordinates) are refined linearly inside of their face; the points are
those of the refined mesh and not moved onto the limit surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from manylights.usd.primvars import Values
from manylights.usd.vectors import cross, unit

INFINITE = 10.0
"""Sharpness that no level makes smooth, as in OpenSubdiv."""


@dataclass
class Cage:
    """How a mesh is refined.

    Attributes:
        scheme: ``"catmullClark"`` or ``"loop"``.
        creases: ``(k, 2)`` points of sharp edges.
        sharpness: ``(k,)`` of those.
        corners: ``(n,)`` sharpness of each point.
        sharp_boundary: do corners of one face at the boundary stay where they are?
    """

    scheme: str
    creases: np.ndarray
    sharpness: np.ndarray
    corners: np.ndarray
    sharp_boundary: bool = True


class Level:
    """Topology of one level: which points, edges and faces meet.

    Attributes:
        counts: corners of each face.
        indices: point of each corner.
    """

    def __init__(self, counts, indices, point_count: int, cage: Cage) -> None:
        self.counts, self.indices, self.point_count, self.cage = counts, indices, point_count, cage
        begin = np.cumsum(counts) - counts
        self.face = np.repeat(np.arange(len(counts)), counts)
        corner = np.arange(len(indices))
        self.following = np.where(
            corner + 1 == (begin + counts)[self.face], begin[self.face], corner + 1
        )
        self.previous = np.empty_like(corner)
        self.previous[self.following] = corner
        pairs = np.sort(np.stack([indices, indices[self.following]], axis=1), axis=1)
        keys, self.edge, self.edge_faces = np.unique(
            pairs[:, 0] * point_count + pairs[:, 1], return_inverse=True, return_counts=True
        )
        self.ends = np.stack([keys // point_count, keys % point_count], axis=1)
        self.sharpness = np.where(self.edge_faces == 2, 0.0, INFINITE)
        self._add_creases(keys)

    def _add_creases(self, keys: np.ndarray) -> None:
        pairs = np.sort(self.cage.creases, axis=1)
        wanted = pairs[:, 0] * self.point_count + pairs[:, 1]
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        found = keys[at] == wanted
        np.maximum.at(self.sharpness, at[found], self.cage.sharpness[found])

    def _sum(self, where, rows, count) -> np.ndarray:
        """Sum rows that belong to the same point, edge or face."""
        columns = [np.bincount(where, rows[:, k], count) for k in range(rows.shape[1])]
        return np.stack(columns, axis=1) if columns else np.zeros((count, 0))

    def points(self, old: np.ndarray) -> np.ndarray:
        """Return the refined points: the old ones' successors, then edges', then faces'."""
        middle = old[self.ends].mean(axis=1)
        sharp = np.minimum(self.sharpness, 1)[:, None]
        if self.cage.scheme == "loop":
            centers = old[:0]
            opposite = self._sum(self.edge, old[self.indices[self.previous]], len(self.ends))
            smooth = 0.75 * middle + opposite / 8
        else:
            centers = (
                self._sum(self.face, old[self.indices], len(self.counts)) / self.counts[:, None]
            )
            smooth = (2 * middle + self._sum(self.edge, centers[self.face], len(self.ends))) / 4
        edges = sharp * middle + (1 - sharp) * smooth
        return np.concatenate([self._vertices(old, middle, centers), edges, centers])

    def _vertices(self, old, middle, centers) -> np.ndarray:
        count = len(old)
        ends = self.ends.ravel()
        valence = np.maximum(np.bincount(ends, minlength=count), 1)[:, None]
        ring = self._sum(ends, np.repeat(middle, 2, axis=0), count) / valence
        if self.cage.scheme == "loop":
            # Weights of Loop's thesis; `ring` are middles of edges, half way to the neighbours
            weight = 5 / 8 - (3 / 8 + np.cos(2 * np.pi / valence) / 4) ** 2
            smooth = (1 - 2 * weight) * old + 2 * weight * ring
        else:
            meeting = np.maximum(np.bincount(self.indices, minlength=count), 1)[:, None]
            around = self._sum(self.indices, centers[self.face], count) / meeting
            smooth = (around + 2 * ring + (valence - 3) * old) / valence
        is_sharp = np.repeat(self.sharpness > 0, 2)
        sharp_count = np.bincount(ends[is_sharp], minlength=count)
        sharpness = np.bincount(ends, np.repeat(np.minimum(self.sharpness, INFINITE), 2), count)
        sharpness = (sharpness / np.maximum(sharp_count, 1)).clip(0, 1)[:, None]
        along = np.repeat(middle, 2, axis=0)[is_sharp]
        crease = (old + self._sum(ends[is_sharp], along, count) / 2) / 2
        rule = np.where((sharp_count == 2)[:, None], crease, old)
        blend = np.where((sharp_count >= 2)[:, None], sharpness, 0)
        result = blend * rule + (1 - blend) * smooth
        fixed = np.minimum(self._corner_sharpness(), 1)[:, None]
        return fixed * old + (1 - fixed) * result

    def _corner_sharpness(self) -> np.ndarray:
        """Return how sharp points are: authored, at the end of one face, or in no face at all."""
        meeting = np.bincount(self.indices, minlength=self.point_count)
        corners = np.zeros(self.point_count)
        corners[: len(self.cage.corners)] = self.cage.corners
        fixed = (meeting == 0) | ((meeting == 1) & self.cage.sharp_boundary)
        return np.where(fixed, INFINITE, corners)

    def split_corners(self, rows: np.ndarray) -> np.ndarray:
        """Return values on the corners of the children of each face, linear inside of it."""
        if not rows.size:
            return np.zeros((4 * len(rows), 0))
        after = (rows + rows[self.following]) / 2
        if self.cage.scheme == "loop":
            three = np.stack([rows, after, after[self.previous]], axis=1)
            return self._loop_order(three, after.reshape(len(self.counts), 3, -1))
        center = self._sum(self.face, rows, len(self.counts)) / self.counts[:, None]
        four = np.stack([rows, after, center[self.face], after[self.previous]], axis=1)
        return four.reshape(4 * len(rows), -1)

    def _loop_order(self, outer, inner) -> np.ndarray:
        """Return the corners of the three outer triangles of each face, then of the inner one."""
        outer = outer.reshape(-1, 3, 3, *outer.shape[2:])
        return np.concatenate([outer, inner[:, None]], axis=1).reshape(-1, *outer.shape[3:])

    def split_faces(self, rows: np.ndarray) -> np.ndarray:
        """Return values on the children of each face."""
        loop = self.cage.scheme == "loop"
        return np.repeat(rows, 4) if loop else np.repeat(rows, self.counts)

    def next(self) -> Level:
        """Return the refined topology, with what is left of the creases."""
        edge = self.point_count + self.edge
        if self.cage.scheme == "loop":
            three = np.stack([self.indices, edge, edge[self.previous]], axis=1)
            indices = self._loop_order(three, edge.reshape(-1, 3))
            total = self.point_count + len(self.ends)
            counts = np.full(len(indices) // 3, 3)
        else:
            center = self.point_count + len(self.ends) + self.face
            indices = np.stack([self.indices, edge, center, edge[self.previous]], axis=1).ravel()
            total = self.point_count + len(self.ends) + len(self.counts)
            counts = np.full(len(indices) // 4, 4)
        sharp = np.flatnonzero(self.sharpness > 0)
        left = _less_sharp(self.sharpness[sharp])
        halves = [np.stack([self.ends[sharp, k], self.point_count + sharp], axis=1) for k in (0, 1)]
        corners = np.zeros(total)
        corners[: self.point_count] = _less_sharp(self._corner_sharpness())
        cage = replace(
            self.cage, creases=np.concatenate(halves), sharpness=np.tile(left, 2), corners=corners
        )
        return Level(counts, indices, total, cage)

    def normals(self, points: np.ndarray) -> Values:
        """Return smooth normals; they break at edges that stay sharp."""
        inside = points[self.indices].astype(np.float64)
        ahead, behind = inside[self.following] - inside, inside[self.previous] - inside
        face = cross(ahead, behind)
        broken = (self.sharpness >= INFINITE) & (self.edge_faces == 2)
        if not broken.any():
            total = self._sum(self.indices, face, self.point_count)
            return Values(unit(total).astype(np.float32), "vertex")
        group = self._corner_groups(broken)
        return Values(
            unit(self._sum(group, face, len(self.indices)))[group].astype(np.float32), "faceVarying"
        )

    def _corner_groups(self, broken: np.ndarray) -> np.ndarray:
        """Number corners so that those of one point with no sharp edge between have the same."""
        order = np.argsort(self.edge, kind="stable")
        first = np.searchsorted(self.edge[order], np.flatnonzero((self.edge_faces == 2) & ~broken))
        a, b = order[first], order[first + 1]
        opposed = self.indices[a] != self.indices[b]
        b_same = np.where(opposed, self.following[b], b)
        b_other = np.where(opposed, b, self.following[b])
        left = np.concatenate([a, self.following[a]])
        right = np.concatenate([b_same, b_other])
        group = np.arange(len(self.indices))
        while True:
            lowest = np.minimum(group[left], group[right])
            before = group.copy()
            np.minimum.at(group, left, lowest)
            np.minimum.at(group, right, lowest)
            if (group == before).all():
                return group


def _less_sharp(sharpness: np.ndarray) -> np.ndarray:
    """Return the sharpness one level on."""
    return np.where(sharpness >= INFINITE, sharpness, np.maximum(sharpness - 1, 0))

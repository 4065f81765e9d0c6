"""Lamps as few meshes: arrays of places, shapes and radiances, without a loop over lamps."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from manylights.usd.color import lamp_spectrum, peak_of
from manylights.usd.description import MeshShape, copied_faces, transformed, triangle_areas
from manylights.usd.light_groups import GroupMember

#: Radiances that become a mesh each, which every integrator can sample. More become one mesh with
#: the attribute ``face_color``, which only ours can.
SEPARATE_RADIANCES = 8


@dataclass
class _Part:
    """Copies of a mesh in the world: all triangles, and what each copy emits."""

    positions: np.ndarray
    faces: np.ndarray
    radiance: np.ndarray
    bsdf: dict | None
    member: GroupMember | None


class Lamps:
    """Collects emissive triangles of constant radiance, and makes meshes of them.

    Attributes:
        uses_attribute: whether a mesh has its radiance in an attribute.
    """

    def __init__(self) -> None:
        self._parts: list[_Part] = []
        self.uses_attribute = False

    def add(self, points, faces, matrices, radiances, bsdf=None, areas=None, member=None) -> None:
        """Add copies of a mesh.

        Args:
            points: ``(k, 3)``, or ``(n, k, 3)`` if each copy has others.
            faces: ``(m, 3)``, counterclockwise on the side that emits.
            matrices: ``(n, 4, 4)`` to the world.
            radiances: ``(n, 3)``.
            bsdf: a dictionary for Mitsuba.
            areas: ``(n,)`` of the shapes that the meshes stand for: the power is that of these.
            member: of a group of lights. Default: there are none.
        """
        positions = transformed(np.asarray(points), matrices)
        radiances = np.broadcast_to(radiances, (len(matrices), 3))
        if areas is not None:
            total = triangle_areas(positions, faces).sum(axis=1)
            factor = np.divide(areas, total, out=np.zeros_like(total), where=total > 0)
            radiances = radiances * factor[:, None]
        copies = copied_faces(faces, positions.shape[1], matrices)
        if not len(matrices):
            return
        self._parts.append(
            _Part(
                positions.reshape(-1, 3).astype(np.float32),
                copies.reshape(-1, 3),
                radiances.astype(np.float32),
                bsdf,
                member,
            )
        )

    def meshes(self) -> list[MeshShape]:
        """Return as few meshes as BSDFs, groups and variant allow, all triangles once."""
        groups: dict[tuple, list[_Part]] = {}
        for part in self._parts:
            key = id(part.bsdf), part.member and part.member.entry
            groups.setdefault(key, []).append(part)
        result = []
        for parts in groups.values():
            meshes = self._join(parts)
            for mesh in meshes:
                mesh.light = parts[0].member and parts[0].member.name
            result += meshes
        return result

    def _join(self, parts: list[_Part]) -> list[MeshShape]:
        """Return the meshes of one BSDF: one for each radiance, or one for all."""
        begins = np.cumsum([0, *(len(part.positions) for part in parts[:-1])])
        positions = np.concatenate([part.positions for part in parts])
        faces = np.concatenate([part.faces + begin for part, begin in zip(parts, begins)])
        faces = faces.astype(np.uint32)
        copies = np.concatenate([part.radiance for part in parts])
        sizes = [
            np.full(len(part.radiance), len(part.faces) // len(part.radiance)) for part in parts
        ]
        values, which = _distinct(copies)
        which = np.repeat(which, np.concatenate(sizes))
        bsdf = parts[0].bsdf
        if len(values) == 1:
            return [MeshShape(positions, faces, bsdf=bsdf, radiance=constant(values[0]))]
        if len(values) <= SEPARATE_RADIANCES:
            return [
                _select(positions, faces[which == index], bsdf, constant(value))
                for index, value in enumerate(values)
            ]
        self.uses_attribute = True
        return [_with_attribute(positions, faces, values[which], bsdf)]


def _with_attribute(positions, faces, radiance: np.ndarray, bsdf) -> MeshShape:
    """Return a mesh with a radiance, ``(m, 3)``, for each face."""
    texture = {"type": "mesh_attribute", "name": "face_color"}
    if "spectral" in mi.variant():
        peak = peak_of(radiance)
        radiance = radiance / np.float32(peak)
        texture = lamp_spectrum(texture, peak)
    attributes = {"face_color": radiance}
    return MeshShape(positions, faces, bsdf=bsdf, attributes=attributes, radiance=texture)


def constant(radiance) -> dict:
    """Return a radiance as a dictionary for Mitsuba."""
    return {"type": "rgb", "value": [float(channel) for channel in radiance]}


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows and which of them each one is; rounding is no difference."""
    if (rows == rows[0]).all():
        return rows[:1], np.zeros(len(rows), dtype=np.int64)
    # Sixteen bits of a mantissa: instances of one lamp differ by the rounding of their areas
    keys = (rows.view(np.uint32) + 64) >> 7
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return rows[first], np.ravel(which)


def _select(positions, faces, bsdf, radiance) -> MeshShape:
    """Return a mesh of some of the faces, with the vertices that they use."""
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.uint32)
    return MeshShape(positions[used], faces, bsdf=bsdf, radiance=radiance)

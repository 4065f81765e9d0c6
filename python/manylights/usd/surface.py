"""Triangles of one shape with one material: what geometry hands to lights and materials."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np


@dataclass
class Surface:
    """A triangle mesh in the space of its prim.

    Attributes:
        positions: ``(n, 3)`` float32.
        faces: ``(m, 3)`` uint32; winding as the prim's outside (``leftHanded`` already applied).
        normals: ``(n, 3)`` float32, or ``None`` for flat shading.
        uv: ``(n, 2)`` float32 with v as in USD (origin bottom left), or ``None``.
        colors: ``(n, 3)`` (per vertex) or ``(m, 3)`` (per face) float32 displayColor, or ``None``.
        color_primvar: what ``colors`` were read from.
        opacity: the same of displayOpacity, ``(n, 1)`` or ``(m, 1)``.
        colors_per: ``"vertex"`` or ``"face"``: what ``colors`` has a row for.
        opacity_per: the same of ``opacity``.
        face_of: ``(m,)`` int32, the authored face that each triangle belongs to.
        double_sided: of the prim.
        binding: the prim (mesh or subset) whose material binding holds.
        uv_sets: other texture coordinates by primvar name, ``(n, 2)``.
    """

    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    colors: np.ndarray | None = None
    opacity: np.ndarray | None = None
    face_of: np.ndarray | None = None
    colors_per: str = "face"
    opacity_per: str = "face"
    double_sided: bool = False
    binding: Any = None
    color_primvar: str = "displayColor"
    uv_sets: dict[str, np.ndarray] = field(default_factory=dict)

    def part(self, chosen: np.ndarray) -> Surface:
        """Return some of the triangles, with the vertices that they use.

        Args:
            chosen: ``(m,)`` bool, or indices of triangles.
        """
        used, faces = np.unique(self.faces[chosen], return_inverse=True)

        def rows(array, per="vertex"):
            return None if array is None else array[chosen if per == "face" else used]

        return replace(
            self,
            positions=self.positions[used],
            faces=faces.reshape(-1, 3).astype(np.uint32),
            normals=rows(self.normals),
            uv=rows(self.uv),
            colors=rows(self.colors, self.colors_per),
            opacity=rows(self.opacity, self.opacity_per),
            face_of=rows(self.face_of, "face"),
            uv_sets={name: rows(array) for name, array in self.uv_sets.items()},
        )

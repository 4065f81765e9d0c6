"""Triangles of one shape with one material: what geometry hands to lights and materials."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Surface:
    """A triangle mesh in the space of its prim.

    Attributes:
        positions: ``(n, 3)`` float32.
        faces: ``(m, 3)`` uint32; winding as the prim's outside (``leftHanded`` already applied).
        normals: ``(n, 3)`` float32, or ``None`` for flat shading.
        uv: ``(n, 2)`` float32 with v as in USD (origin bottom left), or ``None``.
        colors: ``(n, 3)`` (per vertex) or ``(m, 3)`` (per face) float32 of displayColor, or ``None``.
        opacity: the same of displayOpacity, ``(n, 1)`` or ``(m, 1)``.
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
    double_sided: bool = False
    binding: object = None
    uv_sets: dict[str, np.ndarray] = field(default_factory=dict)

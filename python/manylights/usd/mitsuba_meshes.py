"""Normals and texture coordinates as Mitsuba's meshes need them."""

from __future__ import annotations

import numpy as np

from manylights.usd.surface import Surface
from manylights.usd.textures import mitsuba_wrap
from manylights.usd.vectors import area_vectors, unit


def chosen_uv(surface: Surface, material) -> np.ndarray | None:
    """Return the texture coordinates that a material uses, ``None`` if it has no images."""
    if not material.lookups:
        return surface.uv
    return surface.uv_sets.get(material.uv_primvar, surface.uv)


def with_directions(surface: Surface) -> np.ndarray:
    """Return unit normals, that of a triangle in place of those that are zero."""
    normals = unit(surface.normals).astype(np.float32)
    missing = ~(np.abs(normals).sum(axis=1) > 0)
    if missing.any():
        flat = area_vectors(surface.positions, surface.faces)
        total = np.zeros((len(normals), 3))
        for corner in range(3):
            np.add.at(total, surface.faces[:, corner], flat)
        total[np.linalg.norm(total, axis=1) == 0] = [0, 0, 1]
        normals[missing] = unit(total)[missing]
    return normals


def checked_uv(surface: Surface, material, context):
    """Return the texture coordinates to use, with notes on missing ones and on wrapping."""
    uv = chosen_uv(surface, material)
    if not material.lookups:
        return uv
    if material.uv_primvar and material.uv_primvar not in surface.uv_sets:
        text = f"a mesh has no primvar {material.uv_primvar} for its images"
        text += ": its first texture coordinates are used" if uv is not None else ""
        context.notes.add("texture coordinates", text, surface.binding)
    if uv is None:
        if not material.uv_primvar:
            text = "a mesh has no texture coordinates for its images: their first pixel is used"
            context.notes.add("texture coordinates", text, surface.binding)
        return np.zeros((len(surface.positions), 2), dtype=np.float32)
    for lookup in material.lookups:
        places = uv @ lookup.to_uv[:2, :2].T + lookup.to_uv[:2, 2]
        outside = (places < -1e-4) | (places > 1 + 1e-4)
        odd = [name in ("useMetadata", "black") for name in lookup.wrap]
        odd[1] |= lookup.wrap[0] != lookup.wrap[1]
        if (outside.any(axis=0) & odd).any():
            text = "texture coordinates leave 0..1 where wrapS and wrapT are {} and {}: {} in both"
            text = text.format(*lookup.wrap, mitsuba_wrap(lookup.wrap))
            context.notes.add("wrap", text, lookup.node.GetPath())
    return uv

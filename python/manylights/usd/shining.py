"""Geometry that emits: mesh lights, geometry lights and materials that glow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from pxr import UsdLux

from manylights.usd.context import Context
from manylights.usd.copies import copies
from manylights.usd.description import MeshShape, transformed, triangle_areas
from manylights.usd.inputs import LightInputs
from manylights.usd.lamps import Lamps, constant
from manylights.usd.light_groups import GroupMember
from manylights.usd.shaping import Cone
from manylights.usd.surface import Surface
from manylights.usd.textures import scaled
from manylights.usd.vectors import area_vectors

#: Triangles that are handled at once, and that fit into memory.
CHUNK, MOST_TRIANGLES = 2_000_000, 20_000_000

#: Distance between the two sides of a double-sided light, over its size.
THICKNESS = 1e-4


@dataclass
class Glow:
    """What a surface emits.

    Attributes:
        radiance: three factors of the texture.
        normalized: three more, to divide by the area of the whole prim in the world.
        texture: a dictionary for Mitsuba, ``None`` for a constant radiance.
        bsdf: a dictionary for Mitsuba, ``None`` if it does not reflect.
        needs_mesh: whether emission or reflection vary over the surface.
    """

    radiance: np.ndarray
    normalized: np.ndarray
    texture: dict | None
    bsdf: dict | None
    needs_mesh: bool

    def shines(self) -> bool:
        """Is there any light?"""
        return bool(self.radiance.any() or self.normalized.any())


class MeshLight:
    """A light on geometry, by an API schema or by a ``GeometryLight`` that points to it."""

    def __init__(self, prim, context: Context, tints: bool) -> None:
        self.inputs = inputs = LightInputs(prim, context)
        self.context = context
        value = inputs.radiance()
        self.radiance = np.zeros(3) if value is None else value
        self.normalize = bool(inputs.get("normalize"))
        is_mesh_light = prim.HasAPI(UsdLux.MeshLightAPI)
        usual = "materialGlowTintsLight" if is_mesh_light else "noMaterialResponse"
        self.mode = inputs.own("light:materialSyncMode", usual) if tints else "noMaterialResponse"
        inputs.note_unsupported()
        if Cone.read(inputs, "mesh"):
            context.notes.add("cone", "the cone of a mesh light was left out", prim)

    def glow(self, surface: Surface, material) -> Glow:
        """Return what a surface emits: the light's radiance, perhaps tinted by the material."""
        bsdf = None if self.mode == "noMaterialResponse" else material.bsdf
        tint, texture = np.ones(3), None
        if self.mode == "materialGlowTintsLight":
            if material.emission is None:
                text = "the material of a mesh light does not glow, so it does not tint the light"
                self.context.notes.add("tint", text, self.inputs.prim)
            else:
                tint, texture = constant_of(material.emission, surface)
        elif self.mode == "independent" and material.emission is not None:
            text = "the material of a mesh light glows independently: only the light was read"
            self.context.notes.add("tint", text, self.inputs.prim)
        varies = texture is not None or (bsdf is not None and _varies(surface, material))
        parts = (np.zeros(3), self.radiance * tint)
        return Glow(*(parts if self.normalize else parts[::-1]), texture, bsdf, varies)


def glow_of(surface: Surface, material) -> Glow | None:
    """Return what a material emits by itself, None for nothing."""
    if material.emission is None:
        return None
    radiance, texture = constant_of(material.emission, surface)
    if not radiance.any():
        return None
    varies = texture is not None or _varies(surface, material)
    return Glow(radiance, np.zeros(3), texture, material.bsdf, varies)


def together(glows: list[Glow]) -> Glow:
    """Return the light of several lights on a surface, which reflects as with the first."""
    sums = (sum(glow.radiance for glow in glows), sum(glow.normalized for glow in glows))
    return replace(glows[0], radiance=sums[0], normalized=sums[1])


def _varies(surface: Surface, material) -> bool:
    """Does a material have images, or perhaps the colors of the surface?"""
    colored = surface.colors is not None or surface.opacity is not None
    return bool(material.lookups) or colored


def constant_of(emission: dict, surface: Surface) -> tuple[np.ndarray, dict | None]:
    """Split an emission into factors and an image, None if it is constant.

    Of an emission in the colors of the surface the mean is used.
    """
    if emission["type"] in ("bitmap", "d65"):
        return np.ones(3), emission
    if emission["type"] == "mesh_attribute":
        value = surface.colors.mean(axis=0)
    else:
        value = np.broadcast_to(np.array(emission["value"], dtype=np.float64), 3)
    return np.maximum(np.where(np.isfinite(value), value, 0.0), 0.0), None


def world_areas(surfaces: list[Surface], worlds: np.ndarray) -> np.ndarray:
    """Return the area of some surfaces together in each of their places, ``(n,)``."""
    areas = np.zeros(len(worlds))
    for surface in surfaces:
        for chunk in chunks(len(worlds), len(surface.faces)):
            positions = transformed(surface.positions, worlds[chunk])
            areas[chunk] += triangle_areas(positions, surface.faces).sum(axis=1)
    return areas


def chunks(copies: int, triangles: int) -> list[slice]:
    """Return slices of copies that have no more than ``CHUNK`` triangles, or one copy."""
    step = max(CHUNK // max(triangles, 1), 1)
    return [slice(begin, begin + step) for begin in range(0, copies, step)]


def two_sided(surface: Surface) -> Surface:
    """Return a surface with a copy that faces the other way, a little apart.

    On coincident triangles chance would decide which side a ray meets.
    """
    points, faces = surface.positions.astype(np.float64), surface.faces.astype(np.int64)
    normals = area_vectors(points, faces)
    sums = np.zeros_like(points)
    for corner in range(3):
        np.add.at(sums, faces[:, corner], normals)
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(float).tiny)
    shift = 0.5 * THICKNESS * np.ptp(points, axis=0).max() * sums

    def twice(rows):
        return None if rows is None else np.concatenate([rows, rows])

    return replace(
        surface,
        positions=np.concatenate([points + shift, points - shift]).astype(np.float32),
        faces=np.concatenate([faces, faces[:, ::-1] + len(points)]).astype(np.uint32),
        normals=None,
        uv=twice(surface.uv),
        colors=twice(surface.colors),
        opacity=twice(surface.opacity),
        uv_sets={},
    )


def add_lamps(
    lamps: Lamps, surface: Surface, glow: Glow, worlds, areas, member: GroupMember | None = None
) -> list[MeshShape]:
    """Add a surface in all its places; return the meshes that lamps cannot hold.

    Args:
        lamps: for what has a constant radiance and needs no texture coordinates.
        surface: what emits.
        glow: how.
        worlds: ``(n, 4, 4)``.
        areas: ``(n,)`` of the whole prim, to normalize by.
        member: of a group of lights. Default: there are none.
    """
    radiance = np.broadcast_to(glow.radiance, (len(worlds), 3))
    if glow.normalized.any():
        inverse = np.divide(1.0, areas, out=np.zeros_like(areas), where=areas > 0)
        radiance = radiance + glow.normalized * inverse[:, None]
    if surface.double_sided:
        surface = two_sided(surface)
    if glow.texture is not None and surface.uv is None:
        # Without texture coordinates an image has one value
        radiance = radiance * _mean(glow.texture)
        glow = replace(glow, texture=None)
    if glow.needs_mesh:
        meshes = _own_meshes(surface, glow, worlds, radiance)
        for mesh in meshes:
            mesh.light = member and member.name
        return meshes
    for chunk in chunks(len(worlds), len(surface.faces)):
        lamps.add(
            surface.positions,
            surface.faces,
            worlds[chunk],
            radiance[chunk],
            glow.bsdf,
            member=member,
        )
    return []


def _own_meshes(surface: Surface, glow: Glow, worlds, radiance) -> list[MeshShape]:
    """Return a mesh for each radiance, with texture coordinates and colors."""
    values, which = np.unique(radiance.astype(np.float32), axis=0, return_inverse=True)
    result = []
    for index, value in enumerate(values):
        mesh = copies(surface, glow.bsdf, worlds[np.ravel(which) == index])
        # Mitsuba's density of light samples is wrong on meshes with smooth normals
        mesh.normals = None
        mesh.radiance = constant(value) if glow.texture is None else scaled(glow.texture, value)
        result.append(mesh)
    return result


def _mean(texture: dict) -> np.ndarray:
    """Return the mean of an image."""
    scale, image = texture.get("scale", 1.0), texture.get("nested", texture)
    linear = image["bitmap"].convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    return scale * np.array(linear).mean(axis=(0, 1))

"""Geometry as meshes and instances of Mitsuba; what shines is drawn in each of its places."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from pxr import Sdf, Tf, Usd, UsdLux

from manylights.usd.context import Context, Notes
from manylights.usd.copies import copies
from manylights.usd.description import transformed
from manylights.usd.geometry import surfaces_of
from manylights.usd.light_shapes import transform
from manylights.usd.lights import Lights
from manylights.usd.materials import Materials
from manylights.usd.mitsuba_meshes import checked_uv
from manylights.usd.shining import (
    MOST_TRIANGLES,
    Glow,
    MeshLight,
    add_lamps,
    glow_of,
    together,
    world_areas,
)
from manylights.usd.stage import targets_of
from manylights.usd.surface import Surface
from manylights.usd.traversal import Batch, Item

#: More copies than this of a few triangles cost more as instances of Mitsuba than as one mesh.
MANY_COPIES, BAKED_TRIANGLES = 256, 4_000_000

#: Which of the lowest coordinates each corner of a box has.
CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T.astype(bool)


class Scenery:
    """Turns the geometry of batches into parts of a description.

    Attributes:
        entries: those parts by id.
    """

    def __init__(self, context: Context, lights: Lights, batches: list[Batch]) -> None:
        self.context, self.lights = context, lights
        self.materials = Materials(context)
        self.entries: dict[str, object] = {}
        self._corners: list[np.ndarray] = []
        self._pointed = _geometry_lights(context, batches)

    def add(self, batch: Batch) -> None:
        """Add all geometry of a batch."""
        quiet: list[tuple[Item, Surface, object]] = []
        for item in batch.items:
            if item.role != "geometry":
                continue
            try:
                quiet += self._add_shining(batch, item)
            except (Tf.ErrorException, TypeError, ValueError) as error:
                reason = " ".join(str(error).split())
                text = f"a geometry could not be read: {reason}"
                self.context.notes.add("geometry", text, item.prim)
        if len(batch.transforms) == 1:
            for item, surface, material in quiet:
                self._enter(item.prim, copies(surface, material.bsdf, batch.worlds(item)))
        elif quiet:
            self._add_instances(batch, quiet)

    def points(self) -> np.ndarray:
        """Return points that span all geometry in the world, ``(n, 3)``."""
        return np.concatenate([np.zeros((0, 3)), *self._corners])

    def _enter(self, prim: Usd.Prim, part) -> str:
        """Add a part under a name like its prim's path; return it."""
        base = re.sub(r"\W", "_", str(prim.GetPath()).strip("/")) or "shape"
        name, number = base, 1
        while name in self.entries:
            number += 1
            name = f"{base}_{number}"
        self.entries[name] = part
        return name

    def _add_shining(self, batch: Batch, item: Item) -> list[tuple[Item, Surface, object]]:
        """Add the surfaces of a prim that shine, return the others with their materials."""
        surfaces, bound = self._surfaces(item.prim)
        if not surfaces:
            return []
        if batch.color is not None:
            _give_color(surfaces, batch.color)
        worlds = batch.worlds(item)
        self._corners += [_box(surface.positions, worlds) for surface in surfaces]
        lights = self._lights(item.prim)
        quiet, shining = [], []
        for surface, material in zip(surfaces, bound):
            material = self.materials.make(material, surface)
            surface.uv = checked_uv(surface, material, self.context)
            glow = self._glow(item.prim, lights, surface, material)
            if glow is None or not glow.shines():
                quiet.append((item, surface, material))
            else:
                shining.append((surface, glow))
        if shining:
            self._shine(batch, item, surfaces, shining)
        return quiet

    def _surfaces(self, prim: Usd.Prim) -> tuple[list[Surface], list]:
        """Return the surfaces of a prim with the colors that their materials ask for, and these."""
        surfaces = [part for part in surfaces_of(prim, self.context) if len(part.faces)]
        bound = [self.materials.bound(part.binding) for part in surfaces]
        names = {name for name in map(self.materials.color_primvar, bound) if name}
        if names - {"displayColor"}:
            name = min(names - {"displayColor"})
            context = replace(self.context, color_primvar=name, notes=Notes())
            colored = [part for part in surfaces_of(prim, context) if len(part.faces)]
            if any(part.colors is not None for part in colored):
                surfaces = [replace(part, color_primvar=name) for part in colored]
        return surfaces, bound

    def _lights(self, prim: Usd.Prim) -> list[MeshLight]:
        """Return the lights that a geometry is: its own, and those that point to it."""
        own = [MeshLight(prim, self.context, tints=True)] if prim.HasAPI(UsdLux.LightAPI) else []
        pointing = self._pointed.get(prim.GetPath(), [])
        return own + [MeshLight(light, self.context, tints=False) for light in pointing]

    def _glow(self, prim: Usd.Prim, lights: list[MeshLight], surface, material) -> Glow | None:
        """Return what a surface emits, ``None`` for nothing."""
        if not lights:
            return glow_of(surface, material)
        glows = [light.glow(surface, material) for light in lights]
        if len(glows) > 1 and glows[0].texture is not None:
            text = "the light of a mesh shows a picture: lights that point to it were left out"
            self.context.notes.add("geometry light", text, prim)
            return glows[0]
        return together(glows)

    def _shine(self, batch, item, surfaces, shining: list[tuple[Surface, Glow]]) -> None:
        prim, worlds = item.prim, batch.worlds(item)
        triangles = len(worlds) * sum(len(surface.faces) for surface, _ in shining)
        if triangles > MOST_TRIANGLES:
            text = f"{triangles} shining triangles are more than {MOST_TRIANGLES}: left out"
            self.context.notes.add("instances", text, prim, len(worlds))
            return
        areas = None
        if any(glow.normalized.any() for _, glow in shining):
            areas = world_areas(surfaces, worlds)
            if not (areas > 0).all():
                text = "a light with a zero area was left out"
                self.context.notes.add("area", text, prim, int((areas <= 0).sum()))
        pointing, groups = self._pointed.get(prim.GetPath(), []), self.context.light_groups
        if groups and len({groups.entry_of(str(light.GetPath())) for light in pointing}) > 1:
            text = "lights of several light groups shine from one geometry: all are in the first"
            self.context.notes.add("geometry light groups", text, prim)
        others = (*(light.GetPath() for light in pointing), *batch.instancers)
        member = groups.of(prim, others)
        for surface, glow in shining:
            for mesh in add_lamps(self.lights.lamps, surface, glow, worlds, areas, member):
                if mesh.light:
                    self.entries[self.lights.named(mesh.light)] = mesh
                else:
                    self._enter(prim, mesh)
        self.lights.count += len(worlds)

    def _add_instances(self, batch: Batch, quiet) -> None:
        """Add copies of what does not shine."""
        transforms, first = batch.transforms, quiet[0][0].prim
        good = np.abs(np.linalg.det(transforms[:, :3, :3])) > 0
        if not good.all():
            text = "an instance without extent was left out"
            self.context.notes.add("instance", text, first, int((~good).sum()))
            transforms = transforms[good]
        triangles = sum(len(surface.faces) for _, surface, _ in quiet)
        if len(transforms) > MANY_COPIES and triangles * len(transforms) <= BAKED_TRIANGLES:
            for item, surface, material in quiet:
                self._enter(item.prim, copies(surface, material.bsdf, item.local @ transforms))
            return
        group = {"type": "shapegroup"}
        for index, (item, surface, material) in enumerate(quiet):
            group[f"shape_{index}"] = copies(surface, material.bsdf, item.local[None])
        name = self._enter(first, group)
        for index, matrix in enumerate(transforms):
            self.entries[f"{name}_instance_{index}"] = {
                "type": "instance",
                "to_world": transform(matrix),
                "shapegroup": {"type": "ref", "id": name},
            }


def _geometry_lights(context: Context, batches: list[Batch]) -> dict[Sdf.Path, list[Usd.Prim]]:
    """Return the ``GeometryLight`` prims by the path of the geometry that they point to."""
    result, drawn = {}, set()
    for batch in batches:
        for item in batch.items:
            drawn.add(item.prim.GetPath())
            if item.prim.GetTypeName() == "GeometryLight":
                for target in targets_of(item.prim, "geometry"):
                    found = result.setdefault(target, [])
                    found += [item.prim] if item.prim not in found else []
    for target, prims in result.items():
        for prim in prims if target not in drawn else ():
            text = f"a GeometryLight points to {target}, which is not drawn"
            context.notes.add("geometry light", text, prim)
    return result


def _give_color(surfaces: list[Surface], color: np.ndarray) -> None:
    """Set the displayColor of surfaces that have none."""
    for surface in surfaces:
        if surface.colors is None and surface.color_primvar == "displayColor":
            surface.colors = np.tile(np.float32(color), (len(surface.faces), 1))
            surface.colors_per = "face"


def _box(positions: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Return the lowest and the highest corner of the boxes of copies of points, ``(2, 3)``."""
    corners = np.where(CORNERS, positions.min(axis=0), positions.max(axis=0))
    moved = transformed(corners, matrices).reshape(-1, 3)
    return np.stack([moved.min(axis=0), moved.max(axis=0)])

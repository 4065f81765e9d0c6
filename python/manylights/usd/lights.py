"""Lights of UsdLux as emitters and emissive shapes of Mitsuba.

Radiance is in nits, which Mitsuba's unit equals; lengths stay in units of the stage. Where lights
are many, round under a transform that is not, or small, meshes with the same power take their
place: see :class:`manylights.usd.lamps.Lamps`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Tf, Usd

from manylights.usd import shaping
from manylights.usd import tessellation as shapes
from manylights.usd.context import Context
from manylights.usd.domes import Domes
from manylights.usd.images import read_image
from manylights.usd.inputs import LightInputs
from manylights.usd.lamps import Lamps, constant
from manylights.usd.light_groups import GroupMember, split
from manylights.usd.light_shapes import AREAS, EXACT, SHAPES, corners, facing, scaled, unmirrored

#: Round lights up to this number stay exact shapes, flat ones up to the other.
MOST_ROUND, MOST_FLAT = 1000, 32

#: Levels of icospheres for few, thousands, and more spheres.
SPHERE_LEVELS = ((MOST_ROUND, 2), (10_000, 1), (float("inf"), 0))

#: Segments of round flat lights and tubes for few and for many.
SEGMENTS = ((MOST_ROUND, 64), (float("inf"), 12))

#: Angle of a distant light in degrees above which its shadows are visibly soft.
SHARPEST_ANGLE = 1.0


@dataclass
class Light:
    """All copies of one light of a kind.

    Attributes:
        prim: the light.
        matrices: ``(n, 4, 4)`` to the world of its unit shape.
        radiance: three channels, if ``normalize`` times the area.
        normalize: divide the radiance by the area?
        member: of a group of lights, ``None`` if there are none.
    """

    prim: Usd.Prim
    matrices: np.ndarray
    radiance: np.ndarray
    normalize: bool
    member: GroupMember | None = None


class Lights:
    """Reads lights one after the other; :meth:`finish` decides what becomes of them.

    Attributes:
        context: the stage.
        lamps: the meshes that emit.
        entries: finished parts of the description, by id.
        domes: of the whole stage.
        count: lights that shine.
    """

    def __init__(self, context: Context) -> None:
        self.context, self.lamps = context, Lamps()
        self.entries: dict[str, dict] = {}
        self.domes = Domes(context)
        self.count = 0
        self._kinds: dict[str, list[Light]] = {}
        self._points: list[np.ndarray] = []
        self._member: GroupMember | None = None
        self._named: dict[str, int] = {}

    # -- Reading

    def add(self, prim: Usd.Prim, matrices: np.ndarray, instancers: tuple = ()) -> None:
        """Add a light at all its places, ``(n, 4, 4)``, where these instancers have put it."""
        reader = READERS.get(str(prim.GetTypeName()))
        notes = self.context.notes
        if reader is None:
            name = prim.GetTypeName() or "no type"
            notes.add(f"light {name}", f"lights of {name} are left out", prim)
            return
        try:
            inputs = LightInputs(prim, self.context)
            radiance = inputs.radiance()
            if radiance is None:
                return
            inputs.note_unsupported()
            _note_visibility(inputs)
            shines = np.any(radiance) and reader not in (Lights._portal, Lights._geometry)
            self._member = self.context.light_groups.of(prim, instancers, shines)
            reader(self, inputs, radiance, matrices)
        except (TypeError, ValueError, Tf.ErrorException) as error:
            text = " ".join(str(error).split())
            notes.add("light value", f"a light could not be read: {text}", prim)

    def _sphere(self, inputs: LightInputs, radiance, matrices) -> None:
        radius = inputs.length("radius")
        matrices = scaled(matrices, radius, radius, radius)
        if radius == 0 or inputs.own("treatAsPoint", False):
            self._point(inputs, radiance, matrices, radius == 0)
        else:
            self._area_light("sphere", inputs, radiance, matrices)

    def _rect(self, inputs: LightInputs, radiance, matrices) -> None:
        matrices = scaled(matrices, inputs.length("width"), inputs.length("height"), 1.0)
        image = None
        if inputs.file("texture:file"):
            image = read_image(inputs.file("texture:file"), inputs.prim, self.context)
        if image is None:
            self._area_light("rect", inputs, radiance, matrices)
        else:
            self._pictures(inputs, radiance, matrices, image)

    def _disk(self, inputs: LightInputs, radiance, matrices) -> None:
        radius = inputs.length("radius")
        self._area_light("disk", inputs, radiance, scaled(matrices, radius, radius, 1.0))

    def _cylinder(self, inputs: LightInputs, radiance, matrices) -> None:
        radius = inputs.length("radius")
        if inputs.own("treatAsLine", False):
            text = "a light that is to be treated as a line keeps its radius"
            self.context.notes.add("treatAsLine", text, inputs.prim)
        matrices = scaled(matrices, inputs.length("length"), radius, radius)
        self._area_light("cylinder", inputs, radiance, matrices)

    def _distant(self, inputs: LightInputs, radiance, matrices) -> None:
        angle = inputs.angle()
        half = np.clip(np.radians(angle) / 2, 0.0, np.pi)
        sine = np.sin(half) ** 2
        area = np.pi * sine if half <= np.pi / 2 else np.pi * (2 - sine)
        if area == 0.0 or inputs.get("normalize"):
            area = 1.0
        if angle > SHARPEST_ANGLE:
            text = f"a distant light with an angle of {angle:g} degrees has sharp shadows"
            self.context.notes.add("angle", text, inputs.prim)
        directions = -matrices[:, 2, :3]
        lengths = np.linalg.norm(directions, axis=1)
        good = self._good(lengths, [inputs.prim], [len(lengths)])
        for direction in directions[good] / lengths[good, None]:
            irradiance = constant(radiance * area)
            self.emit("directional", direction=direction.tolist(), irradiance=irradiance)
        self._shine(radiance, int(good.sum()))

    def _dome(self, inputs: LightInputs, radiance, matrices) -> None:
        shining = self.domes.add(inputs, radiance, matrices, self._member)
        self._shine(radiance, shining)

    def _portal(self, inputs: LightInputs, radiance, matrices) -> None:
        text = "portals only help to sample and were left out"
        self.context.notes.add("portal", text, inputs.prim)

    def _geometry(self, inputs: LightInputs, radiance, matrices) -> None:
        """The geometry that such a light points to emits, see ``Emission``."""

    # -- What they have in common

    def _point(self, inputs: LightInputs, radiance, matrices, no_radius: bool) -> None:
        """Add a sphere without extent: intensity is radiance times projected area."""
        normalize = bool(inputs.get("normalize"))
        if no_radius and not normalize:
            text = (
                "a sphere light of radius 0 has no area: it was treated as normalized, with "
                "the intensity of a point light"
            )
            self.context.notes.add("radius", text, inputs.prim)
        share = np.full(len(matrices), 0.25)
        if not (normalize or no_radius):
            share = shapes.sphere_areas(matrices[:, :3, :3]) / 4
        intensities = np.outer(share, radiance)
        cone = shaping.Cone.read(inputs, "sphere")
        if cone:
            shaping.add_spots(self, cone, "sphere", matrices, intensities, inputs.prim)
        else:
            for position, intensity in zip(matrices[:, 3, :3].tolist(), intensities):
                self.emit("point", position=position, intensity=constant(intensity))
        self._points.append(matrices[:, 3, :3])
        self._shine(radiance, len(matrices))

    def _area_light(self, kind: str, inputs: LightInputs, radiance, matrices) -> None:
        """Add a light with a surface that emits evenly."""
        normalize = bool(inputs.get("normalize"))
        cone = shaping.Cone.read(inputs, kind)
        if cone is None:
            light = Light(inputs.prim, matrices, radiance, normalize, self._member)
            self._kinds.setdefault(kind, []).append(light)
            return
        areas = AREAS[kind](matrices[:, :3, :3])
        good = self._good(areas, [inputs.prim], [len(areas)])
        matrices, areas = matrices[good], areas[good]
        seen = {"sphere": 1 / 4, "cylinder": 1 / np.pi}.get(kind, 1.0)
        share = np.full(len(areas), seen) if normalize else areas * seen
        intensities = np.outer(share, radiance)
        shaping.add_spots(self, cone, kind, matrices, intensities, inputs.prim)
        self._points.append(matrices[:, 3, :3])
        self._shine(radiance, len(areas))

    def _pictures(self, inputs: LightInputs, radiance, matrices, image) -> None:
        """Add rectangles that show a picture, from the front as it is in its file."""
        areas = AREAS["rect"](matrices[:, :3, :3])
        good = self._good(areas, [inputs.prim], [len(areas)])
        if shaping.Cone.read(inputs, "rect"):
            text = "the cone of a light with a picture was left out"
            self.context.notes.add("cone", text, inputs.prim)
        textures = {}
        for matrix, area in zip(matrices[good], areas[good]):
            scale = radiance / (area if inputs.get("normalize") else 1.0)
            to_world, mirrored = facing(matrix)
            key = (*scale, mirrored)
            if key not in textures:
                textures[key] = image.texture(scale, unmirrored(mirrored))
            emitter = {"type": "area", "radiance": textures[key]}
            self.emit("rectangle", to_world=to_world, emitter=emitter)
        self._points.append(corners(matrices[good]))
        self._shine(radiance, int(good.sum()))

    def _good(self, areas: np.ndarray, prims: list, counts: list[int]) -> np.ndarray:
        """Return which areas are finite and not zero, note those that are not."""
        good = np.isfinite(areas) & (areas > 0)
        if not good.all():
            first = np.repeat(np.arange(len(prims)), counts)[~good][0]
            text = "a light with a zero or infinite area was left out"
            self.context.notes.add("area", text, prims[first], int((~good).sum()))
        return good

    def _shine(self, radiance, count: int) -> None:
        if np.any(radiance):
            self.count += count

    def emit(self, kind: str, **parameters) -> None:
        """Add a finished part of the description, of the light that is at hand."""
        member = self._member
        name = self.named(member.name) if member else f"light_{len(self.entries)}"
        self.entries[name] = {"type": kind, **parameters}

    def named(self, path: str) -> str:
        """Return a key for something that is called by a path: the first one is the path."""
        count = self._named[path] = self._named.get(path, 0) + 1
        return path if count == 1 else f"{path}#{count}"

    # -- The end

    def points(self) -> np.ndarray:
        """Return points that span the lights in the world, ``(n, 3)``."""
        spans = [corners(light.matrices) for kind in self._kinds.values() for light in kind]
        return np.concatenate([np.zeros((0, 3)), *spans, *self._points])

    def finish(self, size: float) -> None:
        """Turn what was read into entries and lamps; ``size`` is that of the scene."""
        for kind, lights in self._kinds.items():
            matrices, radiance, areas, which = self._joined(kind, lights)
            members = [light.member for light in lights]
            exact = EXACT[kind](matrices, size)
            most = MOST_FLAT if kind == "rect" else MOST_ROUND
            if exact.sum() > most:
                exact[:] = False
            for matrix, value, light in zip(matrices[exact], radiance[exact], which[exact]):
                emitter = {"type": "area", "radiance": constant(value)}
                self._member = members[light]
                self.emit(**SHAPES[kind](matrix), emitter=emitter)
            if not exact.all():
                parts = list(split(members, which[~exact]))
                self._bake(kind, matrices[~exact], radiance[~exact], areas[~exact], parts)
        self.entries.update(self.domes.finish())

    def _joined(self, kind: str, lights: list[Light]) -> tuple[np.ndarray, ...]:
        """Return matrices, radiances, areas and numbers of all lights of a kind that shine."""
        counts = [len(light.matrices) for light in lights]
        matrices = np.concatenate([light.matrices for light in lights])
        radiance = np.repeat([light.radiance for light in lights], counts, axis=0)
        areas = AREAS[kind](matrices[:, :3, :3])
        good = self._good(areas, [light.prim for light in lights], counts)
        divided = good & np.repeat([light.normalize for light in lights], counts)
        radiance[divided] /= areas[divided, None]
        good &= radiance.any(axis=1)
        self.count += int(good.sum())
        which = np.repeat(np.arange(len(lights)), counts)
        return matrices[good], radiance[good], areas[good], which[good]

    def _bake(self, kind: str, matrices, radiance, areas, parts) -> None:
        """Turn lights into triangles; ``parts`` are those of each group, see ``split``."""
        count = len(matrices)
        if kind == "rect":
            for member, part in parts:
                self.lamps.add(*shapes.square(), matrices[part], radiance[part], member=member)
            return
        if kind == "sphere":
            level = next(level for most, level in SPHERE_LEVELS if count <= most)
            points, faces = shapes.icosphere(level)
            points = points @ shapes.random_rotations(count)
        else:
            segments = next(number for most, number in SEGMENTS if count <= most)
            points, faces = (shapes.circle if kind == "disk" else shapes.tube)(segments)
        text = f"{kind} lights became meshes of {len(faces)} triangles with the same power"
        self.context.notes.add(f"tessellated {kind}", text, "/", count)
        for member, part in parts:
            own = points if points.ndim == 2 else points[part]
            self.lamps.add(
                own, faces, matrices[part], radiance[part], areas=areas[part], member=member
            )


def _note_visibility(inputs: LightInputs) -> None:
    private = {"inputs:visibility:camera", "primvars:arnold:camera", "karma:light:renderlightgeo"}
    if not private.isdisjoint(inputs.authored):
        text = "another renderer's switch for lights that cameras see was ignored"
        inputs.context.notes.add("visibility", f"{text}, hide_emitters hides all", inputs.prim)


READERS = {
    "SphereLight": Lights._sphere,
    "RectLight": Lights._rect,
    "DiskLight": Lights._disk,
    "CylinderLight": Lights._cylinder,
    "DistantLight": Lights._distant,
    "DomeLight": Lights._dome,
    "DomeLight_1": Lights._dome,
    "PortalLight": Lights._portal,
    "GeometryLight": Lights._geometry,
}

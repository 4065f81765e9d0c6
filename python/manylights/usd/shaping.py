"""Cones of UsdLux as spot lights.

No area light of Mitsuba has a profile over angles. From a distance of a few radii a light with a
cone looks like a spot whose intensity is radiance times projected area, so that is what it becomes:
one spot in the middle, or a few that spread over the surface. Mitsuba's linear falloff, and its
lack of a cosine, are made up for by a texture on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from pxr import UsdLux

from manylights.usd.inputs import LightInputs
from manylights.usd.vectors import unit

#: Spots on the surface of a light, along each side.
GRID = 4

#: Number of lights up to which they have several spots, and number of spots with textures.
FEW_LIGHTS, MOST_TEXTURED = 4, 64

#: Degrees above which a texture, which lies in a plane, cannot hold a profile.
WIDEST_TEXTURE = 85.0

#: Pixels along each side of a texture.
RESOLUTION = 512


@dataclass(frozen=True)
class Cone:
    """The shaping of a light that changes something.

    Attributes:
        angle: in degrees from the axis.
        softness: part of the angle in which light fades.
        focus: exponent of a cosine.
    """

    angle: float
    softness: float
    focus: float

    @staticmethod
    def read(inputs: LightInputs, kind: str) -> Cone | None:
        """Return the cone of a light, None if it has none or all its light is in it."""
        authored = any("shaping:" in name for name in inputs.authored)
        applied = inputs.prim.HasAPI(UsdLux.ShapingAPI)
        if not authored and not applied:
            return None
        names = ("shaping:cone:angle", "inputs:shaping:cone:angle")
        has_angle = applied or not inputs.authored.isdisjoint(names)
        angle = float(inputs.get("shaping:cone:angle")) if has_angle else 180.0
        softness = float(np.clip(inputs.get("shaping:cone:softness"), 0.0, 1.0))
        focus = max(float(inputs.get("shaping:focus")), 0.0)
        notes, prim = inputs.context.notes, inputs.prim
        if focus and any(inputs.get("shaping:focusTint")):
            notes.add("focusTint", "the tint of a light's focus was ignored", prim)
        if not np.isfinite([angle, softness, focus]).all():
            notes.add("cone", "a cone that is not finite was left out", prim)
            return None
        flat = kind in ("rect", "disk")
        if angle >= (90.0 if flat else 180.0):
            if focus:
                notes.add("focus", "the focus of a light without a cone was left out", prim)
            return None
        if flat and angle > WIDEST_TEXTURE:
            text = f"the cone of a flat light is wider than {WIDEST_TEXTURE:g} degrees: left out"
            notes.add("cone", text, prim)
            return None
        return Cone(max(angle, 0.0), softness, focus)

    def profile(self, theta: np.ndarray) -> np.ndarray:
        """Return what UsdLux lets through at an angle from the axis, in radians."""
        outer = np.radians(self.angle)
        inner = (1.0 - self.softness) * outer
        x = np.clip((theta - inner) / max(outer - inner, 1e-9), 0.0, 1.0)
        return (1.0 - x * x * (3.0 - 2.0 * x)) * np.abs(np.cos(theta)) ** self.focus


def add_spots(lights, cone: Cone, kind: str, matrices, intensities, prim) -> None:
    """Add spot lights in the places of lights with a cone.

    Args:
        lights: the ``Lights`` to add them to.
        cone: of all of them.
        kind: of light.
        matrices: ``(n, 4, 4)`` of their unit shapes.
        intensities: ``(n, 3)`` along the axis, or for cylinders across theirs.
        prim: the light, for notes.
    """
    places = _places(kind) if len(matrices) <= FEW_LIGHTS else np.zeros((1, 3))
    count = len(places) * len(matrices)
    texture = None
    needed = kind != "sphere" or cone.softness > 0 or cone.focus > 0
    if needed and cone.angle <= WIDEST_TEXTURE and count <= MOST_TEXTURED:
        texture = _texture(cone, kind)
        name = f"cone_{len(lights.entries)}"
        lights.entries[name] = texture
    beam = (1.0 - cone.softness) * cone.angle
    to_world = np.tile(np.eye(4), (len(matrices), 1, 1))
    to_world[:, :3, :3] = np.swapaxes(_frames(matrices, kind), 1, 2)
    values = (intensities / len(places)).tolist()
    for place in places:
        to_world[:, :3, 3] = place @ matrices[:, :3, :3] + matrices[:, 3, :3]
        for frame, value in zip(to_world, values):
            spot = {"to_world": mi.ScalarTransform4f(frame), "cutoff_angle": cone.angle}
            spot["intensity"] = {"type": "rgb", "value": value}
            spot["beam_width"] = beam
            if texture is not None:
                spot["texture"] = {"type": "ref", "id": name}
            lights.emit("spot", **spot)
    _note(lights, kind, len(matrices), needed and texture is None, prim)


def _note(lights, kind: str, count: int, rough: bool, prim) -> None:
    edge = ", with another falloff" if rough else ""
    text = f"{kind} lights with a cone became spots, which have no size and are not seen{edge}"
    lights.context.notes.add("cone", text, prim, count)


def _places(kind: str) -> np.ndarray:
    """Return points on the unit shape of a light, each of which stands for the same area."""
    middles = (np.arange(GRID) + 0.5) / GRID - 0.5
    if kind == "sphere":
        return np.zeros((1, 3))
    if kind == "cylinder":
        return np.stack([middles, 0 * middles, 0 * middles], axis=1)
    if kind == "rect":
        x, y = np.meshgrid(middles, middles)
        return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    index = np.arange(GRID * GRID)
    radius, angle = np.sqrt((index + 0.5) / len(index)), index * np.pi * (3 - 5**0.5)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], axis=1)


def _frames(matrices: np.ndarray, kind: str) -> np.ndarray:
    """Return the axes of spots as rows: Z is where they point, X along that of a cylinder."""
    x, y, z = (matrices[:, row, :3] for row in range(3))
    axis = -z
    if kind in ("rect", "disk"):
        axis = np.cross(x, y)
        axis *= np.where((axis * z).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    axis = np.where(axis.any(axis=1, keepdims=True), axis, (0.0, 0.0, -1.0))
    axis = unit(axis)
    side = x - (x * axis).sum(axis=1, keepdims=True) * axis
    lost = np.linalg.norm(side, axis=1) <= 1e-9 * np.linalg.norm(x, axis=1)
    side[lost] = np.cross(axis[lost], np.eye(3)[np.abs(axis[lost]).argmin(axis=1)])
    side = unit(side)
    return np.stack([side, np.cross(axis, side), axis], axis=1)


def _texture(cone: Cone, kind: str) -> dict:
    """Return a texture that turns Mitsuba's spot into the cone of a light."""
    extent = np.tan(np.radians(cone.angle))
    x = ((np.arange(RESOLUTION) + 0.5) / RESOLUTION * 2 - 1) * extent
    x, y = np.meshgrid(x, x)
    theta = np.arctan(np.hypot(x, y))
    outer, inner = np.radians(cone.angle), np.radians((1 - cone.softness) * cone.angle)
    linear = np.clip((outer - theta) / max(outer - inner, 1e-9), 1e-3, 1.0)
    values = cone.profile(np.minimum(theta, outer * (1 - 1e-3))) / linear
    if kind in ("rect", "disk"):
        values = values * np.cos(theta)
    if kind == "cylinder":
        values = values * np.sqrt((1 + y * y) / (1 + x * x + y * y))
    bitmap = mi.Bitmap(values.astype(np.float32)[:, :, None])
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}

"""Domes: Mitsuba has one environment, so several become their sum."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from manylights.usd.context import Context
from manylights.usd.images import Image, read_image
from manylights.usd.inputs import LightInputs
from manylights.usd.light_groups import GroupMember

#: Rows are where the axes of a dome with its pole along Z go, as ``p @ POLE_Z``: turned by 90
#: degrees around X.
POLE_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass
class Dome:
    """A picture around everything.

    Attributes:
        image: with Mitsuba's axes of an environment map.
        scale: three factors.
        rotation: ``(3, 3)``, rows are its axes in the world; perhaps mirrored.
    """

    image: Image
    scale: np.ndarray
    rotation: np.ndarray


class Domes:
    """Collects the domes of a stage."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.constant = np.zeros(3)
        self.count = 0
        self._domes: list[Dome] = []
        self._members: list[GroupMember] = []

    def add(self, inputs: LightInputs, radiance, matrices: np.ndarray, member=None) -> int:
        """Add a dome at all its places, of a group of lights; return how many shine."""
        notes, prim = self.context.notes, inputs.prim
        self._members += [member] if member and np.any(radiance) else []
        if inputs.get("texture:format") not in ("automatic", "latlong"):
            text = f"a dome's texture:format {inputs.get('texture:format')} was read as latlong"
            notes.add("texture:format", text, prim)
        file = inputs.file("texture:file")
        image = read_image(file, prim, self.context) if file and np.any(radiance) else None
        if image is None:
            self.constant += radiance * len(matrices)
            self.count += len(matrices)
            return len(matrices)
        linear = _rotations(matrices[:, :3, :3])
        good = np.isfinite(linear).all(axis=(1, 2))
        if not good.all():
            notes.add("transform", "a dome without directions was left out", prim)
        if self._pole(inputs) == "Z":
            linear = POLE_Z @ linear
        for rotation in linear[good]:
            self._domes.append(Dome(image, radiance, rotation))
        self.count += int(good.sum())
        return int(good.sum())

    def _pole(self, inputs: LightInputs) -> str:
        """Return the axis of a dome's pole: the old schema has Y even where Z is up."""
        if inputs.prim.GetTypeName() != "DomeLight_1":
            return "Y"
        axis = str(inputs.own("poleAxis", "scene"))
        return self.context.up_axis() if axis == "scene" else axis

    def finish(self) -> dict[str, dict]:
        """Return the environment of the stage, if it has one, by its id."""
        if self.count > 1:
            text = f"{self.count} domes became one environment, their sum"
            self.context.notes.add("domes", text, "/")
        self.context.light_groups.check_environment(self._members)
        name = self._members[0].name if self._members else "environment"
        if not self._domes:
            if not self.constant.any():
                return {}
            radiance = {"type": "rgb", "value": self.constant.tolist()}
            return {name: {"type": "constant", "radiance": radiance}}
        first = self._domes[0]
        mirrored = np.linalg.det(first.rotation) < 0
        if len(self._domes) == 1:
            pixels = first.image.pixels * first.scale
            pixels = pixels[:, ::-1] if mirrored else pixels
            rotation = np.diag([-1.0, 1, 1]) @ first.rotation if mirrored else first.rotation
        else:
            pixels, rotation = self._sum(), np.eye(3)
        to_world = np.eye(4)
        to_world[:3, :3] = rotation.T
        pixels = np.ascontiguousarray(pixels + self.constant, dtype=np.float32)
        environment = {
            "type": "envmap",
            "bitmap": mi.Bitmap(pixels),
            "to_world": mi.ScalarTransform4f(to_world),
        }
        return {name: environment}

    def _sum(self) -> np.ndarray:
        """Return the sum of all pictures, as large as the largest."""
        height = max(dome.image.pixels.shape[0] for dome in self._domes)
        width = max(dome.image.pixels.shape[1] for dome in self._domes)
        height, width = max(height, 64), max(width, 128)
        phi = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
        theta = np.pi * (np.arange(height) + 0.5) / height
        theta, phi = np.meshgrid(theta, phi, indexing="ij")
        directions = [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)]
        directions = np.stack(directions, axis=-1)
        total = np.zeros((height, width, 3))
        for dome in self._domes:
            total += _lookup(dome.image.pixels, directions @ dome.rotation.T) * dome.scale
        return total


def _rotations(linear: np.ndarray) -> np.ndarray:
    """Return the nearest rotations, perhaps mirrored; NaN where there is none."""
    u, values, v = np.linalg.svd(linear)
    rotations = u @ v
    rotations[values[:, 2] <= 1e-12 * values[:, 0]] = np.nan
    return rotations


def _lookup(pixels: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return what an environment map shows in directions of its own space, bilinear."""
    height, width = pixels.shape[:2]
    x, y, z = np.moveaxis(directions, -1, 0)
    u = (0.5 - np.arctan2(x, z) / (2 * np.pi)) * width - 0.5
    v = np.arccos(np.clip(y, -1, 1)) / np.pi * height - 0.5
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    du, dv = (u - column)[..., None], (v - row)[..., None]
    left, right = column % width, (column + 1) % width
    top, bottom = np.clip(row, 0, height - 1), np.clip(row + 1, 0, height - 1)
    upper = pixels[top, left] * (1 - du) + pixels[top, right] * du
    lower = pixels[bottom, left] * (1 - du) + pixels[bottom, right] * du
    return upper * (1 - dv) + lower * dv

"""Render settings of a stage, with the attributes ``mitsuba:...`` that hdMitsuba reads, too."""

from __future__ import annotations

import math

from pxr import Sdf, Usd, UsdRender, Vt

from manylights.usd.context import Context
from manylights.usd.stage import targets_of

#: More pixels than this along a side are a slip.
LARGEST_SIDE = 65536

#: Mitsuba's filters of pixels.
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")


class RenderSettings:
    """The render settings to use, perhaps none.

    Attributes:
        prim: a ``RenderSettings`` prim, None if there is none.
        product: its first ``RenderProduct``, which is stronger, None if there is none.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self.prim = self._find()
        self.product = self._first_product()
        self._note_purposes()

    def _find(self) -> Usd.Prim | None:
        stage = self.context.stage
        path = stage.GetMetadata("renderSettingsPrimPath")
        if path:
            prim = stage.GetPrimAtPath(path) if Sdf.Path.IsValidPathString(path) else None
            if prim and prim.IsA(UsdRender.Settings):
                return prim
            text = f"renderSettingsPrimPath {path} is no RenderSettings"
            self.context.notes.add("settings", text, path)
        found = [prim for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]
        if len(found) > 1:
            text = (
                f"the stage has {len(found)} RenderSettings and does not say which: none was used"
            )
            self.context.notes.add("settings", text, found[0])
        return found[0] if len(found) == 1 else None

    def _first_product(self) -> Usd.Prim | None:
        """Return the product whose image is rendered, note others with another camera."""
        targets = targets_of(self.prim, "products") if self.prim else ()
        prims = [self.context.stage.GetPrimAtPath(path) for path in targets]
        products = [prim for prim in prims if prim and prim.IsA(UsdRender.Product)]
        if len({_camera_of(product) for product in products}) > 1:
            path = products[0].GetPath()
            text = f"the RenderSettings have products of several cameras, used was {path}"
            self.context.notes.add("products", text, self.prim)
        return products[0] if products else None

    def _note_purposes(self) -> None:
        value, used = self._value("includedPurposes"), self.context.purposes
        included = list(value) if isinstance(value, Vt.TokenArray) else None
        if included is not None and {*included} != {*used}:
            text = f"includedPurposes {', '.join(included)} of the RenderSettings were ignored, "
            text += f"used were {', '.join(used)}: the argument purposes chooses them"
            self.context.notes.add("includedPurposes", text, self.prim)

    def _value(self, name: str, fallback=None):
        """Return an authored attribute of the product or the settings."""
        for prim in (self.product, self.prim):
            attribute = prim.GetAttribute(name) if prim else None
            if attribute and attribute.HasAuthoredValue():
                return self.context.value(attribute, fallback)
        return fallback

    def camera(self) -> Sdf.Path | None:
        """Return the path of the camera."""
        found = [_camera_of(prim) for prim in (self.product, self.prim) if prim]
        return next(filter(None, found), None)

    def has_lens(self) -> bool:
        """May cameras have depth of field?"""
        return not self._value("disableDepthOfField", False)

    def resolution(self) -> tuple[int, int] | None:
        """Return width and height in pixels, if they are authored."""
        value = self._value("resolution")
        if value is None:
            return None
        width, height = int(value[0]), int(value[1])
        if min(width, height) < 1 or max(width, height) > LARGEST_SIDE:
            text = f"resolution ({width}, {height}) of the render settings was ignored"
            self.context.notes.add("resolution", text, self.prim)
            return None
        if float(self._value("pixelAspectRatio", 1.0)) != 1.0:
            text = "pixels that are not square (pixelAspectRatio) were made square"
            self.context.notes.add("pixelAspectRatio", text, self.prim)
        window = self._value("dataWindowNDC", (0, 0, 1, 1))
        if tuple(window) != (0, 0, 1, 1):
            text = "dataWindowNDC was ignored, the whole image is rendered"
            self.context.notes.add("dataWindowNDC", text, self.prim)
        return width, height

    def conform(self, horizontal: float, vertical: float, aspect: float) -> tuple[float, float]:
        """Return an aperture with the aspect of the image, by the authored policy."""
        policy = str(self._value("aspectRatioConformPolicy", "expandAperture"))
        wide = aspect > horizontal / vertical
        if policy == "adjustPixelAspectRatio" and not math.isclose(aspect, horizontal / vertical):
            text = "aspectRatioConformPolicy adjustPixelAspectRatio was read as expandAperture"
            self.context.notes.add("aspectRatioConformPolicy", text, self.prim)
        keep_vertical = {
            "cropAperture": not wide,
            "adjustApertureWidth": True,
            "adjustApertureHeight": False,
        }.get(policy, wide)
        return (vertical * aspect, vertical) if keep_vertical else (horizontal, horizontal / aspect)

    def sample_count(self) -> int | None:
        """Return the samples per pixel."""
        value = self._value("mitsuba:sample_count")
        if value is None:
            return None
        if int(value) < 1:
            text = f"mitsuba:sample_count {value} was ignored, it has to be at least 1"
            self.context.notes.add("sample_count", text, self.prim)
            return None
        return int(value)

    def apply_to_sensor(self, camera: Usd.Prim, sensor: dict) -> None:
        """Choose a pinhole and the filter of pixels, if a camera or the settings ask for it."""
        kind = self._of_camera(camera, "mitsuba:sensor:type") or sensor["type"]
        if (kind, sensor["type"]) == ("perspective", "thinlens"):
            del sensor["aperture_radius"], sensor["focus_distance"]
            sensor["type"] = kind
        elif kind != sensor["type"]:
            text = f"mitsuba:sensor:type {kind} was ignored, used was {sensor['type']}"
            self.context.notes.add("sensor", text, camera)
        name = self._of_camera(camera, "mitsuba:sensor:film:pixel_filter:type")
        if name in FILTERS:
            sensor["film"]["rfilter"] = {"type": name}
        elif name:
            text = f"the pixel filter {name} is none of {', '.join(FILTERS)}: box was used"
            self.context.notes.add("filter type", text, camera)

    def _of_camera(self, camera: Usd.Prim, name: str) -> str | None:
        attribute = camera.GetAttribute(name)
        value = self.context.value(attribute) if attribute else self._value(name)
        return str(value) if value else None

    def integrator(self) -> dict | None:
        """Return the integrator, with what is nested in it."""
        if not self.prim or self._value("mitsuba:integrator:type") is None:
            return None
        result: dict = {}
        prefix = "mitsuba:integrator:"
        for attribute in self.prim.GetAuthoredAttributes():
            name = attribute.GetName()
            value = self.context.value(attribute) if name.startswith(prefix) else None
            if value is None:
                continue
            *parents, key = name[len(prefix) :].split(":")
            inner = result
            for parent in parents:
                inner = inner.setdefault(parent, {})
            inner[key] = _plain(value)
        return result


def _camera_of(prim: Usd.Prim) -> Sdf.Path | None:
    """Return the path of the camera of settings or a product."""
    return next(iter(targets_of(prim, "camera")), None)


def _plain(value):
    """Return a value of USD as Mitsuba takes it."""
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Sdf.AssetPath):
        return value.resolvedPath or value.path
    try:
        return [float(part) for part in value]
    except (TypeError, ValueError):
        return str(value)

"""Reads what all lights of UsdLux have in common: their inputs, and the radiance that they give."""

from __future__ import annotations

import math

import numpy as np
from pxr import Sdf, Usd, UsdLux, UsdShade

from manylights.errors import typed
from manylights.usd.context import Context

#: What inputs are where a stage says nothing, or blocks them.
FALLBACKS = {
    "intensity": 1.0,
    "exposure": 0.0,
    "color": (1.0, 1.0, 1.0),
    "normalize": False,
    "enableColorTemperature": False,
    "colorTemperature": 6500.0,
    "diffuse": 1.0,
    "specular": 1.0,
    "radius": 0.5,
    "width": 1.0,
    "height": 1.0,
    "length": 1.0,
    "angle": 0.53,
    "texture:file": None,
    "texture:format": "automatic",
    "shaping:cone:angle": 90.0,
    "shaping:cone:softness": 0.0,
    "shaping:focus": 0.0,
    "shaping:focusTint": (0.0, 0.0, 0.0),
    "shaping:ies:file": None,
    "shadow:enable": True,
}

#: Those of some types.
TYPED_FALLBACKS = {("DistantLight", "intensity"): 50000.0}

#: Blender writes suns with a quarter of their irradiance and half of their angle, other lights
#: right but for their white (``scenes/bench/blender_units.py``).
BLENDER_SUN = {"intensity": 4.0, "angle": 2.0}

#: It switches the color temperature of all lights on; this one is its default, and white.
BLENDER_WHITE = 6500.0

#: Before USD 21.05 inputs of lights had no ``inputs:``.
LEGACY = tuple(name for name in FALLBACKS if name not in ("diffuse", "specular", "shadow:enable"))


class LightInputs:
    """The inputs of one light.

    Attributes:
        prim: the light.
        authored: names of its properties that a stage says something about.
    """

    def __init__(self, prim: Usd.Prim, context: Context) -> None:
        self.prim, self.context = prim, context
        self.authored = set(prim.GetAuthoredPropertyNames())
        self.legacy = set()
        if not self.authored.isdisjoint(LEGACY):
            self._find_legacy()

    def _find_legacy(self) -> None:
        names = {name for name in LEGACY if name in self.authored}
        names = {name for name in names if f"inputs:{name}" not in self.authored}
        # A mesh may have primvars and attributes of its own by such a name
        if not self.prim.IsA(UsdLux.BoundableLightBase) and not self.prim.IsA(
            UsdLux.NonboundableLightBase
        ):
            return
        if self.context.legacy_lights:
            self.legacy = names
        elif names:
            text = (
                f"{', '.join(sorted(names))} without inputs: are of lights before USD 21.05 and "
                f"were ignored; {typed('legacy_lights=True', '--legacy-lights')} reads them"
            )
            self.context.notes.add("legacy_lights", text, self.prim)

    def get(self, name: str):
        """Return an input; the schema's fallback if it is blocked or has no value."""
        fallback = TYPED_FALLBACKS.get((self.prim.GetTypeName(), name), FALLBACKS[name])
        if name in self.legacy:
            attribute = self.prim.GetAttribute(name)
        elif f"inputs:{name}" in self.authored:
            attribute = self.prim.GetAttribute(f"inputs:{name}")
        else:
            return fallback
        if attribute.HasAuthoredConnections():
            sources = UsdShade.Utils.GetValueProducingAttributes(UsdShade.Input(attribute))
            kinds = [UsdShade.Utils.GetType(source.GetName()) for source in sources]
            if kinds and kinds[0] != UsdShade.AttributeType.Output:
                attribute = sources[0]
            else:
                text = f"inputs:{name} is connected to a shader and was left at its value"
                self.context.notes.add("connection", text, self.prim)
        return self.context.value(attribute, fallback)

    def own(self, name: str, fallback):
        """Return an attribute that is no input."""
        if name not in self.authored:
            return fallback
        return self.context.value(self.prim.GetAttribute(name), fallback)

    def radiance(self) -> np.ndarray | None:
        """Return what a light emits where it is not normalized, three channels; None if broken."""
        try:
            scale = float(self.get("intensity")) * 2.0 ** float(self.get("exposure"))
        except OverflowError:
            scale = math.inf
        if self._is_blender_sun():
            scale *= BLENDER_SUN["intensity"]
        color = np.array(self.get("color"), dtype=np.float64) * scale
        if self.get("enableColorTemperature"):
            kelvin = float(self.get("colorTemperature"))
            if not (self.context.blender_light_units and kelvin == BLENDER_WHITE):
                color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
        if not np.isfinite(color).all():
            text = "a light whose intensity, exposure or color is not finite was left out"
            self.context.notes.add("light value", text, self.prim)
            return None
        if (color < 0).any():
            text = "negative light is not possible, it was cut off at zero"
            self.context.notes.add("negative", text, self.prim)
        return np.maximum(color, 0.0)

    def angle(self) -> float:
        """Return the angle of a distant light's disk in degrees."""
        factor = BLENDER_SUN["angle"] if self._is_blender_sun() else 1.0
        return float(self.get("angle")) * factor

    def _is_blender_sun(self) -> bool:
        return self.context.blender_light_units and self.prim.GetTypeName() == "DistantLight"

    def length(self, name: str) -> float:
        """Return a radius or an extent, 0 and a note if it is none."""
        value = float(self.get(name))
        if not math.isfinite(value):
            self.context.notes.add("light value", f"a light's {name} is {value}", self.prim)
            return 0.0
        return abs(value)

    def file(self, name: str) -> Sdf.AssetPath | None:
        """Return a file that an input names, None if it names none."""
        asset = self.get(name)
        return asset if isinstance(asset, Sdf.AssetPath) and asset.path else None

    def note_unsupported(self) -> None:
        """Note the inputs of lights that Mitsuba has nothing for."""
        notes, prim = self.context.notes, self.prim
        for name in ("diffuse", "specular"):
            if f"inputs:{name}" in self.authored and float(self.get(name)) != 1.0:
                notes.add(name, f"a light's {name} multiplier was ignored", prim)
        if self.file("shaping:ies:file"):
            text = f"the ies profile {self.file('shaping:ies:file').path} was left out"
            notes.add("ies", f"{text}: the light shines alike in all directions", prim)
        if "inputs:shadow:enable" in self.authored and not self.get("shadow:enable"):
            notes.add("shadow", "a light without shadow casts one", prim)
        relation = prim.GetRelationship("light:filters")
        if relation and relation.GetTargets():
            notes.add("filter", "a light filter was ignored", prim)
        for kind in ("lightLink", "shadowLink"):
            if any(name.startswith(f"collection:{kind}:") for name in self.authored):
                self._note_link(kind)

    def _note_link(self, kind: str) -> None:
        """Note linking, unless it includes everything."""
        parts = ("includes", "excludes")
        relations = [self.prim.GetRelationship(f"collection:{kind}:{part}") for part in parts]
        chosen = any(relation and relation.GetTargets() for relation in relations)
        everything = self.own(f"collection:{kind}:includeRoot", True)
        if chosen or not everything:
            text = "a link of lights to some objects was ignored, they light all"
            self.context.notes.add("link", text, self.prim)

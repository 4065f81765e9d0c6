"""A surface's look as Mitsuba's ``principled`` BSDF, with masks, normal maps and emission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from manylights.usd.shading import LUMINANCE, Attribute, Lookup, like
from manylights.usd.textures import Textures


@dataclass
class Look:
    """What a surface node says; each part a value, a ``Lookup`` or an ``Attribute``.

    Attributes:
        base_color: of diffuse reflection, and of metals.
        base_weight: its factor.
        metallic: 0 to 1.
        roughness: 0 to 1; the microfacets' alpha is its square.
        ior: index of refraction.
        specular_color: reflectance at normal incidence in place of ``ior``, or ``None``.
        clearcoat: 0 to 1.
        clearcoat_roughness: as ``roughness``.
        opacity: 0 to 1.
        threshold: above 0, opacity is all or nothing.
        presence: is opacity a surface's presence, rather than what its diffuse part loses?
        emission: radiance in nits.
        emission_weight: its factor.
        normal: a normal map, or ``None``.
    """

    base_color: Any = (0.18, 0.18, 0.18)
    base_weight: float = 1.0
    metallic: Any = 0.0
    roughness: Any = 0.5
    ior: float = 1.5
    specular_color: Any = None
    clearcoat: Any = 0.0
    clearcoat_roughness: Any = 0.01
    opacity: Any = 1.0
    threshold: float = 0.0
    presence: bool = False
    emission: Any = (0.0, 0.0, 0.0)
    emission_weight: float = 1.0
    normal: Any = None

    def parts(self) -> list:
        """Return all that may be an image or a primvar."""
        return [
            *(self.base_color, self.metallic, self.roughness, self.clearcoat),
            *(self.clearcoat_roughness, self.opacity, self.emission, self.normal),
        ]

    def lookups(self) -> list[Lookup]:
        """Return the images."""
        return [part for part in self.parts() if isinstance(part, Lookup)]

    def color_primvar(self) -> str | None:
        """Return the primvar that a color is, ``None`` if there is none."""
        colors = [part for part in (self.base_color, self.emission) if isinstance(part, Attribute)]
        return colors[0].primvar if colors else None

    def uses_primvars(self) -> bool:
        """Does the look depend on the mesh's colors?"""
        return any(isinstance(part, Attribute) for part in self.parts())


def is_white(texture) -> bool:
    """Is this an image that is 1 everywhere, as the alpha of many is?"""
    if not isinstance(texture, dict) or texture["type"] != "bitmap":
        return False
    pixels = np.array(texture["bitmap"])
    return bool((pixels == (np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1)).all())


def _primvar_of(surface, rows: str) -> str:
    """Return the primvar that the colors or the opacity of a surface were read from."""
    return surface.color_primvar if rows == "colors" else "displayOpacity"


class Principled:
    """Makes dictionaries of looks.

    Args:
        textures: reads images.
        context: of the stage.
        surface: whose colors ``Attribute`` parts mean.
        prim: the material, for notes.
    """

    def __init__(self, textures: Textures, context, surface, prim) -> None:
        self.textures, self.context, self.surface, self.prim = textures, context, surface, prim

    def bsdf(self, look: Look) -> dict:
        """Return the BSDF: two-sided, within a mask if it is not everywhere."""
        bsdf = {
            "type": "principled",
            "base_color": self._color(look.base_color, look.base_weight),
            "metallic": self._number(look.metallic),
            "roughness": self._number(look.roughness),
            "clearcoat": self._number(look.clearcoat),
        }
        self._set_reflectance(bsdf, look)
        if bsdf["clearcoat"] != 0.0:
            bsdf["clearcoat_gloss"] = self._gloss(look.clearcoat_roughness)
        for name in ("metallic", "clearcoat"):
            if bsdf[name] == 0.0:
                del bsdf[name]  # without the lobe the kernel is smaller
        if isinstance(look.normal, Lookup):
            normals = self.textures.make(look.normal, "normal")
            if isinstance(normals, dict):
                bsdf = {"type": "normalmap", "normalmap": normals, "bsdf": bsdf}
        return self._masked({"type": "twosided", "bsdf": bsdf}, look)

    def emission(self, look: Look) -> dict | None:
        """Return the radiance, ``None`` if it is zero."""
        if look.emission_weight <= 0:
            return None
        radiance = self._color(look.emission, look.emission_weight, "emission")
        image = radiance.get("nested", radiance).get("bitmap")
        values = radiance.get("value", (1.0,)) if image is None else np.array(image)
        return radiance if np.any(values) else None

    def _set_reflectance(self, bsdf: dict, look: Look) -> None:
        if look.specular_color is None:
            bsdf["eta"] = float(np.clip(look.ior, 1.0, 10.0))
            return
        # `principled` has grey reflectances up to .08 there
        bsdf["specular"] = float(np.clip(np.dot(look.specular_color, LUMINANCE) / 0.08, 0, 1))
        bsdf["metallic"] = 0.0

    def _color(self, part, weight: float, role: str = "color") -> dict:
        """Return a color as a dictionary."""
        if isinstance(part, Lookup):
            if weight != 1:
                part.scale, part.bias = part.scale * weight, part.bias * weight
            part = self.textures.make(part, role)
        elif isinstance(part, Attribute):
            part = self._attribute(part, "colors", "color")
        if isinstance(part, dict):
            return part
        three = np.broadcast_to(np.array(part, dtype=float), 3) * weight
        limits = (0, 1) if role == "color" else (0, None)
        return {"type": "rgb", "value": [float(value) for value in np.clip(three, *limits)]}

    def _number(self, part):
        """Return a number, or a texture of numbers."""
        if isinstance(part, Lookup):
            part = self.textures.make(part, "data")
        elif isinstance(part, Attribute):
            part = self._attribute(part, "opacity", "opacity")
        if isinstance(part, dict):
            return part
        return float(np.clip(part, 0, 1))

    def _attribute(self, part: Attribute, rows: str, name: str):
        """Return the colors of the mesh, the fallback if it has none."""
        found = getattr(self.surface, rows, None)
        if found is not None and part.primvar == _primvar_of(self.surface, rows):
            per = getattr(self.surface, f"{rows}_per")
            return {"type": "mesh_attribute", "name": f"{per}_{name}"}
        text = f"the primvar {part.primvar} is not read here, its fallback value is used"
        self.context.notes.add("primvar reader", text, self.prim)
        fallback = (0.0, 0.0, 0.0) if rows == "colors" else 1.0
        if part.fallback is None:
            return fallback
        return like(part.fallback, fallback, self.prim, self.context)

    def _gloss(self, roughness):
        """Return Disney's gloss for which alpha is the square of the coat's roughness."""
        if isinstance(roughness, (Lookup, Attribute)):
            text = "images on the roughness of clear coats are not used"
            self.context.notes.add("textured input", text, self.prim)
            roughness = 0.01
        return float(np.clip((0.1 - float(roughness) ** 2) / 0.099, 0, 1))

    def _masked(self, bsdf: dict, look: Look) -> dict:
        if isinstance(look.opacity, Lookup):
            look.opacity.threshold = look.threshold
        opacity = self._number(look.opacity)
        if opacity == 1.0 or is_white(opacity):
            return bsdf
        if look.threshold > 0 and not isinstance(opacity, dict):
            return bsdf if opacity >= look.threshold else {"type": "null"}
        if not look.presence and look.threshold <= 0:
            text = "opacity makes the whole surface thinner, its highlights, too"
            self.context.notes.add("opacity", text, self.prim)
        return {"type": "mask", "opacity": opacity, "bsdf": bsdf}

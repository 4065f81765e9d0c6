"""Which material a prim is bound to, and what Mitsuba makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pxr import UsdShade

from manylights.usd import materialx
from manylights.usd.native_shaders import PREFIX, native
from manylights.usd.preview_surface import omni_pbr, preview_surface
from manylights.usd.principled import Look, Principled
from manylights.usd.shading import Lookup, producer, shader_id
from manylights.usd.textures import Textures

#: Surface nodes that are read
READERS = {
    "UsdPreviewSurface": preview_surface,
    "ND_UsdPreviewSurface_surfaceshader": preview_surface,
    "ND_standard_surface_surfaceshader": materialx.standard_surface,
    "ND_open_pbr_surface_surfaceshader": materialx.open_pbr,
    "ND_surface_unlit": materialx.surface_unlit,
    "mdl:OmniPBR": omni_pbr,
    "mdl:OmniPBR_Opacity": omni_pbr,
}

GREY = [0.18, 0.18, 0.18]
"""Of what has neither material nor color."""


@dataclass
class Material:
    """What Mitsuba makes of a material.

    Attributes:
        bsdf: for ``mi.load_dict``.
        emission: the radiance of an ``area`` emitter, for ``mi.load_dict``, or ``None``.
        uv_primvar: the texture coordinates that its images use, ``None`` for the mesh's own.
        lookups: its images.
        prim: the material, ``None`` where there is none.
    """

    bsdf: dict
    emission: dict | None = None
    uv_primvar: str | None = None
    lookups: list[Lookup] = field(default_factory=list)
    prim: Any = None


class Materials:
    """The materials of a stage, each made once."""

    def __init__(self, context) -> None:
        self.context, self.textures = context, Textures(context)
        self._looks: dict[str, object] = {}
        self._made: dict[tuple, Material] = {}

    def color_primvar(self, material) -> str | None:
        """Return the primvar that the colors of a USD material are, ``None`` if there is none."""
        found = self._found(material) if material else None
        return found.color_primvar() if isinstance(found, Look) else None

    def bound(self, prim):
        """Return the material of a prim: for full renders, for previews, else for all purposes."""
        binding = UsdShade.MaterialBindingAPI(prim)
        material, relationship = binding.ComputeBoundMaterial(UsdShade.Tokens.full)
        if material and _is_for_full(relationship):
            return material
        material, _ = binding.ComputeBoundMaterial(UsdShade.Tokens.preview)
        if not material and _has_binding(prim):
            text = "a material is bound that is not there: grey, or displayColor"
            self.context.notes.add("missing material", text, prim)
        return material or None

    def make(self, material, surface) -> Material:
        """Return what Mitsuba makes of a material of USD, or of none, on a surface."""
        found = self._look(material) if material else None
        if found is None:
            own = surface is None or surface.color_primvar == "displayColor"
            return self._of_colors(surface if own else None)
        if isinstance(found, Material):
            return found
        key: tuple = (str(material.GetPath()),)
        if found.uses_primvars():
            key += (*_rates(surface), surface and surface.color_primvar)
        if key not in self._made:
            self._made[key] = self._of_look(with_own_lookups(found), material.GetPrim(), surface)
        return self._made[key]

    def _look(self, material):
        """Return the look of a material, a ``Material`` of Mitsuba's own, or ``None``."""
        found = self._found(material)
        if isinstance(found, str):
            self.context.notes.add(*_PROBLEMS.get(found, (found, _OTHERS.format(found))), material)
            return None
        return found

    def _found(self, material):
        """Return what ``_read`` does, read once."""
        path = str(material.GetPath())
        if path not in self._looks:
            self._looks[path] = self._read(material)
        return self._looks[path]

    def _read(self, material):
        """Return a look, a ``Material``, or a word that says why there is neither."""
        others = []
        for name, shader in surface_shaders(material):
            identifier = shader_id(shader)
            if identifier.startswith(PREFIX):
                bsdf = native(shader, self.context, self.textures)
                return Material(bsdf, prim=material.GetPrim())
            if identifier in READERS:
                return READERS[identifier](shader, self.context)
            others.append(identifier or name or "one without an id")
        return others[0] if others else ""

    def _of_look(self, look: Look, prim, surface) -> Material:
        make = Principled(self.textures, self.context, surface, prim)
        names = list(dict.fromkeys(lookup.primvar for lookup in look.lookups()))
        if len(names) > 1:
            text = f"images of one material use the texture coordinates {names[0]} only"
            self.context.notes.add("texture coordinates", text, prim)
        primvar = names[0] if names else None
        return Material(make.bsdf(look), make.emission(look), primvar, look.lookups(), prim)

    def _of_colors(self, surface) -> Material:
        """Return a diffuse material with displayColor and displayOpacity, grey without."""
        key = ("", *_rates(surface))
        if key not in self._made:
            colors, opacity = key[1:]
            reflectance = {"type": "rgb", "value": GREY}
            if colors:
                reflectance = {"type": "mesh_attribute", "name": f"{colors}_color"}
            bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
            if opacity:
                mask = {"type": "mesh_attribute", "name": f"{opacity}_opacity"}
                bsdf = {"type": "mask", "opacity": mask, "bsdf": bsdf}
            self._made[key] = Material(bsdf)
        return self._made[key]


_PROBLEMS = {
    "": (
        "material without a surface",
        "meshes have a material without a surface and are grey: Blender writes none for a pure "
        "emission node, use its Principled BSDF with emission there",
    )
}
_OTHERS = "materials with the shader {} are grey, or have displayColor"


def with_own_lookups(look: Look) -> Look:
    """Return a look whose lookups may be changed."""
    parts = vars(look).items()
    return Look(**{k: replace(part) if isinstance(part, Lookup) else part for k, part in parts})


def surface_shaders(material) -> list:
    """Return names and shaders of all surface outputs: Mitsuba's own first, then the universal."""
    outputs = [o for o in material.GetOutputs() if str(o.GetFullName()).endswith(":surface")]
    order = {"outputs:mitsuba:surface": 0, "outputs:surface": 1, "outputs:mtlx:surface": 2}
    outputs = sorted(outputs, key=lambda output: order.get(str(output.GetFullName()), 3))
    found = []
    for output in outputs:
        attribute, computed = producer(output)
        if computed:
            found.append((output.GetFullName(), UsdShade.Shader(attribute.GetPrim())))
    return found


def _has_binding(prim) -> bool:
    """Is a prim, or one above it, bound to anything?"""
    while prim:
        if UsdShade.MaterialBindingAPI(prim).GetDirectBindingRel().GetTargets():
            return True
        prim = prim.GetParent()
    return False


def _is_for_full(relationship) -> bool:
    """Is a binding, direct or of a collection, for full renders only?"""
    parts = relationship.GetName().split(":")[2:] if relationship else []
    return parts[:1] == ["full"] or (parts[:2] == ["collection", "full"] and len(parts) > 2)


def _rates(surface) -> tuple[str, str]:
    """Return what a surface's colors and its opacity have a row for, empty if it has none."""
    if surface is None:
        return "", ""
    colors = "" if surface.colors is None else surface.colors_per
    opacity = surface.opacity
    if opacity is None or np.all(opacity == 1):
        return colors, ""
    return colors, surface.opacity_per

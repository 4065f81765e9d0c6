"""UsdPreviewSurface and OmniPBR as looks."""

from __future__ import annotations

import numpy as np

from manylights.usd.principled import Look
from manylights.usd.shading import (
    Attribute,
    Lookup,
    constant,
    constant_like,
    evaluate,
    evaluate_like,
)


def preview_surface(shader, context) -> Look:
    """Read a UsdPreviewSurface."""

    def any_of(name, fallback):
        return evaluate_like(shader, name, context, fallback)

    def number(name, fallback):
        found = any_of(name, fallback)
        if isinstance(found, (Lookup, Attribute)):
            text = f"images on the input {name} are not used"
            context.notes.add("textured input", text, shader)
            return fallback
        return found

    look = Look(
        base_color=any_of("diffuseColor", (0.18, 0.18, 0.18)),
        metallic=any_of("metallic", 0.0),
        roughness=any_of("roughness", 0.5),
        ior=number("ior", 1.5),
        clearcoat=any_of("clearcoat", 0.0),
        clearcoat_roughness=number("clearcoatRoughness", 0.01),
        opacity=any_of("opacity", 1.0),
        threshold=number("opacityThreshold", 0.0),
        presence=constant(shader, "opacityMode", context, "transparent") == "presence",
        emission=any_of("emissiveColor", (0.0, 0.0, 0.0)),
        normal=evaluate(shader.GetInput("normal"), context),
    )
    if number("useSpecularWorkflow", 0) == 1:
        look.specular_color = number("specularColor", (0.0, 0.0, 0.0))
        look.metallic = 0.0
        text = "the specular workflow is approximated: grey highlights"
        context.notes.add("specular workflow", text, shader)
    for name in ("displacement", "occlusion"):
        plain = {"displacement": 0.0, "occlusion": 1.0}[name]
        if shader.GetInput(name) and any_of(name, plain) != plain:
            context.notes.add(name, f"the input {name} is not used", shader)
    return look


def omni_pbr(shader, context) -> Look:
    """Read the constants and the color image of an OmniPBR material."""

    def value(name, fallback):
        return constant_like(shader, name, context, fallback)

    tint = value("diffuse_tint", (1, 1, 1))
    color = np.array(value("diffuse_color_constant", (0.2, 0.2, 0.2))) * tint
    look = Look(
        base_color=tuple(color),
        metallic=value("metallic_constant", 0.0),
        roughness=value("reflection_roughness_constant", 0.5),
    )
    image = shader.GetInput("diffuse_texture")
    if image and getattr(context.value(image.GetAttr()), "path", ""):
        look.base_color = Lookup(image, shader, wrap=("repeat", "repeat"))
        look.base_color.scale[:3] = tint
    if constant(shader, "enable_emission", context, False):
        look.emission = value("emissive_color", (1.0, 0.1, 0.1))
        look.emission_weight = value("emissive_intensity", 40.0)
    if constant(shader, "enable_opacity", context, False):
        look.opacity, look.presence = value("opacity_constant", 1.0), True
    return look

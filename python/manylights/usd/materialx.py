"""MaterialX nodes in USD: images and constants, standard_surface and open_pbr_surface.

Only what a picture of many lights needs: base color, metalness, roughness, coat, emission, opacity.
"""

from __future__ import annotations

import numpy as np
from pxr import UsdShade

from manylights.usd.principled import Look
from manylights.usd.shading import (
    Attribute,
    Lookup,
    constant,
    constant_like,
    evaluate,
    evaluate_like,
    like,
    texture_coordinate,
)

WRAPS = {"periodic": "repeat", "constant": "black"}
CHANNELS = {
    "outr": "r",
    "outg": "g",
    "outb": "b",
    "outa": "a",
    "r": "r",
    "g": "g",
    "b": "b",
    "a": "a",
}


def evaluate_node(shader, output, context, depth: int):
    """Return what a MaterialX node computes, as ``shading.evaluate`` does."""
    name = shader.GetShaderId()[len("ND_") :]
    if name.startswith(("image_", "tiledimage_", "gltf_image_", "gltf_colorimage")):
        return _image(shader, name, context)
    if name.startswith("constant_"):
        return constant(shader, "value", context)
    if name.startswith("geompropvalue_"):
        geomprop = constant(shader, "geomprop", context)
        return Attribute(str(geomprop or ""), constant(shader, "default", context))
    channel = CHANNELS.get(UsdShade.Utils.GetBaseNameAndType(output.GetName())[0])
    if name.startswith("extract_"):
        channel = "rgba"[int(np.clip(constant_like(shader, "index", context, 0), 0, 3))]
    elif name.startswith("swizzle_"):
        letters = str(constant(shader, "channels", context, ""))
        channel = letters if letters in ("r", "g", "b", "a") else None
    elif not name.startswith(("separate", "convert_", "normalmap", "dot_", "multiply_", "clamp_")):
        context.notes.add("node", f"nodes like ND_{name} are not followed", shader)
        return _default(shader, context)
    found = evaluate(_first(shader, ("in", "in1")), context, depth + 1)
    if name.startswith("multiply_"):
        return _scaled(found, evaluate(shader.GetInput("in2"), context, depth + 1), shader, context)
    if name.startswith("normalmap") and isinstance(found, Lookup):
        found.scale, found.bias = np.full(4, 2.0), np.full(4, -1.0)
    if channel is None:
        return found
    if isinstance(found, Lookup):
        found.channel = channel
    elif np.size(found) > 1:
        found = found[min("rgba".index(channel), np.size(found) - 1)]
    return found


def _first(shader, names):
    return next((shader.GetInput(name) for name in names if shader.GetInput(name)), None)


def _default(shader, context):
    """Return a value that the node itself has, rather than nothing."""
    shader_input = _first(shader, ("default", "value"))
    return None if shader_input is None else context.value(shader_input.GetAttr())


def _scaled(found, factor, shader, context):
    """Return a product of which one side is constant."""
    if isinstance(factor, (Lookup, Attribute)):
        found, factor = factor, found
    if factor is None or found is None:
        return found
    if isinstance(factor, (Lookup, Attribute)):
        context.notes.add("node", "products of two images are the first of them", shader)
        return found
    if isinstance(found, Attribute):
        return found
    three = np.array(like(factor, (1.0, 1.0, 1.0), shader, context))
    if isinstance(found, Lookup):
        four = np.append(three, three.mean())
        found.scale, found.bias = found.scale * four, found.bias * four
        return found
    return tuple(np.array(like(found, (1.0, 1.0, 1.0), shader, context)) * three)


def _image(shader, name: str, context) -> Lookup:
    number = name.endswith("_float")
    lookup = Lookup(shader.GetInput("file"), shader, "r" if number else "rgb")
    default = constant(shader, "default", context)
    if default is not None:
        lookup.fallback = np.array([*like(default, (0.0, 0.0, 0.0), shader, context), 1.0])
    modes = [constant(shader, f"{axis}addressmode", context, "periodic") for axis in "uv"]
    lookup.wrap = tuple(WRAPS.get(mode, str(mode)) for mode in modes)
    lookup.primvar, lookup.to_uv = texture_coordinate(shader.GetInput("texcoord"), context)
    if name.startswith("tiledimage_"):
        tiling = constant_like(shader, "uvtiling", context, (1, 1))
        offset = constant_like(shader, "uvoffset", context, (0, 0))
        tiles = np.array([[tiling[0], 0, -offset[0]], [0, tiling[1], -offset[1]], [0, 0, 1]])
        lookup.to_uv = tiles @ lookup.to_uv
    return lookup


class _Inputs:
    """Reads the inputs of one surface node."""

    def __init__(self, shader, context) -> None:
        self.shader, self.context = shader, context

    def any(self, name: str, fallback):
        """Return what feeds an input."""
        return evaluate_like(self.shader, name, self.context, fallback)

    def number(self, name: str, fallback: float) -> float:
        """Return a number; an image in its place is noted."""
        found = self.any(name, fallback)
        if isinstance(found, (Lookup, Attribute)):
            text = f"images on inputs like {name} are not used"
            self.context.notes.add("textured input", text, self.shader)
            return fallback
        return found

    def ior(self, name: str, weight: str) -> float:
        """Return the index of refraction whose reflectance is that of ``name`` times a weight."""
        index = self.number(name, 1.5)
        factor = max(self.number(weight, 1.0), 0.0)
        if factor == 1.0:
            return index
        root = min(abs(index - 1) / (index + 1) * np.sqrt(factor), 0.99)
        return float((1 + root) / (1 - root))


def standard_surface(shader, context) -> Look:
    """Read an ND_standard_surface_surfaceshader."""
    inputs = _Inputs(shader, context)
    look = Look(
        base_color=inputs.any("base_color", (0.8, 0.8, 0.8)),
        base_weight=inputs.number("base", 1.0),
        metallic=inputs.any("metalness", 0.0),
        roughness=inputs.any("specular_roughness", 0.2),
        ior=inputs.ior("specular_IOR", "specular"),
        clearcoat=inputs.any("coat", 0.0),
        clearcoat_roughness=inputs.any("coat_roughness", 0.1),
        opacity=inputs.any("opacity", 1.0),
        presence=True,
        emission=inputs.any("emission_color", (1.0, 1.0, 1.0)),
        emission_weight=inputs.number("emission", 0.0),
        normal=evaluate(shader.GetInput("normal"), context),
    )
    _note_rest(inputs, ("transmission", "subsurface", "sheen", "thin_film_thickness"))
    _note_rest(inputs, ("specular_color", "coat_color"), plain=1.0)
    return look


def open_pbr(shader, context) -> Look:
    """Read an ND_open_pbr_surface_surfaceshader; its emission is in nits."""
    inputs = _Inputs(shader, context)
    look = Look(
        base_color=inputs.any("base_color", (0.8, 0.8, 0.8)),
        base_weight=inputs.number("base_weight", 1.0),
        metallic=inputs.any("base_metalness", 0.0),
        roughness=inputs.any("specular_roughness", 0.3),
        ior=inputs.ior("specular_ior", "specular_weight"),
        clearcoat=inputs.any("coat_weight", 0.0),
        clearcoat_roughness=inputs.any("coat_roughness", 0.0),
        opacity=inputs.any("geometry_opacity", 1.0),
        presence=True,
        emission=inputs.any("emission_color", (1.0, 1.0, 1.0)),
        emission_weight=inputs.number("emission_luminance", 0.0),
        normal=evaluate(shader.GetInput("geometry_normal"), context),
    )
    _note_rest(inputs, ("transmission_weight", "subsurface_weight", "fuzz_weight"))
    _note_rest(inputs, ("specular_color", "coat_color"), plain=1.0)
    return look


def surface_unlit(shader, context) -> Look:
    """Read an ND_surface_unlit: emission alone."""
    inputs = _Inputs(shader, context)
    return Look(
        base_color=(0.0, 0.0, 0.0),
        specular_color=(0.0, 0.0, 0.0),
        opacity=inputs.any("opacity", 1.0),
        presence=True,
        emission=inputs.any("emission_color", (1.0, 1.0, 1.0)),
        emission_weight=inputs.number("emission", 1.0),
    )


def _note_rest(inputs: _Inputs, names, plain: float = 0.0) -> None:
    """Note inputs that are not used and have another value than the one that changes nothing."""
    for name in names:
        value = inputs.any(name, (plain,) * 3 if plain else plain)
        if isinstance(value, (Lookup, Attribute)) or np.any(np.asarray(value) != plain):
            text = f"the input {name} of surfaces is not used"
            inputs.context.notes.add(f"input {name}", text, inputs.shader)

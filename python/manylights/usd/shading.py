"""Shading networks: what feeds an input, as a value, a lookup into an image or a primvar."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pxr import Sdf, UsdShade

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

DEEPEST = 32
"""Nodes in a row; networks may have circles."""


@dataclass
class Lookup:
    """A lookup into an image.

    Attributes:
        file: attribute with the asset path.
        node: the shader.
        channel: ``"r"``, ``"g"``, ``"b"``, ``"a"`` or ``"rgb"``.
        scale: four factors.
        bias: four numbers that are added.
        fallback: four numbers, where the image cannot be read.
        wrap: of both directions: ``"repeat"``, ``"mirror"``, ``"clamp"``, ``"black"`` or
            ``"useMetadata"``.
        to_uv: ``(3, 3)``, from the mesh's texture coordinates to the image's; v points up.
        primvar: name of the texture coordinates, ``None`` for the mesh's own.
        color_space: as authored; empty for automatic.
        threshold: above 0, values become 1 where they reach it, else 0.
    """

    file: Any
    node: Any
    channel: str = "rgb"
    scale: np.ndarray = field(default_factory=lambda: np.ones(4))
    bias: np.ndarray = field(default_factory=lambda: np.zeros(4))
    fallback: np.ndarray = field(default_factory=lambda: np.array([0.0, 0, 0, 1]))
    wrap: tuple[str, str] = ("useMetadata", "useMetadata")
    to_uv: np.ndarray = field(default_factory=lambda: np.eye(3))
    primvar: str | None = None
    color_space: str = ""
    threshold: float = 0.0

    def of_channel(self, four):
        """Return what ``channel`` takes of four numbers: one of them, or three."""
        if self.channel == "rgb":
            return tuple(float(value) for value in four[:3])
        return float(four["rgba".index(self.channel)])


@dataclass
class Attribute:
    """The value of a primvar.

    Attributes:
        primvar: its name.
        fallback: where the mesh has none.
    """

    primvar: str
    fallback: Any


def shader_id(shader) -> str:
    """Return the id of a shader; for one in a file, its sub-identifier."""
    name = shader.GetShaderId() or ""
    if name:
        return name
    for kind in shader.GetSourceTypes():
        return (
            f"{kind}:{shader.GetSourceAssetSubIdentifier(kind) or shader.GetSourceAsset(kind).path}"
        )
    authored = shader.GetIdAttr().Get()
    return authored if isinstance(authored, str) else ""


def producer(connectable):
    """Return what an input or output gets its value from: an attribute, and whether it computes.

    Follows connections through node graphs and interfaces. ``(None, False)`` if there is nothing.
    """
    found = UsdShade.Utils.GetValueProducingAttributes(connectable)
    for attribute in found:
        kind = UsdShade.Utils.GetType(attribute.GetName())
        return attribute, kind == UsdShade.AttributeType.Output
    return None, False


def constant(shader, name: str, context, fallback=None):
    """Return the value of an input, also one that is connected to another's value."""
    shader_input = shader.GetInput(name)
    if not shader_input:
        return fallback
    attribute, computed = producer(shader_input)
    if attribute is None or computed:
        return context.value(shader_input.GetAttr(), fallback)
    return context.value(attribute, fallback)


def like(value, fallback, prim, context):
    """Return a value as a number, or as many as the fallback has; the fallback if it is none.

    Three numbers become one by their luminance, one becomes several.
    """
    size = np.size(fallback)
    try:
        array = np.atleast_1d(np.array(value, dtype=np.float64))
        if size == 1 and array.shape in ((3,), (4,)):
            array = array[:3] @ LUMINANCE
        array = np.broadcast_to(array if array.size == 1 else array[:size], size)
        if not np.isfinite(array).all():
            raise ValueError("not finite")
    except (TypeError, ValueError):
        shown = " ".join(str(value).split())[:60]
        text = f"an input of a shader has the value {shown}: its fallback is used"
        context.notes.add("shader input", text, prim)
        return fallback
    return tuple(array.tolist()) if np.ndim(fallback) else float(array.item())


def constant_like(shader, name: str, context, fallback):
    """Return the value of an input, ``like`` its fallback."""
    value = constant(shader, name, context)
    return fallback if value is None else like(value, fallback, shader, context)


def evaluate_like(shader, name: str, context, fallback):
    """Return what feeds an input, a value ``like`` the fallback; the fallback if nothing does."""
    found = evaluate(shader.GetInput(name), context)
    if found is None or isinstance(found, (Lookup, Attribute)):
        return fallback if found is None else found
    return like(found, fallback, shader, context)


def evaluate(shader_input, context, depth: int = 0):
    """Return what feeds an input: a value, a ``Lookup``, an ``Attribute``, or ``None``."""
    if not shader_input:
        return None
    attribute, computed = producer(shader_input)
    if attribute is None:
        return context.value(shader_input.GetAttr())
    if not computed:
        return context.value(attribute)
    found = evaluate_node(UsdShade.Shader(attribute.GetPrim()), attribute, context, depth)
    return context.value(shader_input.GetAttr()) if found is None else found


def evaluate_node(shader, output, context, depth: int):
    """Return what a node computes, as far as it is an image, a constant or a primvar."""
    from manylights.usd import materialx

    name = shader_id(shader)
    if name == "UsdUVTexture" or name.startswith("ND_UsdUVTexture"):
        return _uv_texture(shader, UsdShade.Utils.GetBaseNameAndType(output.GetName())[0], context)
    if name.startswith(("UsdPrimvarReader_", "ND_UsdPrimvarReader_")):
        varname = constant(shader, "varname", context)
        return Attribute(str(varname or ""), constant(shader, "fallback", context))
    if name.startswith("ND_") and depth < DEEPEST:
        return materialx.evaluate_node(shader, output, context, depth)
    context.notes.add("node", f"nodes like {name or 'one without an id'} are not followed", shader)
    return None


def _uv_texture(shader, channel: str, context) -> Lookup:
    lookup = Lookup(shader.GetInput("file"), shader, channel if channel in "rgba" else "rgb")
    for name in ("scale", "bias", "fallback"):
        value = constant_like(shader, name, context, tuple(getattr(lookup, name)))
        setattr(lookup, name, np.array(value))
    wraps = [constant(shader, name, context, "useMetadata") for name in ("wrapS", "wrapT")]
    lookup.wrap = tuple(str(wrap) for wrap in wraps)
    space = constant(shader, "sourceColorSpace", context, "auto")
    lookup.color_space = "" if space == "auto" else str(space)
    lookup.primvar, lookup.to_uv = texture_coordinate(shader.GetInput("st"), context)
    return lookup


def file_path(lookup: Lookup, context):
    """Return the path of an image as authored and resolved, and the layer that says so.

    The color space of the attribute's metadata, where there is one, becomes the lookup's.
    """
    attribute, computed = producer(lookup.file) if lookup.file else (None, False)
    asset = None if attribute is None or computed else context.value(attribute)
    if not isinstance(asset, Sdf.AssetPath):
        return None, None, None
    if attribute.GetColorSpace():
        lookup.color_space = str(attribute.GetColorSpace())
    stack = attribute.GetPropertyStack(context.time)
    return asset.path, asset.resolvedPath, stack[0].layer if stack else None


def texture_coordinate(shader_input, context) -> tuple[str | None, np.ndarray]:
    """Return the primvar of texture coordinates, and the matrix that is applied to them."""
    matrix = np.eye(3)
    for _ in range(DEEPEST):
        attribute, computed = producer(shader_input) if shader_input else (None, False)
        if not computed:
            return None, matrix
        shader = UsdShade.Shader(attribute.GetPrim())
        name = shader_id(shader)
        if name in ("UsdTransform2d", "ND_UsdTransform2d"):
            matrix = matrix @ transform_2d(shader, context)
            shader_input = shader.GetInput("in")
        elif name.startswith("ND_place2d"):
            matrix = matrix @ _place_2d(shader, context)
            shader_input = shader.GetInput("texcoord")
        elif "PrimvarReader" in name:
            return constant(shader, "varname", context) or None, matrix
        elif name.startswith("ND_geompropvalue"):
            return constant(shader, "geomprop", context) or None, matrix
        elif name.startswith("ND_texcoord"):
            return None, matrix
        else:
            context.notes.add("node", f"nodes like {name} are not followed", shader)
            return None, matrix
    return None, matrix


def transform_2d(shader, context) -> np.ndarray:
    """Return the matrix of a UsdTransform2d: scale, then rotation (degrees), then translation."""
    scale = constant_like(shader, "scale", context, (1, 1))
    angle = np.radians(constant_like(shader, "rotation", context, 0.0))
    shift = constant_like(shader, "translation", context, (0, 0))
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, shift[0]], [sin, cos, shift[1]], [0, 0, 1]])
    return turn @ np.diag([scale[0], scale[1], 1.0])


def _place_2d(shader, context) -> np.ndarray:
    """Return the matrix of MaterialX's place2d, which divides by its scale, about a pivot."""
    scale = np.array(constant_like(shader, "scale", context, (1, 1)))
    angle = np.radians(constant_like(shader, "rotate", context, 0.0))
    offset = np.array(constant_like(shader, "offset", context, (0, 0)))
    pivot = np.array(constant_like(shader, "pivot", context, (0, 0)))
    cos, sin = np.cos(-angle), np.sin(-angle)

    def moved(by):
        return np.array([[1, 0, by[0]], [0, 1, by[1]], [0, 0, 1]])

    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return (
        moved(pivot - offset)
        @ turn
        @ np.diag([*(1 / np.where(scale == 0, 1, scale)), 1.0])
        @ moved(-pivot)
    )

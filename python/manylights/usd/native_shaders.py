"""Mitsuba's own BSDFs and textures in a stage: shaders ``mitsuba_<plugin>``, as for hdMitsuba."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from pxr import Gf, Sdf, UsdShade

from manylights.usd.shading import DEEPEST, Lookup, evaluate, producer, shader_id

PREFIX = "mitsuba_"


def native(shader, context, textures, depth: int = 0) -> dict:
    """Return a shader as Mitsuba's dictionary, with those that it is connected to."""
    result = {"type": shader_id(shader)[len(PREFIX) :]}
    for shader_input in shader.GetInputs():
        name = shader_input.GetBaseName()
        attribute, computed = producer(shader_input)
        if computed and depth < DEEPEST:
            source = UsdShade.Shader(attribute.GetPrim())
            value = _connected(source, shader_input, name, context, textures, depth)
        else:
            value = context.value(attribute if attribute else shader_input.GetAttr())
        if value is not None:
            result[name] = _converted(value, shader_input.GetTypeName())
    return result


def _connected(source, shader_input, name: str, context, textures, depth: int):
    if shader_id(source).startswith(PREFIX):
        return native(source, context, textures, depth + 1)
    found = evaluate(shader_input, context)
    if isinstance(found, Lookup):
        data = "color" not in name and "reflectance" not in name and "radiance" not in name
        role = "normal" if name == "normalmap" else "data" if data else "color"
        return textures.make(found, role)
    return found


def _converted(value, kind):
    """Return a value of USD as ``mi.load_dict`` takes it."""
    if isinstance(value, Sdf.AssetPath):
        return value.resolvedPath or value.path
    if isinstance(value, (Gf.Matrix3d, Gf.Matrix4d)):
        matrix = np.array(value).T
        return mi.ScalarTransform3f(matrix) if len(matrix) == 3 else mi.ScalarTransform4f(matrix)
    if isinstance(value, (Gf.Vec3f, Gf.Vec3d, Gf.Vec3h)):
        color = kind.role == Sdf.ValueRoleNames.Color
        three = [float(part) for part in value]
        return {"type": "rgb", "value": three} if color else three
    if isinstance(value, tuple):
        return {"type": "rgb", "value": [float(part) for part in value]}
    return value

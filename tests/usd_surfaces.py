"""Stages from text and what is measured on their surfaces, for the tests of the USD reader."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
from manylights.usd.context import Context
from manylights.usd.copies import copies
from manylights.usd.geometry import surfaces_of
from manylights.usd.materials import Materials
from manylights.usd.mitsuba_meshes import checked_uv
from pxr import Usd

_numbers = itertools.count()

SQUARE = """
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
"""
"""The topology of a square of side 2 that faces +Z."""


def stage_of(text, folder=None):
    """Return a stage of the text of a .usda file; with a folder, saved there."""
    if folder is None:
        stage = Usd.Stage.CreateInMemory()
        stage.GetRootLayer().ImportFromString("#usda 1.0\n" + text)
        return stage
    # OpenUSD keeps layers by their path while a stage uses them
    path = folder / f"stage{next(_numbers)}.usda"
    path.write_text("#usda 1.0\n" + text)
    return Usd.Stage.Open(str(path))


def context_of(stage, time=None, **choices):
    """Return how a stage is read; without a time at the default one."""
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    return Context(stage, code, **choices)


def read(text, path="/a", **choices):
    """Return the surfaces of one prim, and the notes."""
    stage = stage_of(text)
    context = context_of(stage, **choices)
    return surfaces_of(stage.GetPrimAtPath(path), context), context.notes


def mesh(body, attributes=""):
    """Return the text of a mesh at /a."""
    return (
        f'def Mesh "a" (\n{attributes}\n) {{\n{body}\n}}\n'
        if attributes
        else (f'def Mesh "a" {{\n{body}\n}}\n')
    )


def only(text, **choices):
    """Return the one surface of /a, of which nothing has to be noted."""
    surfaces, notes = read(text, **choices)
    assert not notes, [note.text for note in notes]
    assert len(surfaces) == 1
    return surfaces[0]


def corners(surface):
    """Return the corners of all triangles, ``(m, 3, 3)``."""
    return surface.positions[surface.faces].astype(np.float64)


def area_vectors(surface):
    """Return the area of each triangle times its normal, ``(m, 3)``."""
    p = corners(surface)
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) / 2


def area(surface):
    """Return the area of a surface."""
    return np.linalg.norm(area_vectors(surface), axis=1).sum()


def volume(surface):
    """Return the volume inside of a closed surface whose outside is its front."""
    return np.einsum("mi,mi->", corners(surface)[:, 0], area_vectors(surface)) / 3


def kinds(notes):
    """Return the kinds of all notes."""
    return [note.kind for note in notes]


def material_on(surface, materials):
    """Return what Mitsuba makes of the material that a surface is bound to."""
    return materials.make(materials.bound(surface.binding), surface)


def mesh_of(surface, material, context, matrix, name, emission=None):
    """Return a surface as Mitsuba's mesh, in the world that the columns of a matrix lead to."""
    surface.uv = checked_uv(surface, material, context)
    shape = copies(surface, material.bsdf, np.asarray(matrix).T[None])
    shape.radiance = emission
    return shape.instantiate(name, {})


def meshes_of(stage, time=None, emission=False, **choices):
    """Return Mitsuba's meshes of a whole stage as entries of a scene, and the notes."""
    context = context_of(stage, time, **choices)
    materials, result = Materials(context), {}
    for prim in stage.Traverse():
        for surface in surfaces_of(prim, context):
            material = material_on(surface, materials)
            matrix = np.array(context.transforms.GetLocalToWorldTransform(prim)).T
            name = f"mesh{len(result)}"
            light = material.emission if emission else None
            result[name] = mesh_of(surface, material, context, matrix, name, light)
    return result, context.notes


def picture(stage, size=16, from_z=1, light=1.0, lights=None, entries=None, **choices):
    """Render the square from -1 to 1 in x and y, seen along z, under a constant sky.

    Args:
        stage: what is in it.
        size: pixels each way.
        from_z: 1 to look from above, -1 from below (x then runs to the left).
        light: radiance of the sky.
        lights: more entries of the scene. Default: none.
        entries: more shapes. Default: none.
        choices: of ``meshes_of``.

    Returns:
        ``(size, size, 3)``, y upwards from the last row.
    """
    shapes, _ = meshes_of(stage, **choices)
    turn = mi.ScalarTransform4f().look_at(origin=[0, 0, 5 * from_z], target=[0, 0, 0], up=[0, 1, 0])
    scene = {
        "type": "scene",
        # Without lamps directions of the BSDF alone, which are exact for a diffuse one
        "integrator": {"type": "direct", "emitter_samples": int(lights is not None)},
        "sensor": {
            "type": "orthographic",
            "to_world": turn,
            "film": {
                **{"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                **{"pixel_format": "rgb", "component_format": "float32"},
            },
            "sampler": {"type": "independent", "sample_count": 64},
        },
        **shapes,
        **(lights or {}),
        **(entries or {}),
    }
    if light:
        scene["sky"] = {"type": "constant", "radiance": light}
    return np.array(mi.render(mi.load_dict(scene), seed=1))

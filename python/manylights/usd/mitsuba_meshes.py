"""Surfaces as Mitsuba's meshes."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from manylights.usd.surface import Surface
from manylights.usd.textures import mitsuba_wrap, to_mitsuba_uv
from manylights.usd.vectors import area_vectors, cross, unit


def in_world(surface: Surface, matrix: np.ndarray) -> Surface:
    """Return a surface moved by a matrix.

    Its outside stays its outside: where the matrix mirrors, triangles are turned around.

    Args:
        surface: in the space of its prim.
        matrix: ``(4, 4)`` in column form (the transpose of a ``Gf.Matrix4d``).
    """
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    positions = surface.positions @ linear.T + np.asarray(matrix, dtype=np.float64)[:3, 3]
    normals, faces = surface.normals, surface.faces
    if np.linalg.det(linear) < 0:
        faces = np.ascontiguousarray(faces[:, [0, 2, 1]])
    if normals is not None:
        normals = unit(normals @ cofactors(linear).T).astype(np.float32)
    return replace(surface, positions=positions.astype(np.float32), faces=faces, normals=normals)


def cofactors(linear: np.ndarray) -> np.ndarray:
    """Return the matrix for normals: the inverse transpose but for a positive factor.

    A singular matrix has one, too.
    """
    columns = linear.T
    matrix = cross(columns[[1, 2, 0]], columns[[2, 0, 1]]).T
    return -matrix if np.linalg.det(linear) < 0 else matrix


def join(surfaces: list[Surface], material) -> Surface:
    """Return several surfaces of one material as one; ``kind_of`` is the same for all of them."""
    if len(surfaces) == 1:
        return surfaces[0]
    sizes = [len(surface.positions) for surface in surfaces]
    begins = np.cumsum([0, *sizes[:-1]]).astype(np.uint32)

    def rows(name):
        if getattr(surfaces[0], name) is None:
            return None
        return np.concatenate([getattr(surface, name) for surface in surfaces])

    uv = [chosen_uv(surface, material) for surface in surfaces]
    uv = None if uv[0] is None else np.concatenate(uv)
    named = all(material.uv_primvar in surface.uv_sets for surface in surfaces)
    return replace(
        surfaces[0],
        faces=np.concatenate([s.faces + begin for s, begin in zip(surfaces, begins)]),
        uv=uv,
        uv_sets={material.uv_primvar: uv} if named else {},
        **{name: rows(name) for name in ("positions", "normals", "colors", "opacity")},
        face_of=None,
    )


def kind_of(surface: Surface, material) -> tuple:
    """Return what surfaces have in common that ``join`` may make one of."""
    colors, opacity = surface.colors, surface.opacity
    return (
        id(material),
        surface.normals is None,
        chosen_uv(surface, material) is None,
        None if colors is None else surface.colors_per,
        None if opacity is None else surface.opacity_per,
    )


def chosen_uv(surface: Surface, material) -> np.ndarray | None:
    """Return the texture coordinates that a material uses, ``None`` if it has no images."""
    if not material.lookups:
        return surface.uv
    return surface.uv_sets.get(material.uv_primvar, surface.uv)


def mesh_of(surface: Surface, material, context, matrix=None, name="mesh", emission=None):
    """Return a ``mi.Mesh`` of the current variant.

    Args:
        surface: in the space of its prim.
        material: of ``Materials.of``.
        context: of the stage, for notes on texture coordinates.
        matrix: local to world in column form. Default: the surface is in world space.
        name: id of the mesh.
        emission: radiance of an ``area`` emitter, for ``mi.load_dict``. Default: none.
    """
    if matrix is not None:
        surface = in_world(surface, matrix)
    uv = checked_uv(surface, material, context)
    props = mi.Properties()
    props["mesh_bsdf"] = material.bsdf_object()
    if emission is not None:
        props["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": emission})
    if surface.normals is None:
        props["face_normals"] = True
    mesh = mi.Mesh(
        name,
        len(surface.positions),
        len(surface.faces),
        props=props,
        has_vertex_normals=surface.normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = surface.faces.ravel()
    parameters["vertex_positions"] = surface.positions.ravel()
    if surface.normals is not None:
        parameters["vertex_normals"] = with_directions(surface).ravel()
    if uv is not None:
        parameters["vertex_texcoords"] = to_mitsuba_uv(uv).astype(np.float32).ravel()
    parameters.update()
    _add_colors(mesh, surface)
    mesh.set_id(name)
    return mesh


def _add_colors(mesh, surface: Surface) -> None:
    for rows, per, name in (
        (surface.colors, surface.colors_per, "color"),
        (surface.opacity, surface.opacity_per, "opacity"),
    ):
        if rows is not None:
            values = np.ascontiguousarray(rows, dtype=np.float32)
            mesh.add_attribute(f"{per}_{name}", values.shape[1], values.ravel())


def with_directions(surface: Surface) -> np.ndarray:
    """Return unit normals, that of a triangle in place of those that are zero."""
    normals = unit(surface.normals).astype(np.float32)
    missing = ~(np.abs(normals).sum(axis=1) > 0)
    if missing.any():
        flat = area_vectors(surface.positions, surface.faces)
        total = np.zeros((len(normals), 3))
        for corner in range(3):
            np.add.at(total, surface.faces[:, corner], flat)
        total[np.linalg.norm(total, axis=1) == 0] = [0, 0, 1]
        normals[missing] = unit(total)[missing]
    return normals


def checked_uv(surface: Surface, material, context):
    """Return the texture coordinates to use, with notes on missing ones and on wrapping."""
    uv = chosen_uv(surface, material)
    if not material.lookups:
        return uv
    if material.uv_primvar and material.uv_primvar not in surface.uv_sets:
        text = f"a mesh has no primvar {material.uv_primvar} for its images"
        text += ": its first texture coordinates are used" if uv is not None else ""
        context.notes.add("texture coordinates", text, surface.binding)
    if uv is None:
        if not material.uv_primvar:
            text = "a mesh has no texture coordinates for its images: their first pixel is used"
            context.notes.add("texture coordinates", text, surface.binding)
        return np.zeros((len(surface.positions), 2), dtype=np.float32)
    for lookup in material.lookups:
        places = uv @ lookup.to_uv[:2, :2].T + lookup.to_uv[:2, 2]
        outside = (places < -1e-4) | (places > 1 + 1e-4)
        odd = [name in ("useMetadata", "black") for name in lookup.wrap]
        odd[1] |= lookup.wrap[0] != lookup.wrap[1]
        if (outside.any(axis=0) & odd).any():
            text = "texture coordinates leave 0..1 where wrapS and wrapT are {} and {}: {} in both"
            text = text.format(*lookup.wrap, mitsuba_wrap(lookup.wrap))
            context.notes.add("wrap", text, lookup.node.GetPath())
    return uv

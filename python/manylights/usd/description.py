"""Meshes as arrays, until Mitsuba objects are made of a whole description at once."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from manylights.usd.vectors import cross


@dataclass
class MeshShape:
    """A mesh in the world, an entry of a description.

    Attributes:
        positions: ``(n, 3)`` float32.
        faces: ``(m, 3)`` uint32, counterclockwise seen from outside.
        normals: ``(n, 3)`` float32, ``None`` for flat shading.
        uv: ``(n, 2)`` float32 as Mitsuba has them, v downwards.
        attributes: arrays by name, ``vertex_...`` with n rows or ``face_...`` with m.
        bsdf: a dictionary for Mitsuba, ``None`` for none.
        radiance: a dictionary for Mitsuba of what the front side emits, ``None`` for nothing.
        light: what it is called if there are groups of lights, a path of a prim.
    """

    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    bsdf: dict | None = None
    radiance: dict | None = None
    light: str | None = None

    def instantiate(self, name: str, objects: dict) -> mi.Mesh:
        """Return the mesh as an object; ``objects`` keeps the parts that several meshes share."""
        props = mi.Properties()
        if self.bsdf is not None:
            props["bsdf"] = _object(self.bsdf, objects)
        if self.radiance is not None:
            props["emitter"] = mi.load_dict({"type": "area", "radiance": self.radiance})
        mesh = mi.Mesh(
            name,
            len(self.positions),
            len(self.faces),
            props=props,
            has_vertex_normals=self.normals is not None,
            has_vertex_texcoords=self.uv is not None,
        )
        for key, values in self.attributes.items():
            values = np.ascontiguousarray(values, dtype=np.float32)
            mesh.add_attribute(key, values.shape[1], np.ravel(values))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ravel(self.positions.astype(np.float32))
        parameters["faces"] = np.ravel(self.faces.astype(np.uint32))
        if self.normals is not None:
            parameters["vertex_normals"] = np.ravel(self.normals.astype(np.float32))
        if self.uv is not None:
            parameters["vertex_texcoords"] = np.ravel(self.uv.astype(np.float32))
        parameters.update()
        mesh.set_id(name)
        return mesh


def instantiate(description: dict) -> dict:
    """Return a description with Mitsuba objects in place of its meshes, also of those inside."""
    return _instantiate(description, "", {})


def _instantiate(part, path: str, objects: dict):
    if isinstance(part, MeshShape):
        return part.instantiate(path, objects)
    if not isinstance(part, dict):
        return part
    prefix = f"{path}_" if path else ""
    return {key: _instantiate(value, f"{prefix}{key}", objects) for key, value in part.items()}


def _object(description: dict, objects: dict):
    """Return the object of a dictionary, the same one each time."""
    if id(description) not in objects:
        # The dictionary is kept, so that no other gets its id
        objects[id(description)] = description, mi.load_dict(description)
    return objects[id(description)][1]


def transformed(positions: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Return copies of points, ``(k, 3)`` by ``(n, 4, 4)`` to ``(n, k, 3)``."""
    return positions @ matrices[:, :3, :3] + matrices[:, None, 3, :3]


def copied_faces(faces: np.ndarray, vertices: int, matrices: np.ndarray) -> np.ndarray:
    """Return the faces of copies of a mesh with so many vertices, ``(n, m, 3)``.

    The winding turns where a matrix mirrors, so that the outside stays outside.
    """
    copies = faces[None] + (vertices * np.arange(len(matrices)))[:, None, None]
    mirrored = np.linalg.det(matrices[:, :3, :3]) < 0
    copies[mirrored] = copies[mirrored][:, :, ::-1]
    return copies


def triangle_areas(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return areas, ``(..., k, 3)`` and ``(m, 3)`` to ``(..., m)``."""
    a, b, c = (positions[..., faces[:, corner], :] for corner in range(3))
    return 0.5 * np.linalg.norm(cross(b - a, c - a), axis=-1)

"""What the generators share: meshes from arrays, colours, powers, cameras.

Lengths are metres, the z axis points up, radiances are W m^-2 sr^-1 and intensities W sr^-1 for
each of the three channels of linear sRGB. Arrays of points and colours have the shape (n, 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from manylights.errors import is_real

WARM = (1.0, 0.68, 0.36)
COOL = (0.72, 0.86, 1.0)
WHITE = (1.0, 0.93, 0.82)
NEON = ((1.0, 0.08, 0.45), (0.1, 0.9, 1.0), (0.45, 1.0, 0.2), (1.0, 0.45, 0.05), (0.5, 0.2, 1.0))

#: Of a scene.
MOST_LIGHTS = 1_000_000


@dataclass
class Quads:
    """Parallelograms that emit to the side of cross(u, v): a corner, two edges, a radiance."""

    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    radiance: np.ndarray

    def __len__(self) -> int:
        return len(self.corner)

    @staticmethod
    def join(parts: list[Quads]) -> Quads:
        """Put several sets of quads into one, in the given order."""
        names = ("corner", "u", "v", "radiance")
        return Quads(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def first(self, count: int) -> Quads:
        """Return the first ``count`` quads."""
        return Quads(self.corner[:count], self.u[:count], self.v[:count], self.radiance[:count])

    def center(self) -> np.ndarray:
        """Return the centres, in metres."""
        return self.corner + 0.5 * (self.u + self.v)

    def scaled_normal(self) -> np.ndarray:
        """Return cross(u, v): its length is the area in square metres."""
        return np.cross(self.u, self.v)


def require_variant() -> None:
    """Raise RuntimeError if no variant is set: meshes are objects of one variant."""
    if mi.variant() is None:
        raise RuntimeError(
            "manylights.scenes makes meshes, which belong to a Mitsuba variant: "
            'call mitsuba.set_variant("llvm_ad_rgb") or another one first'
        )


def check_count(n_lights: int, least: int = 1) -> int:
    """Return ``n_lights``; raise ValueError unless it is an integer in ``least`` to 1,000,000."""
    check_integer("n_lights", n_lights, least, MOST_LIGHTS)
    return int(n_lights)


def check_integer(name: str, value, least: int, most: int | None = None) -> None:
    """Raise ValueError unless an argument is an integer in a range; 10.0 is one."""
    words = f"of at least {least}" if most is None else f"from {least} to {most:,}"
    limit = np.inf if most is None else most
    allowed = is_real(value) and least <= value <= limit and value < np.inf
    check(name, value, allowed and int(value) == value, f"an integer {words}")


def check(name: str, value, allowed: bool, what: str) -> None:
    """Raise ValueError with argument, value and what it must be, unless it is allowed."""
    if not allowed:
        raise ValueError(f"{name}={value!r}: must be {what}")


def random(seed: int) -> np.random.Generator:
    """Return a generator of random numbers; raise ValueError unless the seed is one."""
    check_integer("seed", seed, 0)
    return np.random.default_rng(int(seed))


def log_uniform(rng: np.random.Generator, count: int, median: float, decades: float) -> np.ndarray:
    """Return ``count`` numbers whose logarithms are uniform over ``decades`` around ``median``."""
    return median * 10.0 ** rng.uniform(-0.5 * decades, 0.5 * decades, count)


def pick(rng: np.random.Generator, colors, count: int) -> np.ndarray:
    """Return ``count`` of the given colours at random, shape (count, 3)."""
    return np.asarray(colors, dtype=float)[rng.integers(len(colors), size=count)]


def scene(
    integrator: str | Mapping, sensor: dict, parts: Mapping[str, object] | None = None
) -> dict:
    """Return the dictionary of a scene; ``integrator`` is a plugin's name or a dictionary."""
    known = isinstance(integrator, (str, Mapping))
    check("integrator", integrator, known, "the name of a plugin or a dictionary")
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    return {"type": "scene", "integrator": dict(integrator), "sensor": sensor, **(parts or {})}


def camera(
    origin, target, *, width: int, height: int, spp: int, fov: float = 50.0, up=(0, 0, 1)
) -> dict:
    """Return a perspective camera with a box filter; ``fov`` is the horizontal angle in degrees."""
    for name, value in (("width", width), ("height", height), ("spp", spp)):
        check_integer(name, value, 1)
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "fov": fov,
        "sampler": {"type": "independent", "sample_count": spp},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    }


def diffuse(color) -> dict:
    """Return a diffuse material; a number is a grey, three numbers are linear sRGB."""
    value = [float(color)] * 3 if np.isscalar(color) else [float(x) for x in color]
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def rgb(color) -> dict:
    """Return a colour or a power spectrum given in linear sRGB."""
    return {"type": "rgb", "value": [float(x) for x in color]}


def point(position, intensity) -> dict:
    """Return a point light; ``intensity`` in W sr^-1, three channels."""
    return {"type": "point", "position": [float(x) for x in position], "intensity": rgb(intensity)}


def spot(position, direction, intensity, cutoff: float = 60.0) -> dict:
    """Return a spot light; ``cutoff`` is the half angle in degrees, its inner 3/4 are bright."""
    direction = np.asarray(direction, dtype=float)
    up = [1, 0, 0] if abs(direction[0]) < 0.9 * np.linalg.norm(direction) else [0, 1, 0]
    target = np.asarray(position, dtype=float) + direction / np.linalg.norm(direction)
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(
            origin=[float(x) for x in position], target=[float(x) for x in target], up=up
        ),
        "intensity": rgb(intensity),
        "cutoff_angle": cutoff,
        "beam_width": 0.75 * cutoff,
    }


def rectangle(corner, u, v, *, bsdf: dict, radiance=None) -> dict:
    """Return the ``rectangle`` with a corner and two edges; it faces, and emits, along u x v."""
    corner, u, v = (np.asarray(x, dtype=float) for x in (corner, u, v))
    matrix = np.eye(4)
    normal = np.cross(u, v)
    columns = (0.5 * u, 0.5 * v, normal / np.linalg.norm(normal), corner + 0.5 * (u + v))
    for index, column in enumerate(columns):
        matrix[:3, index] = column
    shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), "bsdf": bsdf}
    if radiance is not None:
        shape["emitter"] = {"type": "area", "radiance": rgb(radiance)}
    return shape


def mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    bsdf: dict,
    face_color: np.ndarray | None = None,
    emitter: dict | None = None,
    uv: np.ndarray | None = None,
):
    """Make a ``mi.Mesh``.

    Args:
        name: shown in Mitsuba's messages.
        vertices: shape (v, 3), metres.
        faces: indices of vertices, shape (f, 3), counter-clockwise seen from outside.
        bsdf: the material; it may use the mesh attribute ``face_color``.
        face_color: shape (f, 3), a reflectance or a radiance. Default: none.
        emitter: the area light. Default: none.
        uv: texture coordinates, shape (v, 2). Default: none.
    """
    require_variant()
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    if emitter is not None:
        properties["emitter"] = mi.load_dict(emitter)
    result = mi.Mesh(
        name, len(vertices), len(faces), props=properties, has_vertex_texcoords=uv is not None
    )
    if face_color is not None:
        result.add_attribute("face_color", 3, np.ravel(face_color).astype(np.float32))
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    return result


def quad_arrays(quads: Quads) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (4 q, 3) and faces (2 q, 3) of quads; none share vertices."""
    corners = np.stack(
        [quads.corner, quads.corner + quads.u, quads.corner + quads.u + quads.v,
         quads.corner + quads.v],
        axis=1,
    )  # fmt: skip
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]])[None]
    return corners.reshape(-1, 3), faces.reshape(-1, 3)


def glowing_mesh(quads: Quads, triangles: int, *, name: str = "lights", texture: bool = False):
    """Make one emissive mesh of the first ``triangles`` triangles of ``quads``.

    Args:
        quads: at least half as many as triangles.
        triangles: number of lights; with an odd number the last quad is half.
        name: shown in Mitsuba's messages.
        texture: give each quad its radiance by a texel of a bitmap, which Mitsuba's own emitter
            sampling handles, instead of the attribute ``face_color``, which it does not (the
            contribution is lost, or scalar variants crash). Default: False.
    """
    vertices, faces = quad_arrays(quads)
    faces = faces[:triangles]
    black = diffuse(0.0)
    if not texture:
        # Spectral variants cut attributes off at 1, so the factor is kept apart.
        brightest = float(quads.radiance.max())
        radiance = {"type": "mesh_attribute", "name": "face_color", "scale": brightest}
        colors = np.repeat(quads.radiance / brightest, 2, axis=0)[:triangles]
        emitter = {"type": "area", "radiance": radiance}
        return mesh(name, vertices, faces, bsdf=black, face_color=colors, emitter=emitter)
    uv, bitmap = _texels(quads.radiance)
    radiance = {"type": "bitmap", "bitmap": bitmap, "raw": False, "filter_type": "nearest"}
    emitter = {"type": "area", "radiance": radiance}
    return mesh(name, vertices, faces, bsdf=black, emitter=emitter, uv=uv)


def _texels(radiance: np.ndarray):
    """Return texture coordinates (4 q, 2) that fill one texel a quad, and the bitmap."""
    side = int(np.ceil(np.sqrt(len(radiance))))
    index = np.arange(len(radiance))
    column, row = index % side, index // side
    pixels = np.zeros((side, side, 3), dtype=np.float32)
    pixels[row, column] = radiance
    offsets = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    uv = (np.stack([column, row], axis=1)[:, None] + offsets[None]) / side
    return uv.reshape(-1, 2), mi.Bitmap(pixels)


def box_arrays(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8 b, 3) and faces (12 b, 3) of boxes from corners, each of shape (b, 3)."""
    choice = np.array([[i & 1, (i >> 1) & 1, (i >> 2) & 1] for i in range(8)], dtype=bool)
    vertices = np.where(choice[None], high[:, None], low[:, None])
    sides = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    pattern = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in sides]).reshape(12, 3)
    faces = 8 * np.arange(len(low))[:, None, None] + pattern[None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def boxes(name: str, low: np.ndarray, high: np.ndarray, colors: np.ndarray):
    """Make one diffuse mesh of boxes, each of its own reflectance of shape (b, 3)."""
    vertices, faces = box_arrays(np.asarray(low, dtype=float), np.asarray(high, dtype=float))
    reflectance = {"type": "mesh_attribute", "name": "face_color"}
    material = {"type": "diffuse", "reflectance": reflectance}
    face_color = np.repeat(colors, 12, axis=0)
    return mesh(name, vertices, faces, bsdf=material, face_color=face_color)


def numbered(prefix: str, items: list) -> dict:
    """Return ``{"prefix_0": items[0], ...}``."""
    return {f"{prefix}_{index}": item for index, item in enumerate(items)}

"""Light on a patch, by quadrature in numpy over the lights that `scene_strategies` describes.

Nothing here calls Mitsuba: transformations, shapes with their texture coordinates, bitmaps, spots,
occlusion within a light and absorption in a box are written down again. Points are spread evenly
over the parameters of a surface, jittered in their cells, and weighted by the area of these, so
that any affine transformation is right by construction. Each seed gives an unbiased image.
"""

from __future__ import annotations

import numpy as np

from tests.described_scenes import (
    PATCH_FOV,
    PATCH_HEIGHT,
    PATCH_NEAR,
    PATCH_PIXELS,
    fog_bounds,
    mesh_arrays,
    texels,
)

# ------------------------------------------------------------------------------ transformations


def rotation(axis, degrees):
    """Rodrigues' formula."""
    x, y, z = np.array(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def affine(steps):
    """Matrix (3, 3) and offset (3,) of steps, the last of which is applied first."""
    matrix, offset = np.eye(3), np.zeros(3)
    for name, *values in steps:
        if name == "translate":
            offset = offset + matrix @ values[0]
        elif name == "rotate":
            matrix = matrix @ rotation(*values)
        elif name == "scale":
            matrix = matrix @ np.diag(values[0])
        else:
            shear = np.eye(3)
            shear[0, 1], shear[0, 2], shear[1, 2] = values[0]
            matrix = matrix @ shear
    return matrix, offset


def uv_affine(steps):
    """Matrix (2, 2) and offset (2,) of steps for texture coordinates."""
    matrix, offset = np.eye(2), np.zeros(2)
    for name, value in steps:
        if name == "translate":
            offset = offset + matrix @ value
        elif name == "rotate":
            c, s = np.cos(np.radians(value)), np.sin(np.radians(value))
            matrix = matrix @ [[c, -s], [s, c]]
        else:
            matrix = matrix @ np.diag(value)
    return matrix, offset


# ------------------------------------------------------------------------------------- textures


def wrapped(index, size, mode):
    """Indices of texels that are there, for any integers."""
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "repeat":
        return index % size
    index = index % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index)


def lookup(texture, uv):
    """Values (n, 3) of a texture at coordinates (n, 2), as they are on the surface."""
    matrix, offset = uv_affine(texture["to_uv"])
    uv = uv @ matrix.T + offset
    if texture["kind"] == "checkerboard":
        odd = (uv - np.floor(uv)) > 0.5
        first, second = np.array(texture["colours"])
        return np.where((odd[:, 0] == odd[:, 1])[:, np.newaxis], first, second)
    pixels = texels(texture).astype(float)
    height, width = pixels.shape[:2]
    position = uv * (width, height)
    if texture["filter"] == "nearest":
        index = np.floor(position).astype(int)
        x, y = (wrapped(index[:, i], n, texture["wrap"]) for i, n in enumerate((width, height)))
        return pixels[y, x]
    corner = np.floor(position - 0.5).astype(int)
    share = position - 0.5 - corner
    result = np.zeros((len(uv), 3))
    for step in np.ndindex(2, 2):
        x, y = (
            wrapped(corner[:, i] + step[i], n, texture["wrap"])
            for i, n in enumerate((width, height))
        )
        weight = np.where(step, share, 1 - share).prod(axis=1)
        result += weight[:, np.newaxis] * pixels[y, x]
    return result


# ------------------------------------------------------------------------------------- surfaces


def jittered(generator, side):
    """One random point (side^2, 2) in each cell of a grid on the unit square."""
    y, x = np.mgrid[0:side, 0:side]
    return (np.stack([x, y], axis=-1).reshape(-1, 2) + generator.random((side**2, 2))) / side


class Samples:
    """Points on one light: positions, outward areas, texture coordinates, colours.

    `areas` (n, 3) are normals times the area that a point stands for; `shading` (n, 3) are the
    normals that tell the side which emits.
    """

    def __init__(self, points, areas, uv, colours=None, shading=None):
        self.points, self.areas, self.uv, self.colours = points, areas, uv, colours
        self.shading = areas if shading is None else shading


def patch(points, along_u, along_v, uv):
    """Points of a surface given by its derivatives, in a frame; outwards is along_u x along_v."""
    return Samples(points, np.cross(along_u, along_v) / len(points), uv)


def rectangle(u, v):
    one, zero = np.ones_like(u), np.zeros_like(u)
    points = np.stack([2 * u - 1, 2 * v - 1, zero], -1)
    tangents = [np.stack([2 * one, zero, zero], -1), np.stack([zero, 2 * one, zero], -1)]
    return points, *tangents, np.stack([u, v], -1)


def disk(u, v):
    c, s, zero = np.cos(2 * np.pi * v), np.sin(2 * np.pi * v), np.zeros_like(u)
    points = np.stack([u * c, u * s, zero], -1)
    around = 2 * np.pi * u[:, np.newaxis] * np.stack([-s, c, zero], -1)
    return points, np.stack([c, s, zero], -1), around, np.stack([u, v], -1)


def cylinder(u, v):
    c, s, zero = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), np.zeros_like(u)
    around = 2 * np.pi * np.stack([-s, c, zero], -1)
    up = np.stack([zero, zero, zero + 1], -1)
    return np.stack([c, s, v], -1), around, up, np.stack([u, v], -1)


def sphere(u, v):
    c, s = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
    below, beside = np.cos(np.pi * v), np.sin(np.pi * v)
    points = np.stack([beside * c, beside * s, below], -1)
    around = 2 * np.pi * np.stack([-beside * s, beside * c, 0 * u], -1)
    down = np.pi * np.stack([below * c, below * s, -beside], -1)
    return points, down, around, np.stack([u, v], -1)


QUADRICS = {"rectangle": rectangle, "disk": disk, "cylinder": cylinder, "sphere": sphere}


def cube_faces():
    """The six faces: the corner of (0, 0) and the edges along u and v, in the plugin's order."""
    corners = [
        [(1, -1, -1), (1, -1, 1), (-1, -1, 1), (-1, -1, -1)],
        [(1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, 1, 1)],
        [(1, -1, -1), (1, 1, -1), (1, 1, 1), (1, -1, 1)],
        [(1, -1, 1), (1, 1, 1), (-1, 1, 1), (-1, -1, 1)],
        [(-1, -1, 1), (-1, 1, 1), (-1, 1, -1), (-1, -1, -1)],
        [(1, 1, -1), (1, -1, -1), (-1, -1, -1), (-1, 1, -1)],
    ]
    for first, second, third, fourth in np.array(corners, float):
        # Their texture coordinates are (0, 1), (1, 1), (1, 0) and (0, 0)
        yield fourth, third - fourth, first - fourth, (second + fourth) / 2


def cube(generator, side):
    """Samples of all faces."""
    parts = []
    for origin, along_u, along_v, middle in cube_faces():
        uv = jittered(generator, side)
        points = origin + uv[:, :1] * along_u + uv[:, 1:] * along_v
        sign = np.sign(np.cross(along_u, along_v) @ middle)
        area = sign * np.cross(along_u, along_v) / len(uv)
        parts.append(Samples(points, np.broadcast_to(area, points.shape), uv))
    joined = [np.concatenate([getattr(p, n) for p in parts]) for n in ("points", "areas", "uv")]
    return Samples(*joined)


def triangles(light, generator, side):
    """Samples of a mesh."""
    corners, uv, normals, colours = mesh_arrays(light)
    parts = []
    for index, (a, b, c) in enumerate(corners):
        square = jittered(generator, side)
        root = np.sqrt(square[:, 0])
        weights = np.stack([1 - root, root * (1 - square[:, 1]), root * square[:, 1]], -1)
        points = weights @ [a, b, c]
        area = np.broadcast_to(np.cross(b - a, c - a) / 2 / len(square), points.shape)
        own = weights @ colours[index]
        if light["radiance"]["kind"] == "face_color":
            own = np.broadcast_to(colours[index][0], own.shape)
        shading = weights @ normals[index] if light["normals"] else area
        parts.append([points, area, weights @ uv[index], own, shading])
    return Samples(*map(np.concatenate, zip(*parts)))


def samples_of(light, generator, side):
    """Points on a light in the world."""
    kind = light["kind"]
    if kind == "cube":
        samples = cube(generator, side)
    elif kind == "mesh":
        samples = triangles(light, generator, side // 2)
    else:
        samples = patch(*QUADRICS[kind](*jittered(generator, side).T))
    matrix, offset = affine(light["steps"])
    # Areas go with the cofactors. Outside stays outside where a transformation mirrors, but for
    # meshes without normals: their outside is that of the order of corners
    sign = -1 if light["flip"] else 1
    if kind == "mesh" and not light["normals"]:
        sign *= np.sign(np.linalg.det(matrix))
    cofactors = np.abs(np.linalg.det(matrix)) * np.linalg.inv(matrix)
    return Samples(
        samples.points @ matrix.T + offset,
        sign * samples.areas @ cofactors,
        samples.uv,
        samples.colours,
        sign * samples.shading @ cofactors,
    )


def emitted(light, samples):
    """Radiance (n, 3) of points on a light."""
    radiance = light["radiance"]
    kind = radiance["kind"]
    if kind in ("rgb", "uniform"):
        return np.broadcast_to(radiance["value"], (len(samples.points), 3))
    if kind in ("vertex_color", "face_color"):
        return radiance["scale"] * samples.colours
    return lookup(radiance, samples.uv)


# ------------------------------------------------------------------------------------ occlusion


def hidden(light, receivers, points):
    """Is a point (m, n, 3) of the light hidden from a receiver (m, 1, 3) by the light itself?"""
    matrix, offset = affine(light["steps"])
    inverse = np.linalg.inv(matrix)
    start, end = ((p - offset) @ inverse.T for p in (receivers, points))
    along = end - start
    if light["kind"] == "mesh":
        return hidden_by_triangles(mesh_arrays(light)[0], start, along)
    if light["kind"] == "cylinder":
        return hidden_by_cylinder(start, along)
    # From the sides that emit of the other shapes all that is outside is seen
    return np.zeros(points.shape[:2], bool)


NEAR = 1e-4
"""Share of a segment at its end within which it does not hit the surface that it leads to."""


def hidden_by_triangles(corners, start, along):
    """Moeller and Trumbore, for each triangle."""
    result = np.zeros(along.shape[:2], bool)
    for a, b, c in corners:
        side = np.cross(along, c - a)
        determinant = side @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((start - a) * side).sum(-1) / determinant
            other = np.cross(start - a, b - a)
            v = (along * other).sum(-1) / determinant
            t = (other @ (c - a)) / determinant
        result |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - NEAR)
    return result


def hidden_by_cylinder(start, along):
    """The other point of the wall on the segment, if it is between the ends of the cylinder."""
    a = (along[..., :2] ** 2).sum(-1)
    c = (start[..., :2] ** 2).sum(-1) - 1
    # One root is 1, the product of both c / a
    t = c / a
    z = start[..., 2] + t * along[..., 2]
    return (t > 0) & (t < 1 - NEAR) & (z >= 0) & (z <= 1)


# ---------------------------------------------------------------------------------------- image


def length_inside(low, high, start, end):
    """Length of segments within a box."""
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / along, (high - start) / along
    first, second = (
        np.where(np.isnan(t), sign * np.inf, t)
        for t, sign in ((np.fmin(first, second), -1), (np.fmax(first, second), 1))
    )
    enter, leave = np.maximum(first.max(-1), 0), np.minimum(second.min(-1), 1)
    return np.maximum(leave - enter, 0) * np.linalg.norm(along, axis=-1)


def transmittance(fog, start, end):
    """Share of the light (..., 3) that is left of it after a segment."""
    if fog is None:
        return 1.0
    depth = length_inside(*fog_bounds(fog), start, end)
    return np.exp(-depth[..., np.newaxis] * np.array(fog["extinction"]))


def receivers(generator, divisions):
    """Random points (m, 3) of the patch, one in each of divisions^2 parts of each pixel."""
    side = divisions * PATCH_PIXELS
    film = jittered(generator, side)
    extent = PATCH_HEIGHT * np.tan(np.radians(PATCH_FOV) / 2)
    # The camera looks down and has y upwards: its left is z cross y
    places = extent * (1 - 2 * film)
    left, up = np.cross([0, 1, 0], [0, 0, -1]), np.array([0, 1, 0])
    return places[:, :1] * left + places[:, 1:] * up


def area_light(light, at, fog, generator, side):
    """Irradiance (m, 3) from a shape."""
    samples = samples_of(light, generator, side)
    offset = at[:, np.newaxis] - samples.points
    distance2 = (offset**2).sum(-1)
    front = (offset * samples.shading).sum(-1) > 0
    from_light = np.abs((offset * samples.areas).sum(-1))
    on_patch = np.maximum(-offset[..., 2], 0)
    points = np.broadcast_to(samples.points, offset.shape)
    seen = front & ~hidden(light, at[:, np.newaxis], points)
    weights = seen * from_light * on_patch / distance2**2
    light_left = transmittance(fog, at[:, np.newaxis], points) if fog else np.ones(3)
    return (weights[..., np.newaxis] * light_left * emitted(light, samples)).sum(axis=1)


def spot_falloff(light, directions):
    """Share (m, 3) of a spot's intensity along directions (m, 3) in its frame."""
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(directions[:, 2], -1, 1)))
    share = np.clip((light["cutoff"] - angle) / (light["cutoff"] - light["beam"]), 0, 1)
    if not light["texture"]:
        return share[:, np.newaxis]
    factor = np.tan(np.radians(light["cutoff"]))
    depth = np.where(share > 0, directions[:, 2], 1)
    uv = 0.5 + 0.5 * directions[:, :2] / (depth[:, np.newaxis] * factor)
    return share[:, np.newaxis] * lookup(light["texture"], uv)


def irradiance(light, at, fog, generator, side):
    """Irradiance (m, 3) of the patch at its points (m, 3) from one light."""
    kind = light["kind"]
    if kind == "directional":
        direction = np.array(light["direction"]) / np.linalg.norm(light["direction"])
        left = transmittance(fog, at, at - 100 * direction)
        return max(-direction[2], 0) * np.array(light["value"]) * left * np.ones(at.shape)
    if kind not in ("point", "spot"):
        return area_light(light, at, fog, generator, side)
    matrix, position = affine(light["steps"]) if kind == "spot" else (None, light["position"])
    offset = at - position
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    intensity = np.array(light["value"]) * transmittance(
        fog, at, np.broadcast_to(position, at.shape)
    )
    if kind == "spot":
        intensity = intensity * spot_falloff(light, offset @ np.linalg.inv(matrix).T)
    return intensity * np.maximum(-offset[:, 2:], 0) / distance**3


FINE = 8
"""Parts of a pixel along its side for spots, whose borders cross pixels; other light is smooth."""


def image(scene, seed, side=20):
    """The image (height, width, 3) of a `lit_patch`, from about side^2 points on each surface."""
    generator = np.random.default_rng(seed)
    fog = scene.get("fog")
    # Rays of Mitsuba's cameras begin on their near plane, and so does the fog
    begin = 1 - PATCH_NEAR / PATCH_HEIGHT
    eye = np.array([0, 0, PATCH_HEIGHT])
    total = 0.0
    for light in scene["lights"]:
        divisions = FINE if light["kind"] in ("point", "spot", "directional") else 1
        at = receivers(generator, divisions)
        light_in = irradiance(light, at, fog, generator, side)
        light_in = light_in * transmittance(fog, at, at + begin * (eye - at))
        shape = (PATCH_PIXELS, divisions, PATCH_PIXELS, divisions, 3)
        total = total + light_in.reshape(shape).mean(axis=(1, 3))
    return scene["power"] * np.array(scene["albedo"]) / np.pi * total


def images(scene, seeds, side=20):
    """Independent images (seeds, height, width, 3)."""
    return np.stack([image(scene, seed, side) for seed in seeds])

"""Area lights whose radiance varies over their surface.

The light that arrives at one point is known from numpy quadrature over the surface of the lights.
Mitsuba's own light sampling is no reference: it is wrong for textured spheres, cylinders, disks and
rectangles that are scaled, mirrored or sheared.
"""

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests import light_scenes
from tests import statistics_tools as tools
from tests.light_scenes import area, diffuse, transform
from tests.shared_results import shared

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

RGB = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
"""Variants in which a texel is what arrives."""

ALBEDO = 0.5
SEEDS = 32


def pattern(width=8, height=4, seed=0):
    """Texels (height, width, 3) of strong contrast, a third of them black."""
    generator = np.random.default_rng(seed)
    texels = generator.exponential(1.0, (height, width, 3))
    texels[generator.random((height, width)) < 1 / 3] = 0
    return texels.astype(np.float32)


def bitmap(texels, to_uv=None, **parameters):
    """A texture of these texels as they are."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    return texture | ({"to_uv": to_uv} if to_uv else {}) | parameters


def lit_point(lights):
    """One pixel, which shows the origin of a white floor, and lights above it."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    return {
        "type": "scene",
        "sensor": {  # close to the floor, below all lights
            "type": "perspective",
            "fov": 0.01,
            "near_clip": 1e-4,
            "to_world": transform().look_at([0.01, 0, 0.01], [0, 0, 0], [0, 0, 1]),
            "film": film,
        },
        "floor": {
            "type": "rectangle",
            "to_world": transform().scale(9),
            "bsdf": diffuse(*[ALBEDO] * 3),
        },
        **lights,
    }


def images(lights, spp, **parameters):
    """The pixel for each seed: (SEEDS, 1, 1, 3)."""
    scene = mi.load_dict(lit_point(lights))
    integrator = mi.load_dict({"type": "manylights_direct", **parameters})
    return tools.render_seeds(scene, integrator, spp, range(SEEDS))


def assert_mean(pixels, expected, label=""):
    """A t test for each channel, precise enough to find a bias of 2 %."""
    values = tools.image_means(pixels)
    error = np.hypot(values.std(axis=0, ddof=1) / np.sqrt(SEEDS), 1e-4 * expected)
    limit = stats.t.isf(tools.SIGNIFICANCE / 6, SEEDS - 1)
    power = stats.t.isf(1 - tools.POWER, SEEDS - 1)
    assert np.all((limit - power) * error <= tools.BIAS * expected), f"{label}: too noisy"
    distance = (values.mean(axis=0) - expected) / error
    assert np.all(np.abs(distance) <= limit), f"{label}: {values.mean(axis=0)}, not {expected}"


# ------------------------------------------------------------------ Surfaces, in numpy


def grid(columns=512, rows=256):
    """Middles (u, v) of the cells of the unit square."""
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return u.ravel(), v.ravel()


def surface(kind, u, v):
    """Points of the unit shape at texture coordinates, and their derivatives."""
    zero, pi = np.zeros_like(u), np.pi
    sin, cos = np.sin(2 * pi * u), np.cos(2 * pi * u)
    if kind == "sphere":
        ring, z = np.sin(pi * v), np.cos(pi * v)
        along_u = 2 * pi * np.stack([-ring * sin, ring * cos, zero], -1)
        along_v = pi * np.stack([z * cos, z * sin, -ring], -1)
        return np.stack([ring * cos, ring * sin, z], -1), along_u, along_v
    if kind == "cylinder":
        along_u = 2 * pi * np.stack([-sin, cos, zero], -1)
        return np.stack([cos, sin, v], -1), along_u, np.stack([zero, zero, zero + 1], -1)
    if kind == "disk":
        sin, cos = np.sin(2 * pi * v), np.cos(2 * pi * v)
        along_v = 2 * pi * np.stack([-u * sin, u * cos, zero], -1)
        return np.stack([u * cos, u * sin, zero], -1), np.stack([cos, sin, zero], -1), along_v
    along_u = np.stack([zero + 2, zero, zero], -1)
    return np.stack([2 * u - 1, 2 * v - 1, zero], -1), along_u, along_u[:, [1, 0, 2]]


def patches(kind, to_world):
    """Texture coordinates, places and area times outer normal of small pieces of a shape."""
    if kind == "cube":
        return cube_patches(to_world)
    matrix = np.array(to_world.matrix)
    u, v = grid()
    p, along_u, along_v = surface(kind, u, v)
    normal = np.cross(along_u @ matrix[:3, :3].T, along_v @ matrix[:3, :3].T) / len(u)
    p = p @ matrix[:3, :3].T + matrix[:3, 3]
    if kind in ("sphere", "cylinder"):
        middle = matrix[:3, 3] + (0.5 * matrix[:3, 2] if kind == "cylinder" else 0)
        outer = np.sign(np.sum(normal * (p - middle), axis=-1, keepdims=True))
    else:
        outer = np.sign(np.linalg.det(matrix[:3, :3]))
    return u, v, p, normal * outer


def cube_patches(to_world):
    """The same for the twelve triangles of a cube, as Mitsuba lays out its texture coordinates."""
    shape = mi.load_dict({"type": "cube", "to_world": to_world})
    parameters = mi.traverse(shape)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    corners = np.array(parameters["vertex_positions"]).reshape(-1, 3)[faces]
    texcoords = np.array(parameters["vertex_texcoords"]).reshape(-1, 2)[faces]
    n = 256
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n)))
    upper = i + j >= n  # of the two triangles in a cell, one is outside of the face
    b1, b2 = (i + 0.5) / n, (j + 0.5) / n
    b1, b2 = np.where(upper, 1 - b1, b1), np.where(upper, 1 - b2, b2)
    weights = np.stack([1 - b1 - b2, b1, b2], -1)
    p = np.einsum("kc,fcx->fkx", weights, corners).reshape(-1, 3)
    uv = np.einsum("kc,fcx->fkx", weights, texcoords).reshape(-1, 2)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    outward = np.sign(np.sum(normal * (corners[:, 0] - corners.mean(axis=(0, 1))), -1))
    normal = np.repeat(normal * outward[:, None] / n**2, n**2, axis=0)
    return uv[:, 0], uv[:, 1], p, normal


def lookup(texels, u, v):
    """Nearest texels of a repeated image."""
    height, width = texels.shape[:2]
    return texels[
        (np.floor(v * height) % height).astype(int), (np.floor(u * width) % width).astype(int)
    ]


def reflected(kind, to_world, radiance):
    """Radiance that the floor's origin reflects; `radiance(u, v)` is that of the light."""
    u, v, p, normal = patches(kind, to_world)
    square = np.sum(p**2, axis=-1)
    facing = np.maximum(-np.sum(p * normal, axis=-1), 0) * np.maximum(p[:, 2], 0)
    return ALBEDO / np.pi * np.sum(radiance(u, v) * (facing / square**2)[:, None], axis=0)


def shears(kind):
    """Transformations about the origin that shapes of this kind may have."""
    if kind in ("sphere", "cylinder"):
        stretched = transform().scale([0.2, 0.2, 0.5 if kind == "cylinder" else 0.2])
        return [
            transform().rotate([1, 0, 0], 90).scale(0.25),
            transform().rotate([0.6, 0.8, 0], 70).scale(0.3),
            transform().rotate([0, 0.6, 0.8], 130) @ stretched,
            transform().rotate([0.8, 0.6, 0], 200).scale([-0.25, 0.25, 0.25]),
        ]
    shear = mi.ScalarTransform4f([[1, 0.6, 0, 0], [0, 1, 0, 0], [0.3, 0, 1, 0], [0, 0, 0, 1]])
    return [
        transform().scale(0.3),
        transform().rotate([0, 0, 1], 40).scale([0.2, 0.4, 0.3]),
        transform().scale([-0.3, 0.3, 0.3]).rotate([0, 0, 1], 20),
        shear @ transform().scale([0.3, -0.2, 0.2]),
    ]


def places(kind):
    """Transformations of four lights around the floor's origin, which flat ones face."""
    result = []
    for index, shape in enumerate(shears(kind)):
        angle = 0.5 + 1.57 * index
        origin = [1.1 * np.cos(angle), 1.1 * np.sin(angle), 0.9 + 0.2 * index]
        frame = transform().look_at(origin, [0, 0, 0], [0, 0, 1])
        result.append(frame @ shape)
    return result


KINDS = ("sphere", "disk", "cylinder", "cube", "rectangle")


def lamp(kind, to_world, radiance):
    """A light; one that a mirror turns inside out is turned back."""
    mirrored = np.linalg.det(np.array(to_world.matrix)[:3, :3]) < 0
    return {
        "type": kind,
        "to_world": to_world,
        "flip_normals": bool(mirrored and kind == "sphere"),
        "emitter": area(radiance),
    }


# ------------------------------------------------------------------------------- Tests


@RGB
def test_sheared_cylinder_is_found_by_rays_only(variant):
    """No point on it is sampled: it is no circular cylinder."""
    squeezed = transform().translate([0, 0, 1]).rotate([0, 1, 0], 90).scale([0.2, 0.5, 0.4])
    light = {"type": "cylinder", "to_world": squeezed, "emitter": area(bitmap(pattern()))}
    assert images({"lamp": light}, 64, bsdf_samples=0).max() == 0
    expected = reflected("cylinder", squeezed, lambda u, v: lookup(pattern(), u, v))
    assert_mean(images({"lamp": light}, 6145, bsdf_samples=16), expected)


@RGB
@pytest.mark.parametrize("kind", KINDS)
def test_texture_of_one_colour_is_that_colour(variant, kind):
    colour = 2.5
    plain = light_scenes.rgb([colour] * 3)
    textured = bitmap(np.full((4, 4, 3), colour, np.float32))
    for to_world in places(kind):
        values = [
            images({"lamp": lamp(kind, to_world, radiance)}, 64, bsdf_samples=0)
            for radiance in (plain, textured)
        ]
        assert values[0].min() > 0
        np.testing.assert_allclose(values[1].mean(), values[0].mean(), rtol=2e-3)


@shared
def reflected_patterns(kind):
    """What the floor's origin reflects of a light at each place with the pattern as its texture."""
    texels = pattern()
    return sum(
        reflected(kind, to_world, lambda u, v: lookup(texels, u, v)) for to_world in places(kind)
    )


@RGB
@pytest.mark.parametrize("bsdf_samples", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_texture_shines_as_its_texels_do(variant, kind, bsdf_samples):
    lights = {
        f"lamp_{index}": lamp(kind, to_world, bitmap(pattern()))
        for index, to_world in enumerate(places(kind))
    }
    expected = reflected_patterns(kind)
    # Half of a cylinder is unseen: much variance
    spp = 12289 if kind == "cylinder" else 6145
    pixels = images(lights, spp, bsdf_samples=bsdf_samples)
    assert_mean(pixels, expected, kind)
    with pytest.raises(AssertionError, match="not"):
        assert_mean(pixels * (1 + tools.BIAS), expected, kind)


@RGB
def test_procedural_texture_shines_as_evaluated(variant):
    """A checkerboard is no image of texels: it is looked at in points."""
    colours = np.array([[0.1, 0.02, 0.05], [1.0, 0.6, 0.3]])
    radiance = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": list(colours[0])},
        "color1": {"type": "rgb", "value": list(colours[1])},
        "to_uv": transform3().scale([3, 2]),
    }

    def value(u, v):
        odd = ((3 * u) % 1 > 0.5) != ((2 * v) % 1 > 0.5)
        return colours[np.where(odd, 0, 1)]

    lights, expected = {}, 0
    for index, kind in enumerate(KINDS[:4]):
        to_world = places(kind)[index]
        lights[kind] = lamp(kind, to_world, radiance)
        expected = expected + reflected(kind, to_world, value)
    assert_mean(images(lights, 4097, bsdf_samples=0), expected)


# ------------------------------------------------------------------- Windows of a house


WINDOWS = 8


def transform3():
    """The identity of texture coordinates."""
    return mi.ScalarTransform3f()


def window():
    """One window of 16 x 16 texels: a bright pane in a dark wall."""
    texels = np.zeros((16, 16, 3), np.float32)
    texels[5:11, 6:10] = [8, 6, 3]
    return texels


def wall(radiance, faces=4 * WINDOWS, colour=None):
    """A grid of quadrilaterals above the floor, of which each sees a quarter of a window.

    `colour(u, v)` is the attribute `vertex_color`.
    """
    u, v = (a.ravel() for a in np.meshgrid(*[np.arange(faces + 1) / faces] * 2))
    first = (np.arange(faces)[:, None] * (faces + 1) + np.arange(faces)).ravel()
    right, above = first + 1, first + faces + 1
    corners = np.concatenate([[first, above, right], [right, above, above + 1]], axis=1)
    properties = mi.Properties()
    properties["mesh_emitter"] = mi.load_dict(area(radiance))
    mesh = mi.Mesh("wall", len(u), corners.shape[1], has_vertex_texcoords=True, props=properties)
    if colour is not None:
        mesh.add_attribute("vertex_color", 3, colour(u, v).ravel().astype(np.float32))
    parameters = mi.traverse(mesh)
    positions = np.stack([2 * u - 1, 2 * v - 1, 0 * u + 1.5], -1)
    parameters["vertex_positions"] = positions.ravel().astype(np.float32)
    parameters["vertex_texcoords"] = np.stack([u, v], -1).ravel().astype(np.float32)
    parameters["faces"] = corners.T.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def repeated(kind):
    """The same wall of windows as a bitmap that is repeated in some way."""
    one = window()
    turn = transform3().scale([WINDOWS, WINDOWS])
    if kind == "repeat":
        return bitmap(one, turn)
    if kind == "mirror":  # a window is symmetric
        return bitmap(one, turn, wrap_mode="mirror")
    if kind == "turned":
        turned = np.ascontiguousarray(one.transpose(1, 0, 2))
        return bitmap(turned, transform3().rotate(90) @ turn)
    if kind == "shifted":
        return bitmap(np.roll(one, 8, axis=(0, 1)), transform3().translate([3.5, -7.5]) @ turn)
    return bitmap(np.tile(one, (WINDOWS, WINDOWS, 1)))


@RGB
@pytest.mark.parametrize("kind", ["repeat", "mirror", "turned", "shifted"])
def test_repeated_windows_are_chosen_as_those_of_one_bitmap(variant, kind):
    """The mean by sampled lights alone, and about the same variance."""
    texels = np.tile(window(), (WINDOWS, WINDOWS, 1))
    down = transform().translate([0, 0, 1.5]).rotate([1, 0, 0], 180)
    # Seen from below v runs the other way; the windows are as far from both borders
    expected = reflected("rectangle", down, lambda u, v: lookup(texels, u, 1 - v))
    parameters = {"bsdf_samples": 0, "reservoirs": 2, "shadow_rays": 1}
    one = images({"wall": wall(repeated("one"))}, 2049, **parameters)
    many = images({"wall": wall(repeated(kind))}, 2049, **parameters)
    assert_mean(one, expected, "one bitmap")
    assert_mean(many, expected, kind)
    ratio = np.var(many, axis=0, ddof=1).mean() / np.var(one, axis=0, ddof=1).mean()
    assert ratio < 2 * stats.f.isf(tools.SIGNIFICANCE, SEEDS - 1, SEEDS - 1)


@RGB
def test_colours_of_vertices_shine_as_interpolated(variant):
    def colour(u, v):
        return np.stack([5 * u, 2 - 2 * v, 0.1 + u * 0], -1)

    down = transform().translate([0, 0, 1.5]).rotate([1, 0, 0], 180)
    expected = reflected("rectangle", down, lambda u, v: colour(u, 1 - v))
    radiance = {"type": "mesh_attribute", "name": "vertex_color"}
    light = wall(radiance, faces=8, colour=colour)
    assert_mean(images({"wall": light}, 4097, bsdf_samples=0), expected)


@RGB
def test_clamped_texture_keeps_its_border(variant):
    """Only the outermost texels shine, on most of a rectangle."""
    texels = pattern(4, 4)
    to_uv = transform3().translate([-1, -1]).scale([3, 3])
    down = transform().translate([0, 0, 1]).rotate([1, 0, 0], 180)
    light = lamp("rectangle", down, bitmap(texels, to_uv, wrap_mode="clamp"))

    def value(u, v):
        column = np.clip(np.floor((3 * u - 1) * 4), 0, 3).astype(int)
        row = np.clip(np.floor((3 * v - 1) * 4), 0, 3).astype(int)
        return texels[row, column]

    expected = reflected("rectangle", down, value)
    assert_mean(images({"lamp": light}, 4097, bsdf_samples=0), expected)


# -------------------------------------------------------------------- Means and budgets


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_means_of_triangles_follow_the_texels(wrap):
    core = pytest.importorskip("manylights._core", reason="it needs Python.h (python3-dev)")
    generator = np.random.default_rng(1)
    texels = np.where(generator.random((16, 24)) < 0.1, generator.random((16, 24)), 0)
    texels = texels.astype(np.float32)
    image = core.BrightnessMap(texels, wrap)
    np.testing.assert_allclose(
        image.mean(np.float64([[0, 0], [1, 0], [1, 1], [0, 1]])), texels.mean(), rtol=0.05
    )
    a, b = generator.random((2, 20_000))
    a, b = np.where(a + b > 1, [1 - a, 1 - b], [a, b])
    shape = np.stack([np.cos([0.3, 2.4, 4.5]), np.sin([0.3, 2.4, 4.5])], -1)
    for size in np.repeat([0.02, 0.1, 0.5, 3.0], 25):
        turn, (x, y) = generator.choice([-1, 1], 2), generator.uniform(-3, 3, 2)
        corners = [x, y] + size * turn * shape[:, :: turn[0]]
        points = corners[0] + a[:, None] * (corners[1] - corners[0])
        points += b[:, None] * (corners[2] - corners[0])
        index = np.floor(points * [24, 16]).astype(int)
        if wrap == "clamp":
            index = np.clip(index, 0, [23, 15])
        else:
            period, index = np.divmod(index, [24, 16])
            if wrap == "mirror":
                index = np.where(period % 2, [23, 15] - index, index)
        values = texels[index[:, 1], index[:, 0]]
        mean = image.mean(corners)
        assert mean > 0 or values.max() == 0
        # It steers choices only: a part of what is near is mixed in
        assert abs(mean - values.mean()) < 0.2 * texels.max()
        if size == 3 and wrap != "clamp":
            assert abs(mean / values.mean() - 1) < 0.15


def test_black_texels_have_no_mean():
    core = pytest.importorskip("manylights._core", reason="it needs Python.h (python3-dev)")
    texels = np.zeros((64, 64), np.float32)
    texels[40, 40], texels[3, 3] = 1e-6, 1e6
    image = core.BrightnessMap(texels)

    def mean(*corners):
        return image.mean(np.float64(corners))

    assert mean([0.2, 0.2], [0.5, 0.2], [0.2, 0.5]) == 0
    assert mean([5.63, 7.63], [5.64, 7.63], [5.63, 7.64]) > 0
    assert mean([np.nan, 0], [1, 0], [0, 1]) > 0
    assert mean([1e30, 0], [1, 0], [0, np.inf]) > 0


@pytest.mark.parametrize("size", [730, 2048])
def test_large_textures_are_read(variant, size):
    texels = np.full((size, size, 1), 2.0, np.float32)
    texels[: size // 2] = 0
    down = transform().translate([0, 0, 1]).rotate([1, 0, 0], 180)
    light = lamp("rectangle", down, bitmap(texels))
    expected = reflected("rectangle", down, lambda u, v: lookup(texels, u, v))
    pixels = images({"lamp": light}, 4097, bsdf_samples=0)
    if "spectral" in variant:  # the same at all wavelengths
        pixels = pixels @ [[0.2126], [0.7152], [0.0722]]
    assert_mean(pixels, expected)


def test_textures_in_points_have_a_budget(scalar):
    """A texture of one's own is looked at a bounded number of times, however large a mesh is."""
    looks = []

    class Glow(mi.Texture):
        def __init__(self, properties):
            mi.Texture.__init__(self, properties)

        def eval(self, si, active=True):
            looks.append(si.prim_index)
            return mi.Color3f(1.0, 0.5, si.uv.x)

        def is_spatially_varying(self):
            return True

    mi.register_texture("glow", Glow)
    scene = lit_point({"lamp": wall({"type": "glow"}, faces=64)})
    integrator = mi.load_dict({"type": "manylights_direct"})
    mi.render(mi.load_dict(scene), integrator=integrator, spp=1)
    assert 4 * 2 * 64**2 <= len(looks) <= 4 * 2 * 64**2 + 100
    looks.clear()
    down = transform().translate([0, 0, 1]).rotate([1, 0, 0], 180)
    scene = lit_point({"lamp": lamp("rectangle", down, {"type": "glow"})})
    mi.render(mi.load_dict(scene), integrator=integrator, spp=1)
    assert 0 < len(looks) <= 2 * 1024 + 100


@RGB
def test_texture_coordinates_of_nan_do_not_lose_a_face(variant):
    """Its place in the tree is that of the whole image, and nothing breaks."""
    mesh = wall(repeated("repeat"))
    parameters = mi.traverse(mesh)
    texcoords = np.array(parameters["vertex_texcoords"])
    texcoords[:6] = np.nan
    parameters["vertex_texcoords"] = texcoords
    parameters.update()
    scene = mi.load_dict(lit_point({"wall": mesh}))
    integrator = mi.load_dict({"type": "manylights_direct", "bsdf_samples": 0})
    mi.render(scene, integrator=integrator, spp=16)
    faces = [0, 1, 2 * 4 * WINDOWS // 2]  # the first two have such a corner
    assert np.ravel(mi.traverse(integrator)["lights_in_tree"])[0] > len(faces)

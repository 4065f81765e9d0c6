"""Lights of USD: each row of the table of lights against a closed form or quadrature."""

import re

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import UsdLux

from tests.statistics_tools import assert_same_mean
from tests.usd_stages import (
    SURFACES,
    area,
    assert_irradiance,
    constant_image,
    irradiance,
    matrix_op,
    placed,
    seen,
    write_stage,
)

pytestmark = pytest.mark.usefixtures("scalar", "plugin")


@pytest.fixture
def load(tmp_path, plugin):
    """A function that loads a stage given as text."""
    from manylights import usd

    def load_text(text, metadata=None, **options):
        return usd.load(write_stage(tmp_path, text, **(metadata or {})), **options)

    return load_text


def emitters(scene, kind):
    """Return the parts of a scene of a type."""
    return [part for part in scene.values() if isinstance(part, dict) and part.get("type") == kind]


def color(part):
    return np.array(part["value"])


def note(scene, kind):
    """Return the texts of the notes of a kind, joined."""
    return " ".join(entry.text for entry in scene.notes if entry.kind == kind)


def row_matrix(linear, position=(0.0, 0.0, 5.0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = linear, position
    return matrix


# -- Area lights


@pytest.mark.parametrize("kind", SURFACES)
@pytest.mark.parametrize("normalize", [False, True])
def test_area_light_gives_its_radiance_over_its_solid_angle(load, kind, normalize):
    matrix = row_matrix(np.eye(3), (0.5, 0.2, 3.0))
    flag = "bool inputs:normalize = true;" if normalize else ""
    light = f"float inputs:intensity = 10;color3f inputs:color = (1, 0.5, 0.25);{flag}"
    scene = load(f'def {kind} "light" {{;{light}{matrix_op(matrix)}}}')
    surface = SURFACES[kind](matrix)
    expected = 10 * np.array([1, 0.5, 0.25]) * seen(surface)
    assert_irradiance(scene, expected / (area(surface) if normalize else 1.0), spp=400)


LINEAR = {
    "turned": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "flipped": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "scaled": 2 * np.eye(3),
    "mirrored x": np.diag([-1, 1, 1]),
    "mirrored z": np.diag([1, 1, -1]),
    "stretched": np.diag([2, 1, 1]),
    "stretched y": np.diag([1, 3, 0.5]),
    "sheared": [[1, 0, 0], [0.5, 1, 0.3], [0, 0.4, 1.2]],
    "sheared, mirrored": [[-1, 0.2, 0], [0.5, 1, 0.3], [0, 0.4, 1.2]],
}


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("kind", SURFACES)
def test_transforms_keep_power_and_facing(load, kind, name):
    matrix = row_matrix(LINEAR[name])
    surface = SURFACES[kind](matrix)
    expected = np.array([seen(surface, up=up) for up in ((0, 0, 1), (0.6, 0, 0.8))])
    text = f'def {kind} "light" {{;float inputs:intensity = 10;{matrix_op(matrix)}}}'
    scene = load(text)
    for up, value in zip(((0, 0, 1), (0.6, 0, 0.8)), expected):
        if value < 1e-6:
            images = irradiance(scene, up=up, spp=16, seeds=range(2))
            assert images.max() < 1e-3
        else:
            assert_irradiance(scene, 10 * value, up=up, rounding=0.01, spp=64)


def test_normalized_area_includes_the_parents_scale(load):
    text = """def Xform "parent" {
        float3 xformOp:scale = (2, 1, 1); uniform token[] xformOpOrder = ["xformOp:scale"]
        def RectLight "light" { ; float inputs:width = 2; float inputs:height = 1
            float inputs:intensity = 10; bool inputs:normalize = true; }
        }"""
    (light,) = emitters(load(text), "rectangle")
    assert color(light["emitter"]["radiance"]) == pytest.approx([2.5] * 3)


def test_ellipsoid_has_its_exact_area(load):
    matrix = row_matrix(np.diag([2.0, 1.0, 1.0]))
    light = "float inputs:radius = 1;float inputs:intensity = 21.4784;bool inputs:normalize = true;"
    scene = load(f'def SphereLight "light" {{;{light}{matrix_op(matrix)}}}')
    assert_irradiance(scene, seen(SURFACES["SphereLight"](matrix, 1.0)), rounding=0.01)


def test_lengths_that_are_not_authored_are_those_of_the_schema(load):
    scene = load('def SphereLight "a" {;bool inputs:normalize = true;}')
    (light,) = emitters(scene, "sphere")
    assert color(light["emitter"]["radiance"]) == pytest.approx([1 / np.pi] * 3)


@settings(max_examples=15, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.floats(-2, 2), min_size=9, max_size=9),
    st.sampled_from(sorted(SURFACES)),
    st.booleans(),
)
def test_power_of_random_transforms(tmp_path_factory, entries, kind, normalize):
    """Radiance times area, summed over what was made of a light, is its power over pi."""
    from manylights import usd

    linear = np.reshape(entries, (3, 3))
    values = np.linalg.svd(linear, compute_uv=False)
    if values[2] < 0.05:
        linear = linear + 3 * np.eye(3)
    matrix = row_matrix(linear)
    flag = "bool inputs:normalize = true;" if normalize else ""
    text = f'def {kind} "light" {{;float inputs:intensity = 7;{flag}{matrix_op(matrix)}}}'
    folder = tmp_path_factory.mktemp("stage")
    scene = mi.load_dict(usd.load(write_stage(folder, text)))
    shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
    radiances = [shape.emitter().eval(front_of(shape)) for shape in shapes]
    power = sum(r[0] * shape.surface_area() for r, shape in zip(radiances, shapes))
    assert power == pytest.approx(7 if normalize else 7 * area(SURFACES[kind](matrix)), rel=2e-3)


def front_of(shape):
    si = mi.SurfaceInteraction3f()
    si.wi, si.prim_index = [0, 0, 1], 0
    return si


# -- Emission scalar


def test_exposure_and_temperature_are_factors(load):
    light = "float inputs:intensity = 3;float inputs:exposure = 2;float inputs:colorTemperature = "
    on = "bool inputs:enableColorTemperature = true;"
    warm = load(f'def SphereLight "a" {{;{light}2000;{on}}}')
    (part,) = emitters(warm, "sphere")
    expected = 12 * np.array([2.5206, 0.6469, 0.0204])
    assert color(part["emitter"]["radiance"]) == pytest.approx(expected, rel=1e-3, abs=1e-3)
    (part,) = emitters(load(f'def SphereLight "a" {{;{light}2000;}}'), "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([12] * 3)
    for beyond, limit in ((500, 1000), (20000, 11000)):
        (part,) = emitters(load(f'def SphereLight "a" {{;{light}{beyond};{on}}}'), "sphere")
        clamped = 12 * np.array(UsdLux.BlackbodyTemperatureAsRgb(limit))
        assert color(part["emitter"]["radiance"]) == pytest.approx(clamped)


def test_blocked_and_valueless_inputs_are_the_fallback(load):
    light = "float inputs:intensity = None;float inputs:radius;rel light:filters = None;"
    light += "float inputs:shaping:focus;float inputs:shaping:cone:angle = 180;"
    api = '(prepend apiSchemas = ["ShapingAPI"])'
    scene = load(f'def SphereLight "a" {api} {{;{light}}}')
    (part,) = emitters(scene, "sphere")
    assert part["radius"] == 0.5
    assert color(part["emitter"]["radiance"]) == pytest.approx([1] * 3)
    assert {entry.kind for entry in scene.notes} == {"no camera", "no geometry"}


def test_bare_intensity_needs_the_switch(load):
    text = 'def SphereLight "a" {;float intensity = 7;}'
    scene = load(text)
    (part,) = emitters(scene, "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([1] * 3)
    assert "legacy_lights" in note(scene, "legacy_lights")
    assert "/a" in note(scene, "legacy_lights")
    (part,) = emitters(load(text, legacy_lights=True), "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([7] * 3)


@pytest.mark.parametrize(
    "kind, expected",
    [("SphereLight", 3), ("DistantLight", 12), ("RectLight", 3)],
)
def test_units_of_blender(load, kind, expected):
    text = f'def {kind} "a" {{;float inputs:intensity = 3;float inputs:angle = 0;}}'
    scene = load(text, blender_light_units=True)
    (part,) = (part for name, part in scene.items() if name.startswith("light_"))
    value = part["irradiance"] if kind == "DistantLight" else part["emitter"]["radiance"]
    assert color(value) == pytest.approx([expected] * 3)


def test_white_of_blender_is_white(load):
    """Blender switches the temperature on, and does not write its default."""
    text = 'def SphereLight "a" {;bool inputs:enableColorTemperature = true;MORE}'
    for more, units in (("", False), ("float inputs:colorTemperature = 6400;", True)):
        (part,) = emitters(load(text.replace("MORE", more), blender_light_units=units), "sphere")
        assert color(part["emitter"]["radiance"])[0] > 1.02
    (part,) = emitters(load(text.replace("MORE", ""), blender_light_units=True), "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([1] * 3)


def test_sun_of_blender_has_half_of_its_angle(load):
    text = 'def DistantLight "a" {;float inputs:intensity = 3;float inputs:angle = 5;}'
    (sun,) = emitters(load(text, blender_light_units=True), "directional")
    disk = np.pi * np.sin(np.radians(5)) ** 2
    assert color(sun["irradiance"]) == pytest.approx([12 * disk] * 3)


@pytest.mark.parametrize(
    "what, time, expected",
    [("samples only", None, 4), ("start", None, 6), ("start", 2, 8), ("default", None, 1)],
)
def test_time(load, what, time, expected):
    samples = "float inputs:intensity.timeSamples = { 1: 4, 3: 8 };"
    if what == "default":
        samples = "float inputs:intensity = 1;" + samples
    if what == "start":
        samples = samples.replace("1: 4", "0: 4, 1: 6, 2: 8")
    metadata = {"startTimeCode": 1} if what == "start" else {}
    (part,) = emitters(load(f'def SphereLight "a" {{;{samples}}}', metadata, time=time), "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([expected] * 3)


def test_moving_light_without_default_stands_where_it_starts(load):
    samples = "double3 xformOp:translate.timeSamples = { 5: (1, 2, 3), 6: (0, 0, 0) };"
    order = 'uniform token[] xformOpOrder = ["xformOp:translate"];'
    (part,) = emitters(load(f'def SphereLight "a" {{;{samples}{order}}}'), "sphere")
    assert part["center"] == [1, 2, 3]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_broken_intensity_is_noted(load, value):
    scene = load(f'def SphereLight "a" {{;float inputs:intensity = {value};}}')
    assert not emitters(scene, "sphere")
    assert "/a" in note(scene, "light value")


# -- Points


@pytest.mark.parametrize("normalize, intensity", [(False, np.pi), (True, 1.0)])
def test_treat_as_point(load, normalize, intensity):
    flag = f"bool inputs:normalize = {str(normalize).lower()};bool treatAsPoint = true;"
    scene = load(f'def SphereLight "a" {{;float inputs:intensity = 4;{flag}{placed(z=2)}}}')
    (part,) = emitters(scene, "point")
    assert color(part["intensity"]) == pytest.approx([intensity] * 3)
    assert_irradiance(scene, intensity / 4)


@pytest.mark.parametrize("normalize", [False, True])
def test_radius_zero(load, normalize):
    flag = f"bool inputs:normalize = {str(normalize).lower()};float inputs:radius = 0;"
    scene = load(f'def SphereLight "a" {{;float inputs:intensity = 4;{flag}}}')
    (part,) = emitters(scene, "point")
    assert color(part["intensity"]) == pytest.approx([1] * 3)
    assert bool(note(scene, "radius")) != normalize


def test_small_far_sphere_is_as_bright_as_a_point(load):
    far = 'def SphereLight "b" {;float inputs:intensity = 0;' + placed(z=-60) + "}"
    light = "float inputs:radius = 0.01;float inputs:intensity = 1e6;"
    scene = load(f'def SphereLight "a" {{;{light}{placed(z=40)}}};{far}')
    assert_irradiance(scene, 1e6 * np.pi * (0.01 / 40) ** 2, rounding=0.01)


# -- Distant lights and domes


@pytest.mark.parametrize(
    "inputs, expected",
    [
        ("", 3.3602),
        ("bool inputs:normalize = true;", 50000),
        ("float inputs:angle = 0;", 50000),
        ("float inputs:angle = 0;bool inputs:normalize = true;", 50000),
        ("float inputs:intensity = 2;float inputs:angle = 180;", 2 * np.pi),
        ("float inputs:intensity = 2;float inputs:angle = 270;", 3 * np.pi),
    ],
)
def test_distant_light(load, inputs, expected):
    scene = load(f'def DistantLight "sun" {{;{inputs}{placed(turn=60, z=0)}}}')
    (part,) = emitters(scene, "directional")
    assert color(part["irradiance"]) == pytest.approx([expected] * 3, rel=1e-4)
    assert_irradiance(scene, expected * 0.5)


def write_map(folder, name, pixels):
    mi.Bitmap(np.asarray(pixels, dtype=np.float32)).write(str(folder / name))


def axis_map(folder):
    """Write an environment map that is black but for the six axes, each in its own color."""
    pixels = np.zeros((64, 128, 3))
    for (row, column), value in AXES.values():
        pixels[max(row - 2, 0) : row + 3, np.arange(column - 3, column + 4) % 128] = value
    write_map(folder, "axes.exr", pixels)


AXES = {
    "+Z": ((32, 64), (1, 0, 0)),
    "-Z": ((32, 0), (0, 1, 0)),
    "+X": ((32, 32), (0, 0, 1)),
    "-X": ((32, 96), (1, 1, 0)),
}


def background(scene, direction):
    """Return what a ray to infinity sees."""
    loaded = mi.load_dict(scene)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(*direction)
    return np.array(loaded.environment().eval(si))


@pytest.mark.parametrize(
    "kind, axis, attributes, axes",
    [
        ("DomeLight", "Y", "", {"+Z": (0, 0, 1), "+X": (1, 0, 0), "-X": (-1, 0, 0)}),
        ("DomeLight", "Z", "", {"+Z": (0, 0, 1), "+X": (1, 0, 0)}),
        ("DomeLight_1", "Z", "", {"+Z": (0, -1, 0), "+X": (1, 0, 0), "-Z": (0, 1, 0)}),
        ("DomeLight_1", "Y", "", {"+Z": (0, 0, 1), "-X": (-1, 0, 0)}),
        ("DomeLight_1", "Y", 'uniform token poleAxis = "Z";', {"+Z": (0, -1, 0)}),
        ("DomeLight", "Y", placed(turn=90), {"+Z": (0, -1, 0), "+X": (1, 0, 0)}),
        ("DomeLight", "Y", matrix_op(np.diag([-1, 1, 1, 1])), {"+X": (-1, 0, 0), "+Z": (0, 0, 1)}),
    ],
)
def test_dome_orientation(load, tmp_path, kind, axis, attributes, axes):
    axis_map(tmp_path)
    text = f'def {kind} "sky" {{;asset inputs:texture:file = @axes.exr@;{attributes}}}'
    scene = load(text, {"upAxis": axis})
    for name, direction in axes.items():
        assert background(scene, direction) == pytest.approx(AXES[name][1], abs=0.01), name


def test_dome_tint_multiplies_each_channel(load, tmp_path):
    write_map(tmp_path, "one.exr", np.full((1, 1, 3), (0.2, 0.4, 0.8)))
    light = "asset inputs:texture:file = @one.exr@;color3f inputs:color = (1, 0.5, 0.25);"
    scene = load(f'def DomeLight "sky" {{;{light}float inputs:intensity = 3;}}')
    assert_irradiance(scene, np.pi * 3 * np.array([0.2, 0.2, 0.2]), rounding=0.01, spp=64)


def test_several_domes_are_their_sum(load, tmp_path):
    axis_map(tmp_path)
    file = "asset inputs:texture:file = @axes.exr@;"
    text = f'def DomeLight "a" {{;{file}}};def DomeLight "b" {{;{file}{placed(turn=90)}}};'
    scene = load(text + 'def DomeLight "c" {;color3f inputs:color = (0.5, 0.25, 0);}')
    plain = np.array([0.5, 0.25, 0])
    assert background(scene, (0, 0, 1)) == pytest.approx(plain + np.array((1, 0, 0)), abs=0.02)
    assert background(scene, (0, -1, 0)) == pytest.approx(plain + np.array((1, 0, 0)), abs=0.02)
    assert background(scene, (1, 0, 0)) == pytest.approx(plain + np.array((0, 0, 2)), abs=0.02)
    assert "3" in note(scene, "domes")


def test_missing_picture_is_noted(load):
    scene = load('def DomeLight "sky" {;asset inputs:texture:file = @nowhere.exr@;}')
    assert "nowhere.exr" in " ".join(entry.text for entry in scene.notes)
    assert len(emitters(scene, "constant")) == 1


# -- Pictures on rectangles


QUARTERS = np.array([[(1, 0, 0), (0, 1, 0)], [(0, 0, 1), (1, 1, 0)]], dtype=float)


def seen_from_front(scene, matrix):
    """Return what one sees of a picture's four quarters, the viewer upright in light space."""
    loaded, found = mi.load_dict(scene), np.zeros((2, 2, 3))
    for row in range(2):
        for column in range(2):
            # The front is at -Z: from there +Y is up and +X is to the left
            target = np.array([0.25 - 0.5 * column, 0.25 - 0.5 * row, 0, 1]) @ matrix
            origin = np.array([0.25 - 0.5 * column, 0.25 - 0.5 * row, -1, 1]) @ matrix
            ray = mi.Ray3f(origin[:3].tolist(), (target - origin)[:3].tolist())
            si = loaded.ray_intersect(ray)
            found[row, column] = np.array(si.emitter(loaded).eval(si))
    return found


def quarters_stage(load, tmp_path, matrix):
    pixels = np.repeat(np.repeat(QUARTERS, 8, axis=0), 8, axis=1)
    write_map(tmp_path, "quarters.exr", pixels)
    light = "asset inputs:texture:file = @quarters.exr@;float inputs:intensity = 2;"
    return load(f'def RectLight "screen" {{;{light}{matrix_op(matrix)}}}')


@pytest.mark.parametrize("name", ["turned", "scaled", "stretched", "mirrored x", "mirrored z"])
def test_picture_on_a_rectangle_is_as_in_its_file(load, tmp_path, name):
    matrix = row_matrix(LINEAR[name])
    found = seen_from_front(quarters_stage(load, tmp_path, matrix), matrix)
    assert found == pytest.approx(2 * QUARTERS, abs=1e-4)
    assert not np.allclose(found[:, ::-1], 2 * QUARTERS)


def test_mirrored_picture_is_caught_by_irradiance(load, tmp_path):
    """Each quarter lights the floor by its own solid angle; a mirrored picture gives others."""
    matrix = row_matrix(np.eye(3), (0.5, 0.3, 0.8))
    scene = quarters_stage(load, tmp_path, matrix)
    expected = np.zeros(3)
    for row in range(2):
        for column in range(2):
            shift = row_matrix(np.eye(3), (0.25 - 0.5 * column, 0.25 - 0.5 * row, 0)) @ matrix
            expected += 2 * QUARTERS[row, column] * seen(SURFACES["RectLight"](shift, 0.5, 0.5))
    images = irradiance(scene, spp=400)
    assert_same_mean(images, constant_image(expected), tile=8)
    with pytest.raises(AssertionError):
        assert_same_mean(images, constant_image(expected[[1, 0, 2]]))


# -- Cones


def cone(angle, softness=0.0, more=""):
    text = f"float inputs:shaping:cone:angle = {angle};"
    return text + f"float inputs:shaping:cone:softness = {softness};{more}"


@pytest.mark.parametrize("kind, facing", [("RectLight", 1.0), ("DiskLight", np.pi / 4)])
def test_cone_of_flat_lights(load, kind, facing):
    """At three quarters of a cone of softness .5 half of the light is left."""
    theta = np.radians(33.75)
    scene = load(f'def {kind} "a" {{;float inputs:intensity = 8;{cone(45, 0.5)}{placed(z=0)}}}')
    at = -100 * np.array([np.sin(theta), 0, np.cos(theta)])
    up = -at / 100
    expected = 8 * facing * np.cos(theta) * 0.5 / 100**2
    assert_irradiance(scene, expected, at=at, up=up, rounding=0.006, size=0.1)
    assert "cone" in note(scene, "cone")
    beyond = -100 * np.array([np.sin(0.8), 0, np.cos(0.8)])
    assert irradiance(scene, at=beyond, up=-beyond, spp=4, size=0.1).max() == 0


@pytest.mark.parametrize("softness", [0.0, 0.4])
@pytest.mark.parametrize("degrees", [5, 20, 27, 29, 35])
def test_cone_of_a_sphere(load, softness, degrees):
    theta = np.radians(degrees)
    text = f'def SphereLight "a" {{;float inputs:intensity = 8;{cone(30, softness)}{placed(z=0)}}}'
    scene = load(text)
    at = -100 * np.array([0, np.sin(theta), np.cos(theta)])
    x = np.clip((degrees - 30 * (1 - softness)) / max(30 * softness, 1e-9), 0, 1)
    expected = 8 * np.pi * 0.25 / 100**2 * (1 - x * x * (3 - 2 * x))
    images = irradiance(scene, at=at, up=-at, spp=4, seeds=range(2), size=0.1)
    assert images.mean() == pytest.approx(expected, rel=0.01, abs=1e-9)


def test_cone_of_a_cylinder_follows_its_profile(load):
    """The projected area of a tube falls with the sine of the angle from its axis."""
    theta = np.radians(40)
    light = f"float inputs:intensity = 8;{cone(60)}{placed(z=0)}"
    scene = load(f'def CylinderLight "a" {{;{light}}}')
    for side, factor in (((1, 0), np.cos(theta)), ((0, 1), 1.0)):
        at = -100 * np.array([*(np.sin(theta) * np.array(side)), np.cos(theta)])
        images = irradiance(scene, at=at, up=-at, spp=4, seeds=range(2), size=0.1)
        assert images.mean() == pytest.approx(8 * factor / 100**2, rel=0.01)


@pytest.mark.parametrize(
    "kind, text",
    [
        ("RectLight", cone(90)),
        ("DiskLight", cone(120, 0.5)),
        ("SphereLight", cone(180)),
        ("DistantLight", cone(20)),
        ("DomeLight", cone(20)),
    ],
)
def test_cones_that_hide_nothing_are_ignored_in_silence(load, kind, text):
    scene = load(f'def {kind} "a" {{;{text}}}')
    assert not emitters(scene, "spot")
    assert not note(scene, "cone")


def test_applied_shaping_without_an_angle_is_a_hemisphere(load):
    api = '(prepend apiSchemas = ["ShapingAPI"])'
    (spot,) = emitters(load(f'def SphereLight "a" {api} {{;}}'), "spot")
    assert spot["cutoff_angle"] == 90
    assert not emitters(load('def SphereLight "a" {;float inputs:shaping:focus;}'), "spot")


# -- Lights that are geometry


QUAD = """int[] faceVertexCounts = [4]; int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-0.5, 0.5, 0), (0.5, 0.5, 0), (0.5, -0.5, 0), (-0.5, -0.5, 0)];"""
"""A unit square that faces -Z."""

GLOW = """def Material "glow" { ; token outputs:surface.connect = </glow/shader.outputs:surface>
    def Shader "shader" { ; uniform token info:id = "UsdPreviewSurface"
        color3f inputs:emissiveColor = (1, 0.5, 0.25); color3f inputs:diffuseColor = (0, 0, 0)
        token outputs:surface; }
    };"""

BOUND = "rel material:binding = </glow>;"


def mesh_light(inputs, bound=True, api="MeshLightAPI"):
    apis = f'(prepend apiSchemas = ["{api}", "MaterialBindingAPI"])'
    return f'{GLOW};def Mesh "quad" {apis} {{;{QUAD}{inputs}{BOUND if bound else ""}}}'


def per_area():
    """Return the irradiance of a quad of radiance 1, five above the floor."""
    return seen(SURFACES["RectLight"](row_matrix(np.eye(3))))


@pytest.mark.parametrize(
    "inputs, bound, expected",
    [
        ("float inputs:intensity = 4;", True, (4, 2, 1)),
        ("float inputs:intensity = 4;", False, (4, 4, 4)),
        ('token light:materialSyncMode = "noMaterialResponse";', True, (1, 1, 1)),
        ("float inputs:exposure = 3;color3f inputs:color = (0, 1, 1);", True, (0, 4, 2)),
    ],
)
def test_mesh_light_has_one_emission(load, inputs, bound, expected):
    scene = load(mesh_light(inputs + placed(), bound))
    assert_irradiance(scene, per_area() * np.array(expected, dtype=float))
    assert bool(note(scene, "tint")) != bound


def test_mesh_light_is_normalized_by_its_area_in_the_world(load):
    matrix = row_matrix(np.diag([2.0, 1, 1]))
    text = "float inputs:intensity = 10;bool inputs:normalize = true;" + matrix_op(matrix)
    expected = 5 * seen(SURFACES["RectLight"](matrix)) * np.array([1, 0.5, 0.25])
    assert_irradiance(load(mesh_light(text)), expected)


@pytest.mark.parametrize("double", [False, True])
def test_back_of_a_mesh_light_shines_if_it_is_double_sided(load, double):
    flag = "uniform bool doubleSided = true;" if double else ""
    scene = load(mesh_light(placed(turn=180) + flag, bound=False))
    if double:
        assert_irradiance(scene, per_area(), rounding=0.002)
    else:
        assert irradiance(scene, spp=4, seeds=range(1)).max() == 0


def test_glowing_material_shines_without_a_light(load):
    scene = load(f'{GLOW};def Mesh "quad" {{;{QUAD}{BOUND}{placed()}}}')
    assert_irradiance(scene, per_area() * np.array([1, 0.5, 0.25]))
    assert not note(scene, "no light")


def test_geometry_light_makes_its_geometry_shine(load):
    light = 'def GeometryLight "light" {;rel geometry = </quad>;float inputs:intensity = 6;}'
    scene = load(f'{light};def Mesh "quad" {{;{QUAD}{placed()}}}')
    assert_irradiance(scene, 6 * per_area())
    assert "/none" in note(load(light.replace("/quad", "/none")), "geometry light")


def geometry_lights(*inputs):
    """Return the text of GeometryLights on /quad, each with its inputs."""
    text = 'def GeometryLight "l{}" {{;rel geometry = </quad>;{}}};'
    return "".join(text.format(index, part) for index, part in enumerate(inputs))


def test_lights_of_one_geometry_add_up(load):
    matrix = row_matrix(np.diag([2.0, 1, 1]))
    lights = geometry_lights(
        "float inputs:intensity = 6;",
        "float inputs:intensity = 3;color3f inputs:color = (0, 1, 0);",
        "float inputs:intensity = 8;bool inputs:normalize = true;",
        "float inputs:intensity = 0;",
    )
    scene = load(f'{lights}def Mesh "quad" {{;{QUAD}{matrix_op(matrix)}}}')
    # 6 of the first, 8 over an area of 2 of the third
    assert_irradiance(scene, seen(SURFACES["RectLight"](matrix)) * np.array([10, 13, 10]))
    assert not note(scene, "geometry light")


def test_a_mesh_light_and_those_that_point_to_it_add_up(load):
    lights = geometry_lights("float inputs:intensity = 6;")
    scene = load(lights + mesh_light("float inputs:intensity = 4;" + placed(), bound=True))
    assert_irradiance(scene, per_area() * np.array([10, 8, 7]))


def test_lights_that_point_to_a_light_with_a_picture_are_noted(load, tmp_path):
    mi.Bitmap(np.full((2, 2, 3), 2.0, np.float32)).write(str(tmp_path / "p.exr"))
    text = mesh_light(placed()).replace(
        "color3f inputs:emissiveColor = (1, 0.5, 0.25)",
        "color3f inputs:emissiveColor.connect = </glow/picture.outputs:rgb>",
    )
    picture = 'def Shader "picture" { ; uniform token info:id = "UsdUVTexture"'
    picture += "; asset inputs:file = @p.exr@; color3f outputs:rgb; }"
    text = text.replace('def Shader "shader"', f'{picture}; def Shader "shader"')
    scene = load(text)
    assert_irradiance(scene, per_area() * np.array([2, 2, 2]))
    scene = load(geometry_lights("float inputs:intensity = 6;") + text)
    assert_irradiance(scene, per_area() * np.array([2, 2, 2]))
    assert "/quad" in note(scene, "geometry light")


# -- What cannot be carried over


@pytest.mark.parametrize(
    "attributes, kind, word",
    [
        ("asset inputs:shaping:ies:file = @bulb.ies@;", "ies", "ies"),
        ("float inputs:shaping:focus = 3;", "focus", "focus"),
        ("float inputs:diffuse = 0.5;", "diffuse", "diffuse"),
        ("float inputs:specular = 0;", "specular", "specular"),
        ("rel light:filters = </filter>;", "filter", "filter"),
        ("rel collection:lightLink:includes = </x>;", "link", "link"),
        ("bool inputs:shadow:enable = false;", "shadow", "shadow"),
    ],
)
def test_one_note_a_kind(load, attributes, kind, word):
    lights = [f'def SphereLight "light_{index}" {{;{attributes}}}' for index in range(3)]
    scene = load(";".join(lights))
    text = note(scene, kind)
    assert word in text
    assert "3 times" in text and "/light_0" in text
    assert len(emitters(scene, "sphere")) == 3
    text = note(load(lights[1]), kind)
    assert word in text
    assert re.search(r"\b1 time\b", text) and "/light_1" in text


@pytest.mark.parametrize("attributes", ["rel light:filters;", "float inputs:diffuse = 1;"])
def test_nothing_is_noted_where_nothing_is_lost(load, attributes):
    scene = load(f'def SphereLight "light" {{;{attributes}}}')
    assert {entry.kind for entry in scene.notes} == {"no camera", "no geometry"}


def test_stage_without_light(load):
    text = f'def Mesh "quad" {{;{QUAD}}}'
    scene = load(text)
    assert "without default_light=True" in note(scene, "no light")
    scene = load(text, default_light=True)
    assert color(emitters(scene, "constant")[0]["radiance"]) == pytest.approx([1] * 3)
    assert re.search("constant environment", note(scene, "no light"))
    lit = load(f'def SphereLight "light" {{;}};{text}', default_light=True)
    assert not emitters(lit, "constant")


@pytest.mark.parametrize("kind", ["RectLight", "DiskLight", "CylinderLight"])
def test_light_without_area_is_noted(load, kind):
    lengths = "float inputs:width = 0;float inputs:radius = 0;"
    scene = load(f'def {kind} "light" {{;{lengths}bool inputs:normalize = true;}}')
    assert "/light" in note(scene, "area")
    assert note(scene, "no light")


def test_mesh_light_keeps_the_colors_that_it_reflects(load):
    """A tinted light without a material reflects with its displayColor."""
    more = 'color3f[] primvars:displayColor = [(0.2, 0.4, 0.6)] (interpolation = "constant");'
    scene = load(mesh_light(placed() + more, bound=False))
    assert_irradiance(scene, per_area())


def test_emissive_picture(load, tmp_path):
    """A picture of four quarters on a mesh, with texture coordinates: its mean lights the floor."""
    pixels = np.repeat(np.repeat(QUARTERS, 8, axis=0), 8, axis=1)
    write_map(tmp_path, "quarters.exr", pixels)
    glow = """def Material "glow" { ; token outputs:surface.connect = </glow/shader.outputs:surface>
        def Shader "shader" { ; uniform token info:id = "UsdPreviewSurface"
            color3f inputs:emissiveColor.connect = </glow/image.outputs:rgb>
            color3f inputs:diffuseColor = (0, 0, 0); token outputs:surface; }
        def Shader "image" { ; uniform token info:id = "UsdUVTexture"
            asset inputs:file = @quarters.exr@; float3 outputs:rgb
            float2 inputs:st.connect = </glow/st.outputs:result>; }
        def Shader "st" { ; uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"; float2 outputs:result; } };"""
    st = "texCoord2f[] primvars:st = [(1, 1), (0, 1), (0, 0), (1, 0)]"
    st += ' (interpolation = "vertex");'
    quad = QUAD.replace("0.5", "0.005")
    scene = load(f'{glow};def Mesh "quad" {{;{quad}{st}{BOUND}{placed(z=0.5)}}}')
    expected = 1e-4 / 0.25 * QUARTERS.mean(axis=(0, 1))
    assert_irradiance(scene, expected, rounding=0.005, size=0.001)


def test_plain_light_on_a_mesh_ignores_its_material(load):
    """LightAPI alone has no response of the material, MeshLightAPI tints."""
    scene = load(mesh_light("float inputs:intensity = 4;" + placed(), api="LightAPI"))
    assert_irradiance(scene, 4 * per_area())


def test_subset_that_glows(load):
    """Of two squares the one in the subset emits: its flux is pi times radiance and area."""
    mesh = """def Mesh "pair" { ; int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 4, 5, 6, 7]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0),
            (2, 0, 0), (3, 0, 0), (3, 1, 0), (2, 1, 0)]
        def GeomSubset "part" (prepend apiSchemas = ["MaterialBindingAPI"]) { ;
            uniform token elementType = "face"; uniform token familyName = "materialBind"
            int[] indices = [1]; rel material:binding = </glow>; } };"""
    scene = mi.load_dict(load(GLOW.replace("(1, 0.5, 0.25)", "(5, 5, 5)") + ";" + mesh))
    shining = [shape for shape in scene.shapes() if shape.is_emitter()]
    radiance = [shape.emitter().eval(front_of(shape))[0] for shape in shining]
    assert radiance == pytest.approx([5])
    assert sum(shape.surface_area() for shape in shining) == pytest.approx(1)
    assert sum(shape.surface_area() for shape in scene.shapes()) == pytest.approx(2)


@pytest.mark.parametrize("unit", [1, 0.01])
def test_units_of_length_change_nothing(load, unit):
    scene = load(f'def SphereLight "a" {{;{placed()}}}', {"metersPerUnit": unit})
    (part,) = emitters(scene, "sphere")
    assert (part["radius"], part["center"]) == (0.5, [0, 0, 5])
    assert color(part["emitter"]["radiance"]) == pytest.approx([1] * 3)
    assert scene.metadata["metersPerUnit"] == pytest.approx(unit)


def test_connected_inputs(load):
    """An input may get its value from that of a node graph; a shader's result is noted."""
    graph = """def NodeGraph "dimmer" { ; float inputs:level = 9; };
        def Shader "noise" { ; uniform token info:id = "noise"; color3f outputs:rgb; };"""
    light = "float inputs:intensity.connect = </dimmer.inputs:level>;"
    light += (
        "color3f inputs:color = (1, 0.5, 0);color3f inputs:color.connect = </noise.outputs:rgb>;"
    )
    scene = load(f'{graph};def SphereLight "a" {{;{light}}}')
    (part,) = emitters(scene, "sphere")
    assert color(part["emitter"]["radiance"]) == pytest.approx([9, 4.5, 0])
    assert "inputs:color" in note(scene, "connection")


@pytest.mark.parametrize("kind, z", [("RectLight", 2.0), ("DiskLight", 2.0), ("SphereLight", 5.0)])
def test_cone_from_near(load, kind, z):
    """Spots stand for a light to a few percent, also near its soft edge."""
    matrix = row_matrix(np.eye(3), (0.25 * z, 0.2 * z, z))
    scene = load(f'def {kind} "a" {{;{cone(40, 0.8)}{matrix_op(matrix)}}}')
    points, normals = SURFACES[kind](matrix)
    theta = np.arccos(points[:, 2] / np.linalg.norm(points, axis=1))
    x = np.clip((theta - np.radians(8)) / np.radians(32), 0, 1)
    shaped = points, normals * (1 - x * x * (3 - 2 * x))[:, None]
    assert_irradiance(scene, seen(shaped), rounding=0.025, spp=4, seeds=range(2))

"""Cameras and render settings of USD stages."""

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Usd, UsdGeom

from tests.test_usd_lights import note
from tests.usd_stages import matrix_op, placed, write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")


@pytest.fixture
def load(tmp_path, plugin):
    """A function that loads a stage given as text."""
    from manylights import usd

    def load_text(text, metadata=None, **options):
        return usd.load(write_stage(tmp_path, text, **(metadata or {})), **options)

    return load_text


LIGHT = 'def SphereLight "light" {;};'


def camera(more="", name="camera", place=""):
    return f'def Camera "{name}" {{;{more}{place or placed(z=0)}}};'


def ray(scene, x, y, aperture=(0.5, 0.5)):
    """Return the ray through a place of the film, (0, 0) at its top left."""
    sensor = mi.load_dict(scene).sensors()[0]
    found, _ = sensor.sample_ray(0, 0.5, [x, y], list(aperture))
    return np.array(found.o), np.array(found.d)


def expected_ray(prim_camera, x, y):
    """Return the same by usd-core's frustum."""
    frustum = prim_camera.GetCamera(Usd.TimeCode.Default()).frustum
    found = frustum.ComputePickRay(Gf.Vec2d(2 * x - 1, 1 - 2 * y))
    return np.array(found.startPoint), np.array(found.direction)


@pytest.mark.parametrize(
    "more",
    [
        "",
        "float focalLength = 20;",
        "float horizontalApertureOffset = 2.0955;",
        "float verticalApertureOffset = -3;float horizontalAperture = 36;",
        'token projection = "orthographic";float horizontalAperture = 40;',
        'token projection = "orthographic";float verticalApertureOffset = 5;',
    ],
)
@pytest.mark.parametrize("linear", ["straight", "turned and scaled"])
def test_rays_are_those_of_the_frustum(tmp_path, load, more, linear):
    matrix = np.eye(4)
    if linear != "straight":
        rotation = Gf.Matrix3d(Gf.Rotation(Gf.Vec3d(1, 2, 0.5), 50))
        matrix[:3, :3] = 3 * np.array(rotation)
        matrix[3, :3] = (4, -2, 7)
    scene = load(LIGHT + camera(more, place=matrix_op(matrix)))
    film = scene["sensor"]["film"]
    stage = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/camera"))
    attributes = prim.GetHorizontalApertureAttr(), prim.GetVerticalApertureAttr()
    aspect = attributes[0].Get() / attributes[1].Get()
    assert film["width"] / film["height"] == pytest.approx(aspect, rel=2e-3)
    for x, y in ((0.5, 0.5), (0.1, 0.2), (0.9, 0.7)):
        origin, direction = ray(scene, x, y)
        start, toward = expected_ray(prim, x, y)
        assert direction == pytest.approx(toward, abs=2e-3)
        if "orthographic" in more and linear == "straight":
            across = origin - start
            assert across[:2] == pytest.approx((0, 0), abs=2e-3)


@pytest.mark.parametrize(
    "policy, width, height, horizontal",
    [
        ("", 200, 100, 30.5816),
        ("", 100, 200, 20.955),
        ("cropAperture", 200, 100, 20.955),
        ("cropAperture", 100, 200, 7.6454),
        ("adjustApertureWidth", 200, 100, 30.5816),
        ("adjustApertureWidth", 100, 200, 7.6454),
        ("adjustApertureHeight", 200, 100, 20.955),
        ("adjustApertureHeight", 100, 200, 20.955),
    ],
)
def test_aperture_conforms_to_the_resolution(load, policy, width, height, horizontal):
    more = f'token aspectRatioConformPolicy = "{policy}";' if policy else ""
    settings = f'def RenderSettings "s" {{;int2 resolution = ({width}, {height});{more}}}'
    sensor = load(LIGHT + camera() + settings)["sensor"]
    assert (sensor["film"]["width"], sensor["film"]["height"]) == (width, height)
    expected = np.degrees(2 * np.arctan(horizontal / 100))
    assert sensor["fov"] == pytest.approx(expected, rel=1e-5)


def test_depth_of_field(load):
    more = "float fStop = 2;float focusDistance = 7;float focalLength = 50;"
    scene = load(LIGHT + camera(more))
    sensor = scene["sensor"]
    assert sensor["type"] == "thinlens"
    # Tenths of a unit: a lens of 5 units at f/2 is 2.5 units wide
    assert sensor["aperture_radius"] == pytest.approx(1.25)
    assert sensor["focus_distance"] == 7
    left, right = (ray(scene, 0.5, 0.5, place) for place in ((0.1, 0.5), (0.9, 0.5)))
    meet = [(o + d * (-7 - o[2]) / d[2])[:2] for o, d in (left, right)]
    assert meet[0] == pytest.approx(meet[1], abs=1e-3)
    assert abs(left[0][0] - right[0][0]) > 0.1


@pytest.mark.parametrize("more", ["float fStop = 0;", "float fStop = 2;float focusDistance = 0;"])
def test_everything_in_focus(load, more):
    scene = load(LIGHT + camera(more))
    assert scene["sensor"]["type"] == "perspective"
    assert bool(note(scene, "focusDistance")) == ("focusDistance" in more)


def test_clipping_range_counts_where_it_is_authored(load):
    sensor = load(LIGHT + camera("float2 clippingRange = (0.5, 70);"))["sensor"]
    assert (sensor["near_clip"], sensor["far_clip"]) == (0.5, 70)
    sensor = load(LIGHT + camera())["sensor"]
    assert sensor["near_clip"] < 0.01
    scene = load(LIGHT + camera("float2 clippingRange = (-1, 0);"))
    assert "/camera" in note(scene, "clippingRange")
    mi.load_dict(scene)


def test_exposure_is_a_factor_beside_the_scene(load):
    more = "float exposure:iso = 200;float exposure:time = 0.5;float exposure = 1;"
    more += "float exposure:fStop = 2;float exposure:responsivity = 3;"
    assert load(LIGHT + camera(more)).exposure == pytest.approx(0.5 * 2 * 2 * 3 / 4)
    assert load(LIGHT + camera()).exposure == 1


def test_choice_of_a_camera(load):
    cameras = camera(name="first") + camera(name="second")
    scene = load(LIGHT + cameras)
    assert scene.camera == "/first"
    assert "/second" in note(scene, "cameras")
    scene = load(LIGHT + cameras, camera="/second")
    assert scene.camera == "/second" and not note(scene, "cameras")
    settings = 'def RenderSettings "s" {;rel camera = </second>;}'
    assert load(LIGHT + cameras + settings).camera == "/second"
    scene = load(LIGHT + cameras + settings.replace("/second", "/nowhere"))
    assert scene.camera == "/first" and "/nowhere" in note(scene, "settings camera")


@pytest.mark.parametrize("path", ["/nowhere", "/light", "no path!"])
def test_camera_that_is_none(load, path):
    with pytest.raises(ValueError, match=f"{path}.*/camera"):
        load(LIGHT + camera(), camera=path)


@pytest.mark.parametrize("axis", ["Y", "Z"])
def test_stage_without_camera_is_framed(load, axis):
    points = "(100, 20, 3), (104, 20, 3), (104, 22, 5), (100, 22, 5)"
    mesh = f"""def Mesh "quad" {{ ; int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]; point3f[] points = [{points}]; }};"""
    scene = load(LIGHT + mesh, {"upAxis": axis})
    assert scene.camera is None and note(scene, "no camera")
    sensor = mi.load_dict(scene).sensors()[0]
    to_local = np.linalg.inv(np.array(sensor.world_transform().matrix))
    corners = np.array([(100, 20, 3, 1), (104, 22, 5, 1), (100, 22, 5, 1)]) @ to_local.T
    slope = np.tan(np.radians(45 / 2))
    assert (np.abs(corners[:, 0]) < slope * corners[:, 2]).all()
    assert (np.abs(corners[:, 1]) < slope * 0.75 * corners[:, 2]).all()
    up = np.array(sensor.world_transform().matrix)[:3, 1]
    assert up["XYZ".index(axis)] > 0.5


def test_clipping_planes_are_noted(load):
    scene = load(LIGHT + camera("float4[] clippingPlanes = [(0, 0, 1, 5)];"))
    assert "/camera" in note(scene, "clippingPlanes")
    assert not note(load(LIGHT + camera()), "clippingPlanes")


@pytest.mark.parametrize("attribute", ["focalLength", "horizontalAperture", "verticalAperture"])
@pytest.mark.parametrize("value", ["0", "-1", "nan"])
def test_broken_cameras_are_noted(load, attribute, value):
    scene = load(LIGHT + camera(f"float {attribute} = {value};"))
    assert "/camera" in note(scene, f"camera {attribute}")
    mi.load_dict(scene)


def test_camera_without_size(load):
    matrix = np.diag([0.0, 0, 0, 1])
    with pytest.raises(ValueError, match="/camera"):
        load(LIGHT + camera(place=matrix_op(matrix)))


def test_settings_for_mitsuba(load):
    settings = """def RenderSettings "s" { ; string mitsuba:integrator:type = "aov"
        string mitsuba:integrator:aovs = "depth:depth"
        string mitsuba:integrator:inner:type = "path"; int mitsuba:integrator:inner:max_depth = 3
        bool mitsuba:integrator:inner:hide_emitters = true; int mitsuba:sample_count = 7
        int2 resolution = (32, 16); };"""
    scene = load(LIGHT + camera() + settings)
    inner = {"type": "path", "max_depth": 3, "hide_emitters": True}
    assert scene["integrator"] == {"type": "aov", "aovs": "depth:depth", "inner": inner}
    assert scene["sensor"]["sampler"]["sample_count"] == 7
    mi.load_dict(scene)
    assert load(LIGHT + camera())["integrator"] == {"type": "manylights_volpath"}


def test_several_settings_need_the_stage_to_choose(load):
    two = "".join(f'def RenderSettings "{name}" {{;int2 resolution = ({size}, 8);}};'
                  for name, size in (("a", 16), ("b", 24)))  # fmt: skip
    scene = load(LIGHT + camera() + two)
    assert "2" in note(scene, "settings")
    scene = load(LIGHT + camera() + two, {"renderSettingsPrimPath": "/b"})
    assert scene["sensor"]["film"]["width"] == 24
    scene = load(LIGHT + camera() + two, {"renderSettingsPrimPath": "/c"})
    assert "/c" in note(scene, "settings")


def test_a_product_is_stronger_than_its_settings(load):
    """What it has no opinion about is that of the settings."""
    product = 'def RenderProduct "NAME" {;rel camera = </NAME_camera>;int2 resolution = (24, 8);};'
    products = product.replace("NAME", "p") + product.replace("NAME", "q")
    settings = """def RenderSettings "s" { ; rel camera = </camera>; int2 resolution = (32, 16)
        token aspectRatioConformPolicy = "cropAperture"; rel products = PRODUCTS };"""
    text = LIGHT + "".join(camera(name=name) for name in ("camera", "q_camera", "p_camera"))
    text += products + settings
    scene = load(text.replace("PRODUCTS", "</p>"))
    assert scene.camera == "/p_camera"
    assert scene["sensor"]["film"]["width"] == 24
    assert scene["sensor"]["fov"] == pytest.approx(np.degrees(2 * np.arctan(20.955 / 100)))
    assert not note(scene, "products")
    scene = load(text.replace("PRODUCTS", "[</q>, </p>]"))
    assert scene.camera == "/q_camera" and "/q" in note(scene, "products")
    assert load(text.replace("PRODUCTS", "[</none>, </camera>]")).camera == "/camera"


def test_settings_that_disable_depth_of_field(load):
    lens = "float fStop = 2;float focusDistance = 7;float horizontalApertureOffset = 2;"
    settings = 'def RenderSettings "s" {;bool disableDepthOfField = 1;}'
    sensor = load(LIGHT + camera(lens) + settings)["sensor"]
    assert sensor["type"] == "perspective" and "principal_point_offset_x" in sensor
    sensor = load(LIGHT + camera(lens) + settings.replace("= 1", "= 0"))["sensor"]
    assert sensor["type"] == "thinlens"


@pytest.mark.parametrize("purposes", [("default", "render"), ("render", "default")])
def test_purposes_of_settings_are_noted_where_others_are_read(load, purposes):
    settings = 'def RenderSettings "s" {;uniform token[] includedPurposes = ["default", "render"];}'
    scene = load(LIGHT + camera() + settings, purposes=purposes)
    assert not note(scene, "includedPurposes")
    scene = load(LIGHT + camera() + settings, purposes=("default",))
    assert "default, render" in note(scene, "includedPurposes")
    scene = load(
        LIGHT + camera() + settings.replace("token[]", "int").replace('["default", "render"]', "3")
    )
    assert not note(scene, "includedPurposes")


@pytest.mark.parametrize("value", ["(0, 5)", "(-3, 5)", "(1000000, 1)"])
def test_resolution_out_of_range_is_noted(load, value):
    settings = f'def RenderSettings "s" {{;int2 resolution = {value};}}'
    scene = load(LIGHT + camera() + settings)
    assert "/s" in note(scene, "resolution")
    assert scene["sensor"]["film"]["width"] == 960


def test_camera_moves_with_time(load):
    move = "double3 xformOp:translate.timeSamples = { 1: (0, 0, 1), 2: (0, 0, 2) };"
    move += 'uniform token[] xformOpOrder = ["xformOp:translate"];'
    for time, z in ((None, 1), (1.5, 1.5), (2, 2)):
        origin, _ = ray(load(LIGHT + camera(place=move), time=time), 0.5, 0.5)
        assert origin[2] == pytest.approx(z, abs=0.01)


@pytest.mark.parametrize("axis", ["X", "up"])
def test_other_up_axes_are_noted(load, axis):
    scene = load(LIGHT, {"upAxis": axis})
    assert axis in note(scene, "upAxis")
    assert scene.metadata["upAxis"] == "Y"


def test_sensor_for_mitsuba(load):
    lens = "float fStop = 2;float focusDistance = 7;"
    pinhole = 'string mitsuba:sensor:type = "perspective";'
    tent = 'string mitsuba:sensor:film:pixel_filter:type = "tent";'
    scene = load(LIGHT + camera(lens + pinhole + tent))
    assert scene["sensor"]["type"] == "perspective"
    assert scene["sensor"]["film"]["rfilter"] == {"type": "tent"}
    mi.load_dict(scene)
    scene = load(
        LIGHT + camera(tent.replace("tent", "round") + pinhole.replace("persp", "retrosp"))
    )
    assert "retrospective" in note(scene, "sensor") and "round" in note(scene, "filter type")
    mi.load_dict(scene)

"""Instances of USD stages: what shines shines in each place, the rest becomes Mitsuba instances."""

import itertools
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from tests.statistics_tools import assert_same_mean
from tests.test_usd_lights import BOUND, GLOW, QUAD, emitters, note
from tests.usd_stages import assert_irradiance, constant_image, irradiance, placed, write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")

POINT = "bool treatAsPoint = true;bool inputs:normalize = true;float inputs:intensity = 400;"
"""A point light of radiant intensity 100."""


@pytest.fixture
def load(tmp_path, plugin):
    """A function that loads a stage given as text."""
    from manylights import usd

    def load_text(text, **options):
        return usd.load(write_stage(tmp_path, text), **options)

    return load_text


def instancer(places, more="", prototypes=None, name="lamps", indices=None):
    """Return a point instancer of a point light below it."""
    positions = ", ".join(str(tuple(map(float, place))) for place in places)
    indices = [0] * len(places) if indices is None else indices
    inside = f'def SphereLight "bulb" {{;{POINT}}}' if prototypes is None else ""
    targets = prototypes or f"</{name}/bulb>"
    return (
        f'def PointInstancer "{name}" {{;point3f[] positions = [{positions}];'
        f"int[] protoIndices = {list(indices)};rel prototypes = {targets};{more}{inside}}}"
    )


def from_points(places, at=(0.0, 0.0, 0.0)):
    """Return the irradiance of points of radiant intensity 100 on a floor that faces up."""
    offsets = np.asarray(places, dtype=float) - at
    squares = (offsets**2).sum(axis=1)
    return 100 * (np.maximum(offsets[:, 2], 0) / squares**1.5).sum()


PLACES = [(0, 0, 4), (3, 1, 5), (-2, 2, 6), (1, -4, 3)]


def positions_of(scene, kind="point"):
    return sorted(tuple(np.round(part["position"], 4)) for part in emitters(scene, kind))


def test_lights_in_an_instancer_shine_each_at_its_place(load):
    scene = load(instancer(PLACES))
    assert positions_of(scene) == sorted(PLACES)
    assert_irradiance(scene, from_points(PLACES))
    images = irradiance(scene)
    with pytest.raises(AssertionError):
        assert_same_mean(images, constant_image(from_points(PLACES[1:])))


@pytest.mark.parametrize(
    "mask",
    [
        "int64[] invisibleIds = [1, 3];",
        "int64[] ids = [7, 8, 9, 10];int64[] invisibleIds = [8, 10];",
    ],
)
def test_mask_drops_instances_and_not_prototypes(load, mask):
    """Masked arrays are shorter than the indices: which prototype an instance has must stay."""
    other = 'def SphereLight "other" {;bool treatAsPoint = true;float inputs:intensity = 0.001;}'
    text = instancer(PLACES, mask + other, "[</lamps/other>, </lamps/bulb>]", indices=[0, 1, 1, 1])
    text = text[:-1] + f'def SphereLight "bulb" {{;{POINT}}};}}'
    scene = load(text)
    bright = [part for part in emitters(scene, "point") if part["intensity"]["value"][0] > 1]
    assert [tuple(np.round(part["position"])) for part in bright] == [PLACES[2]]
    assert len(emitters(scene, "point")) == 2


def test_inactive_ids(tmp_path):
    from manylights import usd

    path = write_stage(tmp_path, instancer(PLACES))
    stage = Usd.Stage.Open(str(path))
    UsdGeom.PointInstancer(stage.GetPrimAtPath("/lamps")).DeactivateIds([0, 2])
    stage.Save()
    assert positions_of(usd.load(path)) == sorted([PLACES[1], PLACES[3]])


def test_orientations_and_scales_place_what_is_inside_of_a_prototype(load):
    """A prototype's root transform counts, that of its ancestors does not."""
    bulb = f'def SphereLight "bulb" {{;{POINT}{placed(x=1, z=0)}}}'
    inside = f'def Xform "away" {{;{placed(x=50)}def Xform "lamp" {{;{placed(z=2)}{bulb}}};}}'
    more = "quath[] orientations = [(0.7071, 0, 0, 0.7071)];float3[] scales = [(2, 2, 2)];"
    text = instancer([(1, 1, 1)], more, "</lamps/away/lamp>")
    scene = load(text[:-1] + inside + "}")
    # A quarter around Z takes (1, 0, 2) times 2 to (0, 2, 4)
    assert positions_of(scene) == [pytest.approx((1, 3, 5), abs=2e-3)]


def test_nested_instancers_multiply(load):
    inner = instancer([(0, 0, 0), (1, 0, 0)], name="inner").replace("</inner", "</outer/inner")
    outer = instancer([(0, 0, 3), (0, 5, 3), (0, 10, 3)], prototypes="</outer/inner>", name="outer")
    scene = load(outer[:-1] + inner + "}")
    expected = [(x, y, 3) for x in (0, 1) for y in (0, 5, 10)]
    assert positions_of(scene) == sorted(expected)


def test_prototypes_are_not_drawn_themselves_below_their_instancer(load):
    assert positions_of(load(instancer([]))) == []
    outside = f'def SphereLight "bulb" {{;{POINT}}}'
    text = instancer([(0, 0, 3)], prototypes="</bulb>") + ";"
    assert positions_of(load(text + outside)) == [(0, 0, 0), (0, 0, 3)]
    over = f'over "bulbs" {{;{outside}}}'
    text = text.replace("</bulb>", "</bulbs/bulb>")
    assert positions_of(load(text + over)) == [(0, 0, 3)]
    assert positions_of(load(text + over.replace("over", "class"))) == [(0, 0, 3)]


def test_visibility_of_prototypes_and_instancers(load):
    hidden = 'token visibility = "invisible";'
    assert positions_of(load(instancer(PLACES).replace(POINT, POINT + hidden))) == []
    assert positions_of(load(instancer(PLACES, hidden))) == []
    # What is above a prototype does not count
    scope = f'def Scope "bulbs" {{;{hidden}def SphereLight "bulb" {{;{POINT}}};}};'
    assert len(positions_of(load(scope + instancer(PLACES, prototypes="</bulbs/bulb>")))) == 4


@pytest.mark.parametrize(
    "text, kind",
    [
        (instancer(PLACES, prototypes="</nowhere>"), "prototype"),
        (instancer(PLACES, indices=[0, 0, 7, -1]), "instance"),
        (instancer(PLACES, indices=[0, 0]), "instancer"),
        (instancer(PLACES, "float3[] scales = [(1, 1, 1)];"), "instancer"),
        (instancer([(float("nan"), 0, 0)]), "instance"),
        (instancer(PLACES, prototypes="</lamps>"), "cycle"),
    ],
)
def test_broken_instancers_are_noted(load, text, kind):
    assert "/lamps" in note(load(text), kind)


LAMP = f"""class "_lamp" {{
    def Xform "arm" {{ ; {placed(z=2)} def SphereLight "bulb" {{ ; {POINT} }}
    def Mesh "shade" {{ ; {QUAD} }} }} }}"""


def native(places, more=""):
    """Return native instances of a lamp with a shade."""
    header = "(instanceable = true;inherits = </_lamp>)"
    return LAMP + "".join(
        f';def Xform "lamp_{index}" {header} {{;{placed(*place)}{more}}}'
        for index, place in enumerate(places)
    )


def test_lights_in_native_instances_shine(load):
    scene = load(native(PLACES))
    assert positions_of(scene) == sorted((x, y, z + 2) for x, y, z in PLACES)


def test_what_does_not_shine_becomes_instances(load):
    scene = load(native(PLACES))
    assert len(emitters(scene, "instance")) == len(PLACES)
    (group,) = emitters(scene, "shapegroup")
    assert isinstance(group["shape_0"], mi.Mesh)
    loaded = mi.load_dict(scene)
    for x, y, z in PLACES:
        ray = mi.Ray3f([x + 0.1, y + 0.2, z + 10.0], [0, 0, -1])
        assert loaded.ray_intersect(ray).t == pytest.approx(8)


def test_instances_with_another_material_are_another_group(load):
    glowing = native(PLACES[:2]) + ";" + GLOW
    bound = native(PLACES[2:], BOUND).replace(LAMP, "").replace("lamp_", "glowing_")
    scene = load(glowing + bound)
    assert len(emitters(scene, "instance")) == 2
    shining = [shape for shape in mi.load_dict(scene).shapes() if shape.is_emitter()]
    assert sum(shape.surface_area() for shape in shining) == pytest.approx(2)


def test_prototypes_may_be_native_instances(load):
    text = instancer(PLACES, prototypes="</lamps/lamp_0>")
    scene = load(text[:-1] + native([(0, 0, 0)]).replace(LAMP, "") + "};" + LAMP)
    assert positions_of(scene) == sorted((x, y, z + 2) for x, y, z in PLACES)
    assert len(emitters(scene, "instance")) == 4


def test_nested_native_instances(load):
    street = native(PLACES[:2]).replace(LAMP + ";", "").replace("/_lamp", "/_lamp")
    street = f'class "_street" {{;{street}}};'
    rows = "".join(
        f'def Xform "row_{y}" (instanceable = true;inherits = </_street>) {{;{placed(y=y, z=0)}}};'
        for y in (0, 20)
    )
    scene = load(LAMP + ";" + street + rows)
    expected = [(x, y + row, z + 2) for x, y, z in PLACES[:2] for row in (0, 20)]
    assert positions_of(scene) == sorted(expected)
    assert len(emitters(scene, "instance")) == 4


def test_shining_meshes_are_drawn_in_each_place(load):
    glowing = f'{GLOW};def Xform "bulbs" {{;def Mesh "bulb" {{;{QUAD}{BOUND}}};}};'
    scene = load(glowing + instancer(PLACES, prototypes="</bulbs/bulb>"))
    shining = [shape for shape in mi.load_dict(scene).shapes() if shape.is_emitter()]
    assert sum(shape.surface_area() for shape in shining) == pytest.approx(5)
    assert not emitters(scene, "instance")


def test_normalized_instances_share_no_area(load):
    """Twice the size gives a quarter of the radiance: each instance has the same power."""
    light = 'def RectLight "bulb" {;bool inputs:normalize = true;}'
    scales = "float3[] scales = [(1, 1, 1), (2, 2, 2), (3, 1, 1), (1, 1, 5)];"
    text = instancer(PLACES, scales, "</lamps/bulb>")
    scene = load(text[:-1] + light + "}")
    values = [part["emitter"]["radiance"]["value"][0] for part in emitters(scene, "rectangle")]
    assert sorted(values) == pytest.approx([1 / 4, 1 / 3, 1, 1])


def test_purposes_and_activation(load):
    lights = "".join(
        f'def Xform "{purpose}" {{;uniform token purpose = "{purpose}";'
        f'def SphereLight "bulb" {{;{POINT}{placed(x=index)}}};}};'
        for index, purpose in enumerate(("default", "render", "proxy", "guide"))
    )
    off = f'def SphereLight "off" (active = false) {{;{POINT}}}'
    assert [x for x, _, _ in positions_of(load(lights + off))] == [0, 1]
    scene = load(lights + off, purposes=("default", "proxy"))
    assert [x for x, _, _ in positions_of(scene)] == [0, 2]


PURPOSES = ("default", "render", "proxy", "guide")
HIDING = '(prepend apiSchemas = ["VisibilityAPI"]) {;uniform token renderVisibility = "invisible";'


def test_purposes_are_hidden_as_usd_computes(tmp_path):
    from manylights import usd

    opinions = (None, "inherited", "invisible", "visible")
    parts = []
    for outer, inner, purpose in itertools.product(opinions, opinions, PURPOSES):
        light = f'def SphereLight "bulb" {{;{POINT}{placed(x=len(parts))}}};'
        for opinion in (inner, outer):
            api = '(prepend apiSchemas = ["VisibilityAPI"])' if opinion else ""
            value = f'uniform token {purpose}Visibility = "{opinion}";' if opinion else ""
            light = f'def Xform "inside" {api} {{;{value}{light}}};'
        own = f'uniform token purpose = "{purpose}";'
        parts.append(f'def Xform "x{len(parts)}" {{;{own}{light}}};')
    path = write_stage(tmp_path, "".join(parts))
    expected = []
    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        imageable = UsdGeom.Imageable(prim)
        if prim.IsA(UsdLux.SphereLight):
            purpose = imageable.ComputePurpose()
            # Guides are hidden there if nobody says otherwise; who asks for them wants them
            drawn = imageable.ComputeEffectiveVisibility(purpose) != "invisible"
            expected.append(drawn or (purpose == "guide" and not _has_opinion(prim)))
    assert expected.count(False) == 3 * 5 and len(expected) == 64
    scene = usd.load(path, purposes=PURPOSES)
    assert [x for x, _, _ in positions_of(scene)] == np.flatnonzero(expected).tolist()


def _has_opinion(light):
    inner = light.GetParent()
    return any(prim.HasAPI(UsdGeom.VisibilityAPI) for prim in (inner, inner.GetParent()))


def test_purposes_are_hidden_in_instances(load):
    render = 'uniform token purpose = "render";'
    proto = f'class Xform "_lamp" {{;{render}def SphereLight "in" {{;{POINT}}};}};'
    header = "(instanceable = true;inherits = </_lamp>)"
    shown, hidden = (f'def Xform "n{x}" {header} {{;{placed(x=x)}}};' for x in (1, 2))
    scene = load(f'{proto}{shown}def Xform "h" {HIDING}{hidden}}};')
    assert [x for x, _, _ in positions_of(scene)] == [1]
    text = instancer(PLACES, render)
    assert len(positions_of(load(text))) == len(PLACES)
    assert positions_of(load(text.replace('"lamps" {', f'"lamps" {HIDING}'))) == []


@settings(max_examples=20, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.tuples(*[st.floats(-3, 3)] * 3), min_size=1, max_size=4),
    st.lists(st.floats(-1, 1), min_size=4, max_size=4),
    st.floats(0.2, 3),
)
def test_random_instancers_place_as_usd_says(tmp_path_factory, places, quaternion, scale):
    """Positions equal those that usd-core computes with its mask and prototype included."""
    from manylights import usd

    path = str(tmp_path_factory.mktemp("stage") / "stage.usda")
    stage = Usd.Stage.CreateNew(path)
    parent = UsdGeom.Xform.Define(stage, "/parent")
    quaternion = np.add(quaternion, (0, 0, 0, 1e-3))
    quaternion /= np.linalg.norm(quaternion)
    parent.AddOrientOp().Set(Gf.Quatf(*map(float, quaternion)))
    parent.AddScaleOp().Set(Gf.Vec3f(scale))
    lamps = UsdGeom.PointInstancer.Define(stage, "/parent/lamps")
    bulb = UsdLux.SphereLight.Define(stage, "/parent/lamps/bulb")
    bulb.AddTranslateOp().Set(Gf.Vec3d(0, 1, 2))
    bulb.CreateTreatAsPointAttr(True)
    lamps.CreatePositionsAttr([Gf.Vec3f(*place) for place in places])
    lamps.CreateProtoIndicesAttr([0] * len(places))
    lamps.CreateInvisibleIdsAttr([0] if len(places) > 2 else [])
    lamps.CreatePrototypesRel().SetTargets([bulb.GetPath()])
    stage.Save()
    code = Usd.TimeCode.Default()
    world = lamps.ComputeLocalToWorldTransform(code)
    matrices = lamps.ComputeInstanceTransformsAtTime(code, code)
    expected = [(matrix * world).ExtractTranslation() for matrix in matrices]
    found = [part["position"] for part in emitters(usd.load(path), "point")]
    assert np.allclose(sorted(found), sorted(map(tuple, expected)), atol=1e-5)


# -- Many


def many_lamps(path, kind, count):
    """Write an instancer of lamps: small spheres, or squares that glow."""
    stage = Usd.Stage.CreateNew(str(path))
    lamps = UsdGeom.PointInstancer.Define(stage, "/lamps")
    places = np.random.default_rng(1).uniform(-50, 50, (count, 3)).astype(np.float32)
    places[:, 2] = 20
    lamps.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(places))
    lamps.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, dtype=np.int32)))
    if kind == "sphere":
        bulb = UsdLux.SphereLight.Define(stage, "/lamps/bulb")
        bulb.CreateRadiusAttr(0.01)  # so small that they hardly hide each other
        bulb.CreateIntensityAttr(100)
    else:
        bulb = UsdGeom.Mesh.Define(stage, "/lamps/bulb")
        bulb.CreatePointsAttr([(0, 0, 0), (0, 0.1, 0), (0.1, 0.1, 0), (0.1, 0, 0)])
        bulb.CreateFaceVertexCountsAttr([4])
        bulb.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        glow = UsdShade.Material.Define(stage, "/glow")
        shader = UsdShade.Shader.Define(stage, "/glow/shader")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set((100, 100, 100))
        glow.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(bulb.GetPrim()).Bind(glow)
    lamps.CreatePrototypesRel().SetTargets([bulb.GetPath()])
    stage.Save()
    return places.astype(float)


@pytest.mark.parametrize("kind", ["sphere", "mesh"])
def test_many_lamps_are_one_mesh_of_the_same_light(tmp_path, kind):
    from manylights import usd

    places = many_lamps(tmp_path / "many.usdc", kind, 20_000)
    begin = time.process_time()
    scene = usd.load(tmp_path / "many.usdc")
    assert time.process_time() - begin < 5
    meshes = [part for part in scene.values() if isinstance(part, mi.Mesh)]
    assert [mesh.is_emitter() for mesh in meshes] == [True]
    squares = (places**2).sum(axis=1)
    if kind == "sphere":
        expected = 100 * np.pi * 0.01**2 * (places[:, 2] / squares**1.5).sum()
    else:
        middles = np.add(places, (0.05, 0.05, 0))
        squares = (middles**2).sum(axis=1)
        expected = 100 * 0.01 * (places[:, 2] ** 2 / squares**2).sum()
    assert_irradiance(scene, expected, rounding=0.005, spp=32, seeds=range(4))


def test_separate_lamps_have_their_radiance_for_each_face(tmp_path, load):
    """More than a thousand spheres with as many radiances become one mesh."""
    rng = np.random.default_rng(2)
    # In one plane, each in a square of its own, where none hides another
    x, y = np.meshgrid(np.linspace(-20, 20, 40), np.linspace(-20, 20, 30))
    places = np.stack([x.ravel(), y.ravel(), np.full(x.size, 40.0)], axis=-1)
    places += rng.uniform(-0.4, 0.4, places.shape) * (1, 1, 0)
    values = rng.uniform(1, 100, len(places))
    lights = ";".join(
        f'def SphereLight "light_{index}" {{;float inputs:radius = 0.1;'
        f"float inputs:intensity = {value};{placed(*place)}}}"
        for index, (place, value) in enumerate(zip(places, values))
    )
    scene = load(lights)
    assert sum(isinstance(part, mi.Mesh) for part in scene.values()) == 1
    assert "1200" in note(scene, "tessellated sphere")
    squares = (places**2).sum(axis=1)
    expected = np.pi * 0.01 * (values * places[:, 2] / squares**1.5).sum()
    assert_irradiance(scene, expected, rounding=0.005, spp=64, seeds=range(4))


def test_instances_move_with_time(load):
    places = "point3f[] positions.timeSamples = { 1: [(0, 0, 1)], 3: [(0, 0, 5)] };"
    text = instancer([(9, 9, 9)], places)
    assert positions_of(load(text, time=2)) == [(0, 0, 3)]
    assert positions_of(load(text, time=3)) == [(0, 0, 5)]
    assert positions_of(load(text)) == [(9, 9, 9)]
    sampled = text.replace("point3f[] positions = [(9.0, 9.0, 9.0)]", "")
    assert positions_of(load(sampled)) == [(0, 0, 1)]


MEASURE = """
import resource, sys, time
import mitsuba as mi
mi.set_variant("scalar_rgb")
from manylights import usd
begin = time.process_time()
scene = usd.load(sys.argv[1])
seconds = time.process_time() - begin
mi.load_dict(scene)
print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind, most", [("sphere", 10), ("mesh", 10), ("separate", 5)])
def test_time_and_memory_of_many_lamps(tmp_path, kind, most):
    """100,000 instances, or 10,000 separate lights."""
    path = tmp_path / "many.usdc"
    if kind == "separate":
        stage = Usd.Stage.CreateNew(str(path))
        for index in range(10_000):
            light = UsdLux.SphereLight.Define(stage, f"/lights/light_{index}")
            light.AddTranslateOp().Set(Gf.Vec3d(index % 100, index // 100, 0))
            light.CreateIntensityAttr(1.0 + index)
        stage.Save()
    else:
        many_lamps(path, kind, 100_000)
    command = [sys.executable, "-c", MEASURE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, memory = map(float, done.stdout.split())
    assert seconds < most
    assert memory < 2e9

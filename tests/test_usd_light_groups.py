"""Groups of lights of USD stages, by the paths of prims: what the reader merges keeps its group."""

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

import manylights
from manylights.errors import UsageError
from manylights.loading.light_groups import entry_of
from manylights.output import exr, light_groups

from tests import statistics_tools as tools
from tests.usd_stages import placed, write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")

FACES = """int[] faceVertexCounts = [4]; int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)];"""

CAMERA = f"""def Camera "camera" {{;float focalLength = 20;float horizontalAperture = 20
    float verticalAperture = 20;{placed(z=4)}}};"""

SETTINGS = 'def RenderSettings "settings" {;uniform int2 resolution = (16, 16);};'

FLOOR = f'def Mesh "floor" {{;{FACES}color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)];}};'


def lamps(name, count, kind="RectLight", size=0.05, x=-0.9, intensity=20.0):
    """Return a scope of small lamps in a row that shine on the floor, each a bit brighter."""
    shape = f"float inputs:width = {size};float inputs:height = {size};"
    shape = shape if kind == "RectLight" else f"float inputs:radius = {size};"
    parts = "".join(
        f'def {kind} "lamp_{i}" {{;{shape}float inputs:intensity = {intensity + i};'
        f"{placed(x, -0.9 + 1.8 * i / count, 0.6)}}};"
        for i in range(count)
    )
    return f'def Scope "{name}" {{;{parts}}};'


def bulb(name, x, more="", intensity=3.0):
    return (
        f'def SphereLight "{name}" {{;float inputs:intensity = {intensity};'
        f"bool treatAsPoint = true;bool inputs:normalize = true;{more}{placed(x, 0, 0.5)}}};"
    )


def instancers():
    """Return two point instancers of one lamp that is elsewhere."""
    shared = 'class Scope "lib" {;' + bulb("bulb", 0) + "};"
    return shared + "".join(
        f'def PointInstancer "{name}" {{;point3f[] positions = [({x}, 0, 0), ({x}, 0.5, 0)];'
        "int[] protoIndices = [0, 0];rel prototypes = </lib/bulb>;};"
        for name, x in (("left", -0.5), ("right", 0.5))
    )


def natives():
    """Return native instances of a lamp, three in one scope and two in another."""
    parts = 'class Xform "_lamp" {;' + lamps("in", 1, "SphereLight", x=0) + "};"
    header = "(instanceable = true;inherits = </_lamp>)"
    for scope, places in (("north", (-0.6, 0.0, 0.6)), ("south", (-0.3, 0.3))):
        inside = "".join(
            f'def Xform "n_{i}" {header} {{;{placed(x, 0, 0)}}};' for i, x in enumerate(places)
        )
        parts += f'def Scope "{scope}" {{;{inside}}};'
    return parts


GLOW = """def Material "glow" { ; token outputs:surface.connect = </glow/shader.outputs:surface>
    def Shader "shader" { ; uniform token info:id = "UsdPreviewSurface"
        color3f inputs:emissiveColor = (4, 2, 1); token outputs:surface; } };"""

PANES = GLOW + "".join(
    f"""def Mesh "pane_{i}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    int[] faceVertexCounts = [3]; int[] faceVertexIndices = [0, 2, 1]
    point3f[] points = [({x}, 0, 0.3), ({x + 0.2}, 0, 0.3), ({x}, 0.2, 0.3)]
    rel material:binding = </glow>;}};"""
    for i, x in enumerate((-0.5, 0.3))
)

DOME = 'def DomeLight "sky" {;float inputs:intensity = 0.2;};'

#: Stages, groups, and what else gives the light of the first group alone.
CASES = {
    "merged": (
        lamps("west", 40) + lamps("east", 40, x=0.9) + DOME,
        "a=/west/*,b=/east/*,sky=sky",
        lamps("west", 40),
    ),
    "spheres": (
        lamps("west", 3, "SphereLight") + lamps("east", 2, "SphereLight", x=0.9),
        "a=/west/*",
        lamps("west", 3, "SphereLight"),
    ),
    "names": (bulb("one", -0.5) + bulb("two", 0.5), "a=one,b=/tw?", bulb("one", -0.5)),
    "instancers": (
        instancers(),
        "a=/left,b=right",
        bulb("one", -0.5) + bulb("two", -0.5).replace("0, 0.5", "0.5, 0.5"),
    ),
    "natives": (
        natives(),
        "a=/north/*",
        natives().replace('Scope "south" {', 'Scope "south" {;token visibility = "invisible";'),
    ),
    "panes": (PANES, "a=pane_0", PANES.partition('def Mesh "pane_1"')[0]),
}


def render(folder, text, **options):
    path = write_stage(folder, CAMERA + SETTINGS + FLOOR + text)
    integrator = {"type": "manylights_direct", "hide_emitters": True}
    return manylights.render(str(path), integrator=integrator, **options)


@pytest.mark.parametrize("case", CASES)
def test_layers_of_groups_sum_and_hold_their_own_light(tmp_path, case):
    text, groups, alone = CASES[case]
    found, expected = [], []
    for seed in range(16):
        path = tmp_path / f"{seed}.exr"
        render(tmp_path, text, light_groups=groups, spp=16, seed=seed, output=path)
        planes, _ = exr.read(path)
        for color in "RGB":
            total = light_groups.total(
                [planes[name] for name in light_groups.of_color(planes, color)]
            )
            np.testing.assert_array_equal(total, planes[color])
        found.append(np.stack([planes[f"RGBA_a.{color}"] for color in "RGB"], axis=-1))
        expected.append(render(tmp_path, alone, spp=16, seed=seed + 100).image[..., :3])
        whole = np.stack([planes[color] for color in "RGB"], axis=-1)
    found, expected = np.stack(found).astype(float), np.stack(expected).astype(float)
    assert whole.mean() > 1.2 * found.mean() > 0
    tools.assert_same_mean(found, expected, bias=0.05)
    assert not tools.compare_means(found * 1.2, expected).passes


def test_lamps_stay_few_meshes_within_their_groups(tmp_path, scalar):
    from manylights import usd

    path = write_stage(tmp_path, lamps("west", 40) + lamps("east", 40, x=0.9))
    scene = usd.load(path, light_groups="a=/west/*")
    shapes = mi.load_dict(dict(scene)).shapes()
    names = {shape.id() for shape in shapes if shape.emitter()}
    assert names == {"/west/lamp_0", "/east/lamp_0"}
    assert [name for name in usd.load(path) if "lamp" in name] == ["lamps_0"]


def test_render_settings_may_have_groups(tmp_path, scalar):
    integrator = """;string mitsuba:integrator:type = "manylights_direct"
        string mitsuba:integrator:light_groups = "a=/west/*";};"""
    settings = SETTINGS.replace(";};", integrator)
    text = lamps("west", 40) + lamps("east", 40, x=0.9) + settings
    path = tmp_path / "out.exr"
    manylights.render(str(write_stage(tmp_path, CAMERA + FLOOR + text)), spp=1, output=path)
    assert light_groups.groups(exr.read(path)[0]) == ["a", "rest"]


def test_an_entry_without_lights_lists_paths(tmp_path):
    text = lamps("west", 40) + lamps("east", 2, x=0.9)
    words = r'"b=/north/\*" matches no light .*The stage has 42 lights: /west/lamp_0, .*, \.\.\.'
    with pytest.raises(UsageError, match=words):
        render(tmp_path, text, light_groups="a=/west/*,b=/north/*")
    with pytest.raises(UsageError, match='"b=lamp_1" matches no light that an entry before'):
        render(tmp_path, text, light_groups="a=*,b=lamp_1")
    with pytest.raises(RuntimeError, match='"b" is none'):
        render(tmp_path, text, light_groups="a=/west/*,b")


def test_domes_of_several_groups_are_refused(tmp_path):
    text = DOME + DOME.replace("sky", "other")
    words = "/sky in a=sky and /other in rest: the domes of a stage become one environment"
    with pytest.raises(UsageError, match=words):
        render(tmp_path, text, light_groups="a=sky")
    render(tmp_path, text + bulb("one", 0), light_groups="a=/[so][kt]*", spp=1)


def test_paths_fit_whole_and_by_their_names():
    core = pytest.importorskip("manylights._core")
    for pattern, name, fits in [
        ("/World/Lamps/*", "/World/Lamps/a/b", True),
        ("/World/*/b", "/World/Lamps/a/b#12", True),
        ("b", "/World/b#2", True),
        ("b*", "/World/b", True),
        ("World", "/World/b", False),
        ("*#2", "/World/b", False),
        ("b", "World/b", False),
        ("b", "b#2", False),
    ]:
        assert (entry_of(f"x={pattern}", name) == 0) == fits, (pattern, name)
        assert (core.light_group(f"x={pattern}", name)[0] == 0) == fits, (pattern, name)


def test_lights_of_several_groups_on_one_geometry_are_noted(tmp_path):
    light = 'def GeometryLight "NAME" {;rel geometry = </quad>;};'
    text = light.replace("NAME", "a") + light.replace("NAME", "b")
    text += f'def Mesh "quad" {{;{FACES}}};' + bulb("b_too", 0)
    scene = manylights.usd.load(write_stage(tmp_path, text), light_groups="x=/a,y=/b*")
    texts = [note.text for note in scene.notes if note.kind == "geometry light groups"]
    assert len(texts) == 1 and "/quad" in texts[0]
    scene = manylights.usd.load(write_stage(tmp_path, text), light_groups="x=/[ab]")
    assert not [note for note in scene.notes if note.kind == "geometry light groups"]

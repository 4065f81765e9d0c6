"""Native instances look as their prims would without instancing, and are in the same places."""

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from tests.test_usd_lights import emitters, note
from tests.usd_stages import write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")

COLORS = {"red": (0.8, 0.1, 0.1), "green": (0.1, 0.7, 0.1), "blue": (0.1, 0.1, 0.9)}

#: Each square is of side 1 and faces +Z; the prototype's own second one is bound to blue.
PROTOTYPE = """
def Mesh "bare" { ; SQUARE } def Mesh "bound" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    rel material:binding = </World/blue>; SQUARE ; AT(0, 2, 0) }"""

PLACES = [(x, y, 5.0) for x in (0, 4, 8) for y in (0, 2)]


def stage(world="", prototype=PROTOTYPE, more="", names=("A", "B", "C")):
    """Return a stage of three instances in a row, of a prototype of two squares.

    Args:
        world: properties of what is above the instances.
        prototype: what the prototype has.
        more: other prims below /World.
        names: of the instances.
    """
    materials = "".join(
        f'def Material "{name}" {{;'
        f"token outputs:surface.connect = </World/{name}/s.outputs:surface>"
        f';def Shader "s" {{;uniform token info:id = "UsdPreviewSurface";'
        f"color3f inputs:diffuseColor = {color};token outputs:surface}};}}"
        for name, color in COLORS.items()
    )
    instances = "".join(
        f'def Xform "{name}" (instanceable = true;references = </P>) {{;AT({4 * index}, 0, 0)}}'
        for index, name in enumerate(names)
    )
    text = f"""class Xform "P" {{ ; {prototype} }}
        def Xform "World" (prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:c"]) {{
            rel material:binding = </World/green>;{world};{materials}{instances}{more} }}"""
    return placed(text)


def placed(text):
    """Return a text with `SQUARE` and `AT(x, y, z)` replaced."""
    square = (
        "int[] faceVertexCounts = [4]; int[] faceVertexIndices = [0, 1, 2, 3]"
        ";point3f[] points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)];"
    )
    order = ';uniform token[] xformOpOrder = ["xformOp:translate"];'
    parts = text.replace("SQUARE", square).split("AT(")
    ends = [part.partition(")") for part in parts[1:]]
    moved = [f"double3 xformOp:translate = ({place}){order}{rest}" for place, _, rest in ends]
    return "".join([parts[0], *moved])


def looks(path, places=PLACES):
    """Return the reflectance and the radiance of what is below each place, ``(n, 2, 3)``."""
    from manylights import usd

    scene = mi.load_dict(usd.load(path))
    result = np.full((len(places), 2, 3), -1.0)
    for index, place in enumerate(places):
        si = scene.ray_intersect(mi.Ray3f(list(place), [0, 0, -1]))
        if si.is_valid():
            result[index, 0] = np.ravel(si.bsdf().eval_diffuse_reflectance(si))
            result[index, 1] = np.ravel(si.emitter(scene).eval(si)) if si.shape.is_emitter() else 0
    return result


def assert_as_without_instancing(folder, text, places=PLACES, distinct=2):
    """Assert looks as without instancing, and how many there are in different instances."""
    expected = looks(
        write_stage(folder, text.replace("instanceable = true", ""), "flat.usda"), places
    )
    found = looks(write_stage(folder, text, "instanced.usda"), places)
    assert (found[:, 0] >= 0).any(axis=1).all()
    assert len(np.unique(expected.round(4), axis=0)) >= distinct
    np.testing.assert_allclose(found, expected, atol=1e-6)
    return found


def bound_by(includes, purpose="", more=""):
    """Return a binding of the collection of some paths to red."""
    targets = ", ".join(f"</World/{path}>" for path in includes)
    return (
        f"rel collection:c:includes = [{targets}];{more}"
        f"rel material:binding:collection:{purpose}c = [</World.collection:c>, </World/red>];"
    )


STRONGER = bound_by(["B"]).replace("red>];", 'red>] (bindMaterialAs = "strongerThanDescendants");')


@pytest.mark.parametrize(
    "world",
    [
        bound_by(["B"]),
        bound_by(["B", "C"]),
        bound_by(["C/bare"]),
        bound_by(["B"], purpose="full:"),
        bound_by(["B"], purpose="preview:"),
        bound_by(["A", "B"], more="rel collection:c:excludes = </World/B/bare>;"),
        bound_by(["B/bare"], more='uniform token collection:c:expansionRule = "explicitOnly";'),
        bound_by([], more='pathExpression collection:c:membershipExpression = "/World/{A,B}//";')
        .replace("rel collection:c:includes = [];", "")
        .replace("{A,B}", "A"),
        STRONGER,
        STRONGER.replace("/B>", "/C/bound>"),
    ],
)
def test_a_collection_binds_some_of_the_instances(tmp_path, world):
    found = assert_as_without_instancing(tmp_path, stage(world), distinct=3)
    assert len(np.unique(found[::2].round(4), axis=0)) + ("bound" in world) == 2


def test_a_collection_of_another_prim_and_a_binding_in_between(tmp_path):
    """Bindings of a group of instances, whose collection is at the root of all."""
    group = """def Scope "group" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        rel material:binding:collection:c = [</World.collection:c>, </World/red>]
        def Xform "D" (instanceable = true;references = </P>) { ; AT(0, 4, 0) }
        def Xform "E" (instanceable = true;references = </P>) { ; AT(4, 4, 0) } }"""
    text = stage("rel collection:c:includes = [</World/group/E>, </World/A>];", more=placed(group))
    found = assert_as_without_instancing(tmp_path, text, [*PLACES, (0, 4, 5), (4, 4, 5)], 3)
    assert np.allclose(found[[0, 7], 0], [COLORS["green"], COLORS["red"]])


@pytest.mark.parametrize("strength", ["weakerThanDescendants", "strongerThanDescendants"])
def test_bindings_of_instances_and_of_what_is_above(tmp_path, strength):
    """One instance has its own binding, one inherits that of a group, the others the world's."""
    bound = f'rel material:binding = </World/red> (bindMaterialAs = "{strength}");'
    head = 'prepend apiSchemas = ["MaterialBindingAPI"]'
    instance = "instanceable = true;references = </P>"
    more = f"""def Xform "D" ({head};{instance}) {{ ; {bound} AT(0, 4, 0) }};
        def Scope "group" ({head}) {{ ; {bound} def Xform "E" ({instance}) {{ ; AT(4, 4, 0) }} }}"""
    places = [*PLACES, (0, 4, 5), (0, 6, 5), (4, 4, 5), (4, 6, 5)]
    assert_as_without_instancing(tmp_path, stage(more=placed(more)), places, 3)


def test_collections_reach_into_nested_instances(tmp_path):
    inner = f'class Xform "Q" {{ ; {PROTOTYPE} }};'
    nested = 'def Xform "in" (instanceable = true;references = </Q>) {;}'
    text = placed(inner) + stage(bound_by(["B/in/bare", "C"]), prototype=nested)
    assert_as_without_instancing(tmp_path, text, distinct=3)


def test_collections_reach_the_prototypes_of_instancers_in_instances(tmp_path):
    """Also those below an ``over``, which are drawn by their instancer only."""
    points = """def PointInstancer "points" { ; rel prototypes = <PATH>; int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (0, 2, 0)]
        over "hidden" { ; def Mesh "m" { ; SQUARE } } }"""
    points = points.replace("PATH", "/P/points/hidden/m")
    text = stage(bound_by(["B/points/hidden"]), prototype=points)
    assert_as_without_instancing(tmp_path, text)


def test_collections_of_subsets_in_instances(tmp_path):
    pair = """def Mesh "pair" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        int[] faceVertexCounts = [4, 4]; int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4, 5]
        point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (1, 3, 0), (-1, 3, 0)]
        uniform token subsetFamily:materialBind:familyType = "partition"
        def GeomSubset "low" { ; uniform token elementType = "face"; int[] indices = [0]
            uniform token familyName = "materialBind" }
        def GeomSubset "high" { ; uniform token elementType = "face"; int[] indices = [1]
            uniform token familyName = "materialBind" } }"""
    text = stage(bound_by(["B/pair/high", "C/pair/low"]), prototype=pair)
    assert_as_without_instancing(tmp_path, text)


@pytest.mark.parametrize("targets", [["A/bare"], ["B/bare"], ["B/bound", "C/bare"]])
def test_a_geometry_light_shines_from_one_instance(tmp_path, targets):
    listed = ", ".join(f"</World/{path}>" for path in targets)
    light = f'def GeometryLight "light" {{;rel geometry = [{listed}];float inputs:intensity = 4;}}'
    for before in (False, True):
        text = stage(world=light if before else "", more="" if before else light)
        found = assert_as_without_instancing(tmp_path, text)
        assert (found[:, 1] == 4).any(axis=1).sum() == len(targets)


def test_geometry_lights_and_nested_instances(tmp_path):
    """One from outside reaches an inner instance, one inside of a prototype is in each instance."""
    inner = f'class Xform "Q" {{ ; {PROTOTYPE} }};'
    nested = 'def Xform "in" (instanceable = true;references = </Q>) {;}'
    light = 'def GeometryLight "light" {;rel geometry = <PATH>;float inputs:intensity = 4;}'
    text = placed(inner) + stage(prototype=nested, more=light.replace("PATH", "/World/B/in/bound"))
    found = assert_as_without_instancing(tmp_path, text)
    assert (found[:, 1] == 4).any(axis=1).tolist() == [False, False, False, True, False, False]
    text = placed(inner) + stage(prototype=nested + light.replace("PATH", "/P/in/bare"))
    found = assert_as_without_instancing(tmp_path, text)
    assert (found[:, 1] == 4).any(axis=1).tolist() == [True, False] * 3


def test_a_geometry_light_on_an_instance_that_is_a_mesh(tmp_path):
    text = """class Mesh "P" { ; SQUARE }
        def Mesh "A" (instanceable = true;references = </P>) { ; AT(0, 0, 0) }
        def Mesh "B" (instanceable = true;references = </P>) { ; AT(4, 0, 0) }
        def GeometryLight "light" { ; rel geometry = </B>;float inputs:intensity = 3;}"""
    found = assert_as_without_instancing(tmp_path, placed(text), PLACES[:4:2])
    assert found[:, 1, 0].tolist() == [0, 3]


def test_instances_that_look_the_same_stay_copies(tmp_path):
    """A binding by a collection costs one more group, not one for each instance."""
    from manylights import usd

    names = [f"i{index}" for index in range(12)]
    scene = usd.load(write_stage(tmp_path, stage(bound_by(names[3:9]), names=names)))
    kinds = [part["type"] for part in scene.values() if isinstance(part, dict)]
    assert kinds.count("shapegroup") == 2
    assert kinds.count("instance") == 12


RESET = 'uniform token[] xformOpOrder = ["!resetXformStack!", "xformOp:translate"];'


@pytest.mark.parametrize("nested", [False, True])
def test_a_prim_that_resets_its_transform_does_not_move_with_its_instance(tmp_path, nested):
    """A mesh, an instance and a light, in instances and in instances of these."""
    from manylights import usd

    fixed = f"""def Mesh "fixed" {{ ; SQUARE ; double3 xformOp:translate = (0, 4, 0);{RESET} }}
        def Xform "group" (instanceable = true;references = </Q>) {{
            double3 xformOp:translate = (4, 4, 0);{RESET} }}
        def SphereLight "light" {{ ; bool treatAsPoint = true;float inputs:intensity = 5
            double3 xformOp:translate = (1, 2, 3);{RESET} }}"""
    square = 'class Xform "Q" { ; def Mesh "in" { ; SQUARE } };'
    text = stage(prototype='def Mesh "moved" { ; SQUARE }' + fixed)
    if nested:
        outer = 'class Xform "R" {;def Xform "p" (instanceable = true;references = </P>) {;};};'
        text = outer + text.replace("</P>", "</R>")
    text = placed(square) + placed(text)
    places = [(0, 0, 5), (4, 0, 5), (8, 0, 5), (0, 4, 5), (4, 4, 5)]
    assert_as_without_instancing(tmp_path, text, places, distinct=1)
    scene = usd.load(tmp_path / "instanced.usda")
    points = [part["position"] for part in emitters(scene, "point")]
    assert np.allclose(points, [(1, 2, 3)] * 3)


# -- Colors of point instancers


def colored(colors, more="", inside="", count=4):
    """Return an instancer of squares four apart with displayColor for each instance."""
    positions = ", ".join(f"({4 * index}, 0, 0)" for index in range(count))
    text = f"""def PointInstancer "squares" {{ ; rel prototypes = </squares/square>
        int[] protoIndices = {[0] * count}; point3f[] positions = [{positions}]
        color3f[] primvars:displayColor = {colors} (interpolation = "vertex")
        {more} def Xform "square" {{ ; def Mesh "m" {{ ; SQUARE ; {inside} }} }} }}"""
    return placed(text)


ROW = [(4.0 * index, 0.0, 5.0) for index in range(4)]
RGBR = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)]


@pytest.mark.parametrize(
    "text, expected",
    [
        (colored(RGBR), RGBR),
        (colored(RGBR[:3], "int[] primvars:displayColor:indices = [2, 1, 0, 2];"),
         [RGBR[2], RGBR[1], RGBR[0], RGBR[2]]),
        (colored(RGBR, "int64[] invisibleIds = [1];"), [RGBR[0], (-1, -1, -1), *RGBR[2:]]),
        (colored(RGBR, "", "color3f[] primvars:displayColor = [(0.5, 0.5, 0)];"),
         [(0.5, 0.5, 0)] * 4),
        (colored(RGBR[:1]), [RGBR[0]] * 4),
    ],
)  # fmt: skip
def test_instances_have_the_colors_that_their_instancer_gives(tmp_path, text, expected):
    """Those of a mesh itself are stronger."""
    found = looks(write_stage(tmp_path, text), ROW)
    assert np.allclose(found[:, 0], expected, atol=1e-6)


def test_colors_reach_instances_in_prototypes(tmp_path):
    square = placed('class Xform "Q" { ; def Mesh "in" { ; SQUARE } };')
    instance = 'def Xform "m" (instanceable = true;references = </Q>) {'
    text = colored(RGBR).replace('def Mesh "m" {', instance).replace(placed("SQUARE"), "")
    found = assert_as_without_instancing(tmp_path, square + text, ROW, distinct=3)
    assert np.allclose(found[:, 0], RGBR)


def test_colors_that_do_not_fit_are_noted(tmp_path):
    from manylights import usd

    scene = usd.load(write_stage(tmp_path, colored(RGBR[:2]), "few.usda"))
    assert "/squares" in note(scene, "primvar size")
    many = [(index / 300, 0, 0) for index in range(300)]
    scene = usd.load(write_stage(tmp_path, colored(many, count=300), "many.usda"))
    assert "300 colors" in note(scene, "instance colors")
    kinds = [part["type"] for part in scene.values() if isinstance(part, dict)]
    assert "shapegroup" not in kinds

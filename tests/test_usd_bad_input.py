"""Stages that are broken: an error or a note that names file and prim, and nothing else."""

import random
import subprocess
import sys
import zipfile

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from tests.test_usd_instancing import PLACES, instancer
from tests.test_usd_lights import BOUND, GLOW, QUAD, note
from tests.usd_stages import write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")


@pytest.fixture
def usd(plugin):
    """The module under test."""
    from manylights import usd

    return usd


LIT = 'def SphereLight "light" {;};'


def crate(path, count=200):
    """Write a binary stage and return its bytes."""
    stage = Usd.Stage.CreateNew(str(path))
    for index in range(count):
        light = UsdLux.SphereLight.Define(stage, f"/light_{index}")
        light.AddTranslateOp().Set(Gf.Vec3d(index, 0, 0))
    stage.Save()
    return path.read_bytes()


def texts(scene):
    return "\n".join(entry.text for entry in scene.notes)


# -- Files


@pytest.mark.parametrize("name", ["nowhere.usd", "nowhere.usdz", "nowhere"])
def test_missing_file(usd, tmp_path, name):
    with pytest.raises(ValueError, match=f"{name}.*no such file"):
        usd.load(tmp_path / name)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"time": "noon"}, "time 'noon': must be a finite number"),
        ({"time": float("nan")}, "time nan: must be a finite number"),
        ({"purposes": 3}, "purposes 3: must be a list of default, render, proxy, guide"),
        ({"subdivision": 1.5}, "subdivision 1.5: must be an integer from 0 to 6"),
        ({"subdivision": 7}, "subdivision 7: must be an integer from 0 to 6"),
        ({"path": None}, "path None: must be a path"),
    ],
)
def test_arguments_of_wrong_types_are_named(usd, tmp_path, choices, words):
    stage = write_stage(tmp_path, LIT)
    with pytest.raises(ValueError, match=words):
        usd.load(**{"path": stage, **choices})


def test_folder(usd, tmp_path):
    with pytest.raises(ValueError, match="folder"):
        usd.load(tmp_path)


@pytest.mark.parametrize("name", ["picture.png", "scene.xml", "notes.txt", "noextension"])
def test_file_of_another_kind(usd, tmp_path, name):
    (tmp_path / name).write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(ValueError, match=f"{name}: not a stage.*usda"):
        usd.load(tmp_path / name)


@pytest.mark.parametrize("name", ["a.usd", "a.usda", "a.usdc", "a.usdz"])
@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" * 30, b"#usda 1.0\ndef Xform {"])
def test_other_content(usd, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        usd.load(tmp_path / name)


def test_syntax_error_names_the_line(usd, tmp_path):
    path = write_stage(tmp_path, 'def Xform "a" {;float x = ;}')
    with pytest.raises(ValueError, match=r"stage.usda:3:\d+"):
        usd.load(path)


@pytest.mark.parametrize("part", [5, 80, 0.3, 0.6, 0.9])
def test_truncated_crate(usd, tmp_path, part):
    data = crate(tmp_path / "whole.usdc")
    path = tmp_path / "part.usdc"
    path.write_bytes(data[: part if part > 1 else int(part * len(data))])
    with pytest.raises(ValueError, match=r"part\.usdc"):
        usd.load(path)


@pytest.mark.parametrize("part", [0.01, 0.5])
def test_truncated_package(usd, tmp_path, part):
    data = crate(tmp_path / "whole.usdc")
    with zipfile.ZipFile(tmp_path / "whole.usdz", "w") as package:
        package.writestr("whole.usdc", data)
    whole = (tmp_path / "whole.usdz").read_bytes()
    (tmp_path / "part.usdz").write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ValueError, match=r"part\.usdz"):
        usd.load(tmp_path / "part.usdz")


def test_old_crate(usd, tmp_path):
    data = bytearray(crate(tmp_path / "whole.usdc"))
    data[8:11] = b"\0\0\1"
    (tmp_path / "old.usdc").write_bytes(bytes(data))
    with pytest.raises(ValueError, match=r"old.usdc.*0\.0\.1"):
        usd.load(tmp_path / "old.usdc")
    text = 'def Xform "old" (references = @./old.usdc@</light_0>) {;};'
    scene = usd.load(write_stage(tmp_path, LIT + text))
    assert "old.usdc" in texts(scene) and "/old" in texts(scene)
    assert "0.0.1" in texts(scene)


@pytest.mark.parametrize("seed", range(25))
def test_damaged_crates_raise_or_load(usd, tmp_path, seed):
    rng = random.Random(seed)
    data = bytearray(crate(tmp_path / "whole.usdc", 20))
    for _ in range(rng.randrange(1, 5)):
        data[rng.randrange(88, len(data))] = rng.randrange(256)
    (tmp_path / "bad.usdc").write_bytes(bytes(data))
    try:
        mi.load_dict(usd.load(tmp_path / "bad.usdc"))
    except usd.StageError as error:
        assert "bad.usdc" in str(error)


# -- Composition


def test_missing_references_are_grouped(usd, tmp_path):
    text = "".join(
        f'def Xform "prim_{index}" (references = @./gone_{index % 50}.usda@) {{;}};'
        for index in range(200)
    )
    scene = usd.load(write_stage(tmp_path, LIT + text))
    found = [entry for entry in scene.notes if "gone_" in entry.text]
    assert 1 < len(found) <= 5
    assert sum(entry.count for entry in found) == 200
    assert "/prim_" in texts(scene)


def test_missing_sublayer_and_payload(usd, tmp_path):
    path = write_stage(tmp_path, LIT + 'def Xform "a" (payload = @./cargo.usd@) {;}')
    text = path.read_text().replace("#usda 1.0", "#usda 1.0\n(\nsubLayers = [@./under.usda@]\n)")
    path.write_text(text)
    scene = usd.load(path)
    assert "under.usda" in texts(scene)
    assert "cargo.usd" in texts(scene) and "/a" in texts(scene)


def test_materialx_names_the_extra(usd, tmp_path):
    text = 'def Xform "a" (references = @./look.mtlx@</MaterialX>) {;}'
    (tmp_path / "look.mtlx").write_text('<?xml version="1.0"?><materialx version="1.38"/>')
    assert "manylights[usd-mtlx]" in texts(usd.load(write_stage(tmp_path, LIT + text)))


@pytest.mark.parametrize("text", ["(references = @./stage.usda@</a>)", "(inherits = </a>)"])
def test_cycles_are_cut(usd, tmp_path, text):
    scene = usd.load(write_stage(tmp_path, LIT + f'def Xform "a" {text} {{;}}'))
    assert "/a" in note(scene, "cycle") or "/a" in note(scene, "composition")


def test_instancers_that_instance_each_other(usd, tmp_path):
    a = instancer(PLACES, prototypes="</b>", name="a")
    b = instancer(PLACES, prototypes="[</a>, </b>]", name="b", indices=[0, 1, 0, 1])
    scene = usd.load(write_stage(tmp_path, f"{LIT}{a};{b}"))
    assert note(scene, "cycle")
    mi.load_dict(scene)


# -- Prims


@pytest.mark.parametrize(
    "text",
    [
        'def PointInstancer "bad" {;int protoIndices = 3;point3f[] positions = [(0, 0, 0)];}',
        'def PointInstancer "bad" {;int[] protoIndices = [0];string positions = "here";}',
        'def Xform "bad" {;int visibility = 3;double3 xformOp:translate = (0, 0, 0);'
        'uniform token[] xformOpOrder = ["xformOp:nothing"];}',
        'def Mesh "bad" {;string points = "none";int faceVertexCounts = 3;}',
        'def Camera "bad" {;string focalLength = "long";}',
        'def Camera "bad" {;string clippingRange = "near";token projection = "none";}',
        'def RenderSettings "bad" {;string resolution = "high";int camera = 1;}',
        'def RenderSettings "bad" {;string mitsuba:sample_count = "many";}',
        'def RenderSettings "bad" {;int[] resolution = [1];}',
        'def BasisCurves "bad" {;point3f[] points = [(0, 0, 0)];float[] curveVertexCounts = [1];}',
    ],
)
def test_attributes_of_another_type(usd, tmp_path, text):
    """They are noted, ignored, or an error: never another exception."""
    path = write_stage(tmp_path, LIT + text)
    try:
        scene = usd.load(path)
    except usd.StageError as error:
        assert "/bad" in str(error)
        return
    mi.load_dict(scene)


@pytest.mark.parametrize(
    "change, text",
    [
        (
            ("int[] faceVertexIndices = [0, 1, 2, 3]", "float faceVertexIndices = 1e38"),
            "a geometry could not be read",
        ),
        (
            ("int[] faceVertexCounts = [4]", "double[] faceVertexCounts = [4]"),
            "a geometry could not be read",
        ),
        (
            ("", 'uniform token subdivisionScheme = "catmullClark";double creaseLengths = 1e38'),
            "a geometry could not be read",
        ),
        (("", "color3f[] primvars:displayColor = [(1, 0, 0)];BAD"), "a geometry could not be read"),
        (('token info:id = "UsdPreviewSurface"', 'string[] info:id = ["y"]'), "grey"),
    ],
)
def test_meshes_and_shaders_with_values_of_another_type(usd, tmp_path, change, text):
    """The mesh or its material is left out and noted, the rest is there."""
    old, new = change
    new = new.replace("BAD", "quath[] primvars:displayColor:indices = [(1, 0, 0, 0)]")
    bad = f'def Mesh "bad" {{;{QUAD}{BOUND}}}{GLOW}'
    bad = bad.replace(old, new) if old else bad.replace(QUAD, f"{QUAD}{new};")
    assert bad.count(new) == 1
    scene = usd.load(write_stage(tmp_path, LIT + bad))
    assert text in texts(scene) and ("/bad" in texts(scene) or "/glow" in texts(scene))
    mi.load_dict(scene)


@pytest.mark.parametrize(
    "matrix",
    ["(nan, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)", "(inf, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)"],
)
def test_transforms_that_are_not_finite(usd, tmp_path, matrix):
    order = 'uniform token[] xformOpOrder = ["xformOp:transform"];'
    place = f"matrix4d xformOp:transform = ({matrix}, (0, 0, 0, 1));{order}"
    scene = usd.load(write_stage(tmp_path, f'def Xform "a" {{;{place}{LIT}}}'))
    assert "/a" in note(scene, "prim") and "not finite" in note(scene, "prim")


@pytest.mark.parametrize("kind", ["SphereLight", "RectLight", "DiskLight", "CylinderLight"])
@pytest.mark.parametrize("diagonal", [(0, 0, 0), (1, 0, 0), (0, 1, 1)])
@pytest.mark.parametrize("normalize", ["true", "false"])
def test_singular_transforms(usd, tmp_path, kind, diagonal, normalize):
    x, y, z = diagonal
    order = 'uniform token[] xformOpOrder = ["xformOp:scale"];'
    place = f"float3 xformOp:scale = ({x}, {y}, {z});{order}bool inputs:normalize = {normalize};"
    scene = usd.load(write_stage(tmp_path, f'def {kind} "light" {{;{place}}}'))
    loaded = mi.load_dict(scene)
    image = np.array(mi.render(loaded, spp=1))
    assert np.isfinite(image).all()
    if not loaded.emitters():
        assert "/light" in note(scene, "area") and note(scene, "no light")


@pytest.mark.parametrize(
    "text",
    [
        "float3 inputs:intensity = (1, 2, 3);",
        'string inputs:color = "red";',
        'token inputs:radius = "large";',
        "float inputs:radius = nan;",
        "float inputs:exposure = 1e30;",
        "color3f inputs:color = (nan, 0, 0);",
        "asset inputs:shaping:ies:file = @@;",
        "float inputs:intensity = -3;",
    ],
)
def test_values_of_the_wrong_kind(usd, tmp_path, text):
    scene = usd.load(write_stage(tmp_path, f'def SphereLight "light" {{;{text}}}'))
    mi.load_dict(scene)
    broken = {"light value", "negative", "area"}
    found = [entry for entry in scene.notes if entry.kind in broken]
    assert "@@" in text or "/light" in found[0].text


@pytest.mark.parametrize("name", ["empty.png", "text.exr", "picture.tif", "gone.hdr"])
@pytest.mark.parametrize("kind", ["RectLight", "DomeLight"])
def test_broken_pictures(usd, tmp_path, name, kind):
    if name != "gone.hdr":
        (tmp_path / name).write_bytes(b"" if name == "empty.png" else b"no picture")
    text = f'def {kind} "light" {{;asset inputs:texture:file = @./{name}@;}}'
    scene = usd.load(write_stage(tmp_path, text))
    assert name in texts(scene) and "/light" in texts(scene)
    mi.load_dict(scene)


@pytest.mark.parametrize("part", [0.3, 0.9])
def test_truncated_picture_in_a_package(usd, tmp_path, part):
    """In a process of its own: read from memory, such a picture never ends."""
    mi.Bitmap(np.ones((32, 64, 3), dtype=np.float32)).write(str(tmp_path / "sky.exr"))
    picture = (tmp_path / "sky.exr").read_bytes()
    (tmp_path / "sky.exr").write_bytes(picture[: int(part * len(picture))])
    text = 'def DomeLight "sky" {;asset inputs:texture:file = @sky.exr@;}'
    write_stage(tmp_path, text)
    package = tmp_path / "packed.usdz"
    with Sdf.ZipFileWriter.CreateNew(str(package)) as writer:
        writer.AddFile(str(tmp_path / "stage.usda"), "stage.usda")
        writer.AddFile(str(tmp_path / "sky.exr"), "sky.exr")
    code = (
        "import sys, mitsuba as mi; mi.set_variant('scalar_rgb'); import manylights.usd as usd; "
        "print(*(note.text for note in usd.load(sys.argv[1]).notes), sep='\\n')"
    )
    command = [sys.executable, "-c", code, str(package)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "sky.exr" in done.stdout and "1 time, at /sky" in done.stdout


def test_picture_that_is_not_finite(usd, tmp_path):
    pixels = np.ones((4, 8, 3), dtype=np.float32)
    pixels[1, 2] = np.nan
    mi.Bitmap(pixels).write(str(tmp_path / "nan.exr"))
    text = 'def DomeLight "sky" {;asset inputs:texture:file = @./nan.exr@;}'
    assert "nan.exr" in texts(usd.load(write_stage(tmp_path, text)))


def test_empty_stage(usd, tmp_path):
    scene = usd.load(write_stage(tmp_path, ""))
    assert note(scene, "no light") and note(scene, "no camera") and note(scene, "no geometry")
    assert np.array(mi.render(mi.load_dict(scene), spp=1)).max() == 0


def test_deep_stage(usd, tmp_path):
    path = str(tmp_path / "deep.usda")
    stage = Usd.Stage.CreateNew(path)
    UsdGeom.Xform.Define(stage, "/" + "/".join(["a"] * 400))
    UsdLux.SphereLight.Define(stage, "/" + "/".join(["a"] * 400) + "/light")
    stage.Save()
    assert len(mi.load_dict(usd.load(path)).emitters()) == 1


def test_deep_instance(usd, tmp_path):
    """Deeper than Python's functions may call each other."""
    path, place = str(tmp_path / "deep.usda"), "/" + "/".join(["a"] * 1200)
    stage = Usd.Stage.CreateNew(path)
    stage.CreateClassPrim("/lamp")
    UsdLux.SphereLight.Define(stage, "/lamp/light")
    instance = UsdGeom.Xform.Define(stage, place).GetPrim()
    instance.GetReferences().AddInternalReference("/lamp")
    instance.SetInstanceable(True)
    stage.Save()
    assert len(mi.load_dict(usd.load(path)).emitters()) == 1


def test_too_many_instances_are_noted(usd, tmp_path):
    """Four levels of a hundred instances each are more than memory holds."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "many.usda"))
    target = UsdLux.SphereLight.Define(stage, "/lamps/light").GetPath()
    for level in range(4):
        lamps = UsdGeom.PointInstancer.Define(stage, f"/lamps/level_{level}")
        lamps.CreatePositionsAttr([(float(index), 0.0, 0.0) for index in range(100)])
        lamps.CreateProtoIndicesAttr([0] * 100)
        lamps.CreatePrototypesRel().SetTargets([target])
        target = lamps.GetPath()
    stage.GetPrimAtPath("/lamps").SetSpecifier(Sdf.SpecifierOver)
    top = UsdGeom.PointInstancer.Define(stage, "/top")
    top.CreatePositionsAttr([(0.0, 0.0, 0.0)])
    top.CreateProtoIndicesAttr([0])
    top.CreatePrototypesRel().SetTargets([target])
    stage.Save()
    scene = usd.load(tmp_path / "many.usda")
    assert "/lamps/light" in note(scene, "instances")


def test_warnings_stay_off_the_terminal(usd, tmp_path):
    text = "".join(f'def Xform "a_{i}" (references = @./gone_{i}.usda@) {{;}};' for i in range(99))
    path = write_stage(tmp_path, LIT + text + f'def Mesh "quad" {{;{QUAD}}}')
    code = (
        "import mitsuba as mi; mi.set_variant('scalar_rgb'); from manylights import usd; "
        f"usd.load({str(path)!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr and not done.stdout


def test_without_usd_core_the_error_says_what_to_install(usd):
    code = (
        "import sys; sys.modules['pxr'] = None; import manylights\n"
        "try: import manylights.usd\n"
        "except ImportError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'manylights[usd]'" in done.stdout, done.stderr


@pytest.mark.parametrize(
    "options, text",
    [
        ({"purposes": ("default", "preview")}, "purpose 'preview'.*proxy"),
        ({"subdivision": -1}, "subdivision -1"),
        ({"subdivision": 50}, "subdivision 50"),
    ],
)
def test_options_out_of_range(usd, tmp_path, options, text):
    with pytest.raises(ValueError, match=text):
        usd.load(write_stage(tmp_path, LIT), **options)


def test_many_missing_pictures_share_notes(usd, tmp_path):
    file = "asset inputs:texture:file"
    text = ";".join(f'def RectLight "l_{i}" {{;{file} = @./p_{i}.exr@;}}' for i in range(50))
    scene = usd.load(write_stage(tmp_path, text))
    found = [entry for entry in scene.notes if "p_" in entry.text]
    assert len(found) == 5 and sum(entry.count for entry in found) == 50


def test_the_reader_is_an_attribute_of_the_package(plugin):
    assert plugin.usd.load
    with pytest.raises(AttributeError, match="nothing"):
        _ = plugin.nothing


def test_foreign_types_are_noted(usd, tmp_path):
    text = 'def Gizmo "a" {;def SphereLight "light" {;}};def Gizmo "b" {;};def PhysicsScene "c" {;}'
    scene = usd.load(write_stage(tmp_path, text))
    (found,) = (entry for entry in scene.notes if entry.kind.startswith("type"))
    assert (found.kind, found.count, found.prim) == ("type Gizmo", 2, "/a")
    assert len(mi.load_dict(scene).emitters()) == 1

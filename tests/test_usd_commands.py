"""The commands on USD stages: options, what is written, and messages."""

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from manylights import progress
from manylights.cli import main
from manylights.output import channels, images

pytest.importorskip("pxr")
pytestmark = pytest.mark.usefixtures("plugin")

STAGES = Path(__file__).parents[1] / "scenes" / "usd"

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    startTimeCode = 1
)
def Xform "World"
{
    def Mesh "floor"
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)]
        color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]
    }
    def Camera "front"
    {
        double3 xformOp:translate = (0, 0, 5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Camera "bright"
    {
        float exposure = 1
        double3 xformOp:translate = (0, 0, 5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    LIGHT
}
"""

LAMP = """def RectLight "lamp"
    {
        float inputs:intensity = 4
        double3 xformOp:translate = (0, 0, 8)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }"""


@pytest.fixture
def stage(tmp_path):
    """A floor below a lamp, with two cameras; the second one's exposure is 2."""
    path = tmp_path / "stage.usda"
    path.write_text(STAGE.replace("LIGHT", LAMP))
    return path


def render(stage, *options):
    """Render in a scalar variant, and return the colours."""
    target = stage.with_suffix(".exr")
    command = ["render", str(stage), "-o", str(target), "--variant", "scalar_rgb", "--spp", "4"]
    assert main([*command, *options]) == 0
    return channels.read_colors(target)


def test_camera_and_its_exposure(stage, capsys):
    """The same view through a camera of twice the exposure is twice as bright."""
    front, bright = (render(stage, "--camera", f"/World/{name}") for name in ("front", "bright"))
    assert front.max() > 0
    assert np.allclose(bright, 2 * front, rtol=1e-3)
    assert "exposure brightens the image 2 times" in capsys.readouterr().err


def test_exposure_leaves_alpha_and_depth():
    """Only colours are multiplied."""
    pixels = np.full((2, 2, 5), 0.25, dtype=np.float32)
    bitmap = images.exposed(channels.join(["R", "G", "B", "A", "dd.T"], pixels), 4.0)
    found = channels.split(bitmap)
    assert {name: float(values[0, 0]) for name, values in found.items()} == {
        **dict.fromkeys("RGB", 1.0),
        "A": 0.25,
        "dd.T": 0.25,
    }


def test_hidden_lights(tmp_path):
    """A lamp in front of the camera is seen, or not."""
    path = tmp_path / "lamp.usda"
    seen = LAMP.replace("(0, 0, 8)", "(0, 0, 2)")
    turned = seen.replace('xformOpOrder = ["xformOp:translate"]', 'xformOpOrder = ["T", "R"]')
    turned = turned.replace('"T", "R"', '"xformOp:translate", "xformOp:rotateX"')
    turned = turned.replace("uniform", "float xformOp:rotateX = 180\n        uniform")
    path.write_text(STAGE.replace("LIGHT", turned))
    assert np.isclose(render(path).max(), 4, rtol=1e-2)
    assert render(path, "--hide-lights").max() < 1


def test_stage_without_light(tmp_path, capsys):
    """Black with a note, or lit evenly."""
    path = tmp_path / "dark.usda"
    path.write_text(STAGE.replace("LIGHT", ""))
    assert render(path).max() == 0
    assert "--default-light" in capsys.readouterr().err
    assert render(path, "--default-light").min() > 0


def test_tree_of_a_stage(stage, capsys):
    """Lights of a stage are listed as those of XML are."""
    assert main(["tree", str(stage)]) == 0
    assert "2" in capsys.readouterr().out  # triangles of the rectangle


def test_converted_stage_is_the_same_scene(tmp_path):
    """XML with its files, moved elsewhere, renders the same picture."""
    xml = tmp_path / "a" / "materials.xml"
    xml.parent.mkdir()
    assert main(["convert", str(STAGES / "materials.usda"), str(xml)]) == 0
    moved = xml.parent.rename(tmp_path / "b") / xml.name
    mi.set_variant("scalar_rgb")
    converted = mi.load_file(str(moved), spp=1, resx=48, resy=36)
    from manylights import usd

    description = usd.load(STAGES / "materials.usda")
    description["sensor"]["film"].update(width=48, height=36)
    original = mi.load_dict(description)
    a, b = (np.array(mi.render(scene, spp=64, seed=1)) for scene in (converted, original))
    assert np.isclose(a.mean(), b.mean(), rtol=1e-3)
    assert np.abs(a - b).max() < 0.05 * b.max()


def test_lamps_of_converted_stage_keep_their_colours(tmp_path):
    """Radiance of merged lamps is an attribute of their faces, which the file has, too."""
    xml = tmp_path / "street.xml"
    assert main(["convert", str(STAGES / "z_up.usda"), str(xml)]) == 0
    assert main(["tree", str(xml)]) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--camera", "/World/nowhere"], "--camera /World/nowhere: no such prim; the stage has"),
        (["--light-groups", "key=/Nowhere"], '--light-groups: "key=/Nowhere" matches no light'),
        (["--time", "noon"], "--time noon: must be a number"),
        (["--subdivision", "9"], "--subdivision 9: must be an integer from 0 to 6"),
        (["-D", "spp=4"], "-D spp"),
    ],
)
def test_bad_options(stage, capsys, options, message):
    """Each message names what is wrong."""
    command = ["render", str(stage), "-o", str(stage.with_suffix(".exr")), *options]
    try:
        status = main(command)
    except SystemExit as error:
        status = error.code
    assert status == 2
    assert message in capsys.readouterr().err


def test_without_usd_core(stage):
    """The error says what to install; nothing else needs it."""
    code = (
        "import sys; sys.modules['pxr'] = None\n"
        "from manylights.cli import main\n"
        f"sys.exit(main(['render', {str(stage)!r}, '-o', 'x.exr', '--variant', 'scalar_rgb']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install 'manylights[usd]'" in done.stderr


def test_bench_measures_a_stage(stage, tmp_path):
    """A stage is a scene like any other."""
    settings = 'def RenderSettings "small"\n{\n    int2 resolution = (64, 36)\n}\n'
    stage.write_text(stage.read_text() + settings)
    out = tmp_path / "measured"
    command = ["bench", str(stage), "--out", str(out), "--variant", "scalar_rgb", "--seeds", "2"]
    command += ["--spp", "1", "--methods", "resampled_tree", "--time-budget", "0.05"]
    pytest.importorskip("flip_evaluator")
    assert main(command) == 0
    assert (out / "results.json").is_file()


@pytest.mark.parametrize("command", ["render", "tree", "convert"])
@pytest.mark.parametrize("patience", [0.0, 600.0])
def test_long_loading_has_a_bar(stage, tmp_path, monkeypatch, capsys, command, patience):
    monkeypatch.setenv("FORCE_COLOR", "1")  # what rich takes for a terminal
    monkeypatch.setattr(progress, "PATIENCE", patience)
    outputs = {"render": ["--spp", "1", "-o", "out.exr"], "tree": [], "convert": ["out.xml"]}
    monkeypatch.chdir(tmp_path)
    assert main([command, str(stage), "--variant", "scalar_rgb", *outputs[command]]) == 0
    assert ("loading" in capsys.readouterr().err) == (patience == 0.0)

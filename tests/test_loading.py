"""Loading: the reader follows from the file's name, and all go the same way from there."""

import re
import sys
import types
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import loading
from manylights.cli import main
from manylights.errors import UsageError
from manylights.lights import describe

from tests.light_scenes import area, rgb, transform

pytestmark = pytest.mark.usefixtures("plugin")


class Stage(dict):
    """What `manylights.usd.load` returns."""

    notes = (types.SimpleNamespace(text="one light has a profile that is not read (/Lamp)"),)
    exposure = 1.0
    files = ()


def stage():
    """A floor and three lamps that can be merged, for a path tracer."""
    place = transform().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.2)
    lamp = {"type": "rectangle", "to_world": place, "emitter": area(rgb([3, 2, 1]))}
    return Stage(
        type="scene",
        integrator={"type": "path", "max_depth": 3},
        sensor={
            "type": "perspective",
            "to_world": transform().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8},
        },
        floor={"type": "rectangle"},
        **{f"lamp_{index}": lamp for index in range(3)},
    )


@pytest.fixture
def usd(monkeypatch, tmp_path):
    """A reader of stages that notes its arguments; `path` is a file that it accepts."""
    reader = types.ModuleType("manylights.usd")
    reader.calls, reader.path = [], tmp_path / "stage.usda"
    reader.path.write_text("#usda 1.0\n")

    def load(path, **options):
        reader.calls.append((path, options))
        return stage()

    reader.load = load
    monkeypatch.setattr(Stage, "files", [str(reader.path)])
    monkeypatch.setitem(sys.modules, "manylights.usd", reader)
    monkeypatch.setattr(manylights, "usd", reader, raising=False)
    return reader


def test_a_stage_goes_the_same_way_as_xml(usd, scalar):
    loaded = loading.load(str(usd.path), usd_options=loading.UsdOptions(camera="/Camera"))
    ((path, options),) = usd.calls
    assert path == str(usd.path)
    assert options == {**vars(loading.UsdOptions()), "camera": "/Camera"}
    assert loaded.notes[0] == Stage.notes[0].text
    assert "path replaced by manylights_volpath" in loaded.notes[1]
    assert "replaced by manylights_sobol" in loaded.notes[2]
    assert loaded.notes[3] == "emitters: 3 meshes merged into 1"
    assert loaded.files == [usd.path]
    image = np.array(loaded.scene.integrator().render(loaded.scene, spp=4))
    assert np.isfinite(image).all() and image.mean() > 0.0


def test_layers_of_a_stage_are_among_its_files(usd, scalar, monkeypatch):
    monkeypatch.setattr(Stage, "files", ["stage.usda", "lamps.usdc"])
    assert loading.load(str(usd.path)).files == [Path("stage.usda"), Path("lamps.usdc")]


@pytest.mark.parametrize("ending", ["usd", "usda", "usdc", "usdz", "USDA"])
def test_the_ending_chooses_the_reader(usd, scalar, tmp_path, ending):
    path = tmp_path / f"other.{ending}"
    path.write_text("")
    assert describe(str(path))["kinds"] == {"area triangle": 6}


def test_defaults_of_a_stage_are_refused(usd, scalar):
    with pytest.raises(
        UsageError, match=r"defines spp: .*stage\.usda is USD, only XML has <default>"
    ):
        loading.load(str(usd.path), {"spp": "4"})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"path": 3}, "path 3: must be a path"),
        ({"defines": ["resx=8"]}, r"defines \['resx=8'\]: must be a dictionary"),
        ({"defines": {"sky": "1"}}, r"defines sky: .*points\.xml has no <default> of this name"),
        ({"integrator": {"type": "path"}}, "integrator {'type': 'path'}: must be the name of a pl"),
        ({"sampler": 3}, "sampler 3: must be the name of a plugin"),
        ({"settings": "max_depth=3"}, "settings 'max_depth=3': must be a dictionary"),
        ({"usd_options": 3}, "usd_options 3: must be UsdOptions"),
    ],
)
def test_arguments_of_wrong_types_are_named(scalar, arguments, words):
    path = Path(__file__).parents[1] / "scenes" / "points.xml"
    with pytest.raises(UsageError, match=words):
        loading.load(**{"path": path, **arguments})


def test_paths_may_be_objects(scalar):
    path = Path(__file__).parents[1] / "scenes" / "points.xml"
    assert describe(path) | {"build_ms": 0} == describe(str(path)) | {"build_ms": 0}
    with pytest.raises(UsageError, match="path 3: must be a path"):
        describe(3)


def test_missing_usd_core_is_named(monkeypatch, capsys, tmp_path):
    path = tmp_path / "stage.usda"
    path.write_text("#usda 1.0\n")
    monkeypatch.delattr(manylights, "usd", raising=False)
    for name in list(sys.modules):
        if name.partition(".")[0] == "pxr" or name.startswith("manylights.usd"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pxr", None)
    command = ["render", str(path), "-o", str(tmp_path / "out.exr"), "--variant", "scalar_rgb"]
    assert main(command) == 2
    assert "pip install 'manylights[usd]'" in capsys.readouterr().err


def test_files_are_looked_for_beside_a_link(scalar, tmp_path):
    """The folder is that of the path as given, not of what it points to."""
    shapes, links = tmp_path / "shapes", tmp_path / "links"
    shapes.mkdir(), links.mkdir()
    (shapes / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="part.ply"/>'
        "</shape></scene>"
    )
    triangle = Path(__file__).parents[1] / "scenes" / "data" / "triangle.ply"
    (links / "part.ply").write_bytes(triangle.read_bytes())
    (links / "scene.xml").symlink_to(shapes / "scene.xml")
    assert links / "part.ply" in loading.load(str(links / "scene.xml")).files


@pytest.mark.parametrize("spheres", range(1, 16))
def test_sensor_without_a_sampler_gets_one_however_many_nodes_there_are(scalar, tmp_path, spheres):
    """Mitsuba's list of nodes moves when it grows; 4, 8 and 16 of them used to end the process."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="manylights_direct"/><sensor type="perspective"/>'
        + spheres * '<shape type="sphere"/>'
        + "</scene>"
    )
    (sensor,) = loading.load(str(path)).scene.sensors()
    assert sensor.sampler().class_name() == "SobolSampler"


@pytest.mark.parametrize(
    ("name", "words"), [("", "is a folder"), ("a.exr", "is an image"), ("a.xml", "no such file")]
)
def test_what_is_no_scene_is_told(scalar, tmp_path, name, words):
    (tmp_path / "a.exr").write_bytes(b"")
    with pytest.raises(UsageError, match=words):
        loading.load(str(tmp_path / name))


@pytest.mark.parametrize(
    "option", ["--camera=/c", "--time=1", "--default-light", "--legacy-lights", "--subdivision=1"]
)
def test_options_of_stages_are_refused_for_xml(scalar, capsys, option):
    scene = Path(__file__).parents[1] / "scenes" / "points.xml"
    assert main(["tree", str(scene), "--variant", "scalar_rgb", option]) == 2
    assert f"{option.split('=')[0]}: {scene} is XML" in capsys.readouterr().err


def test_scene_without_sensor_or_lights_is_told(scalar, tmp_path, capsys):
    path = tmp_path / "scene.xml"
    path.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    assert any("has none" in note for note in loading.load(str(path)).notes)
    command = ["render", str(path), "-o", str(tmp_path / "a.exr"), "--variant", "scalar_rgb"]
    assert main(command) == 2
    assert "scene.xml: has no sensor" in capsys.readouterr().err
    with pytest.raises(UsageError, match="the scene has no sensor"):
        manylights.render(str(path), spp=1)


MISTAKES = {
    "integrator": ("", "<float name='spliting_rate' value='2'/>"),
    "sensor": ("<float name='fovv' value='45'/>", ""),
    "sampler": ("<sampler type='independent'><integer name='samples' value='2'/></sampler>", ""),
    "film": ("<film type='hdrfilm'><integer name='widht' value='8'/></film>", ""),
}


@pytest.mark.parametrize("place", MISTAKES)
def test_unknown_parameter_is_refused_wherever_it_is(scalar, tmp_path, capsys, place):
    """As by `mi.load_file`, though loading has looked at all parameters itself."""
    path = tmp_path / "scene.xml"
    in_sensor, in_integrator = MISTAKES[place]
    path.write_text(
        f'<scene version="3.0.0"><integrator type="manylights_direct">{in_integrator}</integrator>'
        f'<sensor type="perspective">{in_sensor}</sensor><shape type="sphere"/></scene>'
    )
    name = re.search("name='(\\w+)' value", in_sensor + in_integrator)[1]
    command = ["render", str(path), "-o", str(tmp_path / "a.exr"), "--variant", "scalar_rgb"]
    assert main(command) == 2
    message = capsys.readouterr().err
    assert f'"{name}"' in message and f"{place} plugin" in message and "scene.xml" in message
    assert not (tmp_path / "a.exr").exists()


def test_unknown_parameter_of_a_merged_lamp_is_refused(scalar):
    scene = stage()
    scene["lamp_1"] = {**scene["lamp_1"], "flip": True}
    with pytest.raises(RuntimeError, match='"flip"'):
        manylights.render(scene, spp=1)


@pytest.mark.parametrize(("width", "height"), [(0, 8), (8, 0), (33000, 33000)])
def test_films_of_no_size_or_too_large_are_refused(scalar, width, height):
    scene = stage()
    scene["sensor"]["film"] |= {"width": width, "height": height}
    scene["sensor"]["fov"] = 40
    with pytest.raises(UsageError, match=f"film {width} x {height}: .*(1 x 1|2\\^32)"):
        manylights.render(scene, spp=1)


@pytest.mark.parametrize("plugin", ["manylights_direct", "manylights_volpath"])
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_film_without_pixels_is_refused_by_the_plugins(variant, plugin):
    scene = stage()
    scene["sensor"] |= {"fov": 40, "film": {**scene["sensor"]["film"], "width": 0}}
    integrator = mi.load_dict({"type": plugin})
    with pytest.raises(RuntimeError, match="the film has 0 x 8 pixels"):
        integrator.render(mi.load_dict(scene), seed=0, spp=1)

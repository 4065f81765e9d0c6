"""The stages in `scenes/usd`, and any others in folders that the environment names."""

import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Usd, UsdValidation

from tests.statistics_tools import assert_same_mean, render_seeds
from tests.usd_stages import write_stage

pytestmark = pytest.mark.usefixtures("scalar", "plugin")

FOLDER = Path(__file__).parents[1] / "scenes" / "usd"

#: What is noted about each stage, and how many emitters Mitsuba gets.
STAGES = {
    "lights": ({"cone"}, 10),
    "street": ({"tessellated sphere"}, 1),
    "z_up": (set(), 10),
    "domes": ({"domes"}, 2),
    "materials": (set(), 2),
    "lens": ({"tessellated sphere"}, 1),
}

#: Folders with checkouts of stages to load, separated as in PATH.
OTHERS = os.environ.get("MANYLIGHTS_USD_STAGES", "")


def test_all_stages_are_listed():
    assert {path.stem for path in FOLDER.glob("*.usd*")} == set(STAGES)


@pytest.mark.parametrize("name", STAGES)
def test_stage_is_valid(name):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    stage = Usd.Stage.Open(str(FOLDER / f"{name}.usda"))
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []


@pytest.mark.parametrize("name", STAGES)
def test_stage_loads_and_renders(name):
    from manylights import usd

    notes, emitters = STAGES[name]
    scene = usd.load(FOLDER / f"{name}.usda")
    assert {note.kind for note in scene.notes} == notes
    scene["sensor"]["film"].update(width=16, height=12)
    scene["integrator"]["max_depth"] = 2
    loaded = mi.load_dict(scene)
    assert len(loaded.emitters()) == emitters
    image = np.array(mi.render(loaded, spp=4))
    assert np.isfinite(image).all()
    assert (image.max(axis=2) > 0).mean() > 0.3


def stages_below(folders):
    """Return the stages in some folders."""
    found = (path for folder in folders for path in Path(folder).rglob("*.usd*"))
    return sorted(path for path in found if path.suffix in (".usd", ".usda", ".usdc", ".usdz"))


@pytest.mark.skipif(not OTHERS, reason="MANYLIGHTS_USD_STAGES names no folders of stages")
@pytest.mark.parametrize("path", stages_below(filter(None, OTHERS.split(os.pathsep))), ids=str)
def test_other_stages_load_or_say_why(path):
    from manylights import usd

    try:
        scene = usd.load(path)
    except usd.StageError as error:
        assert path.name in str(error)
        return
    assert all(note.text and note.prim for note in scene.notes)
    mi.load_dict(scene)


BY_HAND = """
def Camera "camera" { ; float horizontalAperture = 20; float verticalAperture = 20
    float focalLength = 20; double3 xformOp:translate = (0, 2, 6)
    float xformOp:rotateX = -15
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]; };
def RenderSettings "settings" { ; int2 resolution = (32, 32); };
def Mesh "floor" { ; int[] faceVertexCounts = [4]; int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-3, 0, 3), (3, 0, 3), (3, 0, -3), (-3, 0, -3)]
    color3f[] primvars:displayColor = [(0.5, 0.4, 0.3)]; };
def SphereLight "sphere" { ; float inputs:intensity = 4; float inputs:radius = 0.3
    double3 xformOp:translate = (-1, 1, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]; };
def RectLight "rect" { ; color3f inputs:color = (1, 0.5, 0.25); float inputs:intensity = 12
    bool inputs:normalize = true; float inputs:width = 2; float inputs:height = 0.5
    double3 xformOp:translate = (1, 1.5, 0); float xformOp:rotateX = -90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]; };
def DistantLight "sun" { ; float inputs:intensity = 0.5; float inputs:angle = 0
    float xformOp:rotateX = -40; uniform token[] xformOpOrder = ["xformOp:rotateX"]; };
def DomeLight "sky" { ; float inputs:intensity = 0.1; };
"""


def scene_by_hand():
    """Return the same scene in Mitsuba's own words."""
    to = mi.ScalarTransform4f

    def rgb(*value):
        return {"type": "rgb", "value": list(value)}

    def area(*value):
        return {"type": "area", "radiance": rgb(*value)}

    turned = to().translate([0, 2, 6]) @ to().rotate([1, 0, 0], -15) @ to().rotate([0, 1, 0], 180)
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    lamp = to().translate([1, 1.5, 0]) @ to().rotate([1, 0, 0], 90) @ to().scale([1, 0.25, 1])
    angle = np.radians(40)
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5))),
            "to_world": turned,
            "film": film,
        },
        "floor": {
            "type": "rectangle",
            "to_world": to().rotate([1, 0, 0], -90) @ to().scale(3),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)},
        },
        "sphere": {"type": "sphere", "center": [-1, 1, 0], "radius": 0.3, "light": area(4, 4, 4)},
        "rect": {"type": "rectangle", "to_world": lamp, "light": area(12, 6, 3)},
        "sun": {
            "type": "directional",
            "direction": [0, -float(np.sin(angle)), -float(np.cos(angle))],
            "irradiance": rgb(0.5, 0.5, 0.5),
        },
        "sky": {"type": "constant", "radiance": rgb(0.1, 0.1, 0.1)},
        "integrator": {"type": "manylights_direct"},
    }


def test_stage_looks_as_the_same_scene_by_hand(tmp_path):
    from manylights import usd

    scene = usd.load(write_stage(tmp_path, BY_HAND))
    scene["integrator"] = {"type": "manylights_direct"}
    stage = render_seeds(mi.load_dict(scene), spp=96, seeds=range(12))
    by_hand = scene_by_hand()
    assert_same_mean(stage, render_seeds(mi.load_dict(by_hand), spp=96, seeds=range(12, 24)))
    del by_hand["sun"]
    with pytest.raises(AssertionError):
        assert_same_mean(stage, render_seeds(mi.load_dict(by_hand), spp=96, seeds=range(12, 24)))

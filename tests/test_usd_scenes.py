"""The stages in `scenes/usd`, and any others in folders that the environment names."""

import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Usd, UsdValidation

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

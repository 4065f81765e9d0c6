"""Images scale with the unit of emission, from 1e-25 to 1e25, alike in all variants."""

import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests.light_scenes import rgb

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

FACTORS = (1e-25, 1e-21, 1e-18, 1e20, 1e25)
CASES = {
    "points": lambda f: light_scenes.points(25, total=12.0 * f),
    "spots": lambda f: light_scenes.spots(25, total=40.0 * f),
    "narrow spots": lambda f: narrow_spots(f),
    "triangles": lambda f: {
        "lamps": light_scenes.make_mesh(light_scenes.triangles(40), rgb([4 * f, 3 * f, 2 * f]))
    },
    "spheres": lambda f: light_scenes.shapes("sphere", total=40.0 * f),
    "suns": lambda f: suns(f),
    "sky and a projector": lambda f: {
        "sky": {"type": "constant", "radiance": rgb([f, 2 * f, f])},
        **light_scenes.points(12, total=12.0 * f),
        "spot": {
            "type": "spot",
            "to_world": light_scenes.transform().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "texture": {"type": "checkerboard"},
            "intensity": rgb([9 * f, 9 * f, f]),
        },
    },
}
METHODS = ("resampled_tree", "talk", "adaptive_splitting", "tree", "exhaustive")


def narrow_spots(factor):
    """Spots of 10 degrees, all of one strength."""
    result = {}
    for i in range(20):
        x, y = i % 5 - 2.0, i // 5 - 1.5
        result[f"spot{i}"] = {
            "type": "spot",
            "to_world": light_scenes.transform().look_at([x, y, 3], [x, y, 0], [0, 1, 0]),
            "intensity": rgb([9 * factor, 5 * factor, 3 * factor]),
            "cutoff_angle": 10,
        }
    return result


def suns(factor):
    """More than all get a shadow ray."""
    return {
        f"sun{i}": {
            "type": "directional",
            "direction": [0.2 * i - 0.6, 0.3, -1],
            "irradiance": rgb([factor * (i + 1), factor, factor]),
        }
        for i in range(7)
    }


def render(case, factor, **parameters):
    """An image over `factor`, whose sums still fit into floats."""
    scene = mi.load_dict({**light_scenes.stage(), **CASES[case](factor)})
    integrator = mi.load_dict({"type": "manylights_direct", **parameters})
    image = mi.render(scene, integrator=integrator, spp=8, seed=3)
    return np.array(image, dtype=np.float64) / factor


@pytest.mark.parametrize(
    "variant", ["scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono_polarized"], indirect=True
)
@pytest.mark.parametrize("case", CASES)
def test_image_does_not_depend_on_unit(variant, case):
    """The same choices in any unit: not only the mean, each pixel is the same."""
    expected = render(case, 1.0)
    assert expected.mean() > 0
    for factor in FACTORS:
        found = render(case, factor)
        error = np.abs(found - expected).mean() / np.abs(expected).mean()
        assert error < 0.01, f"times {factor:g}: mean {found.mean()}, not {expected.mean()}"


@pytest.mark.parametrize("method", METHODS)
def test_methods_do_not_depend_on_unit(llvm, method):
    """All of them, without the second pass' noise of rounding."""
    expected = render("triangles", 1.0, method=method)
    for factor in FACTORS:
        found = render("triangles", factor, method=method)
        error = np.abs(found - expected).mean() / expected.mean()
        assert error < 0.01, f"times {factor:g}: mean {found.mean()}, not {expected.mean()}"


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
@pytest.mark.parametrize("factor", [1e-30, 1e30])
def test_unit_changes_between_renderings(variant, factor):
    """The tree that is kept follows: intensities are changed in place."""
    integrator = mi.load_dict({"type": "manylights_direct"})
    scene = mi.load_dict({**light_scenes.stage(), **light_scenes.points(25)})
    expected = np.array(mi.render(scene, integrator=integrator, spp=8, seed=3))
    params = mi.traverse(scene)
    for key in list(params.keys()):
        if key.endswith("intensity.value"):
            params[key] = params[key] * factor
    params.update()
    found = np.array(mi.render(scene, integrator=integrator, spp=8, seed=3), dtype=float) / factor
    assert np.abs(found - expected).mean() < 0.01 * expected.mean()


def test_lights_of_all_brightnesses(llvm):
    """A light 1e30 times brighter than the others, and hidden, takes nothing from their light."""
    lights = light_scenes.points(25)
    buried = {"type": "point", "position": [0, 0, -50], "intensity": rgb([1e30, 1e30, 1e30])}
    images = []
    for extra in ({}, {"buried": buried}):
        scene = mi.load_dict({**light_scenes.stage(), **lights, **extra})
        integrator = mi.load_dict({"type": "manylights_direct", "method": "exhaustive"})
        images.append(np.array(mi.render(scene, integrator=integrator, spp=256, seed=3)))
    assert images[1].mean() == pytest.approx(images[0].mean(), rel=0.02)

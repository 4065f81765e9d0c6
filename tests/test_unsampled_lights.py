"""Lights that light sampling never chooses: of `sampling_weight` 0, or without a way to do so."""

import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests import statistics_tools as tools
from tests.light_scenes import area, rgb, transform
from tests.test_bad_input import warnings  # noqa: F401

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)

COLOUR = rgb([3, 2, 1])
LIGHTS = {
    "sphere": {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.4, "emitter": area(COLOUR)},
    "mesh": {"type": "cube", "emitter": area(COLOUR)},
    "sky": {"type": "constant", "radiance": COLOUR},
    "point": {"type": "point", "position": [0, 0, 1.5], "intensity": COLOUR},
    "sun": {"type": "directional", "direction": [0.1, 0.2, -1], "irradiance": COLOUR},
}


def weighted(light, weight):
    """The light with a sampling weight."""
    if light["type"] == "cube":
        light = light | {"to_world": transform().translate([0, 0, 1.5]).scale(0.3)}
    if "emitter" in light:
        return light | {"emitter": light["emitter"] | {"sampling_weight": weight}}
    return light | {"sampling_weight": weight}


def load(light):
    """Points above a floor, and the light."""
    scene = light_scenes.stage(block=False)
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    return mi.load_dict({**scene, **light_scenes.points(12, total=1.0), "light": light})


def images(scene, **integrator):
    """Renderings of direct light."""
    return tools.render_seeds(scene, mi.load_dict(integrator), 64, range(12))


@VARIANTS
@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("bsdf_samples", [0, 1])
def test_weight_of_zero(variant, name, bsdf_samples):
    """Never chosen, so that it is dark if rays cannot hit it, as in Mitsuba's integrators."""
    scene = load(weighted(LIGHTS[name], 0.0))
    found = images(scene, type="manylights_direct", bsdf_samples=bsdf_samples)
    expected = images(scene, type="direct", emitter_samples=1, bsdf_samples=bsdf_samples)
    tools.assert_same_mean(found, expected, bias=0.5, label=name)


@VARIANTS
def test_other_weights_do_not_matter(variant):
    """Same bits."""
    pictures = [
        np.array(
            mi.render(
                load(weighted(LIGHTS["point"], weight)),
                integrator=mi.load_dict({"type": "manylights_direct"}),
                spp=4,
            )
        )
        for weight in (1.0, 7.0)
    ]
    np.testing.assert_array_equal(*pictures)


CURVE = {"type": "bsplinecurve", "emitter": area(COLOUR)}


@pytest.mark.parametrize("bsdf_samples", [0, 1])
def test_lights_for_rays_alone_are_named(scalar, warnings, tmp_path, bsdf_samples):  # noqa: F811
    """Where no rays look for them, a warning names the first; otherwise there is none."""
    path = tmp_path / "curve.txt"
    path.write_text("".join(f"{x} 0 1.5 0.1\n" for x in np.linspace(-1, 1, 6)))
    scene = load({**CURVE, "filename": str(path)})
    warnings.clear()
    mi.render(
        scene,
        integrator=mi.load_dict({"type": "manylights_direct", "bsdf_samples": bsdf_samples}),
        spp=1,
    )
    texts = [text for text in warnings if "bsdf_samples" in text]
    assert len(texts) == (bsdf_samples == 0)
    assert all("1 of the scene's emitters" in text and '"light"' in text for text in texts)

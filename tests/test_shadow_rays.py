"""How many shadow rays are traced: a light that is hidden shows it."""

import math

import mitsuba as mi
import numpy as np
import pytest

HEIGHT, OFFSET, INTENSITY, ALBEDO = 1.0, 0.75, 3.0, 0.5


def two_points():
    """Two equal lights above a point of a floor, one of them hidden."""
    transform = mi.ScalarTransform4f

    def light(x):
        return {"type": "point", "position": [x, 0, HEIGHT], "intensity": INTENSITY}

    blocker = transform().translate([OFFSET / 2, 0, HEIGHT / 2]).scale(0.05)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 0.01,
                "to_world": transform().look_at([0, -1, 4], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 8, "rfilter": {"type": "box"}},
            },
            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": ALBEDO}},
            "blocker": {"type": "sphere", "to_world": blocker},
            "seen": light(-OFFSET),
            "hidden": light(OFFSET),
        }
    )


def radiance_of_one():
    distance2 = HEIGHT**2 + OFFSET**2
    return ALBEDO / math.pi * INTENSITY * HEIGHT / distance2**1.5


@pytest.mark.parametrize(
    "parameters", [{"method": "exhaustive"}, {"splitting_rate": math.inf}], ids=str
)
@pytest.mark.parametrize("reservoirs", [1, 2])
@pytest.mark.parametrize("variant", ["scalar", "llvm"])
def test_no_more_shadow_rays_than_wanted(variant, plugin, parameters, reservoirs, request):
    """One ray finds twice the light of one, or nothing; two find just that light.

    Of 128 pixels all are alike with a probability of 2^-127.
    """
    request.getfixturevalue(variant)
    integrator = {"type": "manylights_direct", "bsdf_samples": 0, **parameters}
    integrator |= {"reservoirs": reservoirs, "shadow_rays": reservoirs}
    image = mi.render(two_points(), integrator=mi.load_dict(integrator), spp=1, seed=3)
    found = np.array(image)[..., 0] / radiance_of_one()
    levels = [0, 2] if reservoirs == 1 else [1]
    nearest = np.array(levels)[np.abs(found[..., None] - levels).argmin(-1)]
    np.testing.assert_allclose(found, nearest, atol=2e-3)
    assert set(np.unique(nearest)) == set(levels)

"""The film channels that the parameter `counts` adds."""

import mitsuba as mi
import numpy as np
import pytest
from manylights import scenes

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
both_plugins = pytest.mark.parametrize("plugin", ["manylights_direct", "manylights_volpath"])

LIGHTS = 300


def render(plugin, lights=LIGHTS, scene=scenes.open_plane, **parameters):
    """A small image of a plane below point lights, the same points of it for all parameters."""
    if plugin == "manylights_volpath":
        parameters.setdefault("max_depth", 2)
    scene = scene(lights, width=24, height=16)
    scene["sensor"]["sampler"] = {"type": "manylights_sobol"}
    scene = mi.load_dict(scene)
    integrator = mi.load_dict({"type": plugin, **parameters})
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=5))


def counts_of(plugin, **parameters):
    """Mean number of candidates and of visited nodes, and the most candidates of a pixel."""
    image = render(plugin, counts=True, **parameters)
    return image[..., 3].mean(), image[..., 4].mean(), image[..., 3].max()


@both_variants
@both_plugins
def test_colours_stay_the_same(variant, plugin):
    """Three channels follow the colours, which change by rounding only (a kernel of its own)."""
    plain, counted = render(plugin), render(plugin, counts=True)
    assert plain.shape[2] == 3 and counted.shape[2] == 6
    np.testing.assert_allclose(counted[..., :3], plain, rtol=1e-5, atol=1e-7)
    assert np.isfinite(counted).all()


@both_variants
@both_plugins
def test_counts_of_the_methods(variant, plugin):
    """What is known of each method: bounds, one descent, all lights."""
    candidates, visits, most = counts_of(plugin)
    assert 1 < candidates <= most <= 16
    assert visits > candidates
    candidates, visits, _ = counts_of(plugin, method="tree")
    assert 0 < candidates <= 1
    assert candidates <= visits
    seen = candidates  # the share of the samples that meet a surface
    assert counts_of(plugin, method="exhaustive")[:2] == (pytest.approx(seen * LIGHTS), 0)
    for method in ("talk", "adaptive_splitting"):
        few, many = (counts_of(plugin, method=method, splitting_rate=r)[0] for r in (0.25, 4))
        assert seen <= few < many < LIGHTS


@both_variants
def test_without_a_tree_no_node_is_visited(variant):
    """As few lights as reservoirs are all candidates."""
    candidates, visits, _ = counts_of("manylights_direct", lights=3)
    assert (candidates, visits) == (pytest.approx(3, rel=0.3), 0)


@both_variants
def test_paths_add_up_their_vertices(variant):
    """Each further vertex considers some lights more."""
    one, two = (
        counts_of("manylights_volpath", scene=scenes.fog_open, max_depth=depth)[0]
        for depth in (3, 5)
    )
    assert one < two


@both_variants
def test_names_of_the_channels(variant):
    """They are names of film channels, also behind those of `aov`."""
    ours = {"type": "manylights_direct", "counts": True}
    assert channels(ours) == ["R", "G", "B", "candidates", "node_visits", "expected"]
    talk = {**ours, "method": "talk"}
    assert channels(talk) == ["R", "G", "B", "candidates", "node_visits"]
    nested = channels({"type": "aov", "aovs": "depth:depth", "image": ours})
    assert nested[-4:] == [
        *("image.candidates", "image.node_visits", "image.expected"),
        "depth.T",
    ]
    assert not mi.load_dict({"type": "manylights_direct"}).aov_names()


def channels(integrator):
    """Names of the channels of the film after a render."""
    scene = mi.load_dict(scenes.open_plane(20, width=8, height=8))
    mi.render(scene, integrator=mi.load_dict(integrator), spp=1)
    return [field.name for field in scene.sensors()[0].film().bitmap().struct_()]

"""`manylights_direct` has the same mean as three independent estimates of direct light.

Each comparison is one of image and tile means over seeds (`statistics_tools`), with as many
samples as a bias of 2 % of the image mean needs to be found. The last tests plant such a bias.
"""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest

from tests import closed_form, light_scenes
from tests import statistics_tools as tools
from tests.conftest import require_variant
from tests.path_references import quick_and_slow
from tests.references import (
    ERROR,
    assert_same_mean,
    compare_means,
    planned_images,
    reference_images,
    reference_variant,
)

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

INFINITY = float("inf")

# Mitsuba samples these lights wrongly (see light_scenes), its BSDF sampling is right.
BSDF_ONLY = ("mesh-smooth",)

# The exhaustive sum is checked against Mitsuba's choice of one light for all kinds of lights; for
# materials, where that choice needs many samples, these are enough.
CHECKED_MATERIALS = ("material-twosided", "material-roughplastic", "material-dielectric")


# Minutes in scalar variants, where more than a glossy lobe or a mirror has to be averaged.
SLOW_SCENES = (
    "material-blend",
    "material-mask",
    "material-plastic",
    "material-roughdielectric",
)

# Scenes for the second method and for the variants that differ in their spectra only.
SUBSET = (
    "points",
    "spots",
    "mesh-constant",
    "mesh-face-colours",
    "textured",
    "projectors",
    "sky",
    "mixed",
    "points-17",
    "material-roughconductor",
    "material-principled",
    "material-roughdielectric",
    "material-dielectric",
    "material-mask",
)

# In spectral variants a mesh attribute is a reflectance spectrum, not one of a light: the colours
# of faces differ from those of separate lights.
SPECTRAL_SUBSET = tuple(
    name for name in SUBSET if name not in SLOW_SCENES and not name.startswith("mesh")
)

# The others take up to ten seconds each.
QUICK_SPECTRAL = [name for name in SPECTRAL_SUBSET if not name.startswith("material-")]

# One-factor variations of the parameters, then combinations of extremes.
PARAMETERS = (
    {"splitting_rate": 0},
    {"splitting_rate": 0.2},
    {"splitting_rate": 4},
    {"splitting_rate": INFINITY},
    {"reservoirs": 1, "shadow_rays": 1},
    {"reservoirs": 4, "shadow_rays": 1},
    {"reservoirs": 8, "shadow_rays": 2},
    {"reservoirs": 16, "shadow_rays": 1},
    {"reservoirs": 16, "shadow_rays": 3},
    {"reservoirs": 16, "shadow_rays": 4},
    {"bsdf_samples": 0},
    {"bsdf_samples": 2},
    {"splitting_rate": 0, "reservoirs": 1, "shadow_rays": 1, "bsdf_samples": 0},
    {"splitting_rate": INFINITY, "reservoirs": 4, "shadow_rays": 4, "bsdf_samples": 2},
    {"splitting_rate": 4, "reservoirs": 8, "shadow_rays": 1, "bsdf_samples": 0},
)
METHODS = ("resampled_tree", "talk")
OTHER_METHODS = ("adaptive_splitting", "tree", "exhaustive")


def parameter_id(parameters):
    """A readable test id: `reservoirs=4,shadow_rays=1`."""
    return ",".join(f"{name}={value}" for name, value in parameters.items())


def light_tree(**parameters):
    """The integrator under test."""
    return mi.load_dict({"type": "manylights_direct", **parameters})


def reference_kinds(name, kinds):
    """The kinds of references that are right for the scene."""
    if name in BSDF_ONLY:
        return ("bsdf",)
    if name.startswith("material") and name not in CHECKED_MATERIALS:
        return ("exhaustive",)
    return kinds


def plugin_images(name, **parameters):
    """Images of the integrator under test in the current variant."""
    scene = light_scenes.load(name)
    return planned_images(scene, light_tree(**parameters), ERROR["tested"], first_seed=0)


def assert_unbiased(name, variant, kinds, **parameters):
    """Compare the integrator with references of the given kinds; return its images."""
    images = plugin_images(name, **parameters)
    assert (images >= 0).all()
    matched = {
        key: parameters[key] for key in ("bsdf_samples", "hide_emitters") if key in parameters
    }
    matched["bsdf_samples"] = min(matched.get("bsdf_samples", 1), 1)
    for kind in reference_kinds(name, kinds):
        reference = reference_images(name, kind, reference_variant(variant), **matched)
        assert_same_mean(images, reference, label=f"{name}, {variant}, {kind}")
    return images


THREE_KINDS = ("exhaustive", "uniform", "power")


@pytest.mark.parametrize(
    "name",
    quick_and_slow(
        [name for name in light_scenes.SCENES if reference_kinds(name, THREE_KINDS)[1:]], SUBSET
    ),
)
def test_references_agree(llvm, name):
    """The references have one mean; a disagreement would be the test's own mistake."""
    first = reference_images(name, "exhaustive", llvm)
    for kind in ("uniform", "power"):
        assert_same_mean(first, reference_images(name, kind, llvm), label=f"{name}, {kind}")


@pytest.mark.parametrize("name", quick_and_slow(light_scenes.SCENES, SUBSET))
def test_mean_equals_exhaustive_uniform_and_power_sampling(llvm, name):
    """All lights and materials in llvm_ad_rgb against all references."""
    assert_unbiased(name, llvm, THREE_KINDS)


@pytest.mark.parametrize("name", [name for name in light_scenes.SCENES if name not in SUBSET])
def test_mean_equals_exhaustive_sum(llvm, name):
    """Against the sharpest reference those that take long with all three."""
    assert_unbiased(name, llvm, ("exhaustive",))


def scalar_scenes():
    """All scenes; those that take long are marked."""
    return [
        pytest.param(name, marks=[pytest.mark.slow] if name in SLOW_SCENES else [])
        for name in light_scenes.SCENES
    ]


@pytest.mark.parametrize("name", scalar_scenes())
def test_mean_in_scalar_variant(scalar, name):
    """All lights and materials in scalar_rgb."""
    assert_unbiased(name, scalar, ("exhaustive",))


@pytest.mark.parametrize("name", quick_and_slow(SPECTRAL_SUBSET, QUICK_SPECTRAL))
def test_mean_in_spectral_variant(name):
    """Spectra with random wavelengths."""
    require_variant("scalar_spectral")
    assert_unbiased(name, "scalar_spectral", ("exhaustive",))


@pytest.mark.parametrize("name", SUBSET)
def test_mean_in_polarized_variant(name):
    """Mueller matrices."""
    assert_unbiased(name, require_variant("llvm_ad_mono_polarized"), ("exhaustive",))


@pytest.mark.parametrize("name", [name for name in SUBSET if name not in SLOW_SCENES])
def test_mean_of_talk_method(llvm, name):
    """The method of the talk has the same mean."""
    assert_unbiased(name, llvm, ("exhaustive",), method="talk")


@pytest.mark.parametrize(
    "name", ["points", "spots", "textured", "mixed", "material-roughconductor"]
)
@pytest.mark.parametrize("method", OTHER_METHODS)
def test_mean_of_other_methods(llvm, method, name):
    """Those that are there for comparison have the same mean, too."""
    assert_unbiased(name, llvm, ("exhaustive",), method=method)


@pytest.mark.parametrize(
    "parameters",
    [
        {"splitting_rate": 0},
        {"splitting_rate": 4},
        {"splitting_rate": INFINITY},
        {"bsdf_samples": 0},
    ],
    ids=parameter_id,
)
def test_mean_of_adaptive_splitting_does_not_depend_on_parameters(llvm, parameters):
    """Every cut has the same mean."""
    assert_unbiased("mixed", llvm, ("exhaustive",), method="adaptive_splitting", **parameters)


@pytest.mark.parametrize("name", ["mirrored", "mesh-smooth", "hard-spots", "many-suns"])
def test_light_samples_reach_all_light(llvm, name):
    """Without BSDF samples nothing can make up for light that is never sampled."""
    images = plugin_images(name, bsdf_samples=0)
    kind = "bsdf" if name == "mesh-smooth" else "exhaustive"
    reference = reference_images(name, kind, reference_variant(llvm))
    assert_same_mean(images, reference, label=f"{name}, {llvm}, light samples alone")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parameters", PARAMETERS, ids=parameter_id)
def test_mean_does_not_depend_on_parameters(llvm, parameters, method):
    """Every setting trades noise for time and leaves the mean alone."""
    assert_unbiased("mixed", llvm, ("exhaustive",), method=method, **parameters)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parameters", PARAMETERS[::3], ids=parameter_id)
def test_mean_does_not_depend_on_parameters_in_scalar_variant(scalar, parameters, method):
    """The same for a glossy material in scalar_rgb."""
    name = "material-roughplastic"
    assert_unbiased(name, scalar, ("exhaustive",), method=method, **parameters)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_mean_with_hidden_emitters(variant):
    """Hidden emitters disappear for the camera and still give light."""
    gone = assert_unbiased("visible-lights", variant, ("uniform",), hide_emitters=True)
    assert not compare_means(plugin_images("visible-lights"), gone).passes


@pytest.mark.parametrize(
    "name",
    quick_and_slow(
        ["material-roughconductor", "material-dielectric", "mixed"], ["material-roughconductor"]
    ),
)
def test_mean_of_stokes_vector(name):
    """The light keeps its polarization: all four Stokes components agree."""
    require_variant("llvm_ad_mono_polarized")
    scene = light_scenes.load(name)
    images, reference = (
        stokes_images(scene, integrator, range(first_seed, first_seed + 8), spp)
        for integrator, first_seed, spp in (("manylights_direct", 0, 256), ("direct", 1000, 2048))
    )
    assert_same_mean(images, reference, power_channels=slice(0, 1), label=name)
    # The comparison means something where the material polarizes the light.
    unpolarized = compare_means(reference[..., 1:], 0 * reference[..., 1:])
    assert unpolarized.passes == (name == "mixed")


def stokes_images(scene, integrator, seeds, spp):
    """Images of the four components, from the three equal channels that `stokes` writes of each."""
    nested = mi.load_dict({"type": "stokes", "nested": {"type": integrator}})
    images = tools.render_seeds(scene, nested, spp, seeds)
    return images[..., -12::3]


CAMERA = closed_form.Camera((0, -2, 3), (0, 0, 0), (0, 0, 1), 40, 6, 4)
ALBEDO = (0.7, 0.5, 0.3)


def plane_lights(count=40):
    """Point and spot lights above the plane of the closed form."""
    generator = np.random.default_rng(12)
    lights = []
    for index in range(count):
        position = tuple(generator.uniform((-1.5, -1.5, 0.8), (1.5, 1.5, 2.0)))
        light = closed_form.Light(position, tuple(generator.uniform(0.05, 1, 3)))
        if index % 2:
            axis = tuple(generator.normal(size=3) * 0.4 - (0, 0, 1))
            cutoff = generator.uniform(20, 60)
            light = dataclasses.replace(
                light, axis=axis, cutoff_degrees=cutoff, beam_degrees=0.6 * cutoff
            )
        lights.append(light)
    return lights


@pytest.mark.parametrize("method", METHODS + OTHER_METHODS)
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_mean_equals_closed_form(variant, method):
    """Point and spot lights above a plane, against quadrature without Mitsuba, pixel by pixel."""
    lights = plane_lights()
    exact = closed_form.plane_image(CAMERA, lights, ALBEDO)[np.newaxis]
    scene = mi.load_dict(closed_form.scene_dict(CAMERA, lights, ALBEDO))
    integrator = light_tree(method=method)
    images = planned_images(scene, integrator, ERROR["tested alone"], first_seed=0)
    comparison = compare_means(images, exact, tile=1)
    assert comparison.passes, comparison.message(f"closed form, {variant}")
    assert comparison.detectable_bias() <= tools.BIAS


def test_closed_form_agrees_with_mitsuba(llvm):
    """The closed form reads camera and lights as Mitsuba does."""
    lights = plane_lights()
    exact = closed_form.plane_image(CAMERA, lights, ALBEDO)[np.newaxis]
    scene = mi.load_dict(closed_form.scene_dict(CAMERA, lights, ALBEDO))
    integrator = mi.load_dict({"type": "direct"})
    images = planned_images(scene, integrator, ERROR["tested alone"], first_seed=0)
    assert_same_mean(images, exact, tile=1)


def test_planted_bias_of_image_is_found(llvm):
    """The images of the integrator, made 2 % brighter or darker, no longer pass."""
    images = plugin_images("mixed")
    reference = reference_images("mixed", "exhaustive", llvm)
    assert_same_mean(images, reference)
    for factor in (1.02, 1 / 1.02):
        with pytest.raises(AssertionError, match="significance"):
            assert_same_mean(factor * images, reference)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_planted_bias_of_one_light_is_found(variant):
    """One light of the scene, brightened such that the image mean grows by 2 %, is found."""
    name, light = "points", "point_7"
    lights = light_scenes.SCENES[name]()
    reference = reference_images(name, "exhaustive", reference_variant(variant))
    only = {key: value for key, value in lights.items() if value_is_kept(key, light)}
    direct = mi.load_dict({"type": "direct"})
    share = planned_images(mi.load_dict(only), direct, 1e-2, 500_000, known=True)
    factor = 1 + 0.02 * reference.mean() / share.mean()
    colour = lights[light]["intensity"]["value"]
    lights[light]["intensity"]["value"] = [factor * value for value in colour]
    brighter = planned_images(mi.load_dict(lights), light_tree(), ERROR["tested"], first_seed=0)
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(brighter, reference)


def value_is_kept(key, light):
    """True for everything but the other point lights."""
    return key == light or not key.startswith("point_")

"""`manylights_volpath` has the same mean as Mitsuba's `path` and, where there are media, `volpath`.

Each comparison is one of image and tile means over seeds (`statistics_tools`), with as many samples
as a bias of 2 % of the image mean needs to be found. The quick tests take one scene of each kind,
the slow ones all of them. The last tests plant a bias in each group, which has to be found.
"""

import mitsuba as mi
import numpy as np
import pytest

from tests import path_scenes
from tests import statistics_tools as tools
from tests.conftest import require_variant
from tests.path_references import (
    MAX_DEPTH,
    METHODS,
    PARAMETERS,
    depth_of,
    known,
    known_images,
    light_tree,
    parameter_id,
    plugin_images,
    quick_and_slow,
    weigh_emitters,
)
from tests.references import (
    ERROR,
    assert_same_mean,
    compare_means,
    planned_images,
    reference_variant,
)
from tests.test_determinism import digest

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
llvm_first = pytest.mark.parametrize(
    "variant", quick_and_slow(["scalar_rgb", "llvm_ad_rgb"], ["llvm_ad_rgb"]), indirect=True
)

# One scene for each feature; the others differ in details.
QUICK = (
    "gallery",
    "mirrors",
    "smoke",
    "camera-inside",
    "points-in-bubble",
    "room",
    "environment",
)
QUICK_SCALAR = ("mirrors", "nested")
QUICK_SPECTRAL = ("mirrors", "points-unbounded")
POLARIZED = ("gallery", "gallery-environment", "mirrors", "fog", "smoke", "nested", "fog-in-glass")

# In `path`, what lets light through counts as a bounce and blocks shadow rays; not in `volpath`.
TRANSPARENT = (
    "gallery",
    "gallery-environment",
    "mirrors",
    "visible-through",
    "silhouettes",
    "material-mask",
    "material-null",
    "material-thindielectric",
)

OPAQUE = [name for name in path_scenes.SURFACES if name not in TRANSPARENT]

VISIBLE = quick_and_slow(["visible-through", "visible-lamps"], ["visible-through"])
"""Scenes whose emitters the camera sees."""

ALL_DEPTHS = -1
DEPTHS = (2, 9, ALL_DEPTHS)


def matched(parameters):
    """What the reference has to have in common with the integrator under test."""
    shared = ("max_depth", "rr_depth", "hide_emitters")
    return {key: value for key, value in parameters.items() if key in shared}


def assert_unbiased(name, variant, sensor=0, **parameters):
    """Compare the integrator with Mitsuba's; return its images."""
    images = plugin_images(name, sensor, **parameters)
    assert (images >= 0).all()
    reference = known_images(name, reference_variant(variant), sensor, **matched(parameters))
    assert_same_mean(images, reference, label=f"{name}, {variant}, {parameters}")
    return images


# ------------------------------------------------------------------------------------- references


@pytest.mark.slow
@pytest.mark.parametrize("name", OPAQUE)
def test_path_agrees_with_volpath(llvm, name):
    """Without media and what lets light through, the references are two estimates of one mean."""
    assert_reference_agrees(name, "volpath")


@pytest.mark.slow
@pytest.mark.parametrize("name", path_scenes.FOGS)
def test_volpath_agrees_with_volpathmis(llvm, name):
    """Mitsuba's other path tracer for media, as a second reference."""
    assert_reference_agrees(name, "volpathmis")


def assert_reference_agrees(name, other):
    """Compare the reference of a scene with another integrator of Mitsuba."""
    integrator = mi.load_dict({"type": other, "max_depth": depth_of(name)})
    scene = path_scenes.load(name)
    weigh_emitters(name, scene)
    images = planned_images(scene, integrator, ERROR["uniform"], 200_000, known=True)
    assert_same_mean(images, known_images(name, mi.variant()), label=f"{name}, {other}")


# ------------------------------------------------------------------------------------------- means


@pytest.mark.parametrize("name", quick_and_slow(path_scenes.SCENES, QUICK))
def test_mean(llvm, name):
    """All scenes in llvm_ad_rgb, three bounces."""
    assert_unbiased(name, llvm)


@pytest.mark.parametrize("name", quick_and_slow(path_scenes.SCENES, QUICK_SCALAR))
def test_mean_in_scalar_variant(scalar, name):
    """All scenes in scalar_rgb."""
    assert_unbiased(name, scalar)


@pytest.mark.parametrize("name", quick_and_slow(path_scenes.SCENES, QUICK_SPECTRAL))
def test_mean_in_spectral_variant(name):
    """Spectra with random wavelengths."""
    assert_unbiased(name, require_variant("llvm_ad_spectral"))


@pytest.mark.slow
@pytest.mark.parametrize("name", POLARIZED)
def test_mean_in_polarized_variant(name):
    """Mueller matrices."""
    assert_unbiased(name, require_variant("llvm_ad_mono_polarized"))


@pytest.mark.parametrize("depth", quick_and_slow(DEPTHS, [9]))
def test_mean_of_bounces(llvm, depth):
    """One and eight bounces between bright walls, and all of them."""
    assert_unbiased("bright-walls", llvm, max_depth=depth)


@pytest.mark.slow
@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize(
    "name",
    ["gallery", "mirrors", "fog", "fog-chromatic", "smoke", "nested", "fog-in-glass", "room"],
)
def test_mean_at_depth(llvm, name, depth):
    """The same with glass, mirrors, colours and several media."""
    assert_unbiased(name, llvm, max_depth=depth)


@pytest.mark.slow
@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("name", ["bright-walls", "fog", "smoke"])
def test_mean_at_depth_in_scalar_variant(scalar, name, depth):
    """The same in scalar_rgb."""
    assert_unbiased(name, scalar, max_depth=depth)


@llvm_first
@pytest.mark.parametrize("name", VISIBLE)
def test_mean_of_visible_emitters(variant, name):
    """With `max_depth` 1 only what the camera sees directly."""
    assert_unbiased(name, variant, max_depth=1)


@both_variants
@pytest.mark.parametrize("name", ["visible-through", "visible-lamps"])
def test_no_light_without_segments(variant, name):
    """With `max_depth` 0 all is black."""
    scene, integrator = path_scenes.load(name), light_tree(max_depth=0)
    assert (tools.render_seeds(scene, integrator, 4, range(2)) == 0).all()


@llvm_first
@pytest.mark.parametrize("name", VISIBLE)
def test_mean_with_hidden_emitters(variant, name):
    """Hidden emitters disappear for the camera and still give light."""
    gone = assert_unbiased(name, variant, hide_emitters=True)
    assert not compare_means(plugin_images(name), gone).passes


@pytest.mark.parametrize("name", quick_and_slow(["dark", "fog-chromatic"], ["dark"]))
@pytest.mark.parametrize("rr_depth", quick_and_slow([1, 2], [1]))
def test_mean_with_early_russian_roulette(llvm, name, rr_depth):
    """Low albedos end most paths."""
    assert_unbiased(name, llvm, max_depth=9, rr_depth=rr_depth)


@llvm_first
@pytest.mark.parametrize("parameters", [*METHODS, *PARAMETERS], ids=parameter_id)
@pytest.mark.parametrize("name", ["camera-inside", "smoke"])
def test_every_setting_gives_numbers(variant, name, parameters):
    """No setting divides by the nothing that an empty reservoir holds."""
    integrator = light_tree(max_depth=3, **parameters)
    image = mi.render(path_scenes.load(name), integrator=integrator, spp=8, seed=3)
    tools.assert_finite(np.array(image), name)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=parameter_id)
@pytest.mark.parametrize("name", ["gallery", "fog", "smoke", "points-in-bubble"])
def test_mean_of_method(llvm, name, method):
    """All methods have one mean; see also `test_path_closed_forms`."""
    assert_unbiased(name, llvm, **method)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[:2], ids=parameter_id)
@pytest.mark.parametrize("parameters", PARAMETERS, ids=parameter_id)
@pytest.mark.parametrize("name", ["gallery", "camera-inside"])
def test_mean_does_not_depend_on_parameters(llvm, name, parameters, method):
    """Every setting trades noise for time and leaves the mean alone."""
    assert_unbiased(name, llvm, **method, **parameters)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[:2], ids=parameter_id)
@pytest.mark.parametrize("parameters", PARAMETERS[::3], ids=parameter_id)
def test_mean_does_not_depend_on_parameters_in_scalar_variant(scalar, parameters, method):
    """The same in scalar_rgb."""
    assert_unbiased("fog-chromatic", scalar, **method, **parameters)


@pytest.mark.slow
@both_variants
@pytest.mark.parametrize("name", ["gallery", "fog"])
def test_mean_with_stratified_sampler(variant, name):
    """Paths that ask for different amounts of random numbers do not spoil the strata."""
    scene = path_scenes.SCENES[name]()
    scene["sensor"]["sampler"] = {"type": "multijitter"}
    integrator = light_tree(max_depth=MAX_DEPTH)
    images = planned_images(mi.load_dict(scene), integrator, ERROR["tested"], first_seed=0)
    reference = known_images(name, reference_variant(variant))
    assert_same_mean(images, reference, label=f"{name}, {variant}")


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [0, 1])
def test_mean_of_two_cameras(llvm, sensor):
    """One camera in fog and one outside of it."""
    assert_unbiased("two-cameras", llvm, sensor)


@both_variants
def test_cameras_in_turn(variant):
    """One integrator renders both cameras, in any order, as new ones do."""
    scene, integrator = path_scenes.load("two-cameras"), light_tree(max_depth=MAX_DEPTH)
    for sensor in (0, 1, 0):
        fresh = light_tree(max_depth=MAX_DEPTH)
        found, expected = (
            np.array(mi.render(scene, sensor=sensor, integrator=i, spp=4, seed=3))
            for i in (integrator, fresh)
        )
        assert np.array_equal(found, expected)


@both_variants
@pytest.mark.parametrize("name", quick_and_slow(["mirrors", "camera-inside"], ["mirrors"]))
def test_mean_under_nesting(variant, name):
    """As part of `aov`, which adds the distance; the colours and the distance agree."""
    scene = path_scenes.load(name)
    images, reference = (
        planned_images(scene, with_distance(integrator), ERROR["tested"], first_seed)
        for integrator, first_seed in (
            (light_tree(max_depth=MAX_DEPTH), 0),
            (known(name, max_depth=MAX_DEPTH), 100_000),
        )
    )
    assert images.shape[-1] == 4
    assert_same_mean(images, reference, label=f"{name}, {variant}, aov")


def with_distance(integrator):
    """The integrator inside of `aov`."""
    return mi.load_dict({"type": "aov", "aovs": "distance:depth", "image": integrator})


# ------------------------------------------------------------------------------------------- alpha


def alpha_images(name, integrator, first_seed, description=None, count=6):
    """The alpha channel alone, which needs few samples."""
    scene = description or path_scenes.SCENES[name]()
    scene["sensor"]["film"]["pixel_format"] = "rgba"
    seeds = range(first_seed, first_seed + count)
    return tools.render_seeds(mi.load_dict(scene), integrator, 65, seeds)[..., 3:]


def assert_same_alpha(name, count=6, **parameters):
    """Compare the share of valid rays with that of Mitsuba's integrator in the same variant."""
    images = alpha_images(name, light_tree(**parameters), 0, count=count)
    reference = alpha_images(name, known(name, **parameters), 100_000, count=count)
    assert_same_mean(images, reference, label=f"{name}, {parameters}")
    return reference.mean(axis=0)


hidden = pytest.mark.parametrize("hide_emitters", [False, True], ids=["shown", "hidden"])


@both_variants
@hidden
@pytest.mark.parametrize("name", ["silhouettes", "fog-silhouettes"])
def test_alpha(variant, name, hide_emitters):
    """Glass, masks, lamps and fog with nothing behind them."""
    alpha = assert_same_alpha(name, max_depth=MAX_DEPTH, hide_emitters=hide_emitters)
    assert alpha.min() == 0 < alpha.max()


@both_variants
@hidden
@pytest.mark.parametrize("name", ["fog-silhouettes"])
def test_alpha_of_visible_emitters(variant, name, hide_emitters):
    """With `max_depth` 1; without media it differs by variant in Mitsuba's `path`."""
    assert_same_alpha(name, count=10, max_depth=1, hide_emitters=hide_emitters)


@both_variants
@hidden
@pytest.mark.parametrize(
    "name", quick_and_slow(["gallery-environment", "environment"], ["gallery-environment"])
)
def test_alpha_of_environment(variant, name, hide_emitters):
    """The sky is valid, unless emitters are hidden."""
    alpha = assert_same_alpha(name, max_depth=MAX_DEPTH, hide_emitters=hide_emitters)
    assert (alpha == 1).all() != hide_emitters


# ------------------------------------------------------------------------------------- determinism

# Powers of two: see test_determinism. LLVM variants learn visibility from 2^16 samples.
SAMPLES = {"scalar": 4, "llvm": 16, "cuda": 16}


@both_variants
@pytest.mark.parametrize("name", ["gallery", "fog-chromatic", "smoke"])
def test_image_does_not_depend_on_threads(variant, name, thread_count):
    """One, three and two threads, and two again give the same bits; another seed does not.

    All of one loaded scene: Mitsuba's order of several rectangles differs when it is loaded again.
    """
    scene = path_scenes.load(name, width=96, height=64)

    def rendered(seed=7):
        integrator, spp = light_tree(max_depth=MAX_DEPTH), SAMPLES[mi.variant().split("_")[0]]
        return digest(np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed)))

    thread_count(1)
    one = rendered()
    thread_count(3)
    assert rendered() == one
    thread_count(2)
    assert rendered() == one
    assert rendered() == one
    assert rendered(seed=8) != one


# ----------------------------------------------------------------------------------- planted biases


def scaled(description, factor, keys):
    """The description of a scene with all colours and numbers under the keys multiplied."""
    if not isinstance(description, dict):
        return description
    return {
        key: times(part, factor) if key in keys else scaled(part, factor, keys)
        for key, part in description.items()
    }


def times(part, factor):
    """A number, a colour or the scale of a medium, multiplied."""
    if isinstance(part, dict):
        return part | {"value": [factor * x for x in part["value"]]}
    return factor * part


BRIGHTNESS = ("intensity", "radiance", "irradiance")
PLANTED = {
    "light-surfaces": ("gallery", BRIGHTNESS, 1.02),
    "light-mirrors": ("mirrors", BRIGHTNESS, 1.02),
    "light-fog": ("camera-inside", BRIGHTNESS, 1.02),
    "light-smoke": ("smoke", BRIGHTNESS, 1.02),
    "light-unbounded": ("points-unbounded", BRIGHTNESS, 1.02),
    "extinction-fog": ("fog", ("sigma_t",), 1.2),
    "extinction-chromatic": ("fog-chromatic", ("sigma_t",), 1.08),
    "extinction-glass": ("fog-in-glass", ("scale",), 1.6),
    "density-smoke": ("smoke-chromatic", ("scale",), 1.5),
    "albedo-fog": ("fog", ("albedo",), 0.97),
    "albedo-nested": ("nested", ("albedo",), 0.95),
    "phase-hg-forward": ("phase-hg-forward", ("g",), 0.94),
    "phase-hg-backward": ("phase-hg-backward", ("g",), 0.85),
    "phase-blendphase": ("phase-blendphase", ("weight",), 3),
}
QUICK_PLANTED = ("extinction-fog",)


def planted_images(name, description):
    """Images of another scene with the settings for the scene `name`."""
    integrator = light_tree(max_depth=depth_of(name))
    return planned_images(mi.load_dict(description), integrator, ERROR["tested"], first_seed=0)


@pytest.mark.parametrize("case", quick_and_slow(PLANTED, QUICK_PLANTED))
def test_planted_bias_is_found(llvm, case):
    """Lights and media that differ do not pass: as little as makes 2 % of the image mean."""
    name, keys, factor = PLANTED[case]
    description = path_scenes.SCENES[name]()
    changed = scaled(description, factor, keys)
    assert str(changed) != str(description)
    images = planted_images(name, changed)
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(images, known_images(name, llvm))


PLANTED_CHANGES = {
    "bounces missing": ("bright-walls", {"max_depth": 5}),
    "scattering missing": ("fog", {"max_depth": 5}),
    "hidden": ("visible-lamps", {"hide_emitters": True}),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", PLANTED_CHANGES)
def test_planted_change_of_paths_is_found(llvm, change):
    """Paths that end too early, and lamps that are not seen, do not pass."""
    name, parameters = PLANTED_CHANGES[change]
    images = plugin_images(name, **({"max_depth": 9} | parameters))
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(images, known_images(name, llvm, max_depth=9))


@pytest.mark.slow
def test_planted_wrong_medium_is_found(llvm):
    """A ball in fog that has no medium on its outside: paths leave it into nothing."""
    scene = path_scenes.SCENES["nested"]()
    del scene["puff"]["exterior"]
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(planted_images("nested", scene), known_images("nested", llvm))


@pytest.mark.parametrize(
    "name", quick_and_slow(["bright-walls", "points-in-bubble"], ["points-in-bubble"])
)
def test_planted_bias_of_one_light_is_found(llvm, name):
    """One point light, brightened such that the image mean grows by 2 %, is found."""
    light, lights = "point_7", path_scenes.SCENES[name]()
    reference = known_images(name, llvm)
    only = {key: value for key, value in lights.items() if key == light or not is_light(value)}
    alone = known(name, max_depth=MAX_DEPTH)
    share = planned_images(mi.load_dict(only), alone, 1e-2, 500_000, known=True)
    factor = 1 + 0.02 * reference.mean() / share.mean()
    lights[light] = scaled(lights[light], factor, ("intensity",))
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(planted_images(name, lights), reference)


def is_light(part):
    """True for the description of a point light or of a shape that emits light."""
    return isinstance(part, dict) and (part["type"] == "point" or "emitter" in part)


def test_planted_bias_of_alpha_is_found(llvm):
    """Fog that is 30 % thicker changes the share of valid rays."""
    name, integrator = "fog-silhouettes", {"max_depth": MAX_DEPTH}
    thicker = scaled(path_scenes.SCENES[name](), 1.3, ("sigma_t",))
    images = alpha_images(name, light_tree(**integrator), 0, thicker)
    reference = alpha_images(name, known(name, **integrator), 100_000)
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(images, reference)

"""Path tracing where the answer is known without Mitsuba: furnaces, absorption, one scattering.

In a closed room whose walls emit E and reflect the share a of the light, the radiance is E/(1 - a)
in all directions, and that of paths with up to n segments a geometric sum. Nothing that absorbs no
light can be seen in it, neither glass nor white fog. The other images come from quadrature with
numpy (`closed_form`).
"""

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests import closed_form, path_scenes
from tests import statistics_tools as tools
from tests.light_scenes import HEIGHT, WIDTH
from tests.path_references import METHODS, PARAMETERS, light_tree, parameter_id, quick_and_slow
from tests.path_scenes import homogeneous, rgb
from tests.references import ERROR, assert_same_mean, planned_images

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
llvm_first = pytest.mark.parametrize(
    "variant", quick_and_slow(["scalar_rgb", "llvm_ad_rgb"], ["llvm_ad_rgb"]), indirect=True
)

CAMERA = closed_form.Camera((0, -2, 3), (0, 0, 0), (0, 0, 1), 40, 6, 4)
ALBEDO = (0.7, 0.5, 0.3)
EXTINCTION = (0.1, 0.2, 0.3)
FOG_CAMERA = closed_form.Camera((0, -3, 0), (0, 0, 0), (0, 0, 1), 30, 6, 4)


def images_of(scene, **parameters):
    """Images of the integrator under test."""
    scene = mi.load_dict(scene)
    return planned_images(scene, light_tree(**parameters), ERROR["tested alone"], first_seed=0)


def assert_exact(images, exact, tile=8, label=""):
    """Compare with known pixel values; the same images may not pass for 2 % more."""
    exact = np.broadcast_to(exact, images.shape[1:])[np.newaxis]
    assert_same_mean(images, exact, tile=tile, label=label)
    for factor in (1.02, 1 / 1.02):
        with pytest.raises(AssertionError, match="significance"):
            assert_same_mean(images, factor * exact, tile=tile)


# ---------------------------------------------------------------------------------------- furnaces


@both_variants
@pytest.mark.parametrize("depth", quick_and_slow([1, 2, 3, 8, -1], [1, 2, -1]))
def test_furnace(variant, depth):
    """Each bounce adds one term of the geometric sum."""
    images = images_of(path_scenes.furnace(), max_depth=depth)
    assert_exact(images, path_scenes.furnace_radiance(depth))


@both_variants
def test_furnace_with_lossless_things(variant):
    """Glass, mirrors, white and holes cannot be seen."""
    images = images_of(path_scenes.furnace(things=path_scenes.lossless_things()))
    assert_exact(images, path_scenes.furnace_radiance(-1))


@pytest.mark.parametrize("rr_depth", quick_and_slow([1, 2, 1000], [1]))
def test_furnace_with_russian_roulette(llvm, rr_depth):
    """Early, late and no termination."""
    images = images_of(path_scenes.furnace(), rr_depth=rr_depth)
    assert_exact(images, path_scenes.furnace_radiance(-1))


def filled_furnace(medium):
    """Scattering without absorption changes nothing; lights on all sides, the camera in fog."""
    images = images_of(path_scenes.furnace(path_scenes.WHITE_MEDIA[medium]()))
    assert_exact(images, path_scenes.furnace_radiance(-1), label=medium)


@pytest.mark.slow
@pytest.mark.parametrize("medium", path_scenes.WHITE_MEDIA)
def test_furnace_filled_with_white_medium(llvm, medium):
    """All media and phase functions in llvm_ad_rgb."""
    filled_furnace(medium)


@pytest.mark.parametrize("medium", quick_and_slow(path_scenes.WHITE_MEDIA, ["smoke"]))
def test_furnace_filled_with_white_medium_in_scalar_variant(scalar, medium):
    """The same in scalar_rgb."""
    filled_furnace(medium)


def white_ball(medium):
    """The ball of fog cannot be seen, nor what is in it."""
    fog = path_scenes.WHITE_MEDIA[medium]()
    # Roulette keeps 95 % of such paths at most: the weights of long ones would be a heavy tail
    images = images_of(path_scenes.open_air(fog, path_scenes.lossless_things()), rr_depth=100)
    assert_exact(images, path_scenes.SKY, label=medium)


@pytest.mark.parametrize("medium", quick_and_slow(path_scenes.WHITE_MEDIA, ["chromatic", "smoke"]))
def test_white_medium_under_uniform_sky(llvm, medium):
    """All media and phase functions in llvm_ad_rgb."""
    white_ball(medium)


@pytest.mark.parametrize("medium", path_scenes.WHITE_MEDIA)
def test_white_medium_under_uniform_sky_in_scalar_variant(scalar, medium):
    """The same in scalar_rgb."""
    white_ball(medium)


@pytest.mark.slow
def test_furnace_notices_absorption(llvm):
    """Fog that absorbs 1 % of what it scatters is found."""
    grey = homogeneous(1.0, 0.99)
    images = images_of(path_scenes.furnace(grey))
    exact = np.broadcast_to(path_scenes.furnace_radiance(-1), images.shape[1:])[np.newaxis]
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(images, exact)


# -------------------------------------------------------------------------------------- absorption


def sky_through_slab(medium, thickness=0.7):
    """The sky behind a slab of fog across the line of sight."""
    camera = closed_form.Camera((0, -3, 0), (0, 0, 0), (0, 0, 1), 60, WIDTH, HEIGHT)
    scene = {"type": "scene", "sensor": path_scenes.stage()["sensor"]}
    scene["sensor"]["fov"] = camera.fov_degrees
    look_at = path_scenes.transform().look_at(camera.origin, camera.target, camera.up)
    scene["sensor"]["to_world"] = look_at
    half = thickness / 2
    scene["fog"] = path_scenes.box((-9, -half, -9), (9, half, 9), interior=medium)
    scene["sky"] = {"type": "constant", "radiance": rgb(path_scenes.SKY)}
    return camera, scene


@both_variants
@pytest.mark.parametrize("albedo", [0.0, 0.8])
def test_sky_through_fog(variant, albedo):
    """Light that is not scattered: exp(-extinction times length), also for the second face."""
    extinction = (0.4, 0.8, 0.6)
    camera, scene = sky_through_slab(homogeneous(extinction, albedo))
    exact = closed_form.slab_image(camera, 0.7, extinction, path_scenes.SKY)
    # Boundaries do not count: the sky is still seen directly
    assert_exact(images_of(scene, max_depth=1), exact, label=f"sky through fog, {variant}")


@both_variants
def test_sky_through_smoke(variant):
    """The same by null collisions: smoke whose density happens to be constant inside the slab."""
    layers = np.full((2, 4, 2, 1), 0.5)
    layers[:, 0] = 1.0
    low, high = (-9, -1.75, -9), (9, 1.75, 9)
    smoke = path_scenes.heterogeneous(path_scenes.grid(layers, low, high), 0.0, scale=1.0)
    camera, scene = sky_through_slab(smoke)
    exact = closed_form.slab_image(camera, 0.7, 0.5, path_scenes.SKY)
    assert_exact(images_of(scene, max_depth=1), exact, label=f"sky through smoke, {variant}")


def lights_above(count=40):
    """Point and spot lights above the plane."""
    generator = np.random.default_rng(12)
    lights = []
    for index in range(count):
        position = tuple(generator.uniform((-1.5, -1.5, 0.8), (1.5, 1.5, 2.0)))
        intensity = tuple(generator.uniform(0.05, 1, 3))
        if index % 2:
            axis = tuple(generator.normal(size=3) * 0.4 - (0, 0, 1))
            cutoff = generator.uniform(20, 60)
            light = closed_form.Light(position, intensity, axis, cutoff, 0.6 * cutoff)
        else:
            light = closed_form.Light(position, intensity)
        lights.append(light)
    return lights


@llvm_first
def test_plane_in_absorbing_fog(variant):
    """Points and spots above a plane: both ways of the light lead through fog, pixel by pixel."""
    lights = lights_above()
    exact = closed_form.plane_image(CAMERA, lights, ALBEDO, extinction=EXTINCTION)
    scene = closed_form.scene_dict(CAMERA, lights, ALBEDO)
    scene["sensor"]["medium"] = homogeneous(EXTINCTION, 0.0)
    images = images_of(scene, max_depth=2)
    assert_exact(images, exact, tile=1, label=f"plane in fog, {variant}")


# ------------------------------------------------------------------------------------------ masks
#
# Mitsuba's area emitters shine whole, whatever the opacity of their surface: the mask lets other
# light through and takes nothing from the emission. Its `path` and ours agree on that wherever
# something is behind the lamp. With nothing behind it `path` drops the emission of the samples
# that pass through the mask (opacity .5: .5 times the radiance), since they end in no surface;
# ours keeps them, as `direct`, and `volpath` in fog. That a lamp does not change with what is
# behind it decides for ours.

RADIANCE = (1.0, 2.0, 3.0)


def masked(opacity, **shape):
    """A rectangle under a mask, black where it is opaque."""
    black = {"type": "diffuse", "reflectance": 0.0}
    mask = {"type": "mask", "opacity": opacity, "nested": {"type": "twosided", "nested": black}}
    return {"type": "rectangle", "bsdf": mask, **shape}


def lamp(height, opacity, **shape):
    """An emissive rectangle of side 1 that looks down from this height."""
    frame = path_scenes.transform().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(0.5)
    emitter = {"type": "area", "radiance": rgb(RADIANCE)}
    return masked(opacity, to_world=frame, emitter=emitter, **shape)


def look_up(things):
    """A camera that sees nothing but the lamp two above it, and what is given."""
    camera = closed_form.Camera((0, 0, 0), (0, 0, 1), (0, 1, 0), 20, 4, 4)
    scene = closed_form.scene_dict(camera, [], ALBEDO)
    del scene["plane"]
    return scene | things


@both_variants
@pytest.mark.parametrize("wall", [False, True], ids=["nothing", "wall"])
@pytest.mark.parametrize("depth", [1, 3])
def test_lamp_under_mask_is_seen_whole(variant, depth, wall):
    """Its emission does not depend on the opacity, nor on what is behind it."""
    things = {"lamp": lamp(2, 0.5)}
    if wall:
        things["wall"] = masked(1.0, to_world=path_scenes.transform().translate([0, 0, 4]).scale(9))
    assert_exact(images_of(look_up(things), max_depth=depth), RADIANCE)


@both_variants
def test_lamp_under_mask_is_seen_whole_in_fog(variant):
    """The same through absorbing fog; the camera's near plane is where it begins."""
    scene = look_up({"lamp": lamp(2, 0.5)})
    scene["sensor"]["medium"] = homogeneous(EXTINCTION, 0.0)
    camera = closed_form.Camera((0, 0, 0), (0, 0, 1), (0, 1, 0), 20, 4, 4)
    exact = closed_form.slab_image(camera, 2 - closed_form.NEAR_CLIP, EXTINCTION, RADIANCE)
    assert_exact(images_of(scene, max_depth=3), exact)


@both_variants
def test_lamp_behind_mask_in_front_of_nothing(variant):
    """What is opaque of a mask covers a lamp behind it, and the rest shows it: 1 - opacity."""
    mask = masked(0.3, to_world=path_scenes.transform().translate([0, 0, 1]).scale(9))
    exact = 0.7 * np.array(RADIANCE)
    assert_exact(images_of(look_up({"lamp": lamp(2, 0.5), "mask": mask}), max_depth=3), exact)


def light_of_rectangle(camera, height, albedo, side=48):
    """Image of the plane z = 0 under the lamp: midpoint rule over both."""
    points = closed_form.plane_points(camera, *closed_form.film_grid(camera, 4))
    nodes = (np.arange(side) + 0.5) / side - 0.5
    total = np.zeros(points.shape[:-1])
    for x in nodes:
        for y in nodes:
            distance2 = ((points - (x, y, height)) ** 2).sum(axis=-1)
            total += height**2 / distance2**2 / side**2
    radiance = np.array(albedo) / np.pi * np.array(RADIANCE) * total[..., np.newaxis]
    return closed_form.pixel_means(camera, radiance, 4)


@both_variants
@pytest.mark.parametrize("opacity", [1.0, 0.5])
def test_light_of_lamp_under_mask(variant, opacity):
    """A floor gets all of its light, by paths of three segments, too."""
    camera = closed_form.Camera((0, -1.5, 0.6), (0, 0, 0), (0, 0, 1), 25, 6, 4)
    scene = closed_form.scene_dict(camera, [], ALBEDO) | {"lamp": lamp(1, opacity)}
    exact = light_of_rectangle(camera, 1, ALBEDO)
    assert_exact(images_of(scene, max_depth=3), exact, tile=1)


BLACK = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.0}}
SHEETS = {
    "mask": {"type": "mask", "opacity": 0.4, "nested": BLACK},
    "blend": {"type": "blendbsdf", "weight": 0.4, "one": {"type": "null"}, "two": BLACK},
    "two-masks": {"type": "mask", "opacity": 1 - 0.6**0.5, "nested": BLACK},
}


@both_variants
@pytest.mark.parametrize("sheet", SHEETS)
def test_point_behind_a_sheet_that_lets_light_through(variant, sheet):
    """A sheet of opacity .4 leaves .6 of the light of a point, though no path can hit that."""
    lights = [closed_form.Light((0, 0, 2), (8.0, 6.0, 4.0))]
    camera = closed_form.Camera((0, -2, 1.5), (0, 0, 0), (0, 0, 1), 40, 6, 4)
    scene = closed_form.scene_dict(camera, lights, ALBEDO)
    heights = (1.9, 1.8) if sheet == "two-masks" else (1.9,)
    for index, height in enumerate(heights):
        frame = path_scenes.transform().translate([0, 0, height]).scale(3)
        scene[f"sheet_{index}"] = {"type": "rectangle", "to_world": frame, "bsdf": SHEETS[sheet]}
    exact = 0.6 * closed_form.plane_image(camera, lights, ALBEDO)
    assert_exact(images_of(scene, max_depth=2), exact, tile=1, label=sheet)


# ---------------------------------------------------------------------------------- one scattering

FLAKES = (0.15, 0.35, 0.9, 0.05, 0.1, -0.1)
PHASES = {
    "isotropic": closed_form.Phase(closed_form.isotropic),
    "hg-forward": closed_form.Phase(closed_form.henyey_greenstein(0.7)),
    "hg-backward": closed_form.Phase(closed_form.henyey_greenstein(-0.5)),
    "rayleigh": closed_form.Phase(closed_form.rayleigh),
    "tabphase": closed_form.Phase(closed_form.tabulated(path_scenes.TABULATED)),
    "blendphase": closed_form.Phase(
        closed_form.blend(0.3, closed_form.henyey_greenstein(0.6), closed_form.rayleigh)
    ),
    "flakes": closed_form.Flakes(*FLAKES),
}


def phase_dict(name):
    """A phase function as a dictionary."""
    if name == "flakes":
        return {"type": "sggx", "S": path_scenes.microflakes(*FLAKES)}
    return path_scenes.PHASES[name]()


def lights_around(count=40):
    """Point and spot lights around the line of sight, out of view."""
    generator = np.random.default_rng(13)
    lights = []
    for index, angle in enumerate(generator.uniform(0, 2 * np.pi, count)):
        radius, distance = generator.uniform((2.5, -2.0), (4.0, 3.0))
        position = np.array([radius * np.cos(angle), distance, radius * np.sin(angle)])
        intensity = tuple(generator.uniform(0.05, 1, 3))
        if index % 2:
            axis = tuple(generator.normal(size=3) * 0.8 - position)
            light = closed_form.Light(tuple(position), intensity, axis, 50.0, 20.0)
        else:
            light = closed_form.Light(tuple(position), intensity)
        lights.append(light)
    return lights


def fog_alone(camera, lights, **medium):
    """Lights in fog without bounds, and nothing else."""
    scene = closed_form.scene_dict(camera, lights, ALBEDO)
    del scene["plane"]
    scene["sensor"]["medium"] = homogeneous(**medium)
    return scene


def single_scattering(name, **parameters):
    """Points and spots in fog of three extinctions and albedos, pixel by pixel."""
    lights = lights_around()
    exact = closed_form.single_scatter_image(FOG_CAMERA, lights, EXTINCTION, ALBEDO, PHASES[name])
    scene = fog_alone(FOG_CAMERA, lights, sigma_t=EXTINCTION, albedo=ALBEDO, phase=phase_dict(name))
    images = images_of(scene, max_depth=2, **parameters)
    assert_exact(images, exact, tile=1, label=f"{name}, {parameters}")


@pytest.mark.parametrize("name", PHASES)
def test_single_scattering(llvm, name):
    """All phase functions in llvm_ad_rgb."""
    single_scattering(name)


@pytest.mark.parametrize("name", quick_and_slow(PHASES, ["hg-backward"]))
def test_single_scattering_in_scalar_variant(scalar, name):
    """The same in scalar_rgb."""
    single_scattering(name)


@pytest.mark.parametrize("parameters", PARAMETERS, ids=parameter_id)
def test_single_scattering_does_not_depend_on_parameters(llvm, parameters):
    """Every setting trades noise for time and leaves the mean alone."""
    single_scattering("hg-forward", **parameters)


@pytest.mark.parametrize("method", METHODS, ids=parameter_id)
def test_single_scattering_of_method(llvm, method):
    """The methods have one mean."""
    single_scattering("hg-backward", **method)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[1:3], ids=parameter_id)
@pytest.mark.parametrize("parameters", PARAMETERS, ids=parameter_id)
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_single_scattering_of_talk_does_not_depend_on_parameters(variant, parameters, method):
    """Every setting of the method of the talk."""
    single_scattering("rayleigh", **method, **parameters)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[:2], ids=parameter_id)
@pytest.mark.parametrize("parameters", PARAMETERS, ids=parameter_id)
def test_furnace_does_not_depend_on_parameters(llvm, parameters, method):
    """Every setting with many bounces between emitters on all sides."""
    images = images_of(path_scenes.furnace(), **parameters, **method)
    assert_exact(images, path_scenes.furnace_radiance(-1), label=f"{parameters}, {method}")


# --------------------------------------------------------------------------- scattering near lamps


def lamps_beside_view(count=1):
    """Points close to the line of sight, out of view."""
    places = [(0.9, 0.0, 0.3), (-1.1, -0.6, 0.4), (0.2, 0.4, -1.2)]
    return [closed_form.Light(place, (1.0, 0.7, 0.4)) for place in places[:count]]


@both_variants
@pytest.mark.parametrize("count", [1, 3])
def test_scattering_twice_near_lamps(variant, count):
    """Paths that pass close to points bring the light that they should, pixel by pixel."""
    camera = closed_form.Camera((0, -3, 0), (0, 0, 0), (0, 0, 1), 8, 3, 2)
    lights, albedo = lamps_beside_view(count), 0.9
    isotropic = closed_form.Phase(closed_form.isotropic)
    exact = closed_form.single_scatter_image(camera, lights, EXTINCTION, (albedo,) * 3, isotropic)
    exact += closed_form.double_scatter_image(camera, lights, EXTINCTION, albedo)
    scene = fog_alone(camera, lights, sigma_t=EXTINCTION, albedo=albedo)
    assert_exact(images_of(scene, max_depth=3), exact, tile=1, label=f"{count} lamps, {variant}")


def grows(errors, few, factor=1.5):
    """True unless `errors` are significantly below `factor` times those of `few` samples."""
    result = stats.ttest_ind(errors, factor * few, equal_var=False, alternative="less")
    return result.pvalue > tools.SIGNIFICANCE


def test_error_near_lamps_falls_with_samples(llvm):
    """Squared errors times samples stay: with the phase function alone they grow without bound."""
    camera = closed_form.Camera((0, -3, 0), (0, 0, 0), (0, 0, 1), 8, 6, 4)
    lights, albedo = lamps_beside_view(), 0.9
    isotropic = closed_form.Phase(closed_form.isotropic)
    exact = closed_form.single_scatter_image(camera, lights, EXTINCTION, (albedo,) * 3, isotropic)
    exact += closed_form.double_scatter_image(camera, lights, EXTINCTION, albedo)
    scene = mi.load_dict(fog_alone(camera, lights, sigma_t=EXTINCTION, albedo=albedo))
    errors = {}
    for spp in (4, 64):
        images = tools.render_seeds(scene, light_tree(max_depth=3), spp, range(64))
        errors[spp] = spp * ((images / exact - 1) ** 2).mean(axis=(1, 2, 3))
    assert not grows(errors[64], errors[4])
    # As much as the phase function alone had them grow
    assert grows(1.7 * errors[64], errors[4])

"""Gradients through `manylights_volpath` equal finite differences of Mitsuba's own renderings.

What is compared is the derivative of the image mean by the logarithm of a parameter, one number
per seed. Mitsuba's automatic derivatives are a second reference where they are right: not for
extinctions, by which Mitsuba 3.9.1 moves the points of scattering across boundaries, and not for
roughness in `volpath`.
"""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests import closed_form, path_scenes
from tests import statistics_tools as tools
from tests import test_path_closed_forms as closed_forms
from tests.light_scenes import make_mesh, points, rgb, stage, triangles
from tests.path_references import light_tree
from tests.path_scenes import homogeneous
from tests.references import set_power_weights

pytestmark = pytest.mark.usefixtures("plugin", "own_threads", "llvm")

SEEDS = 24
STEP = 0.05
"""Relative change of a parameter to either side for finite differences."""

BIAS = {"surfaces": 0.1, "fog": 0.15, "smoke": 0.2}
"""Relative error of a derivative that has to be found; finite differences of fog are noisy."""

PARAMETERS = {"max_depth": 3, "rr_depth": 1000}


def surfaces(**parts):
    """A floor of rough metal and a diffuse ball under points and a mesh, on a small film."""
    metal = {"type": "roughconductor", "alpha": 0.3, "material": "Al"}
    ball = path_scenes.diffuse(0.6, 0.6, 0.6)
    bright = {"type": "point", "position": [0.4, -1.2, 2], "intensity": rgb([3, 2, 1])}
    lamps = make_mesh(triangles(30), rgb([4, 3, 2]))
    lights = {**points(30, total=4.0), "bright": bright, "lamps": lamps}
    scene = {**stage(metal, ball, block=False), **lights, **parts}
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    return scene


def fog():
    """The same with a diffuse floor, in coloured fog that takes more light than it scatters."""
    box = path_scenes.fog_box(homogeneous((0.3, 0.4, 0.5), (0.5, 0.4, 0.3)))
    scene = surfaces(fog=box)
    scene["floor"]["material"] = path_scenes.diffuse(0.6, 0.5, 0.4)
    return scene


def smoke():
    """The same in smoke of two densities."""
    box = path_scenes.fog_box(path_scenes.heterogeneous(albedo=(0.3, 0.2, 0.1), scale=1.5))
    return fog() | {"fog": box}


MEDIUM = "fog.interior_medium"
CASES = {
    "surfaces": (
        surfaces,
        {
            "reflectance": "ball.bsdf.reflectance.value",
            "roughness": "floor.bsdf.alpha.value",
            "radiance": "lamps.emitter.radiance.value",
            "intensity": "bright.intensity.value",
        },
    ),
    "fog": (
        fog,
        {
            "reflectance": "floor.bsdf.reflectance.value",
            "radiance": "lamps.emitter.radiance.value",
            "albedo": f"{MEDIUM}.albedo.value.value",
            "extinction": f"{MEDIUM}.sigma_t.value.value",
        },
    ),
    "smoke": (
        smoke,
        {
            "reflectance": "floor.bsdf.reflectance.value",
            "albedo": f"{MEDIUM}.albedo.value.value",
            "extinction": f"{MEDIUM}.sigma_t.data",
        },
    ),
}
RIGHT_IN_MITSUBA = {
    "surfaces": ("reflectance", "roughness", "radiance", "intensity"),
    "fog": ("reflectance", "radiance", "albedo"),
    "smoke": ("reflectance", "albedo"),
}
"""Parameters for which Mitsuba's own automatic derivatives are right."""


def as_images(values):
    """Numbers for each seed and parameter as images of one pixel."""
    return np.array(values, dtype=float)[:, np.newaxis, np.newaxis]


def automatic(scene, keys, integrator, spp, seeds):
    """Derivatives by `dr.backward`, for each seed and parameter."""
    scene = mi.load_dict(scene)
    parameters = mi.traverse(scene)
    result = []
    for seed in seeds:
        for key in keys:
            dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, spp=spp, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        result.append([derivative(parameters[key]) for key in keys])
        for key in keys:
            dr.disable_grad(parameters[key])
        parameters.update()
    return as_images(result)


def derivative(value):
    """Sum of gradient times value: the derivative by the logarithm of a common factor."""
    return float(np.sum(np.array(dr.grad(value)) * np.array(dr.detach(value))))


@functools.cache
def differences(case, spp=2048):
    """The same by finite differences of Mitsuba's renderings."""
    make, keys = CASES[case]
    scene = mi.load_dict(make())
    set_power_weights(scene)
    integrator = mitsuba_integrator(case)
    columns = [difference(scene, integrator, key, spp) for key in keys.values()]
    return as_images(np.transpose(columns))


def mitsuba_integrator(case):
    """Mitsuba's integrator for the case."""
    return mi.load_dict({"type": "path" if case == "surfaces" else "volpath", **PARAMETERS})


def difference(scene, integrator, key, spp):
    """Central differences for each seed; equal seeds on both sides."""
    parameters = mi.traverse(scene)
    before = type(parameters[key])(parameters[key])
    means = []
    for factor in (1 + STEP, 1 - STEP):
        parameters[key] = before * factor
        parameters.update()
        images = tools.render_seeds(scene, integrator, spp, range(300_000, 300_000 + 32))
        means.append(images.mean(axis=(1, 2, 3)))
    parameters[key] = before
    parameters.update()
    return (means[0] - means[1]) / (2 * STEP)


SAMPLES = {"surfaces": 2048, "fog": 256, "smoke": 128}
MITSUBA_SAMPLES = SAMPLES | {"surfaces": 512}
"""The same of Mitsuba's own derivatives: no finite differences add to the noise."""
COMPARED_SAMPLES = SAMPLES | {"surfaces": 64}
"""Those of the integrator under test then: derivatives by surfaces have little noise."""


@functools.cache
def plugin_gradients(case, spp=None):
    """Automatic derivatives of the integrator under test."""
    make, keys = CASES[case]
    integrator = light_tree(**PARAMETERS)
    return automatic(make(), keys.values(), integrator, spp or SAMPLES[case], range(SEEDS))


def cases():
    """The cases; differentiating fog takes a minute, most of it to compile."""
    marks = {"surfaces": []}
    return [pytest.param(case, marks=marks.get(case, [pytest.mark.slow])) for case in CASES]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_gradients_equal_finite_differences(case):
    """Reflectance, roughness, emission, extinction and albedo of a medium."""
    tools.assert_same_mean(plugin_gradients(case), differences(case), bias=BIAS[case], label=case)


@pytest.mark.parametrize("case", cases())
def test_gradients_equal_those_of_mitsuba(case):
    """Where those are right."""
    make, keys = CASES[case]
    right = [list(keys).index(name) for name in RIGHT_IN_MITSUBA[case]]
    seeds = range(400_000, 400_000 + SEEDS)
    integrator = mitsuba_integrator(case)
    expected = automatic(make(), keys.values(), integrator, MITSUBA_SAMPLES[case], seeds)
    found = plugin_gradients(case, COMPARED_SAMPLES[case])[..., right]
    tools.assert_same_mean(found, expected[..., right], bias=2 * BIAS[case], label=case)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_planted_bias_of_gradients_is_found(case):
    """Each derivative alone, too large or too small."""
    found, expected = plugin_gradients(case), differences(case)
    for index in range(len(CASES[case][1])):
        for factor in (1 + BIAS[case], 1 / (1 + BIAS[case])):
            wrong = found.copy()
            wrong[..., index] *= factor
            with pytest.raises(AssertionError, match="significance"):
                tools.assert_same_mean(wrong, expected)


def exact_derivative(image, extinction):
    """Derivative of the mean of `image(extinction)` by the logarithm of all extinctions."""
    above, below = (image(np.array(extinction) * (1 + sign * 1e-3)) for sign in (1, -1))
    return np.reshape((above - below).mean() / 2e-3, (1, 1, 1, 1))


def test_gradient_of_absorption():
    """The sky behind a slab: the logarithm of what is left is proportional to the extinction."""
    extinction = (0.4, 0.8, 0.6)
    camera, scene = closed_forms.sky_through_slab(homogeneous(extinction, 0.5))
    exact = exact_derivative(
        lambda value: closed_form.slab_image(camera, 0.7, value, path_scenes.SKY), extinction
    )
    found = automatic(
        scene, [f"{MEDIUM}.sigma_t.value.value"], light_tree(max_depth=1), 64, range(SEEDS)
    )
    tools.assert_same_mean(found, exact, bias=0.05, label="absorption")


def test_gradients_of_single_scattering():
    """Points and spots in fog: proportional to the albedo; the extinction adds and takes light."""
    camera, lights = closed_forms.FOG_CAMERA, closed_forms.lights_around()
    extinction, albedo = (0.3, 0.5, 0.7), closed_forms.ALBEDO
    phase = closed_forms.PHASES["isotropic"]

    def image(value):
        return closed_form.single_scatter_image(camera, lights, value, albedo, phase, nodes=256)

    scene = closed_forms.fog_alone(camera, lights, sigma_t=extinction, albedo=albedo)
    keys = ["sensor.medium.albedo.value.value", "sensor.medium.sigma_t.value.value"]
    found = automatic(scene, keys, light_tree(max_depth=2), 64, range(SEEDS))
    exact = [np.reshape(image(np.array(extinction)).mean(), (1, 1, 1, 1))]
    exact.append(exact_derivative(image, extinction))
    exact = np.concatenate(exact, axis=-1)
    tools.assert_same_mean(found, exact, bias=0.1, label="single scattering")


def test_rendering_does_not_depend_on_gradients():
    """Whether a parameter is differentiated or not, the image is the same."""
    scene = mi.load_dict(fog())
    integrator = light_tree(**PARAMETERS)
    parameters = mi.traverse(scene)
    images = []
    for enable in (False, True):
        if enable:
            dr.enable_grad(parameters["floor.bsdf.reflectance.value"])
            parameters.update()
        images.append(np.array(mi.render(scene, parameters, integrator=integrator, spp=8, seed=2)))
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-6)


def test_freezing_works_or_is_refused():
    """A frozen function gives the images of other seeds, or says what cannot be done."""
    scene, integrator = mi.load_dict(fog()), light_tree(**PARAMETERS)

    def image(seed):
        return mi.render(scene, integrator=integrator, spp=4, seed=seed)

    frozen = dr.freeze(image)
    try:
        found = [np.array(frozen(mi.UInt32(seed))) for seed in (1, 2, 1)]
    except RuntimeError as error:
        assert "dr.freeze" in full_text(error)
        return
    for seed, frozen_image in zip((1, 2, 1), found):
        np.testing.assert_allclose(frozen_image, np.array(image(seed)), rtol=1e-4, atol=1e-6)


def full_text(error):
    """The messages of an exception and of its causes."""
    texts = []
    while error is not None:
        texts.append(str(error))
        error = error.__cause__ or error.__context__
    return "\n".join(texts)


ZERO = rgb([0.0] * 3)
AT_ZERO = {
    "floor.bsdf.reflectance.value": (1.0, 2),
    "lamp_0.intensity.value": (1.0, 2),
    "fog.interior_medium.albedo.value.value": (0.5, 2),
    "wall.bsdf.reflectance.value": (0.5, 3),
}
#: Roulette must not end what is black
ROULETTE = [pytest.param(key, 5, id=key) for key in AT_ZERO]
ROULETTE += [pytest.param("wall.bsdf.reflectance.value", 1, id="roulette")]


def black_scene():
    """Two points above a floor, a wall and a cube of fog, all black."""
    to_world = path_scenes.transform().look_at([0, -4, 3], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}}
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": ZERO}
    place = path_scenes.transform().translate([0, 1.5, 0]).rotate([1, 0, 0], 90).scale(2)
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": to_world, "film": film},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": rgb([0.1] * 3)}},
        "wall": {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "diffuse", "reflectance": rgb([0.2] * 3)},
        },
        "fog": {
            "type": "cube",
            "to_world": path_scenes.transform().translate([0.8, -0.5, 0.5]).scale(0.3),
            "bsdf": {"type": "null"},
            "interior": fog,
        },
    }
    for index in range(2):
        position = [index - 1.0, 0.3 * index, 1.0]
        scene[f"lamp_{index}"] = {"type": "point", "position": position, "intensity": ZERO}
    return scene


@pytest.mark.parametrize(("key", "rr_depth"), ROULETTE)
def test_gradients_at_zero_are_differences(llvm, key, rr_depth):
    """What is black in all channels is of consequence where its derivative is wanted.

    The image is linear in each of these parameters but the albedo, of which there is one factor in
    light that is scattered once. The wall is one of two factors: its light comes by the floor.
    """
    value, depth = AT_ZERO[key]
    scene = mi.load_dict(black_scene())
    parameters = mi.traverse(scene)
    for name in (*AT_ZERO, "lamp_1.intensity.value"):
        parameters[name] = mi.Color3f(0.0 if name == key else 0.5)
    if depth == 2:
        parameters["wall.bsdf.reflectance.value"] = mi.Color3f(0.0)
    black = mi.Color3f(0.0)
    dr.enable_grad(black)
    parameters[key] = black
    parameters.update()
    integrator = light_tree(max_depth=depth, rr_depth=rr_depth)
    image = mi.render(scene, parameters, integrator=integrator, spp=4096, seed=1)
    dr.forward(black, dr.ADFlag.ClearEdges)
    found = np.array(dr.grad(image))
    difference = np.zeros(3)
    for step, sign in ((0.0, -1), (value, 1)):
        parameters[key] = mi.Color3f(step)
        parameters.update()
        difference += (
            sign
            * np.array(mi.render(scene, integrator=integrator, spp=4096, seed=1)).mean((0, 1))
            / value
        )
    assert difference.min() > 1e-4
    np.testing.assert_allclose(found.mean((0, 1)), difference, rtol=0.02)

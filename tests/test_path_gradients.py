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

from tests import path_scenes
from tests import statistics_tools as tools
from tests.light_scenes import make_mesh, points, rgb, stage, triangles
from tests.path_references import light_tree
from tests.references import set_power_weights

pytestmark = pytest.mark.usefixtures("plugin", "llvm")

SEEDS = 24
STEP = 0.05
"""Relative change of a parameter to either side for finite differences."""

BIAS = 0.1
"""Relative error of a derivative that has to be found."""

PARAMETERS = {"max_depth": 3, "rr_depth": 1000}


def surfaces(**parts):
    """A floor of rough metal and a diffuse ball under points and a mesh, on a small film."""
    metal = {"type": "roughconductor", "alpha": 0.3, "material": "Al"}
    ball = path_scenes.diffuse(0.6, 0.5, 0.4)
    lamps = make_mesh(triangles(30), rgb([4, 3, 2]))
    scene = {**stage(metal, ball, block=False), **points(30, total=6.0), "lamps": lamps, **parts}
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    return scene


def fog():
    """The same with a diffuse floor, in coloured fog."""
    box = path_scenes.fog_box(path_scenes.homogeneous((0.3, 0.4, 0.5), (0.9, 0.8, 0.7)))
    scene = surfaces(fog=box)
    scene["floor"]["material"] = path_scenes.diffuse(0.6, 0.5, 0.4)
    return scene


def smoke():
    """The same in smoke of two densities."""
    box = path_scenes.fog_box(path_scenes.heterogeneous(albedo=(0.9, 0.8, 0.7)))
    return fog() | {"fog": box}


MEDIUM = "fog.interior_medium"
CASES = {
    "surfaces": (
        surfaces,
        {
            "reflectance": "ball.bsdf.reflectance.value",
            "roughness": "floor.bsdf.alpha.value",
            "radiance": "lamps.emitter.radiance.value",
            "intensity": "point_7.intensity.value",
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


def automatic(case, integrator, spp, seeds):
    """Derivatives by `dr.backward`, for each seed and parameter of the case."""
    scene = mi.load_dict(CASES[case][0]())
    parameters, keys = mi.traverse(scene), CASES[case][1].values()
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
def differences(case, spp=1024):
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


SAMPLES = {"surfaces": 128, "fog": 64, "smoke": 64}


@functools.cache
def plugin_gradients(case):
    """Automatic derivatives of the integrator under test."""
    return automatic(case, light_tree(**PARAMETERS), SAMPLES[case], range(SEEDS))


def cases():
    """The cases; differentiating fog takes a minute, most of it to compile."""
    marks = {"surfaces": []}
    return [pytest.param(case, marks=marks.get(case, [pytest.mark.slow])) for case in CASES]


@pytest.mark.parametrize("case", cases())
def test_gradients_equal_finite_differences(case):
    """Reflectance, roughness, emission, extinction and albedo of a medium."""
    tools.assert_same_mean(plugin_gradients(case), differences(case), bias=BIAS, label=case)


@pytest.mark.parametrize("case", cases())
def test_gradients_equal_those_of_mitsuba(case):
    """Where those are right."""
    right = [list(CASES[case][1]).index(name) for name in RIGHT_IN_MITSUBA[case]]
    seeds = range(400_000, 400_000 + SEEDS)
    expected = automatic(case, mitsuba_integrator(case), SAMPLES[case], seeds)
    found = plugin_gradients(case)[..., right]
    tools.assert_same_mean(found, expected[..., right], bias=2 * BIAS, label=case)


@pytest.mark.parametrize("case", cases())
def test_planted_bias_of_gradients_is_found(case):
    """Each derivative alone, 10 % too large or too small."""
    found, expected = plugin_gradients(case), differences(case)
    for index in range(len(CASES[case][1])):
        for factor in (1 + BIAS, 1 / (1 + BIAS)):
            wrong = found.copy()
            wrong[..., index] *= factor
            with pytest.raises(AssertionError, match="significance"):
                tools.assert_same_mean(wrong, expected, bias=BIAS)


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

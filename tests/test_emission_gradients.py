"""Gradients of everything that emitters emit: images are linear in emission.

So the sum of gradient times value over all emission is the image, and for one parameter it is the
part of the image that is missing without it: a closed form for automatic derivatives.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests import statistics_tools as tools
from tests.conftest import require_variant
from tests.test_path_gradients import derivative

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

SEEDS = 8
DIRECT = {"type": "manylights_direct"}
PATHS = {"type": "manylights_volpath", "max_depth": 3}

FEW_RAYS = DIRECT | {"shadow_rays": 2}
"""For each kind of light: derivatives compile a kernel for each ray, and all rays are alike."""


def attribute_mesh(name, count=12):
    """Triangles that face the floor, whose radiance is a mesh attribute."""
    lamps = light_scenes.make_mesh(lamps_above(count), {"type": "mesh_attribute", "name": name})
    numbers = 3 * count * (3 if name.startswith("vertex") else 1)
    values = np.random.default_rng(1).uniform(1, 5, numbers).astype(np.float32)
    lamps.add_attribute(name, 3, values)
    return {"lamps": lamps}


def lamps_above(count):
    """Triangles (count, 3, 3) above the floor that emit downwards."""
    x, y = np.arange(count) % 4 - 1.5, np.arange(count) // 4 - 1.0
    corners = np.array([[0, 0, 0], [0, 0.4, 0], [0.4, 0, 0]])
    return np.stack([x, y, np.full(count, 1.5)], axis=-1)[:, np.newaxis] + corners


def irregular(scale=1.0):
    """Two spectral lines of 4 nm."""
    return {
        "type": "irregular",
        "wavelengths": "400,541,543,547,549,610,612,616,618,700",
        "values": ",".join(str(scale * v) for v in (0, 0, 90, 90, 0, 0, 60, 60, 0, 0)),
    }


def regular(scale=1.0):
    """A spectrum at equal distances, not that of daylight."""
    values = ",".join(str(scale * v) for v in (1, 3, 2, 4, 1))
    return {"type": "regular", "wavelength_min": 400, "wavelength_max": 700, "values": values}


def uniform(scale=1.0):
    """The same at all wavelengths."""
    return {"type": "uniform", "value": 3.0 * scale}


def points_of(spectrum, count=12):
    """Point lights of equal spectra."""
    lights = light_scenes.points(count)
    return {name: light | {"intensity": spectrum} for name, light in lights.items()}


def mesh_of(radiance, count=12):
    """One mesh of constant radiance."""
    return {"lamps": light_scenes.make_mesh(lamps_above(count), radiance)}


def only(name, scene):
    """The lights of a scene whose names begin in this way."""
    return {key: light for key, light in scene.items() if key.startswith(name)}


def textured_spots():
    """Spots with a bitmap, which takes part in the intensity."""
    lights = only("spot", light_scenes.projectors())
    return {key: light for key, light in lights.items() if "texture" in light}


RGB = {
    "points": (lambda: light_scenes.points(12), "intensity.value"),
    "uniform points": (lambda: points_of(uniform()), "intensity.value"),
    "spots": (lambda: light_scenes.spots(12), "intensity.value"),
    "mesh": (lambda: mesh_of(light_scenes.rgb([3, 2, 1])), "radiance.value"),
    "uniform mesh": (lambda: mesh_of(uniform()), "radiance.value"),
    "face_color": (lambda: attribute_mesh("face_color"), "lamps.face_color"),
    "vertex_color": (lambda: attribute_mesh("vertex_color"), "lamps.vertex_color"),
    "textured rectangles": (
        lambda: light_scenes.shapes("rectangle", 5, size=0.5, radiance=light_scenes.stripes(12.0)),
        "radiance.data",
    ),
    "textured disks": (
        lambda: light_scenes.shapes("disk", 3, size=0.4, radiance=light_scenes.stripes(12.0)),
        "radiance.data",
    ),
    "spheres": (lambda: light_scenes.shapes("sphere", 3), "radiance.value"),
    "uniform disks": (lambda: light_scenes.shapes("disk", 3, radiance=uniform()), "radiance.value"),
    "cylinders": (lambda: light_scenes.shapes("cylinder", 3), "radiance.value"),
    "smooth meshes": (lambda: only("lamp_", light_scenes.mesh_smooth()), "radiance.value"),
    "projectors": (lambda: only("projector", light_scenes.projectors()), "irradiance.data"),
    "textured spots": (lambda: textured_spots(), "texture.data"),
    "suns": (lambda: only("sun", light_scenes.many_suns()), "irradiance.value"),
    "sky": (lambda: only("sky", light_scenes.sky()), "radiance.value"),
    "envmap data": (lambda: only("sky", light_scenes.environment_map()), "sky.data"),
    "envmap scale": (lambda: only("sky", light_scenes.environment_map()), "sky.scale"),
}
SPECTRAL = {
    "irregular points": (lambda: points_of(irregular()), "intensity.values"),
    "regular points": (lambda: points_of(regular()), "intensity.values"),
    "regular mesh": (lambda: mesh_of(regular()), "radiance.values"),
    "irregular mesh": (lambda: mesh_of(irregular()), "radiance.values"),
    "uniform mesh": (lambda: mesh_of(uniform()), "radiance.value"),
    "daylight": (lambda: points_of({"type": "d65", "scale": 3.0}), "intensity.values"),
    "rgb": (lambda: points_of(light_scenes.rgb([3, 2, 1])), "intensity.d65.values"),
    "spheres": (lambda: light_scenes.shapes("sphere", 3, radiance=irregular()), "radiance.values"),
}
CASES = [("llvm_ad_rgb", name) for name in RGB] + [("llvm_ad_spectral", name) for name in SPECTRAL]


def gradients(scene, suffix, integrator, spp):
    """Sums of gradient times value of the parameters that end in `suffix`, for each seed."""
    parameters = mi.traverse(scene)
    keys = [key for key in parameters.keys() if key.endswith(suffix)]  # noqa: SIM118
    assert keys, f"no {suffix} among {list(parameters.keys())}"
    before = {key: type(parameters[key])(parameters[key]) for key in keys}
    sums = []
    for seed in range(100, 100 + SEEDS):
        # Plugins may keep something else that is computed from what they are given
        given = {key: type(value)(value) for key, value in before.items()}
        for key in keys:
            dr.enable_grad(given[key])
            parameters[key] = given[key]
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, spp=spp, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        sums.append(sum(derivative(value) for value in given.values()))
    for key in keys:
        parameters[key] = before[key]
    parameters.update()
    return np.reshape(sums, (SEEDS, 1, 1, 1))


def mean_images(scene, integrator, spp):
    """Image means, for each seed, in the shape of images."""
    images = tools.render_seeds(scene, integrator, spp, range(SEEDS))
    return images.mean(axis=(1, 2, 3))[:, np.newaxis, np.newaxis, np.newaxis]


def plane():
    """A floor of two materials on a small film, with nothing in the way of the lights."""
    scene = light_scenes.stage(block=False)
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    return scene


def load(lights, static=()):
    """A scene with these lights, among others that are not differentiated."""
    return mi.load_dict({**plane(), **lights, **dict(static)})


@pytest.mark.parametrize(("variant", "name"), CASES)
def test_gradient_times_emission_is_the_image(variant, name):
    """Alone, so that all of the image comes from the parameter."""
    variant = require_variant(variant)
    make, suffix = (RGB if "rgb" in variant else SPECTRAL)[name]
    scene, integrator = load(make()), mi.load_dict(FEW_RAYS)
    spp = 32 if "rgb" in variant else 128  # wavelengths are noise, too
    found = gradients(scene, suffix, integrator, spp)
    expected = mean_images(scene, integrator, 2 * spp)
    assert expected.mean() > 0
    tools.assert_same_mean(found, expected, bias=0.15, label=name)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(found * 1.2, expected)


def lights_of_all_kinds():
    """Few of each kind: every light that is differentiated makes the kernels longer."""
    lights = light_scenes.points(4, total=2.0) | {"uniform": points_of(uniform(0.1), 1)["point_0"]}
    for kind in ("rectangle", "sphere", "disk", "cylinder"):
        lights |= light_scenes.shapes(kind, 1, total=6.0)
    sky = light_scenes.sky()
    return lights | mesh_of(light_scenes.rgb([1, 2, 3]), 4) | {"sky": sky["sky"], "sun": sky["sun"]}


EMISSION = ("intensity.value", ".radiance.value", "irradiance.value")


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [DIRECT, PATHS], ids=["direct", "paths"])
def test_all_gradients_times_emission_are_the_image(llvm, integrator):
    """The sum over lights of every kind, after any number of bounces."""
    scene, integrator = load(lights_of_all_kinds()), mi.load_dict(integrator)
    found = gradients(scene, EMISSION, integrator, 32)
    expected = mean_images(scene, integrator, 64)
    tools.assert_same_mean(found, expected, bias=0.1)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(found * 1.12, expected)


@pytest.mark.parametrize("name", ["uniform points", "face_color", "mesh"])
def test_gradient_among_other_lights(llvm, name):
    """Finite differences: what the image gains by the light of the parameter, among others."""
    make, suffix = RGB[name]
    others = {f"{key}_other": light for key, light in light_scenes.points(20, seed=3).items()}
    lights = make()
    key = next(key for key in mi.traverse(load(lights)).keys() if key.endswith(suffix))  # noqa: SIM118
    scene, integrator = load(lights, others), mi.load_dict(DIRECT)
    assert [name for name in mi.traverse(scene).keys() if name.endswith(key)] == [key]  # noqa: SIM118
    found = gradients(scene, key, integrator, 32)
    parameters = mi.traverse(scene)
    before, images = parameters[key], []
    for factor in (1.0, 0.0):
        parameters[key] = before * factor
        parameters.update()
        images.append(mean_images(scene, integrator, 64))
    tools.assert_same_mean(found, images[0] - images[1], bias=0.1, label=name)


def test_optimization_goes_on_where_colours_become_equal(llvm):
    """A face colour that varies, becomes constant, and varies again, always has its gradient."""
    scene = load(attribute_mesh("vertex_color"))
    integrator, parameters = mi.load_dict(DIRECT), mi.traverse(scene)
    varying = np.array(parameters["lamps.vertex_color"])
    for values in (varying, np.full_like(varying, 2), varying):
        parameters["lamps.vertex_color"] = mi.Float(values)
        dr.enable_grad(parameters["lamps.vertex_color"])
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, spp=64, seed=2)
        dr.backward(dr.mean(image, axis=None))
        mean = derivative(parameters["lamps.vertex_color"])
        assert mean == pytest.approx(np.array(image).mean(), rel=0.3)

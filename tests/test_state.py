"""What lives longer than a call: lights, samplers, patterns of samples, what was learnt.

`integrator.sample` alone, without `mi.render` around it, has the lights of the scene as it is; a
sampler keeps its pattern while visibility is learnt, and its number of samples whatever happens;
derivatives pass through direct calls; shapes in groups are shapes of the scene.
"""

import gc
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from manylights import scenes

from tests import light_scenes
from tests.shared_results import shared

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
both_plugins = pytest.mark.parametrize("plugin_name", ["manylights_direct", "manylights_volpath"])


def load(plugin_name, **parameters):
    """An integrator that sees direct light."""
    if plugin_name == "manylights_volpath":
        parameters.setdefault("max_depth", 2)
    return mi.load_dict({"type": plugin_name, **parameters})


def image(scene, integrator, seed=5, spp=16):
    """One image as an array."""
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp))


# -------------------------------------------------------------------------- calls of sample() alone


def lit_floor(intensity, shapes=False):
    """A floor below a point light, maybe with a sky and glowing balls."""
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(5)},
        "light": {
            "type": "point",
            "position": [0, 0, 1],
            "intensity": {"type": "rgb", "value": intensity},
        },
    }
    if shapes:
        scene["sky"] = {"type": "constant"}
        for index in range(20):
            emitter = {"type": "area", "radiance": {"type": "rgb", "value": index + 1.0}}
            ball = {"type": "sphere", "center": [0.3 * index - 3, 1, 2], "radius": 0.1}
            scene[f"ball_{index}"] = {**ball, "emitter": emitter}
    return mi.load_dict(scene)


class Caller:
    """Calls `sample` with one sampler and one ray."""

    def __init__(self):
        self.sampler = mi.load_dict({"type": "independent"})
        self.ray = mi.RayDifferential3f(mi.Ray3f([0.1, 0.2, 1], [0, 0, -1]))

    def __call__(self, scene, integrator):
        self.sampler.seed(0, 1)
        return np.ravel(integrator.sample(scene, self.sampler, self.ray)[0])


@both_variants
@both_plugins
def test_sample_follows_the_scene(variant, plugin_name):
    """The same sampler, before and after an update, and with another scene."""
    call, integrator, scene = Caller(), load(plugin_name), lit_floor(1.0)
    before = call(scene, integrator)
    parameters = mi.traverse(scene)
    parameters["light.intensity.value"] = mi.Color3f(10.0)
    parameters.update()
    np.testing.assert_allclose(call(scene, integrator), 10 * before, rtol=1e-5)
    np.testing.assert_allclose(call(lit_floor(3.0), integrator), 3 * before, rtol=1e-5)
    np.testing.assert_allclose(call(scene, integrator), 10 * before, rtol=1e-5)


@both_variants
@both_plugins
def test_sample_with_what_lies_where_others_lay(variant, plugin_name):
    """Scenes and integrators come and go, and get each other's addresses; the sampler stays."""
    call, integrator = Caller(), load(plugin_name)
    for index in range(12):
        scene = lit_floor(1.0 + index, shapes=index % 3 > 0)
        found = call(scene, integrator)
        fresh = load(plugin_name)
        np.testing.assert_array_equal(found, Caller()(scene, fresh))
        if index % 2:
            integrator = fresh
        del scene, fresh
        gc.collect()


# ----------------------------------------------------------------------------- patterns of samples

SAMPLERS = {"stratified": 64, "multijitter": 64, "ldsampler": 64, "orthogonal": 121}


def ramp(sampler, spp):
    """A camera that sees a ramp of radiance, in a scene with so many lights that it is learnt."""
    ramp = np.repeat(np.linspace(0, 1, 97, dtype=np.float32)[None, :, None], 2, axis=0)
    bitmap = {"type": "bitmap", "data": mi.TensorXf(ramp), "raw": True, "wrap_mode": "clamp"}
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "screen": {"type": "rectangle", "emitter": {"type": "area", "radiance": bitmap}},
        "sensor": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]),
            "film": {**film, "pixel_format": "luminance", "component_format": "float32"},
            "sampler": {"type": sampler, "sample_count": spp},
        },
    }
    for index in range(40):
        scene[f"light_{index}"] = {"type": "point", "position": [index, 0, -5]}
    return mi.load_dict(scene)


@shared
def slope_variance(variant, sampler, spp, learn):
    """Variance of a pixel's mean position, times the number of samples."""
    scene = ramp(sampler, spp)
    integrator = load("manylights_direct", learn_visibility=learn, bsdf_samples=0)
    images = [image(scene, integrator, seed, spp)[8:-8, 8:-8] for seed in range(2)]
    return spp * np.var(images[0] - images[1])


@both_variants
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_learning_keeps_the_pattern(variant, sampler):
    """All samples of a pixel together have the pattern of the sampler.

    Its variance of a linear function is 1 / 64 of that of independent numbers and less; if a
    sixteenth of the samples had a pattern of their own it would be more than 1 / 10.
    """
    independent = slope_variance(variant, "independent", SAMPLERS[sampler], True)
    assert slope_variance(variant, sampler, SAMPLERS[sampler], True) < independent / 40
    assert slope_variance(variant, sampler, SAMPLERS[sampler], False) < independent / 40


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
def test_learning_does_not_depend_on_threads(scalar, sampler, thread_count):
    """The same bits with one thread and with three."""
    description = scenes.house(300, width=40, height=24)
    description["sensor"]["sampler"] = {"type": sampler, "sample_count": 16}
    scene = mi.load_dict(description)
    images = []
    for threads in (1, 3):
        thread_count(threads)
        images.append(image(scene, load("manylights_direct")))
    assert np.array_equal(*images)


# ------------------------------------------------------------------------------------- exceptions


def test_exception_leaves_the_sampler_as_it_was(llvm):
    """The next render without `spp` has as many samples as the one that failed."""

    class Failing(mi.BSDF):
        """Fails when it is recorded."""

        def __init__(self, properties):
            mi.BSDF.__init__(self, properties)
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def sample(self, *_):
            """Not reached by light sampling alone."""
            raise RuntimeError("sample")

        def eval_pdf(self, *_):
            """What light sampling asks for."""
            raise RuntimeError("not today")

        eval = pdf = eval_pdf

    mi.register_bsdf("failing", Failing)
    description = light_scenes.SCENES["points"]()
    description["sensor"]["film"] |= {"width": 128, "height": 128}
    description["ball"] = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "failing"}}
    scene = mi.load_dict(description)
    with pytest.raises(RuntimeError):
        image(scene, load("manylights_direct"), spp=64)
    sampler = scene.sensors()[0].sampler()
    assert sampler.sample_count() == 64
    sampler.set_samples_per_wavefront(64)


def test_sensor_with_a_place_for_each_sample(llvm):
    """As many samples at once as places: nothing can be learnt from some of them before."""
    spp, width, height = 256, 64, 48
    scene = mi.load_dict(scenes.open_plane(200, width=width, height=height))
    sensor = scene.sensors()[0]
    expected = image(scene, load("manylights_direct"), spp=spp).mean()
    parameters = mi.traverse(sensor)
    matrix = parameters["to_world"].matrix
    parameters["to_world"] = mi.Transform4f(matrix + dr.zeros(mi.Float, spp * width * height))
    parameters.update()
    found = image(scene, load("manylights_direct"), spp=spp).mean()
    np.testing.assert_allclose(found, expected, rtol=0.01)


# -------------------------------------------------------------------------- what keeps the tree


def build_time(integrator):
    """Milliseconds of the last build: the same number as long as there is no other one."""
    return np.ravel(mi.traverse(integrator)["build_ms"])[0]


INFINITE = {
    "sun": {"type": "directional", "direction": [0.2, 0.3, -1], "irradiance": {"type": "rgb"}},
    "sky": {"type": "envmap", "bitmap": None},
}


@both_variants
@pytest.mark.parametrize("name", INFINITE)
def test_lights_at_infinity_do_not_change_the_tree(variant, name):
    """Images are those of a new integrator, without a new tree."""
    light = dict(INFINITE[name])
    if name == "sky":
        data = np.random.default_rng(1).uniform(0.1, 1, (8, 16, 3)).astype(np.float32)
        light["bitmap"] = mi.Bitmap(data)
    else:
        light["irradiance"] = {"type": "rgb", "value": 0.7}
    scene = mi.load_dict({**light_scenes.SCENES["points"](), name: light})
    integrator = load("manylights_direct")
    before, built = image(scene, integrator, spp=4), build_time(integrator)
    parameters = mi.traverse(scene)
    if name == "sky":
        parameters["sky.data"] = 3 * parameters["sky.data"]
        parameters["sky.to_world"] = mi.ScalarTransform4f().rotate([0, 0, 1], 40)
    else:
        parameters["sun.to_world"] = mi.ScalarTransform4f().look_at(
            [0, 0, 0], [1, 0, -1], [0, 1, 0]
        )
    parameters.update()
    after = image(scene, integrator, spp=4)
    assert build_time(integrator) == built
    assert not np.array_equal(before, after)
    assert np.array_equal(after, image(scene, load("manylights_direct"), spp=4))


GRADIENTS = {
    "points": "point_7.intensity.value",
    "spots": "spot_3.intensity.value",
    "mesh-constant": "lamps.emitter.radiance.value",
    "spheres": "sphere_3.emitter.radiance.value",
}


def emitters_of(name):
    """A scene by name, and which of its parts is the light of `GRADIENTS`."""
    if name == "spheres":
        description = {**light_scenes.stage(), **light_scenes.shapes("sphere")}
    else:
        description = light_scenes.SCENES[name]()
    return description, GRADIENTS[name].split(".")[0]


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradient_steps_keep_the_tree(llvm, name):
    """Of the brightest light by a factor: it is all that this light gives, step after step."""
    description, light = emitters_of(name)
    scene, integrator = mi.load_dict(description), load("manylights_direct")
    parameters = mi.traverse(scene)
    pattern = light + r"\.(.*\.)?(intensity|radiance)\.value"
    (key,) = [name for name, _ in parameters.items() if re.fullmatch(pattern, name)]
    image(scene, integrator, spp=4)
    built, start = build_time(integrator), 20 * mi.Color3f(parameters[key])

    found = []
    for seed in range(6):
        factor = mi.Float(1.0)
        dr.enable_grad(factor)
        parameters[key] = factor * start
        parameters.update()
        images = mi.render(scene, parameters, integrator=integrator, spp=64, seed=seed)
        dr.backward(dr.mean(images, axis=None))
        assert build_time(integrator) == built
        found.append(dr.grad(factor)[0])

    kind = light.split("_")[0]
    alone = {
        k: v for k, v in description.items() if k == light or not k.startswith((kind, "lamps"))
    }
    alone = mi.load_dict(alone)
    single = mi.traverse(alone)
    single[key] = start
    single.update()
    expected = image(alone, load("manylights_direct"), spp=1024).mean()
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert error < 0.05 * expected
    assert abs(np.mean(found) - expected) < 8 * error + 0.01 * expected

    # Without a gradient the table has it again
    parameters[key] = start
    parameters.update()
    assert np.array_equal(image(scene, integrator), image(scene, load("manylights_direct")))


# ---------------------------------------------------------------------- derivatives of direct calls


def derivative_scene(plugin_name):
    """Forty points above a floor, and a ball of fog for `manylights_volpath`."""
    rng = np.random.default_rng(0)
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    look_at = mi.ScalarTransform4f().look_at([0, -4, 4], [0, 0, 0], [0, 0, 1])
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": grey},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look_at, "film": film},
    }
    for index, (x, y) in enumerate(rng.uniform(-2, 2, (40, 2))):
        scene[f"light_{index}"] = {"type": "point", "position": [float(x), float(y), 1.0]}
    if plugin_name == "manylights_volpath":
        fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}
        scene["ball"] = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "null"}, "interior": fog}
    return mi.load_dict(scene)


def direct_call(kind, scene, integrator):
    """The mean of an image from `render`, or of rays from `sample`."""
    if kind == "render":
        return dr.mean(integrator.render(scene, spp=32, seed=1), axis=None)
    count = 4096
    sampler, rng = mi.load_dict({"type": "independent"}), mi.PCG32(size=count)
    sampler.seed(3, count)
    x, y = 4 * rng.next_float32() - 2, 4 * rng.next_float32() - 2
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(x, y, 2), mi.Vector3f(0, 0, -1)))
    return dr.mean(mi.luminance(integrator.sample(scene, sampler, ray)[0]), axis=None)


@both_plugins
@pytest.mark.parametrize("kind", ["render", "sample"])
def test_derivatives_of_direct_calls(llvm, plugin_name, kind):
    """Forward and backward, against finite differences with the same random numbers.

    Derivatives compile a kernel for each shadow ray, two are enough.
    """
    scene, integrator = derivative_scene(plugin_name), load(plugin_name, shadow_rays=2)
    parameters = mi.traverse(scene)

    def mean(factor):
        parameters["floor.bsdf.reflectance.value"] = mi.Color3f(0.5 * factor)
        parameters.update()
        return direct_call(kind, scene, integrator)

    expected = (mean(1.02) - mean(0.98)) / 0.04
    for mode in ("forward", "backward"):
        factor = mi.Float(1.0)
        dr.enable_grad(factor)
        value = mean(factor)
        if mode == "forward":
            dr.forward(factor)
            found = dr.grad(value)
        else:
            dr.backward(value)
            found = dr.grad(factor)
        np.testing.assert_allclose(found, expected, rtol=2e-3)


# ------------------------------------------------------------------------------- shapes in groups


def grouped(name, shape):
    """A shape as an instance of a group."""
    return {
        f"{name}_group": {"type": "shapegroup", "shape": shape},
        name: {"type": "instance", "group": {"type": "ref", "id": f"{name}_group"}},
    }


@both_variants
def test_lobes_of_instances(variant):
    """A glossy sheet gives the same image, noise included, whether it is an instance or not."""
    sheet = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 0.2]),
        "bsdf": {"type": "roughconductor", "alpha": 0.1},
    }
    images = []
    for furniture in ({"sheet": sheet}, grouped("sheet", sheet)):
        scene = mi.load_dict({**light_scenes.SCENES["points"](), **furniture})
        images.append(image(scene, load("manylights_direct"), spp=4))
    same = np.isclose(*images, rtol=1e-3, atol=1e-5).all(axis=-1)
    assert same.mean() > 0.99


@both_variants
def test_fog_in_a_group_alone(variant):
    """The sky through two mean free paths of absorbing fog."""
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.0}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    look_at = mi.ScalarTransform4f().look_at([0, -5, 0], [0, 0, 0], [0, 0, 1])
    sensor = {"type": "perspective", "fov": 1, "to_world": look_at, "film": film}
    scene = {"type": "scene", "sky": {"type": "constant"}, "sensor": sensor}
    spp = 4096
    found = image(
        mi.load_dict({**scene, **grouped("ball", ball)}), load("manylights_volpath"), spp=spp
    )
    arrives = np.exp(-2)
    error = np.sqrt(arrives * (1 - arrives) / (16 * spp))  # each path arrives or does not
    assert abs(found.mean() - arrives) < 6 * error


@both_variants
def test_surfaces_without_a_lobe(variant):
    """Metal out of sight does not change how diffuse surfaces choose lights."""
    metal = {"type": "sphere", "center": [0, 0, 90], "radius": 0.1, "b": {"type": "roughconductor"}}
    images = []
    for more in ({}, {"metal": metal}):
        scene = mi.load_dict({**light_scenes.SCENES["points"](), **more})
        images.append(image(scene, load("manylights_direct", learn_visibility=False), spp=1))
    same = np.isclose(*images, rtol=1e-3, atol=1e-5).all(axis=-1)
    assert same.mean() > 0.95


# ----------------------------------------------------------------------------- many BSDF samples


def test_kernels_do_not_grow_with_bsdf_samples(llvm):
    """More than a few are a loop; the mean stays that of one."""
    scene = mi.load_dict(light_scenes.SCENES["mesh-constant"]())
    sizes, means = [], []
    for count in (8, 512):
        integrator = load("manylights_direct", bsdf_samples=count)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            image(scene, integrator, spp=1)
            dr.kernel_history_clear()
            means.append(image(scene, integrator, spp=1).mean())
            history = dr.kernel_history([dr.KernelType.JIT])
        sizes.append([kernel["operation_count"] for kernel in history])
    assert sizes[0] == sizes[1]
    one = image(scene, load("manylights_direct"), spp=256).mean()
    np.testing.assert_allclose(means, one, rtol=0.05)

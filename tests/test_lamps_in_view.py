"""Lamps that are small on the film are sampled from their side, and put on the film.

Flat lamps that face the camera have a closed form: one of area A at the depth z covers K A / z^2
pixels, with K the number of pixels for a unit of area at the depth 1.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests import statistics_tools as tools
from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]
INTEGRATORS = ["manylights_direct", "manylights_volpath"]

WIDTH, HEIGHT, FOV, DEPTH, SIDE = 32, 24, 40.0, 4.0, 0.02
RADIANCE = np.array([1.0, 2.0, 3.0])
PIXELS = (WIDTH / 2 / np.tan(np.radians(FOV / 2))) ** 2
PLACES = [(-0.9, 0.4), (-0.31, -0.66), (0.2, 0.53), (0.77, -0.12), (0.03, 0.02)]

SEEDS, SAMPLES = range(8), 32


def lamp(x, y, z=DEPTH, side=SIDE, shape="rectangle"):
    """A lamp that looks at the camera, which looks along z."""
    place = mi.ScalarTransform4f().translate([x, y, z])
    turn = ([1, 0, 0], 90) if shape == "cylinder" else ([0, 1, 0], 180)
    radiance = {"type": "rgb", "value": RADIANCE.tolist()}
    return {
        "type": shape,
        "to_world": place.rotate(*turn).scale(side / 2),
        "emitter": {"type": "area", "radiance": radiance},
    }


def scene_of(
    places=PLACES, integrator="manylights_direct", film=None, sensor=None, more=None, **options
):
    """Lamps in the dark before a camera at the origin."""
    film = {
        **{"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
        **{"pixel_format": "rgb", "sample_border": False},
        **(film or {}),
    }
    camera = {
        **{"type": "perspective", "fov": FOV, "film": film},
        **{"to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])},
        **{"sampler": {"type": "manylights_sobol"}},
        **(sensor or {}),
    }
    lamps = {f"lamp_{i}": lamp(x, y, **options) for i, (x, y) in enumerate(places)}
    return {
        "type": "scene",
        **{"integrator": {"type": integrator}, "sensor": camera},
        **lamps,
        **(more or {}),
    }


def covered(area=SIDE**2, depth=DEPTH):
    """Pixels that a lamp covers."""
    return PIXELS * area / depth**2


def images_of(description, spp=SAMPLES, seeds=SEEDS):
    """Renderings of several seeds."""
    return tools.render_seeds(mi.load_dict(description), None, spp, seeds)


def camera_rays_alone(description):
    """The same scene, without points on lamps: Mitsuba makes the passes."""
    integrator = {**description["integrator"], "samples_per_pass": 1024}
    return {**description, "integrator": integrator}


def sums_agree(images, expected, bias=0.02):
    """Sums over the pixels against a closed form; True if no difference is significant."""
    sums = images.sum(axis=(1, 2))[:, np.newaxis, np.newaxis, :]
    comparison = tools.compare_means(sums, np.asarray(expected).reshape(1, 1, 1, 3))
    if comparison.passes:
        assert comparison.detectable_bias() < bias, comparison.message()
    return comparison.passes


CAMERAS = {
    "pinhole": {},
    "lens": {"sensor": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.5}},
    "shifted": {
        "sensor": {"principal_point_offset_x": 0.06, "principal_point_offset_y": -0.05},
    },
    "shutter": {"sensor": {"shutter_open": 0.0, "shutter_close": 1.0}},
}


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_tiny_lamps_have_the_right_sum(variant, integrator, camera):
    """In all pixels together, with any camera; a planted bias is found."""
    images = images_of(scene_of(integrator=integrator, **CAMERAS[camera]))
    expected = len(PLACES) * covered() * RADIANCE
    assert sums_agree(images, expected, bias=0.1)
    assert not sums_agree(images * 1.1, expected)


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_camera_rays_alone_are_much_noisier(variant):
    """By the ratio of the numbers of points and hits, which is above 100 here."""
    description = scene_of()
    ours, alone = images_of(description), images_of(camera_rays_alone(description))
    variances = [images[..., 0].sum(axis=(1, 2)).var() for images in (ours, alone)]
    assert variances[0] * 20 < variances[1]


CROP = {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 21, "crop_height": 14}
GAUSSIAN = {"rfilter": {"type": "gaussian"}}


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize(
    ("shape", "film"),
    [
        ("rectangle", {"rfilter": {"type": "lanczos"}}),
        ("disk", {**GAUSSIAN, "sample_border": True}),
        ("sphere", {**GAUSSIAN, **CROP}),
        ("cylinder", {}),
    ],
)
def test_images_agree_with_camera_rays_alone(variant, shape, film):
    """Where each lamp is, also at the border of a crop window; a planted bias is found."""
    description = scene_of(film=film, shape=shape, side=0.1)
    ours = images_of(description)
    alone = images_of(camera_rays_alone(description), 256)
    assert tools.compare_means(ours, alone, tile=4).passes
    assert not tools.compare_means(ours * 1.3, alone, tile=4).passes


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_hidden_lamps_stay_hidden(variant, integrator):
    """Behind a wall, turned away, behind the camera, and beyond its range."""
    wall = mi.ScalarTransform4f().translate([1, 0, DEPTH - 0.1]).scale([1, 2, 1])
    turned = {**lamp(-0.5, 0.1), "to_world": mi.ScalarTransform4f().translate([-0.5, 0.1, 3])}
    turned["to_world"] = turned["to_world"].scale(SIDE / 2)
    more = {
        "wall": {"type": "rectangle", "to_world": wall},
        "turned": turned,
        "behind": lamp(0, 0, z=-3),
        "far": lamp(-0.4, -0.2, z=60, side=0.1),
    }
    description = scene_of(integrator=integrator, more=more, sensor={"far_clip": 50.0})
    shown = sum(x < 0 for x, _ in PLACES)
    assert sums_agree(images_of(description), shown * covered() * RADIANCE, bias=0.1)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(
    ("shape", "camera"), [("sphere", "pinhole"), ("sphere", "lens"), ("cylinder", "pinhole")]
)
def test_lamps_that_shine_inwards_are_dark_outside(variant, integrator, shape, camera):
    """The wall that is nearer hides the one that shines, though both are of one lamp."""
    lamps = {
        f"ball_{i}": {**lamp(x, y if shape == "sphere" else 0, shape=shape), "flip_normals": True}
        for i, (x, y) in enumerate(PLACES)
    }
    description = scene_of([], integrator=integrator, more=lamps, **CAMERAS[camera])
    assert not images_of(description).any()


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_tubes_that_shine_inwards_are_seen_from_their_end(variant, integrator):
    """What their near end covers less what is seen through the far one."""
    radius, length = 0.02, 0.4
    tube = {**lamp(0, 0, shape="cylinder"), "flip_normals": True, "radius": radius}
    del tube["to_world"]
    tube |= {"p0": [0, 0, DEPTH], "p1": [0, 0, DEPTH + length]}
    description = scene_of([], integrator=integrator, more={"tube": tube})
    near, far = (covered(np.pi * radius**2, z) for z in (DEPTH, DEPTH + length))
    images = images_of(description, spp=512)
    assert sums_agree(images, (near - far) * RADIANCE, bias=0.1)
    assert not sums_agree(images * 1.1, (near - far) * RADIANCE)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_lamps_at_the_border_of_the_film(variant):
    """Half of each is outside: of the sum, half is left."""
    right = DEPTH * np.tan(np.radians(FOV / 2))
    places = [(right, 0.1), (-right, -0.3), (0.21, right * HEIGHT / WIDTH)]
    images = images_of(scene_of(places))
    assert sums_agree(images, len(places) / 2 * covered() * RADIANCE, bias=0.2)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_transmittance_of_fog(variant):
    """Of a medium that absorbs alone, homogeneous, around camera and lamps."""
    sigma = np.array([0.1, 0.2, 0.3])
    medium = {
        **{"type": "homogeneous", "albedo": 0.0, "phase": {"type": "isotropic"}},
        "sigma_t": {"type": "rgb", "value": sigma.tolist()},
    }
    description = scene_of(integrator="manylights_volpath", sensor={"medium": medium})
    distance = np.array([np.sqrt(x**2 + y**2 + DEPTH**2) for x, y in PLACES])
    expected = covered() * RADIANCE * np.exp(-distance[:, np.newaxis] * sigma).sum(axis=0)
    images = images_of(description)
    assert sums_agree(images, expected, bias=0.1)
    assert not sums_agree(images * 1.1, expected)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_panes_before_lamps(variant):
    """Rays in media pass what lets light pass straight on; points are seen through it, too."""
    pane = mi.ScalarTransform4f().translate([0, 0, 2]).scale(3)
    more = {"pane": {"type": "rectangle", "to_world": pane, "bsdf": {"type": "null"}}}
    medium = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.1}
    description = scene_of(integrator="manylights_volpath", more=more, sensor={"medium": medium})
    distance = np.array([np.sqrt(x**2 + y**2 + DEPTH**2) for x, y in PLACES])
    expected = covered() * RADIANCE * np.exp(-0.1 * distance).sum()
    assert sums_agree(images_of(description), expected, bias=0.1)


def textured(**options):
    """Lamps with a bitmap, which their own emitter evaluates."""
    description = scene_of(side=0.1, **options)
    data = np.random.default_rng(3).uniform(0, 2, (8, 8, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}
    for name, each in description.items():
        if name.startswith("lamp"):
            each["emitter"]["radiance"] = bitmap
    return description, data.mean(axis=(0, 1))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_lamps_with_a_texture(variant, integrator):
    """Their sum is that of the mean of the bitmap."""
    description, mean = textured(integrator=integrator)
    expected = len(PLACES) * covered(0.1**2) * mean
    assert sums_agree(images_of(description), expected, bias=0.15)


@pytest.mark.parametrize("variant", ["scalar_spectral", "llvm_ad_mono_polarized"], indirect=True)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_other_variants(variant, integrator):
    """Wavelengths are drawn as those of camera rays."""
    description = scene_of(integrator=integrator, side=0.1)
    alone = images_of(camera_rays_alone(description), 256)
    assert tools.compare_means(images_of(description), alone, tile=8).passes


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_same_bits_with_any_threads(variant, rfilter, thread_count):
    """Sums are those of integers."""
    description = scene_of(film={"rfilter": {"type": rfilter}})
    images = []
    for threads in (1, 2, 3):
        thread_count(threads)
        images.append(images_of(description, seeds=[7]))
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])


def sums_of(scene, plan):
    """The film's sums after the passes of a plan: (first, count, role, scramble) each."""
    integrator = scene.integrator()
    parameters = mi.traverse(integrator)
    pointer, kind, *_ = parameters.properties["plan"]
    parameters.set_dirty("plan")
    numbers = type(parameters["plan"])([number for each in plan for number in each])
    parameters.set_property(pointer, kind, numbers)
    parameters.update()
    integrator.render(scene, sensor=scene.sensors()[0], seed=5, spp=16, develop=False)
    return np.array(scene.sensors()[0].film().develop(raw=True), np.float64)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_passes_have_the_points_of_their_samples(variant):
    """However the samples are divided: points are those of their numbers, none twice."""
    scene = mi.load_dict(scene_of(sensor={"sampler": {"type": "manylights_sobol"}}))
    whole = sums_of(scene, [(0, 16, 0, 0)])
    halves = sums_of(scene, [(0, 5, 0, 0)]) + sums_of(scene, [(5, 11, 0, 0)])
    trained = sums_of(scene, [(0, 3, 1, 0), (3, 3, 1, 0), (0, 6, 2, 0), (6, 10, 0, 0)])
    np.testing.assert_allclose(halves, whole, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(trained, whole, rtol=1e-5, atol=1e-6)
    assert not np.allclose(sums_of(scene, [(0, 16, 0, 1)]), whole)


def kernels_of(description):
    """How many kernels a render has in LLVM variants."""
    scene = mi.load_dict(description)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        mi.render(scene, spp=4)
        dr.kernel_history_clear()
        mi.render(scene, spp=4)
        return sum(each["type"] == dr.KernelType.JIT for each in dr.kernel_history())


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_nothing_is_done_where_it_would_not_pay(llvm, integrator):
    """Lamps that are large, out of sight or hidden, and cameras whose view is not known."""
    tiny = kernels_of(scene_of(integrator=integrator))
    hidden = scene_of(integrator=integrator)
    hidden["integrator"]["hide_emitters"] = True
    for name, description in {
        "large": scene_of(integrator=integrator, side=2.0),
        "out of sight": scene_of([(9, 9)], integrator),
        "hidden": hidden,
        "alone": camera_rays_alone(scene_of(integrator=integrator)),
    }.items():
        assert kernels_of(description) < tiny, name


def test_integrators_around_ours_see_lamps_with_camera_rays():
    """Points are sampled by a render of ours alone: inside of others hits have all the weight."""
    require_variant("scalar_rgb")
    description = scene_of(side=0.1)
    around = {"type": "aov", "aovs": "depth:depth", "nested": description["integrator"]}
    images = images_of({**description, "integrator": around}, 128)[..., :3]
    assert sums_agree(images, len(PLACES) * covered(0.1**2) * RADIANCE, bias=0.3)


@pytest.mark.parametrize("direct", [False, True])
def test_gradients_are_those_of_camera_rays(llvm, direct):
    """Of the sum of the image by the radiance of a lamp: the pixels that it covers."""
    scene = mi.load_dict(scene_of([(0.1, 0.1)], side=0.12))
    parameters = mi.traverse(scene)
    key = "lamp_0.emitter.radiance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    if direct:
        image = scene.integrator().render(scene, sensor=scene.sensors()[0], seed=1, spp=1024)
    else:
        image = mi.render(scene, parameters, spp=1024, seed=1)
    dr.backward(dr.sum(image, axis=None))
    gradient = np.array(dr.grad(parameters[key])).ravel()
    np.testing.assert_allclose(gradient, covered(0.12**2), rtol=0.15)


def camera_of(scene):
    """The name of the camera's place among the scene's parameters."""
    return next(key for key in mi.traverse(scene).properties if key.endswith("sensor.to_world"))


def moved_camera(parameters, scene):
    place = mi.ScalarTransform4f().translate([0.1, -0.05, 0.3])
    key = camera_of(scene)
    parameters[key] = type(parameters[key])(place.matrix) @ parameters[key]


def changed(parameters, key, factor):
    parameters[key] = type(parameters[key])(parameters[key] * factor)


CHANGES = {
    "camera": moved_camera,
    "field of view": lambda p, scene: changed(
        p, camera_of(scene).replace("to_world", "x_fov"), 0.8
    ),
    "lamp": lambda p, scene: changed(p, "small.vertex_positions", 1.3),
    "radiance": lambda p, scene: changed(p, "lamp_1.emitter.radiance.value", 1.2),
}


def scene_of_a_mesh():
    """Lamps, one of which is a mesh."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE.tolist()}}
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh("small", 3, 1, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-0.4, 0, 4, -0.4, 0.03, 4, -0.37, 0, 4]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    return mi.load_dict(scene_of(more={"small": mesh}))


def render_once(scene, integrator=None, **options):
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=3, **options))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("change", CHANGES)
def test_points_follow_changes(variant, change):
    """What is known of lamps in view is as if nothing had been rendered before."""
    scene = scene_of_a_mesh()
    integrator = scene.integrator()
    before = render_once(scene, integrator)
    assert np.array_equal(before, render_once(scene, integrator))
    parameters = mi.traverse(scene)
    CHANGES[change](parameters, scene)
    parameters.update()
    after = render_once(scene, integrator)
    assert not np.array_equal(before, after)
    assert np.array_equal(after, render_once(scene, mi.load_dict({"type": "manylights_direct"})))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_points_of_several_sensors(variant):
    """In turn, of more views than are kept: other places, film sizes, borders and windows."""
    films = [
        *({"width": 16 + i, "height": 12} for i in range(7)),
        {"sample_border": True, "rfilter": {"type": "gaussian"}},
        {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 21, "crop_height": 14},
    ]
    scene = scene_of_a_mesh()
    sensors = [mi.load_dict(scene_of(film=film)["sensor"]) for film in films]
    integrator = scene.integrator()
    first = [render_once(scene, integrator, sensor=each) for each in sensors]
    for sensor, image in zip(sensors, first, strict=True):
        fresh = mi.load_dict({"type": "manylights_direct"})
        assert np.array_equal(image, render_once(scene, integrator, sensor=sensor))
        assert np.array_equal(image, render_once(scene, fresh, sensor=sensor))

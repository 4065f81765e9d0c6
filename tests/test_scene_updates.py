"""The tree belongs to the scene as it is now: updates, several scenes and sensors, nesting.

After a change, images of an integrator that has seen the scene before must be equal, bit for bit,
to those of a new integrator, and have the mean that Mitsuba's `direct` finds. A stale tree would
give the image from before the change; each test shows that this one is significantly different.

Where emitters have only become brighter or darker, the tree keeps its shape and gets new fluxes: it
is refitted. A new one may have another shape then, and only the means are equal; the bits are if
all lights change by the same power of two.
"""

import contextlib
import gc
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests.references import assert_same_mean, compare_means, planned_images, reference_variant
from tests.shared_results import shared

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)

ERROR = 4.5e-3
"""Relative standard error of an image mean that the number of samples is chosen for."""

BIAS = 0.05
"""Smallest bias that has to be found: 7.5 standard errors of the difference are 4.8 %.

Changes of the scenes below are much larger, and the mean of what a new tree gives is tested in
`test_unbiased.py`.
"""


def light_tree(**parameters):
    """The integrator under test."""
    return mi.load_dict({"type": "manylights_direct", **parameters})


def reference(**parameters):
    """Mitsuba's own."""
    return mi.load_dict({"type": "direct", "emitter_samples": 1, **parameters})


def image(scene, integrator, seed=5, spp=4, sensor=0):
    """One noisy image, for comparisons bit by bit."""
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp, sensor=sensor))


def was_refitted(integrator):
    """Did the tree keep its shape when it was brought up to date last?"""
    return "refit in" in str(integrator)


def assert_current(scene, integrator, fresh=light_tree, sensor=0):
    """The integrator renders what a new one renders, bit for bit."""
    found, expected = (image(scene, i, sensor=sensor) for i in (integrator, fresh()))
    assert np.array_equal(found, expected)


def known_images(scene, integrator=None, error=ERROR):
    """Images of the reference."""
    return planned_images(scene, integrator or reference(), error, first_seed=100_000, known=True)


def assert_right_mean(scene, integrator, expected=None, label="", error=ERROR):
    """The images have the mean of those that are expected, or of the reference in this variant."""
    images = planned_images(scene, integrator, error, first_seed=0)
    expected = known_images(scene, error=error) if expected is None else expected
    assert_same_mean(images[..., :3], expected[..., :3], bias=BIAS, label=label)


@contextlib.contextmanager
def in_variant(name):
    """Another variant for a while."""
    before = mi.variant()
    mi.set_variant(name)
    try:
        yield
    finally:
        mi.set_variant(before)


# ----------------------------------------------------------------------------------------- changes


def scaled(scene, key, factor):
    """Multiply a parameter."""
    parameters = mi.traverse(scene)
    parameters[key] = factor * parameters[key]
    parameters.update()


def matching(parameters, pattern):
    """The names of parameters that match."""
    return [name for name, _ in parameters.items() if re.fullmatch(pattern, name)]


def brighter_point(scene):
    """One of 200 lights gets forty times as bright."""
    scaled(scene, "point_7.intensity.value", 40)


def lower_points(scene):
    """Forty of 200 lights move towards the floor."""
    parameters = mi.traverse(scene)
    for index in range(40):
        x, y, z = np.ravel(parameters[f"point_{index}.position"])
        parameters[f"point_{index}.position"] = [float(x), float(y), float(z) - 0.8]
    parameters.update()


def turned_spots(scene):
    """Twenty of 60 spots move, and aim at the same point."""
    parameters = mi.traverse(scene)
    look_at = mi.ScalarTransform4f().look_at([0.3, -0.5, 2.0], [0.3, -0.6, 0], [0, 1, 0])
    for index in range(20):
        parameters[f"spot_{index}.to_world"] = look_at
    parameters.update()


def wider_spot(scene):
    """A spot opens, and loses its soft border."""
    parameters = mi.traverse(scene)
    for index in range(0, 60, 2):
        parameters[f"spot_{index}.cutoff_angle"] = 70.0
        parameters[f"spot_{index}.beam_width"] = 65.0
    parameters.update()


def lower_mesh(scene):
    """All vertices of an emissive mesh move towards the middle of the floor."""
    parameters = mi.traverse(scene)
    vertices = np.array(parameters["lamps.vertex_positions"]).reshape(-1, 3)
    moved = (vertices * (0.8, 0.8, 0.6)).astype(np.float32)
    parameters["lamps.vertex_positions"] = np.ravel(moved)
    parameters.update()


def brighter_mesh(scene):
    """The radiance of a whole mesh."""
    (key,) = matching(mi.traverse(scene), r"lamps.*radiance\.value")
    scaled(scene, key, 1.5)


def other_face_colours(scene):
    """Triangles of a mesh exchange their radiance, and each fifth gets brighter."""
    parameters = mi.traverse(scene)
    colours = np.array(parameters["lamps.face_color"]).reshape(-1, 3)[::-1].copy()
    colours[::5] *= 4
    parameters["lamps.face_color"] = np.ravel(colours)
    parameters.update()


def other_texture(scene):
    """The bitmaps on rectangles and disks: upside down, and brighter in one half.

    Mitsuba makes one object of equal textures, and lists it under one of the lights.
    """
    parameters = mi.traverse(scene)
    keys = matching(parameters, r".*radiance\.data")
    assert keys
    for key in keys:
        data = np.array(parameters[key])[::-1].copy()
        data[:4] *= 2
        parameters[key] = mi.TensorXf(data)
    parameters.update()


def moved_shapes(kind):
    """A change that moves each fourth shape to a place near the floor."""

    def change(scene):
        parameters = mi.traverse(scene)
        for index in range(0, 16, 4):
            frame = mi.ScalarTransform4f().translate([0.3 * index / 4 - 0.5, -0.8, 0.9])
            frame = frame.rotate([1, 0, 0], 180).scale(0.15)
            parameters[f"{kind}_{index}.to_world"] = frame
        parameters.update()

    return change


def brighter_sky(scene):
    """A light that is not in the tree."""
    scaled(scene, "sky.radiance.value", 3)


def with_shapes(kind):
    """Sixteen area lights on shapes of one kind."""
    return lambda: {**light_scenes.stage(), **light_scenes.shapes(kind)}


SCENES = light_scenes.SCENES
CHANGES = {
    "intensity": (SCENES["points"], brighter_point),
    "position": (SCENES["points"], lower_points),
    "spot-direction": (SCENES["spots"], turned_spots),
    "spot-angle": (SCENES["spots"], wider_spot),
    "vertices": (SCENES["mesh-constant"], lower_mesh),
    "radiance": (SCENES["mesh-constant"], brighter_mesh),
    "face-colours": (SCENES["mesh-face-colours"], other_face_colours),
    "texture": (SCENES["textured"], other_texture),
    "rectangles": (with_shapes("rectangle"), moved_shapes("rectangle")),
    "spheres": (with_shapes("sphere"), moved_shapes("sphere")),
    "sky": (SCENES["sky"], brighter_sky),
}

REFITTED = ("intensity", "radiance")
"""Changes after which the tree of `resampled_tree` keeps its shape."""


def load(name):
    """A new scene that the change belongs to."""
    return mi.load_dict(CHANGES[name][0]())


@shared
def images_after(name, variant):
    """Images of the reference after a change, in a variant.

    Mitsuba samples lights with face colours wrongly, but hits them.
    """
    with in_variant(variant):
        scene = load(name)
        CHANGES[name][1](scene)
        samples = 0 if name == "face-colours" else 1
        return known_images(scene, reference(emitter_samples=samples))


@both_variants
@pytest.mark.parametrize("method", ["resampled_tree", "talk"])
@pytest.mark.parametrize("name", CHANGES)
def test_update_is_seen(variant, name, method):
    """The same integrator, before and after the update; a second render changes nothing."""
    scene, integrator = load(name), light_tree(method=method)
    before = image(scene, integrator)
    CHANGES[name][1](scene)
    after = image(scene, integrator)
    assert not np.array_equal(before, after)
    assert np.array_equal(after, image(scene, integrator))
    if method == "resampled_tree" and name in REFITTED:
        assert was_refitted(integrator)
    else:
        assert_current(scene, integrator, lambda: light_tree(method=method))


@both_variants
@pytest.mark.parametrize("name", CHANGES)
def test_mean_after_update(variant, name):
    """It is that of `direct`, and that of the images before the update is not."""
    scene, integrator = load(name), light_tree()
    before = planned_images(scene, integrator, ERROR, first_seed=0)
    CHANGES[name][1](scene)
    expected = images_after(name, reference_variant(variant))
    assert_right_mean(scene, integrator, expected, f"{name}, {variant}")
    assert not compare_means(before, expected).passes


@both_variants
@pytest.mark.parametrize("repetitions", [1, 20])
def test_change_and_return(variant, repetitions):
    """Old parameters give the old image back, bit for bit, however often they changed."""
    scene, integrator = load("intensity"), light_tree()
    before = image(scene, integrator)
    for _ in range(repetitions):
        scaled(scene, "point_7.intensity.value", 32)
        assert not np.array_equal(image(scene, integrator), before)
        scaled(scene, "point_7.intensity.value", 1 / 32)
        after = image(scene, integrator)
    assert was_refitted(integrator)
    assert np.array_equal(after, before)


# ------------------------------------------------------------------------------------------- refits


def emission_keys(scene):
    """Names of the emission of all lights, in the order of the scene."""
    return matching(mi.traverse(scene), r".*(intensity|radiance)\.value")


def scale_emission(scene, factor, every=1):
    """Multiply the emission of each light, or of some."""
    parameters = mi.traverse(scene)
    for key in emission_keys(scene)[::every]:
        parameters[key] = factor * parameters[key]
    parameters.update()


def two_meshes():
    """Emissive meshes of one colour each, one of them with smooth normals."""
    return {**SCENES["mesh-smooth"](), "lamps": SCENES["mesh-constant"]()["lamps"]}


ALL_KINDS = {
    "points": SCENES["points"],
    "spots": SCENES["spots"],
    "narrow spots": SCENES["hard-spots"],
    "meshes": two_meshes,
    "spheres": with_shapes("sphere"),
    "disks": with_shapes("disk"),
    "cylinders": with_shapes("cylinder"),
}
every_kind = pytest.mark.parametrize("kind", ALL_KINDS)


@both_variants
@every_kind
def test_twice_as_bright(variant, kind):
    """If all lights change alike, a new tree has the same shape, and the images the same bits."""
    scene, integrator = mi.load_dict(ALL_KINDS[kind]()), light_tree()
    before = image(scene, integrator)
    scale_emission(scene, 2)
    assert_current(scene, integrator)
    assert was_refitted(integrator)
    assert not np.array_equal(before, image(scene, integrator))


@shared
def images_of_brighter(kind, variant):
    """Images of the reference in a variant, where half of the lights are thirty times as bright."""
    with in_variant(variant):
        scene = mi.load_dict(ALL_KINDS[kind]())
        scale_emission(scene, 30, every=2)
        return known_images(scene)


@both_variants
@every_kind
def test_mean_after_refit(variant, kind):
    """Half of the lights get thirty times as bright: the mean is that of `direct`."""
    scene, integrator = mi.load_dict(ALL_KINDS[kind]()), light_tree()
    image(scene, integrator)
    scale_emission(scene, 30, every=2)
    expected = images_of_brighter(kind, reference_variant(variant))
    assert_right_mean(scene, integrator, expected, f"{kind}, {variant}")
    assert was_refitted(integrator)


@both_variants
def test_refit_is_not_a_build(variant):
    """The time of the last build stays, and so do the numbers of nodes and lights."""
    scene, integrator = load("intensity"), light_tree()
    image(scene, integrator)
    numbers = {key: np.ravel(mi.traverse(integrator)[key])[0] for key in KEYS}
    assert "built in" in str(integrator)
    brighter_point(scene)
    image(scene, integrator)
    assert was_refitted(integrator)
    assert numbers == {key: np.ravel(mi.traverse(integrator)[key])[0] for key in KEYS}


@both_variants
def test_refit_of_many_steps(variant):
    """Animated lights: one refit after another, mixed with moves, which build a new tree."""
    scene, integrator = load("intensity"), light_tree()
    image(scene, integrator)
    for step in range(6):
        scale_emission(scene, 1.5, every=step + 1)
        image(scene, integrator)
        assert was_refitted(integrator)
        if step % 3 == 2:
            lower_points(scene)
            assert_current(scene, integrator)
            assert not was_refitted(integrator)
    expected = images_after_steps(reference_variant(variant), error=2.5e-3)
    assert_right_mean(scene, integrator, expected, label=variant, error=2.5e-3)


@shared
def images_after_steps(variant, error):
    """Images of the reference after the same steps, in a variant."""
    with in_variant(variant):
        scene = load("intensity")
        for step in range(6):
            scale_emission(scene, 1.5, every=step + 1)
            if step % 3 == 2:
                lower_points(scene)
        return known_images(scene, error=error)


@both_variants
@pytest.mark.parametrize("name", [name for name in CHANGES if name not in (*REFITTED, "sky")])
def test_other_changes_build_a_new_tree(variant, name):
    """Places, angles, and radiance that varies over a surface."""
    scene, integrator = load(name), light_tree()
    image(scene, integrator)
    CHANGES[name][1](scene)
    image(scene, integrator)
    assert not was_refitted(integrator)


@both_variants
@pytest.mark.parametrize("kind", ["points", "meshes"])
@pytest.mark.parametrize("values", [(0, 1, 0), (1, 0, 2), (1, -1, 1), (1, float("inf"), 1)])
def test_lights_that_come_and_go(variant, kind, values):
    """Lights without power are not in the tree: a new one is built when that changes."""
    scene, integrator = mi.load_dict(ALL_KINDS[kind]()), light_tree()
    parameters, key = mi.traverse(scene), emission_keys(scene)[0]
    counts = []
    for value in values:
        parameters[key] = mi.Color3f(value)
        parameters.update()
        assert_current(scene, integrator)
        assert not was_refitted(integrator)
        counts.append(np.ravel(mi.traverse(integrator)["lights_in_tree"])[0])
    assert counts[0] == counts[2] != counts[1]


def test_gradients_keep_the_tree(llvm):
    """Emission with a derivative leaves the table, but not its place in the tree.

    Kernels ask the emitter for it; its values are those of `test_state.py`.
    """
    scene, integrator = load("intensity"), light_tree()
    image(scene, integrator)
    parameters, key = mi.traverse(scene), "point_7.intensity.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    rendered = mi.render(scene, parameters, integrator=integrator, spp=4, seed=5)
    dr.forward_from(parameters[key])
    assert np.abs(np.array(dr.grad(rendered))).max() > 0
    assert was_refitted(integrator)


def test_image_that_was_not_evaluated_keeps_its_lights(llvm):
    """JIT variants compute an image when it is looked at, maybe after the next change."""
    scene, integrator = load("intensity"), light_tree()
    expected = image(scene, integrator)
    late = mi.render(scene, integrator=integrator, seed=5, spp=4)
    brighter_point(scene)
    after = image(scene, integrator)
    assert was_refitted(integrator)
    assert np.array_equal(np.array(late), expected)
    assert not np.array_equal(after, expected)


@pytest.mark.parametrize(
    "variant",
    [pytest.param("scalar_rgb", marks=pytest.mark.slow), "llvm_ad_rgb"],
    indirect=True,
)
def test_refit_under_nesting(variant):
    """`moment` calls `sample` alone; the mean after a refit is that of `direct`."""
    inner = light_tree()
    scene, integrator = load("intensity"), nested("moment", inner)
    image(scene, integrator)
    brighter_point(scene)
    expected = images_after("intensity", reference_variant(variant))
    assert_right_mean(scene, integrator, expected, variant)
    assert was_refitted(inner)


# ------------------------------------------------------------------------------ scenes and sensors


@both_variants
def test_scenes_in_turn(variant):
    """One integrator, three scenes: none takes another one's lights."""
    names = ("intensity", "vertices", "spheres")
    scenes, integrator = [load(name) for name in names], light_tree()
    expected = [image(scene, light_tree()) for scene in scenes]
    for index in (0, 1, 0, 1, 2, 0, 2, 1):
        assert np.array_equal(image(scenes[index], integrator), expected[index])


@both_variants
def test_update_of_one_of_two_scenes(variant):
    """The other scene keeps its tree."""
    scenes, integrator = [load("intensity"), load("intensity")], light_tree()
    first = [image(scene, integrator) for scene in scenes]
    lower_points(scenes[0])
    assert_current(scenes[0], integrator)
    assert np.array_equal(image(scenes[1], integrator), first[1])
    scale_emission(scenes[0], 2)
    assert_current(scenes[0], integrator)
    assert was_refitted(integrator)
    assert np.array_equal(image(scenes[1], integrator), first[1])


@both_variants
@pytest.mark.parametrize("nesting", [None, "aov", "moment"])
def test_new_scene_after_the_old_one_is_deleted(variant, nesting):
    """A new scene may lie where the old one lay in memory."""
    integrator = nested(nesting, light_tree())
    for factor in (1, 3, 9, 27, 81):
        description = CHANGES["intensity"][0]()
        for index in range(200):
            colour = description[f"point_{index}"]["intensity"]["value"]
            description[f"point_{index}"]["intensity"]["value"] = [factor * c for c in colour]
        scene = mi.load_dict(description)
        assert_current(scene, integrator, lambda: nested(nesting, light_tree()))
        del scene, description
        gc.collect()


@both_variants
def test_new_scene_with_other_media(variant):
    """The new scene may lie where the old one lay and have the same lights, and fog besides."""
    lights = {key: mi.load_dict(light) for key, light in light_scenes.points(2).items()}

    def path_tracer():
        return mi.load_dict({"type": "manylights_volpath", "max_depth": 3})

    def foggy_or_clear(medium):
        ball = {"type": "sphere", "radius": 0.5, "material": {"type": "null"}, **medium}
        return mi.load_dict({**light_scenes.stage(), **lights, "ball": ball})

    media = [{}, {"interior": {"type": "homogeneous", "sigma_t": 4.0}}]
    clear, foggy = (image(foggy_or_clear(medium), path_tracer()) for medium in media)
    assert not np.array_equal(clear, foggy)
    integrator = path_tracer()
    for _ in range(4):
        for medium, expected in zip(media, (clear, foggy)):
            gc.collect()
            assert np.array_equal(image(foggy_or_clear(medium), integrator), expected)


def test_renderings_of_two_threads_that_overlap(scalar):
    """What is vouched for during a rendering no longer is when the last one has ended.

    The first thread ends before the second one, which begins while the first is at work.
    """
    descriptions = [SCENES["points"]() for _ in range(2)]
    for description in descriptions:
        description["sensor"]["film"] |= {"width": 96, "height": 64}
    scenes, integrator = [mi.load_dict(description) for description in descriptions], light_tree()
    image(scenes[0], integrator)
    first, second = (
        threading.Thread(target=image, args=(scene, integrator), kwargs={"spp": spp})
        for scene, spp in zip(scenes, (32, 128))
    )
    first.start()
    time.sleep(0.1)
    second.start()
    first.join()
    assert second.is_alive()
    second.join()
    image(scenes[0], nested("moment", integrator))
    lower_points(scenes[0])
    fresh = nested("moment", light_tree())
    assert_current(scenes[0], nested("moment", integrator), lambda: fresh)


@both_variants
def test_several_sensors(variant):
    """Each sensor of a scene, one after the other, before and after an update."""
    description = SCENES["points"]()
    look_at = mi.ScalarTransform4f().look_at([3, -2, 2], [0, 0, 0.2], [0, 0, 1])
    description["other"] = {**light_scenes.sensor(), "to_world": look_at}
    scene, integrator = mi.load_dict(description), light_tree()
    for _ in range(2):
        images = []
        for sensor in (0, 1, 0):
            assert_current(scene, integrator, sensor=sensor)
            images.append(image(scene, integrator, sensor=sensor))
        assert np.array_equal(images[0], images[2])
        assert not np.array_equal(images[0], images[1])
        scale_emission(scene, 2)


# ----------------------------------------------------------------------------------------- nesting


def nested(kind, integrator):
    """The integrator inside another one, or itself."""
    if kind == "aov":
        return mi.load_dict({"type": "aov", "aovs": "distance:depth", "image": integrator})
    if kind == "moment":
        return mi.load_dict({"type": "moment", "image": integrator})
    return integrator


both_nestings = pytest.mark.parametrize("nesting", ["aov", "moment"])


@both_variants
@both_nestings
def test_update_is_seen_under_nesting(variant, nesting):
    """`aov` calls `render` of the inner integrator, `moment` only its `sample`."""
    scene, integrator = load("position"), nested(nesting, light_tree())
    before = image(scene, integrator)
    lower_points(scene)
    assert_current(scene, integrator, lambda: nested(nesting, light_tree()))
    assert not np.array_equal(before, image(scene, integrator))


@both_variants
@both_nestings
def test_mean_under_nesting(variant, nesting):
    """After an update, against `direct`."""
    scene, integrator = load("position"), nested(nesting, light_tree())
    image(scene, integrator)
    lower_points(scene)
    expected = images_after("position", reference_variant(variant))
    assert_right_mean(scene, integrator, expected, f"{nesting}, {variant}")


LARGE = """
import mitsuba as mi, numpy as np, manylights
mi.set_variant("scalar_rgb")
from tests import light_scenes as scenes
corners = np.random.default_rng(1).random((100_000, 1, 3)) + [0, 0, 1] + 0.01 * np.eye(3)
scene = mi.load_dict({**scenes.stage(), "lamps": scenes.make_mesh(corners, scenes.rgb([1, 1, 1]))})
for _ in range(3):
    inner = mi.load_dict({"type": "manylights_direct"})
    mi.render(scene, integrator=mi.load_dict({"type": "moment", "image": inner}), spp=1)
print("done")
"""


def test_large_tree_under_nesting():
    """One of the threads that render builds the tree: those that wait must not wait for it.

    A thread with nothing else to do while it builds would take up pixels, and hang.
    """
    process = subprocess.run(
        [sys.executable, "-c", LARGE],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert process.stdout.split()[-1:] == ["done"], process.stderr


# ------------------------------------------------------------------------------ published numbers

KEYS = ("lights", "lights_in_tree", "nodes", "depth", "bytes", "build_ms")


@both_variants
def test_numbers_of_the_tree(variant):
    """Zero before the first render, then those of the current scene; read-only."""
    integrator = light_tree()
    assert [mi.traverse(integrator)[key] for key in KEYS] == [0] * len(KEYS)
    for name, lights, in_tree in (("intensity", 200, 200), ("vertices", 100, 100)):
        image(load(name), integrator)
        numbers = {key: mi.traverse(integrator)[key] for key in KEYS}
        assert (numbers["lights"], numbers["lights_in_tree"]) == (lights, in_tree)
        assert lights / 4 <= numbers["nodes"] < lights
        assert 4 <= numbers["depth"] <= 64
        assert numbers["bytes"] >= 100 * numbers["nodes"] + 64 * lights
        assert 0 < numbers["build_ms"] < 1e4


@both_variants
def test_lights_at_infinity_are_not_in_the_tree(variant):
    """They count as lights."""
    scene, integrator = load("sky"), light_tree()
    image(scene, integrator)
    numbers = mi.traverse(integrator)
    at_infinity = [e for e in scene.emitters() if mi.has_flag(e.flags(), mi.EmitterFlags.Infinite)]
    assert numbers["lights"] == len(scene.emitters())
    assert numbers["lights"] - numbers["lights_in_tree"] == len(at_infinity) > 0


@both_variants
@pytest.mark.parametrize("key", KEYS)
def test_numbers_cannot_be_changed(variant, key):
    """Mitsuba refuses to set them."""
    parameters = mi.traverse(light_tree())
    assert parameters.flags(key) & mi.ParamFlags.ReadOnly
    with pytest.raises(Exception, match=r"(?i)read-only"):
        parameters[key] = 1


@both_variants
def test_text_of_the_integrator(variant):
    """Every parameter by name and value, and the tree once there is one."""
    values = {"splitting_rate": 2.5, "reservoirs": 5, "shadow_rays": 3, "bsdf_samples": 0}
    integrator = light_tree(**values, hide_emitters=True)
    assert_text(integrator, **values, hide_emitters="true", method="resampled_tree")
    assert "not built yet" in str(integrator)
    assert "split_function" not in str(integrator)
    image(load("intensity"), integrator)
    assert "lights = 200, lights_in_tree = 200, nodes = " in str(integrator)
    assert_text(light_tree(splitting_rate=float("inf")), splitting_rate="inf")
    assert_text(light_tree(method="talk", split_function="far"), split_function="far")
    assert_text(light_tree(method="adaptive_splitting", splitting_rate=2), splitting_rate=2)
    assert_text(light_tree(method="exhaustive", reservoirs=3, shadow_rays=2), reservoirs=3)
    for unused in ("splitting_rate", "reservoirs", "shadow_rays"):
        assert unused not in str(light_tree(method="tree"))


def assert_text(integrator, **values):
    """`name = value` is in what `print` shows."""
    lines = [line.strip().rstrip(",") for line in str(integrator).splitlines()]
    for name, value in values.items():
        assert f"{name} = {value}" in lines


# ------------------------------------------------------------------------------ invalid parameters

INVALID = [
    ({"splitting_rate": -1}, ["splitting_rate", "-1", ">= 0"]),
    ({"splitting_rate": float("nan")}, ["splitting_rate", "nan", ">= 0"]),
    ({"splitting_rate": float("-inf")}, ["splitting_rate", "-inf", ">= 0"]),
    ({"splitting_rate": "many"}, ["splitting_rate", '"many"', '"inf"']),
    ({"splitting_rate": True}, ["splitting_rate", "expected float", "boolean"]),
    ({"reservoirs": 0}, ["reservoirs", " 0,", "from 1 to 64"]),
    ({"reservoirs": -3}, ["reservoirs", "-3", "from 1 to 64"]),
    ({"reservoirs": 65}, ["reservoirs", "65", "from 1 to 64"]),
    ({"reservoirs": 2.5}, ["reservoirs", "expected integer", "float"]),
    ({"reservoirs": "8"}, ["reservoirs", "expected integer", "string"]),
    ({"shadow_rays": 0}, ["shadow_rays", " 0,", "from 1 to"]),
    ({"shadow_rays": -2}, ["shadow_rays", "-2", "from 1 to"]),
    ({"reservoirs": 4, "shadow_rays": 5}, ["shadow_rays", " 5,", "from 1 to 4"]),
    ({"bsdf_samples": -1}, ["bsdf_samples", "-1", "from 0 to"]),
    ({"hide_emitters": "yes"}, ["hide_emitters", "expected boolean", "string"]),
    ({"method": "best"}, ["method", '"best"', '"resampled_tree" or "talk"']),
    ({"method": 3}, ["method", "expected string", "integer"]),
    ({"split_function": "near"}, ["split_function", '"near"', "unless", "method"]),
    ({"method": "talk", "split_function": "middle"}, ["split_function", '"middle"', '"near" or']),
    ({"method": "tree", "splitting_rate": 1}, ["splitting_rate", "left out", '"tree"']),
    ({"method": "tree", "reservoirs": 8}, ["reservoirs", "left out", '"tree"']),
    ({"method": "exhaustive", "splitting_rate": 1}, ["splitting_rate", "left out"]),
    ({"method": "adaptive_splitting", "shadow_rays": 1}, ["shadow_rays", "left out"]),
    ({"method": "adaptive_splitting", "split_function": "far"}, ["split_function", "unless"]),
    ({"counts": 1}, ["counts", "expected boolean", "integer"]),
    ({"reservoir": 3}, ["unreferenced", '"reservoir": 3']),
]
VALID = [
    {"splitting_rate": 0},
    {"splitting_rate": 1},
    {"splitting_rate": "inf"},
    {"splitting_rate": float("inf")},
    {"reservoirs": 1},
    {"reservoirs": 64, "shadow_rays": 64},
    {"bsdf_samples": 0},
    {"method": "talk"},
    {"method": "talk", "split_function": "near"},
    {"method": "adaptive_splitting", "splitting_rate": 0.5},
    {"method": "tree"},
    {"method": "exhaustive", "reservoirs": 2, "shadow_rays": 1},
    {"counts": True},
]


def parameter_id(parameters):
    """A readable test id."""
    return ",".join(f"{name}={value}" for name, value in parameters.items())


@both_variants
@pytest.mark.parametrize(
    ("parameters", "words"), INVALID, ids=[parameter_id(parameters) for parameters, _ in INVALID]
)
def test_invalid_parameter_is_refused(variant, parameters, words):
    """The message has the name, the value and what is allowed."""
    with pytest.raises(RuntimeError) as raised:
        light_tree(**parameters)
    assert "manylights_direct" in str(raised.value)
    for word in words:
        assert word in str(raised.value)


@both_variants
@pytest.mark.parametrize("parameters", VALID, ids=parameter_id)
def test_valid_parameter_renders(variant, parameters):
    """The borders of the ranges work."""
    result = image(load("intensity"), light_tree(**parameters), spp=1)
    assert np.isfinite(result).all()
    assert result.mean() > 0

"""The same seed gives the same image, bit for bit."""

import hashlib
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes, path_scenes, quick_kernels

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]
METHODS = ["resampled_tree", "talk", "adaptive_splitting"]

SAMPLES = 16


def larger_scene(rfilter="box", sampler="independent"):
    """The mixed scene with enough pixels for both threads to get work."""
    scene = light_scenes.SCENES["mixed"]()
    scene["sensor"]["film"] |= {"width": 96, "height": 64, "rfilter": {"type": rfilter}}
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": SAMPLES}
    return mi.load_dict(scene)


def rendered(method, seed=7):
    """An image from a freshly loaded scene."""
    integrator = mi.load_dict({"type": "manylights_direct", "method": method})
    return np.array(mi.render(larger_scene(), integrator=integrator, spp=SAMPLES, seed=seed))


def rendered_fog():
    """A path-traced image from a freshly loaded scene with lights in fog."""
    return paths(path_scenes.load("points-inside"))


def paths(scene, integrator=None):
    """An image with two bounces."""
    integrator = integrator or mi.load_dict({"type": "manylights_volpath", "max_depth": 3})
    return np.array(mi.render(scene, integrator=integrator, spp=SAMPLES, seed=7))


def digest(image):
    """Checksum of the bytes of an image."""
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("method", METHODS)
def test_image_does_not_depend_on_threads(variant, method, thread_count):
    """One, three and two threads, and two again give the same bits; another seed does not."""
    thread_count(1)
    one = rendered(method)
    thread_count(3)
    assert np.array_equal(one, rendered(method))
    thread_count(2)
    two = rendered(method)
    assert np.array_equal(one, two)
    assert np.array_equal(two, rendered(method))
    assert not np.array_equal(two, rendered(method, seed=8))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("name", ["manylights_direct", "manylights_volpath"])
@pytest.mark.parametrize(
    ("rfilter", "sampler", "samples"),
    [
        ("gaussian", "independent", 16),
        ("mitchell", "independent", 7),
        ("gaussian", "multijitter", 12),
        ("box", "manylights_sobol", 100),
    ],
)
def test_filters_do_not_depend_on_threads(variant, name, rfilter, sampler, samples, thread_count):
    """Pixels share samples where a filter is wide; no number of samples divides the work evenly."""

    def image():
        method = mi.load_dict({"type": name})
        return np.array(mi.render(larger_scene(rfilter, sampler), integrator=method, spp=samples))

    thread_count(1)
    one = image()
    for threads in (2, 5):
        thread_count(threads)
        assert np.array_equal(one, image())


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_repeated_rendering_of_one_scene_is_equal(variant):
    """The tree that the first rendering builds serves the later ones unchanged."""
    scene = larger_scene()
    integrator = mi.load_dict({"type": "manylights_direct"})
    images = [
        np.array(mi.render(scene, integrator=integrator, spp=SAMPLES, seed=seed))
        for seed in (7, 8, 7)
    ]
    assert np.array_equal(images[0], images[2])
    assert not np.array_equal(images[0], images[1])


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_image_does_not_depend_on_the_process(variant, tmp_path):
    """A new process, whose kernels are optimized, renders the same bits, of surfaces and of fog."""
    script = (
        "import mitsuba, manylights\n"
        f"mitsuba.set_variant({variant!r})\n"
        "from tests.test_determinism import digest, rendered, rendered_fog\n"
        "print(digest(rendered('resampled_tree')), digest(rendered_fog()))\n"
    )
    folder = Path(__file__).parents[1]
    process = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env=quick_kernels.optimized_environment(tmp_path),
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    expected = [digest(rendered("resampled_tree")), digest(rendered_fog())]
    assert process.stdout.split()[-2:] == expected


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize(
    ("name", "load", "scene_name"),
    [
        ("manylights_direct", light_scenes.load, "points"),
        ("manylights_volpath", path_scenes.load, "points-inside"),
    ],
)
def test_moving_a_light_and_back_gives_the_same_bits(variant, name, load, scene_name):
    """The tree is built three times, and each time in the same way from the same lights."""
    scene, integrator = load(scene_name), mi.load_dict({"type": name})
    parameters, key = mi.traverse(scene), "point_7.position"
    here = [float(x) for x in np.ravel(parameters[key])]
    there = [here[0] + 0.5, here[1], here[2] - 0.3]
    images = []
    for position in (here, there, here):
        parameters[key] = position
        parameters.update()
        images.append(paths(scene, integrator))
    assert np.array_equal(images[0], images[2])
    assert not np.array_equal(images[0], images[1])


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_image_does_not_depend_on_other_scenes(variant):
    """Scenes that are alive, and were rendered in between, do not change it.

    In JIT variants they share the numbers by which kernels know emitters and shapes.
    """
    alone = rendered_fog()
    scenes = [path_scenes.load(name) for name in ("lamps-inside", "points-inside")]
    images = [paths(scene) for scene in scenes]
    assert np.array_equal(images[-1], alone)
    assert np.array_equal(paths(scenes[-1]), alone)
    for scene, image in zip(scenes, images):
        assert np.array_equal(paths(scene), image)
    assert np.array_equal(rendered_fog(), alone)

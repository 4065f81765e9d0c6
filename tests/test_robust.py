"""What happens around rendering: being stopped, memory, threads, variants, large images."""

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from manylights import scenes
from manylights.loading import has_backend
from scipy import stats

from tests import light_scenes, path_scenes
from tests.conftest import heed_ctrl_c
from tests.statistics_tools import SIGNIFICANCE

pytestmark = pytest.mark.usefixtures("plugin")

both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)

OURS = ["manylights_direct", "manylights_volpath"]
with_mitsubas = pytest.mark.parametrize("name", ["direct", *OURS])


def image(scene, integrator, spp=4, seed=5):
    """One image as an array."""
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))


def start_python(script, *arguments, **options):
    """Start a script in a new process, in the folder that `tests` is in."""
    return subprocess.Popen(
        [sys.executable, "-c", script, *map(str, arguments)],
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def run_python(script, *arguments):
    """Run a script in a new process and return the JSON of its last line."""
    process = start_python(script, *arguments)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    # Mitsuba ends the colour of a warning at the beginning of the next line.
    return json.loads(output.splitlines()[-1].removeprefix("\x1b[0m"))


# ---------------------------------------------------------------------------------- being stopped

MINUTES = 2_000_000
"""Samples per pixel of 24 x 16 pixels that take minutes in scalar variants."""

SOON = 20
"""Seconds within which a render that would take minutes has to end, on a busy machine, too."""

INTERRUPTED = """
import sys
import mitsuba as mi
import manylights

mi.set_variant(sys.argv[1])
from tests import light_scenes
scene = light_scenes.load("points")
integrator = mi.load_dict({"type": sys.argv[2]})
mi.render(scene, integrator=integrator, spp=1)
import drjit as dr
print("ready", flush=True)
try:
    # Again and again: a process that ends by itself no longer heeds the signal
    for _ in range(1000):
        image = mi.render(scene, integrator=integrator, spp=int(sys.argv[3]))
        dr.eval(image)
        dr.sync_thread()
except KeyboardInterrupt:
    sys.exit(3)
except RuntimeError as error:
    # What comes while mi.render itself works, drjit.custom() wraps
    if not isinstance(error.__cause__, KeyboardInterrupt):
        raise
    sys.exit(3)
"""


def interrupt(variant, name, spp, after):
    """Send SIGINT to a process that renders: seconds until its end, and if by KeyboardInterrupt."""
    process = start_python(INTERRUPTED, variant, name, spp, preexec_fn=heed_ctrl_c)
    try:
        while process.stdout.readline().strip() != "ready":
            assert process.poll() is None, process.stderr.read()
        time.sleep(after)
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode in (0, 3), errors
    return time.monotonic() - start, process.returncode == 3


@with_mitsubas
def test_ctrl_c_stops_a_scalar_render(scalar, name):
    """It ends soon, with the exception that Python programs expect, as with Mitsuba's own."""
    seconds, interrupted = interrupt(scalar, name, MINUTES, after=0.5)
    assert interrupted
    assert seconds < SOON


@pytest.mark.parametrize("name", ["direct", "manylights_direct"])
def test_ctrl_c_is_heeded_after_a_kernel(llvm, name):
    """A kernel that runs cannot be stopped, nor can Mitsuba's own: the exception comes after it."""
    spp = 2**19 if llvm.startswith("cuda") else 2**14  # so long that most of the time is in kernels
    _, interrupted = interrupt(llvm, name, spp, after=0.1)
    assert interrupted


@with_mitsubas
def test_cancel_stops_a_scalar_render(scalar, name):
    """From another thread; the next render is whole again."""
    scene, integrator = light_scenes.load("points"), mi.load_dict({"type": name})
    whole = image(scene, integrator)
    timer = threading.Timer(0.5, integrator.cancel)
    start = time.monotonic()
    timer.start()
    image(scene, integrator, spp=MINUTES)
    assert time.monotonic() - start < SOON
    assert np.array_equal(image(scene, integrator), whole)


@with_mitsubas
def test_timeout_stops_a_scalar_render(scalar, name):
    """It counts for each render, and one that is fast enough is not changed by it."""
    scene = light_scenes.load("points")
    integrator = mi.load_dict({"type": name, "timeout": 0.5})
    start = time.monotonic()
    image(scene, integrator, spp=MINUTES)
    assert time.monotonic() - start < SOON
    assert np.array_equal(
        image(scene, integrator, 1), image(scene, mi.load_dict({"type": name}), 1)
    )


@with_mitsubas
def test_timeout_does_not_cut_a_kernel(llvm, name):
    """JIT variants render the whole image, whatever the timeout, ours as Mitsuba's."""
    scene = light_scenes.load("points")
    hurried, patient = (mi.load_dict({"type": name, "timeout": t}) for t in (1e-6, -1.0))
    assert np.array_equal(image(scene, hurried), image(scene, patient))


# ----------------------------------------------------------------------------------------- memory

REPEATS, WARM_UP = 30, 5

WATCH_MEMORY = """
import ctypes, gc, json, sys
import drjit as dr
import mitsuba as mi
import numpy as np
import manylights
from tests import light_scenes

variant, action, name, lights = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])
repeats, warm_up = int(sys.argv[5]), int(sys.argv[6])
mi.set_variant(variant)
vertices = np.resize(light_scenes.triangles(500), (lights, 3, 3)).astype(np.float32)
vertices *= np.random.default_rng(1).uniform(0.9, 1.1, (lights, 1, 1))


def load():
    lamps = light_scenes.make_mesh(vertices, light_scenes.rgb([2, 1.5, 1]))
    integrator = {"type": name}
    return mi.load_dict({**light_scenes.stage(), "lamps": lamps, "integrator": integrator})


def resident():
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/status") as status:
        (line,) = [line for line in status if line.startswith("VmRSS:")]
    return 1024 * int(line.split()[1])


scene = load()
shared = scene.integrator()
used = []
for index in range(repeats):
    if action == "rebuild":
        parameters = mi.traverse(scene)
        parameters["lamps.vertex_positions"] = np.ravel(vertices) + np.float32(0.01 * (index % 2))
        parameters.update()
    elif action != "render":
        del scene
        gc.collect()
        scene = load()
    integrator = shared if action == "load, one integrator" else scene.integrator()
    np.array(mi.render(scene, integrator=integrator, spp=1))
    if index in (warm_up - 1, repeats - 1):
        used.append(resident())
tree = mi.traverse(integrator)["bytes"]
print(json.dumps({"grown": used[-1] - used[0], "tree": tree}))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
@both_variants
@pytest.mark.parametrize("action", ["render", "rebuild", "load", "load, one integrator"])
@pytest.mark.parametrize(
    ("name", "lights"),
    [
        ("manylights_direct", 5_000),
        pytest.param("manylights_direct", 100_000, marks=pytest.mark.slow),
        pytest.param("manylights_volpath", 100_000, marks=pytest.mark.slow),
    ],
)
def test_memory_does_not_grow(variant, action, name, lights):
    """Thirty renders, rebuilds or scenes need no more than five.

    A tree that is not released each time would be kept 25 times. A fifth of that is allowed, 3 MB
    with 5,000 lights: the noise of allocators is below 1 MB. Needs a process of its own, since a
    leak may fill what others have released before.
    """
    result = run_python(WATCH_MEMORY, variant, action, name, lights, REPEATS, WARM_UP)
    assert result["grown"] < 0.2 * result["tree"] * (REPEATS - WARM_UP)


# ---------------------------------------------------------------------------------------- threads


def two_scenes(names):
    """Two scenes with enough pixels for both threads to be at work for a while."""
    film = {"width": 96, "height": 64}
    return [path_scenes.load(name, **film) for name in names]


@both_variants
@pytest.mark.parametrize("shared", [False, True], ids=["own integrators", "one integrator"])
@pytest.mark.parametrize(
    ("name", "scenes"),
    [
        ("direct", ("gallery", "mirrors")),
        ("manylights_direct", ("gallery", "mirrors")),
        ("manylights_volpath", ("fog", "smoke")),
    ],
)
def test_two_threads_render_two_scenes(variant, name, scenes, shared):
    """The same bits as one after the other, for Mitsuba's integrator, and so for ours."""
    scenes = two_scenes(scenes)
    one = mi.load_dict({"type": name})
    integrators = [one, one if shared else mi.load_dict({"type": name})]
    expected = [image(*pair) for pair in zip(scenes, integrators)]
    found = [[], []]

    def work(index):
        for _ in range(3):
            found[index].append(image(scenes[index], integrators[index]))

    workers = [threading.Thread(target=work, args=(index,)) for index in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for images, wanted in zip(found, expected):
        assert len(images) == 3
        assert all(np.array_equal(image, wanted) for image in images)


# --------------------------------------------------------------------------------------- variants

RENDERED = """
import json, sys
import manylights
from tests import test_robust

print(json.dumps(test_robust.rendered_in(sys.argv[1])))
"""


def rendered_in(variant):
    """Set the variant, load a scene and render it with both plugins; a list of all values."""
    mi.set_variant(variant)
    scene = mi.load_dict({**light_scenes.stage(), **light_scenes.points(), **light_scenes.spots()})
    images = [image(scene, mi.load_dict({"type": name})) for name in OURS]
    return np.ravel(images).tolist()


def compiled(variant):
    """Does the plugin have a variant that this machine can run?"""
    backend = {"llvm": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}.get(variant[:4])
    if variant not in mi.variants() or (backend is not None and not has_backend(backend)):
        return False
    mi.set_variant(variant)
    try:
        mi.load_dict({"type": "manylights_direct"})
    except RuntimeError as error:
        assert "was compiled for the variants" in str(error)
        return False
    return True


@pytest.mark.parametrize(
    "variants", [["scalar_rgb", "llvm_ad_rgb"], pytest.param(mi.variants(), marks=pytest.mark.slow)]
)
def test_variants_in_turn(scalar, variants):
    """Each gives what it gives alone in a process, again and again."""
    variants = [variant for variant in variants if compiled(variant)]
    if len(variants) < 2:
        pytest.skip("only one of these variants can be used here")
    alone = {variant: run_python(RENDERED, variant) for variant in variants}
    for variant in [*variants, *reversed(variants)]:
        assert rendered_in(variant) == alone[variant]


# ----------------------------------------------------------------------------------- large images


def block_means(picture, size=64):
    """Means of the channels in blocks of pixels."""
    height, width, channels = picture.shape
    blocks = picture.reshape(height // size, size, width // size, size, channels)
    return blocks.mean(axis=(1, 3), dtype=np.float64)


@pytest.mark.parametrize(
    "name", ["manylights_direct", pytest.param("manylights_volpath", marks=pytest.mark.slow)]
)
def test_more_than_16_million_samples_at_once(llvm, name):
    """Indices beyond 2^24, which floats do not have, give the means of smaller renders."""
    description = light_scenes.SCENES["points-2"]()
    description["sensor"]["film"] |= {"width": 512, "height": 512}
    scene = mi.load_dict(description)
    integrator = mi.load_dict({"type": name})
    large_spp, small_spp, count = 80, 4, 16
    assert large_spp * 512**2 > 2**24
    large = block_means(image(scene, integrator, large_spp, seed=100))
    small = np.array([block_means(image(scene, integrator, small_spp, s)) for s in range(count)])
    # Of the difference, with the variance of small renders
    error = small.std(axis=0, ddof=1) * np.sqrt(1 / count + small_spp / large_spp)
    limit = stats.t.isf(SIGNIFICANCE / 2 / large.size, count - 1)
    assert (np.abs(large - small.mean(axis=0)) <= limit * error + 1e-6).all()
    assert error.mean() < 0.01 * large.mean()


# -------------------------------------------------------------------------------------- all scenes

METHODS = ["resampled_tree", "talk", "adaptive_splitting", "tree", "exhaustive"]
SCENES = {
    "manylights_direct": light_scenes.SCENES,
    "manylights_volpath": {**light_scenes.SCENES, **path_scenes.SCENES},
}


@pytest.mark.usefixtures("own_threads")
@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral"], indirect=True)
@pytest.mark.parametrize("name", OURS)
def test_all_scenes_with_all_methods_are_finite(variant, name):
    """One sample of each pixel: for `make test-sanitized`, where means would take too long."""
    if not compiled(variant):
        pytest.skip(f"the plugin was compiled without {variant}")
    integrators = [mi.load_dict({"type": name, "method": method}) for method in METHODS]
    for key, make in SCENES[name].items():
        scene = mi.load_dict(make())
        for method, integrator in zip(METHODS, integrators):
            assert np.isfinite(image(scene, integrator, spp=1)).all(), (key, method)


@pytest.mark.parametrize("plugin_name", OURS)
def test_kernels_do_not_grow_with_the_lights(llvm, plugin_name):
    """As many kernels, of as many operations, for 100 times as many triangles."""
    assert kernel_sizes(plugin_name, 200) == kernel_sizes(plugin_name, 20_000)


def kernel_sizes(plugin_name, lights):
    """Operations of each kernel of a render."""
    scene = mi.load_dict(scenes.city(lights, width=16, height=9))
    integrator = mi.load_dict({"type": plugin_name})
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        np.array(mi.render(scene, integrator=integrator, spp=1, seed=0))  # builds
        dr.kernel_history_clear()
        np.array(mi.render(scene, integrator=integrator, spp=1, seed=1))
        kernels = dr.kernel_history([dr.KernelType.JIT])
        # Those of different sizes are launched in the order of their sizes.
        return sorted(kernel["operation_count"] for kernel in kernels)

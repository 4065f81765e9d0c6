"""Visibility learnt while rendering: the same mean, less noise, and the same bits every time."""

import threading

import drjit as dr
import manylights
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests import light_scenes
from tests import statistics_tools as tools
from tests.path_references import quick_and_slow
from tests.references import assert_same_mean
from tests.statistics_tools import SIGNIFICANCE

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]
INTEGRATORS = {
    "direct": {"type": "manylights_direct"},
    "paths": {"type": "manylights_volpath", "max_depth": 3},
}
#: Enough pixels to learn: JIT variants do so where recording a second pass pays. In scalar ones
#: the size of blocks depends on the number of threads if there are few.
SIZES = {"scalar": (96, 64), "llvm": (144, 120), "cuda": (960, 640)}
SAMPLES = 8


def size():
    """Parameters of a film for the variant."""
    width, height = SIZES[mi.variant().split("_")[0]]
    return {"width": width, "height": height, "spp": 64}


def hidden_points(fog=False):
    """299 point lights behind a wall, 3 in front of it, in clear air or in fog."""
    scene = manylights.scenes.behind_wall(302, **size())
    if fog:
        medium = {"type": "homogeneous", "sigma_t": 0.05, "albedo": 0.8}
        scene["fog"] = {
            "type": "sphere",
            "radius": 40.0,
            "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": "air"},
        }
        scene = {"type": "scene", "air": medium, **scene}
        scene["sensor"]["medium"] = {"type": "ref", "id": "air"}
    return scene


def hidden_lamps():
    """Lamps with a surface behind a wall, and a few in front: BSDF samples hit some of them."""
    scene = manylights.scenes.behind_wall(1, **size())
    rng = np.random.default_rng(1)
    front = rng.uniform([-3.0, -2.0, 2.0], [2.0, 2.0, 3.0], (4, 3))
    back = rng.uniform([-4.0, 3.3, 1.0], [3.0, 4.5, 3.0], (76, 3))
    corners = np.concatenate([front, back])[:, None] + np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.7, 0.0], [0.7, 0.7, 0.0], [0.7, 0.0, 0.0]]
    )
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return {**scene, "lamps": light_scenes.make_mesh(triangles, light_scenes.rgb([2.0, 2.0, 2.0]))}


SCENES = {"points": hidden_points, "fog": lambda: hidden_points(fog=True), "lamps": hidden_lamps}


def integrator(kind="direct", **parameters):
    """An integrator that learns, unless it is told otherwise."""
    props = {**INTEGRATORS[kind], "learn_visibility": True, **parameters}
    return mi.load_dict({name: value for name, value in props.items() if value is not None})


def render(scene, method, seed=0, spp=SAMPLES):
    """An image as an array."""
    return np.array(mi.render(scene, integrator=method, seed=seed, spp=spp))


def images(scene, method, seeds=range(16), spp=SAMPLES):
    """Images of several seeds."""
    return tools.render_seeds(scene, method, spp, seeds)


#: What an integrator is compared with: every light at each point, or many without learning.
REFERENCES = {
    "direct": {"method": "exhaustive", "learn_visibility": None},
    "paths": {"splitting_rate": 6, "learn_visibility": False},
}
#: With every light at each point a sample takes long, and fewer have the same noise.
REFERENCE_SAMPLES = {"direct": 4, "paths": 8}
#: A bias of 2 % would be found. Images of scalar variants are smaller, there are twice as many.
SEEDS = {"direct": 4, "paths": 6}
CASES = [f"{name}-{kind}" for name in SCENES for kind in INTEGRATORS]
CASES.remove("fog-direct")  # it knows no media


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("case", quick_and_slow(CASES, ["points-direct", "lamps-paths"]))
def test_unbiased(variant, case):
    """Learning, what was learnt before, and all lights at each point have the same mean."""
    name, kind = case.split("-")
    scene = mi.load_dict(SCENES[name]())
    reference = integrator(kind, **REFERENCES[kind])
    count = SEEDS[kind] * (2 if variant.startswith("scalar") else 1)
    seeds, others = range(count), range(100, 100 + count)
    expected = images(scene, reference, others, REFERENCE_SAMPLES[kind])
    learnt = images(scene, integrator(kind), seeds)
    assert_same_mean(learnt, expected, label=f"{case}, learning")
    kept = integrator(kind, learn_visibility="keep")
    render(scene, kept, seed=99)
    assert_same_mean(images(scene, kept, seeds), expected, label=f"{case}, kept")


def test_bias_is_noticed(llvm):
    """A bias of 2 % in the light that arrives fails the comparison above."""
    scene = mi.load_dict(hidden_points())
    learnt = images(scene, integrator(), range(SEEDS["direct"]))
    plain = images(scene, integrator(learn_visibility=False), range(100, 100 + SEEDS["direct"]))
    assert_same_mean(learnt, plain)
    with pytest.raises(AssertionError, match="significance"):
        assert_same_mean(1.02 * learnt, plain)


#: Seeds for variances of pixels: thousands of them are compared, all with the same sign.
FEW = 5


def variances(values):
    """Variance of each pixel over the seeds, relative to the image's mean."""
    return values.var(axis=0, ddof=1).mean(axis=-1) / values.mean() ** 2


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("kind", INTEGRATORS)
def test_less_noise_where_lights_are_hidden(variant, kind):
    """Pixels have less variance with learning; without hidden lights they have not."""
    scene = mi.load_dict(hidden_points())
    learnt = variances(images(scene, integrator(kind), range(FEW)))
    seeds, others = range(100, 100 + FEW), range(200, 200 + FEW)
    plain = variances(images(scene, integrator(kind, learn_visibility=False), seeds))
    test = stats.wilcoxon(learnt.ravel(), plain.ravel(), alternative="less")
    assert test.pvalue < SIGNIFICANCE
    other = variances(images(scene, integrator(kind, learn_visibility=False), others))
    same = stats.wilcoxon(other.ravel(), plain.ravel(), alternative="less")
    assert same.pvalue > SIGNIFICANCE


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("kind", INTEGRATORS)
def test_same_seed_same_bits(variant, kind, thread_count):
    """For any number of threads, any integrator object, and after other renderings."""
    scene = mi.load_dict(hidden_points())
    method = integrator(kind)
    thread_count(1)
    expected = render(scene, method)
    thread_count(3)
    assert np.array_equal(expected, render(scene, method))
    thread_count(2)
    assert not np.array_equal(expected, render(scene, method, seed=1))
    assert np.array_equal(expected, render(scene, integrator(kind)))


SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")


@pytest.mark.parametrize(
    ("kind", "sampler", "learns"),
    [
        *[("direct", sampler, True) for sampler in (*SAMPLERS, "manylights_sobol")],
        *[("paths", "multijitter", True), ("direct", "multijitter", False)],
    ],
)
def test_all_seeds_take_the_same_kernels(llvm, kind, sampler, learns):
    """The seed says which pixels train, and which points of lamps in sight are sampled: as a
    number, and not as a part of the kernels."""
    scene = hidden_points()
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": 4}
    for i in range(4):
        scene[f"small_{i}"] = {
            **{"type": "sphere", "center": [i - 2.0, 1.0, 2.5], "radius": 0.01},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1e3}},
        }
    scene, method = mi.load_dict(scene), integrator(kind, learn_visibility=learns)

    def kernels(seed):
        dr.kernel_history_clear()
        render(scene, method, seed, spp=9 if sampler == "orthogonal" else 4)
        return {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        kernels(0)  # what is made of the scene once has kernels, too
        assert kernels(1) == kernels(2)


def test_overlapping_renderings(scalar):
    """Two threads get the images that they get one after the other."""
    scenes = [mi.load_dict(hidden_points()) for _ in range(2)]
    method = integrator()
    expected = [render(scene, method, seed=3) for scene in scenes]
    found = [None, None]

    def run(index):
        found[index] = render(scenes[index], method, seed=3)

    threads = [threading.Thread(target=run, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_what_is_kept_is_used(variant):
    """A later image has less noise than the first, and depends on what was learnt."""
    scene = mi.load_dict(hidden_points())
    first, second = [], []
    for seed in range(12):
        kept = integrator(learn_visibility="keep")
        first.append(render(scene, kept, seed, spp=4))
        second.append(render(scene, kept, seed + 100, spp=4))
    first, second = variances(np.stack(first)), variances(np.stack(second))
    test = stats.wilcoxon(second.ravel(), first.ravel(), alternative="less")
    assert test.pvalue < SIGNIFICANCE


def floor_under_slats():
    """A floor seen from above, under wide slats with lights above them, 8 m wide."""
    rng = np.random.default_rng(1)
    transform = mi.ScalarTransform4f
    places = rng.uniform([-4.0, -4.0, 1.2], [4.0, 4.0, 1.8], (1000, 3))
    values = 10.0 ** rng.uniform(-1.0, 1.0, 1000)
    scene = manylights.scenes.cut_boundary(1, width=512, height=64, spp=16)
    for index, (place, value) in enumerate(zip(places, values)):
        intensity = {"type": "rgb", "value": float(value)}
        scene[f"light_{index}"] = {"type": "point", "position": list(place), "intensity": intensity}
    for index in range(11):
        wide = transform().translate([0.97 * index - 4.72, 0.0, 0.9]).scale([0.32, 10.0, 1.0])
        scene[f"slat_{index}"] = {"type": "rectangle", "to_world": wide}
    above = transform().look_at([0.0, 0.0, 0.4], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    scene["sensor"]["to_world"] = above.scale([4.0, 4.0, 1.0])
    return scene


def steps(noise, shift):
    """Steps of the logarithm of the noise where columns cross borders of cells, plus `shift` cells.

    Takes rows in groups of eight. Cells have a side of .3 times the distance from the camera,
    rounded to a power of two (`visibility.h`).
    """
    noise = np.log(noise.reshape(8, 8, -1).mean(axis=1))
    width = noise.shape[1]
    columns = np.arange(4, width - 4)
    x = 8.0 * columns / width - 4.0
    border = (x / cell_sides(x) - shift) % 1.0 == 0.0
    return np.concatenate(
        [
            noise[:, i : i + 2].mean(axis=1) - noise[:, i - 2 : i].mean(axis=1)
            for i in columns[border]
        ]
    )


def cell_sides(x):
    """Side of the cells below `floor_under_slats`'s camera, which is .4 m above x = 0."""
    return 2.0 ** np.floor(np.log2(0.3 * np.hypot(0.4, x)))


def border_pvalue(noise):
    """Are the steps at borders of cells larger than in their middle?"""
    at, between = np.abs(steps(noise, 0.0)), np.abs(steps(noise, 0.5))
    return stats.mannwhitneyu(at, between, alternative="greater").pvalue


def test_no_borders_of_cells_in_the_noise(llvm):
    """Nothing changes there at once; 15 % more noise in every other cell would be found."""
    scene = mi.load_dict(floor_under_slats())
    noise = images(scene, integrator(), spp=4)[..., 1].var(axis=0, ddof=1)
    assert border_pvalue(noise) > SIGNIFICANCE
    x = 8.0 * (np.arange(noise.shape[1]) + 0.5) / noise.shape[1] - 4.0
    odd = np.floor(x / cell_sides(x)) % 2.0
    assert border_pvalue(noise * (1.0 + 0.15 * odd) ** 2) < SIGNIFICANCE


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize(
    "parameters",  # candidates are all traced, resampled, or chosen from
    [{}, {"splitting_rate": 4}, {"shadow_rays": 4}],
    ids=["traced", "resampled", "chosen"],
)
def test_what_is_expected(variant, parameters):
    """What should arrive by what was learnt looks like what arrives, and unlike all the light."""
    scene = mi.load_dict(hidden_points())

    def channels(learn):
        method = integrator(learn_visibility=learn, counts=True, **parameters)
        render(scene, method)
        image = render(scene, method, seed=1, spp=16)
        tiles = tools.tile_means(image[np.newaxis], 8)
        return tiles[..., :3].mean(axis=-1).ravel(), tiles[..., 5].ravel()

    arrived, expected = channels("keep")
    _, unshadowed = channels(False)
    near = np.abs(expected - arrived).sum()
    assert near < 0.5 * np.abs(unshadowed - arrived).sum()
    assert np.corrcoef(expected, arrived)[0, 1] > np.corrcoef(unshadowed, arrived)[0, 1]


CHANGES = {
    "a wall": ("wall.vertex_positions", lambda x: x + 0.25, True),
    "a light": ("light_0.position", lambda x: x + 0.25, True),
    "an intensity": ("light_0.intensity.value", lambda x: x * 1.5, False),
}


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("change", CHANGES)
def test_what_is_kept_is_dropped_when_something_moves(variant, change):
    """Then the next image is that of an integrator that has learnt nothing."""
    key, function, drops = CHANGES[change]
    scene = mi.load_dict(hidden_points())
    kept = integrator(learn_visibility="keep")
    render(scene, kept)
    params = mi.traverse(scene)
    params[key] = type(params[key])(function(params[key]))
    params.update()
    fresh = render(scene, integrator(learn_visibility="keep"), seed=5)
    assert np.array_equal(render(scene, kept, seed=5), fresh) == drops


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("spp", [1, 2, 7, 37])
def test_numbers_of_samples(variant, spp):
    """One sample, or a number that is hard to divide, is rendered as well, and teaches.

    In LLVM variants nothing is learnt from so few samples that recording a pass takes longer.
    """
    scene = mi.load_dict(hidden_points())
    image = render(scene, integrator(), spp=spp)
    assert np.isfinite(image).all()
    plain = render(scene, integrator(learn_visibility=False), spp=spp)
    too_few = variant.startswith("llvm") and image.shape[0] * image.shape[1] * spp < 2**16
    assert np.array_equal(image, plain) == too_few


@pytest.mark.parametrize("samples", [2**17, 2**18])
def test_many_materials_want_more_samples(llvm, samples):
    """Recording a pass takes the longer the more BSDFs there are: about 96 are three times 32."""
    description = hidden_points()
    for i in range(94):
        description[f"plate_{i}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([i, 0, -50]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": i / 100}},
        }
    scene = mi.load_dict(description)
    width, height = SIZES["llvm"]
    image, plain = (
        render(scene, integrator(learn_visibility=learn), spp=samples // (width * height))
        for learn in (True, False)
    )
    assert np.array_equal(image, plain) == (samples < 3 * 2**16)


def test_few_samples_teach(scalar):
    """Two samples of each pixel have less noise with learning, and the same mean."""
    scene = mi.load_dict(hidden_points())

    def few(learn, seeds):
        method = integrator(learn_visibility=learn)
        return np.stack([render(scene, method, seed, spp=2) for seed in seeds])

    learnt, plain = few(True, range(12)), few(False, range(100, 112))
    tools.assert_same_mean(learnt, plain, bias=None)
    test = stats.wilcoxon(variances(learnt).ravel(), variances(plain).ravel(), alternative="less")
    assert test.pvalue < SIGNIFICANCE


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_few_lights_need_no_visibility(variant):
    """Where every light is looked at, there is one pass, and nothing is learnt."""
    scene = mi.load_dict(manylights.scenes.behind_wall(8, **size()))
    off = integrator(learn_visibility=False)
    assert np.array_equal(render(scene, integrator()), render(scene, off))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("count", [20, 40])
def test_small_tables_learn(variant, count):
    """Dr.Jit copies small arrays for each thread, and then allows only one kind of sum."""
    scene = mi.load_dict(manylights.scenes.behind_wall(count, **size()))
    learns = integrator(learn_visibility="keep")
    assert np.isfinite(render(scene, learns)).all()
    assert np.array(mi.traverse(learns)["visibility.counts"]).sum() > 0


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_other_integrators_read_only(variant):
    """`moment` asks for samples only: nothing is learnt, nothing changes."""
    scene = mi.load_dict(hidden_points())

    def within_moment(learn):
        nested = {"type": "manylights_direct", "learn_visibility": learn}
        return mi.load_dict({"type": "moment", "image": nested})

    assert np.array_equal(
        render(scene, within_moment(True), spp=8), render(scene, within_moment(False), spp=8)
    )


def test_gradients_are_those_without_learning(llvm):
    """Differentiation records one pass."""
    scene = mi.load_dict(hidden_points())
    gradients = []
    for learn in (False, True):
        params = mi.traverse(scene)
        key = next(name for name, _ in params if name.endswith("reflectance.value"))
        dr.enable_grad(params[key])
        image = mi.render(
            scene, params, integrator=integrator(learn_visibility=learn), spp=SAMPLES, seed_grad=3
        )
        dr.backward(dr.mean(image, axis=None))
        gradients.append(np.array(dr.grad(params[key])))
        dr.disable_grad(params[key])
    # Sums over samples are made in no fixed order
    np.testing.assert_allclose(*gradients, rtol=1e-5)
    assert gradients[0].any()


@pytest.mark.parametrize("kind", INTEGRATORS)
def test_bad_values_are_named(llvm, kind):
    """The message tells the parameter, its value and what is allowed."""
    with pytest.raises(RuntimeError, match=r'learn_visibility.*"always".*boolean or "keep"'):
        integrator(kind, learn_visibility="always")
    with pytest.raises(RuntimeError, match=r"learn_visibility.*resampled_tree"):
        integrator(kind, method="talk")


def test_described(llvm):
    """`to_string` tells the value."""
    assert "learn_visibility = keep" in str(integrator(learn_visibility="keep"))
    assert "learn_visibility = true" in str(mi.load_dict({"type": "manylights_direct"}))

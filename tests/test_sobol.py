"""The sampler `manylights_sobol`: its numbers, how they are asked for, and what renders show.

Numbers of pixels are independent of each other: statistical tests draw those of many pixels, and
take their thresholds from `SIGNIFICANCE`.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.conftest import require_variant
from tests.statistics_tools import SIGNIFICANCE, assert_same_mean, render_seeds, sidak, welch

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

#: Requests of `draw`: a number, two pairs, and a number again.
REQUESTS = "1221"


def make_sampler(samples, kind="manylights_sobol", **parameters):
    return mi.load_dict({"type": kind, "sample_count": samples, **parameters})


def answers(sampler, requests):
    """Return the numbers of all requests, shape (dimensions, lanes)."""
    rows = []
    for request in requests:
        value = sampler.next_1d() if request == "1" else sampler.next_2d()
        rows.append(np.array(value, dtype=float).reshape(int(request), -1))
    return np.concatenate(rows)


def draw(pixels, samples, requests=REQUESTS, seed=0, first=0, keys=None, base_seed=0):
    """Return numbers of a JIT variant, shape (dimensions, pixels, samples).

    `keys` are those of the pixels; without any the sampler makes them from `seed`.
    """
    sampler = make_sampler(samples, seed=base_seed)
    mi.traverse(sampler)["first_sample"] = mi.UInt32(first)
    sampler.set_samples_per_wavefront(samples)
    if keys is not None:
        seed = mi.UInt32(np.repeat(np.asarray(keys, dtype=np.uint32), samples))
    sampler.seed(seed, pixels * samples)
    return answers(sampler, requests).reshape(-1, pixels, samples)


def draw_scalar(keys, samples, requests=REQUESTS, first=0):
    """Return numbers of a scalar variant, shape (dimensions, pixels, samples)."""
    sampler = make_sampler(samples)
    mi.traverse(sampler)["first_sample"] = first
    result = []
    for key in keys:
        sampler.seed(int(key))
        for _ in range(samples):
            result.append(answers(sampler, requests)[:, 0])
            sampler.advance()
    return np.array(result).T.reshape(-1, len(keys), samples)


# -------------------------------------------------------------------------------- distributions


def uniformity(*numbers, bins=32):
    """Return the p-value of a chi-square test of points in the unit interval or square."""
    side = bins if len(numbers) == 1 else int(np.sqrt(bins * 2))
    points = np.stack([np.ravel(values) for values in numbers], axis=1)
    counts, _ = np.histogramdd(points, bins=side, range=[(0, 1)] * len(numbers))
    return stats.chisquare(counts.ravel()).pvalue


def p_values_of(numbers):
    """Return p-values of each dimension, of pairs, and of pixels that are neighbours.

    `numbers` has shape (dimensions, pixels, samples); the numbers of one sample are tested, since
    those of one pixel are not independent.
    """
    columns = [numbers[dimension, :, 3] for dimension in range(len(numbers))]
    yield from (uniformity(column) for column in columns)
    yield from (uniformity(a, b) for a, b in itertools.combinations(columns, 2))
    for row in numbers:
        yield uniformity(row[::2, 3], row[1::2, 3])


@pytest.mark.parametrize("with_keys", [True, False])
def test_numbers_of_pixels_are_uniform_and_independent(llvm, with_keys):
    pixels = 1 << 15
    keys = np.arange(pixels) if with_keys else None
    numbers = draw(pixels, 16, keys=keys)
    assert numbers.min() >= 0 and numbers.max() < 1
    found = list(p_values_of(numbers))
    assert min(found) > sidak(SIGNIFICANCE, len(found))


def test_a_biased_dimension_and_related_pixels_are_found(llvm):
    numbers = draw(1 << 15, 16)
    biased = np.array(numbers)
    biased[2] **= 1.1
    related = np.array(numbers)
    related[1, 1::2] = related[1, ::2]
    for wrong in (biased, related):
        found = list(p_values_of(wrong))
        assert min(found) < sidak(SIGNIFICANCE, len(found))


def test_seeds_differ(llvm):
    """Those of a rendering and those of the sampler."""
    pixels = 1 << 15
    first = draw(pixels, 1, "1")
    for other in (draw(pixels, 1, "1", seed=1), draw(pixels, 1, "1", base_seed=1)):
        assert uniformity(first, other) > sidak(SIGNIFICANCE, 2)


def test_jitter_within_strata_is_that_of_owen_scrambling(llvm):
    """N numbers, one in each of N intervals, and there uniform: their mean has 1 / (12 N^3)."""
    pixels, samples = 1 << 14, 16
    for row in draw(pixels, samples, "12"):
        means = row.mean(axis=1)
        ratio = means.var(ddof=1) * 12 * samples**3
        low, high = stats.chi2.ppf([SIGNIFICANCE / 6, 1 - SIGNIFICANCE / 6], pixels - 1)
        assert low < ratio * (pixels - 1) < high
        assert abs(means.mean() - 0.5) < 5 * means.std() / np.sqrt(pixels)


def test_requests_are_not_correlated(llvm):
    """Products of numbers of different requests, each a mean over the samples of a pixel."""
    pixels, samples = 1 << 14, 16
    numbers = draw(pixels, samples) - 0.5
    scores = []
    for a, b in itertools.combinations(range(len(numbers)), 2):
        products = (numbers[a] * numbers[b]).mean(axis=1)
        scores.append(products.mean() / (products.std() / np.sqrt(pixels)))
    assert np.abs(scores).max() < stats.norm.isf(sidak(SIGNIFICANCE, len(scores)) / 2)


# --------------------------------------------------------------------------------- nets, prefixes


def is_net(x, y):
    """Are there as many points as elementary intervals of each shape, and one in each?"""
    size = len(x)
    for columns in (1 << k for k in range(size.bit_length())):
        rows = size // columns
        cells = np.floor(x * columns) * rows + np.floor(y * rows)
        if len(np.unique(cells)) < size:
            return False
    return True


@pytest.mark.parametrize("size", [1, 2, 4, 8, 16, 64, 256])
def test_aligned_blocks_of_pairs_are_nets(llvm, size):
    first = 3 * size
    for x, y in zip(*draw(16, size, "2", first=first), strict=True):
        assert is_net(x, y)


def cells_of(numbers, shape):
    """Return how many points are in each of the boxes that the unit cube is cut into."""
    points = np.stack(numbers, axis=-1)
    counts, _ = np.histogramdd(points, bins=shape, range=[(0, 1)] * len(shape))
    return counts


@pytest.mark.parametrize("requests", ["1111", "22", "211"])
def test_four_numbers_are_a_net_in_base_four(llvm, requests):
    shapes = [
        shape for shape in itertools.product((1, 4, 16, 64), repeat=4) if np.prod(shape) == 64
    ]
    for sample in np.swapaxes(draw(8, 64, requests, first=64), 0, 1):
        assert all((cells_of(sample, shape) == 1).all() for shape in shapes)


def test_numbers_that_are_no_net_are_found():
    rng = np.random.default_rng(1)
    assert not is_net(*rng.random((2, 16)))
    grid = (np.arange(16) + 0.5) / 16
    assert not is_net(grid, grid)
    assert (cells_of([grid, grid], (16, 1)) == 1).all()
    assert not (cells_of([grid, grid], (4, 4)) == 1).all()


def star_discrepancy(x, y):
    """Return the square of the L2 star discrepancy of points in the square (Warnock 1972)."""
    points = np.stack([x, y], axis=-1)
    most = np.maximum(points[:, np.newaxis], points[np.newaxis])
    once = np.prod(1 - points**2, axis=-1) / 4
    return 1 / 9 - 2 * once.mean() + np.prod(1 - most, axis=-1).mean()


def discrepancies(numbers):
    return np.array([star_discrepancy(x, y) for x, y in zip(*numbers, strict=True)])


@pytest.mark.parametrize(
    ("samples", "share"), [(16, 1 / 3), (48, 1 / 5), (64, 1 / 8), (100, 1 / 8)]
)
def test_discrepancy_is_a_fraction_of_that_of_independent_points(llvm, samples, share):
    """N independent points have (1/4 - 1/9) / N; counts that are no power of two do well, too."""
    independent = (1 / 4 - 1 / 9) / samples
    found = discrepancies(draw(128, samples, "2"))
    assert stats.ttest_1samp(found, share * independent, alternative="less").pvalue < SIGNIFICANCE
    rng = np.random.default_rng(1)
    worse = discrepancies(rng.random((2, 128, samples)))
    assert stats.ttest_1samp(worse, share * independent, alternative="less").pvalue > 0.5


def test_samples_do_not_depend_on_their_number(llvm):
    whole = draw(5, 64)
    for count in (1, 7, 16, 33):
        assert np.array_equal(draw(5, count), whole[..., :count])


def test_samples_can_be_asked_for_in_any_order(llvm):
    whole = draw(3, 100)
    for first, count in ((37, 1), (64, 36), (13, 50)):
        part = draw(3, count, first=first)
        assert np.array_equal(part, whole[..., first : first + count])


def test_each_lane_may_have_its_own_first_sample(llvm):
    whole = draw(1, 8, keys=[5])[:, 0]
    sampler = make_sampler(8)
    mi.traverse(sampler)["first_sample"] = mi.UInt32([6, 1, 3])
    sampler.seed(mi.UInt32([5, 5, 5]), 3)
    assert np.array_equal(answers(sampler, REQUESTS), whole[:, [6, 1, 3]])


def test_advance_goes_to_the_next_wavefront(llvm):
    whole = draw(3, 12)
    sampler = make_sampler(12)
    sampler.set_samples_per_wavefront(4)
    sampler.seed(0, 12)
    for first in (0, 4, 8):
        part = answers(sampler, REQUESTS).reshape(-1, 3, 4)
        assert np.array_equal(part, whole[..., first : first + 4])
        sampler.advance()


def test_scalar_and_llvm_variants_have_the_same_numbers(llvm):
    keys = [0, 1, 2, 77777, 2**32 - 1]
    arrays = [draw(5, count, first=first, keys=keys) for first, count in ((0, 9), (1000, 3))]
    require_variant("scalar_rgb")
    assert np.array_equal(draw_scalar(keys, 9), arrays[0])
    assert np.array_equal(draw_scalar(keys, 3, first=1000), arrays[1])


def test_clones_go_on_and_forks_keep_the_first_sample(variant):
    sampler = make_sampler(5, seed=3)
    mi.traverse(sampler)["first_sample"] = mi.UInt32(11)
    lanes = 1 if variant.startswith("scalar") else 7
    sampler.seed(3, lanes)
    answers(sampler, "12")
    clone, fork = sampler.clone(), sampler.fork()
    expected = answers(sampler, REQUESTS)
    assert np.array_equal(answers(clone, REQUESTS), expected)
    fork.seed(3, lanes)
    answers(fork, "12")
    assert np.array_equal(answers(fork, REQUESTS), expected)
    assert fork.sample_count() == 5


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("sample_count", 0, "an integer from 1 to 4294967295"),
        ("sample_count", -3, "an integer from 1 to 4294967295"),
        ("sample_count", 2**33, "an integer from 1 to 4294967295"),
        ("seed", -1, "an integer from 0 to 4294967295"),
    ],
)
def test_values_out_of_range_are_named(variant, name, value, allowed):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "manylights_sobol", name: value})
    expected = f'manylights_sobol: the parameter "{name}" is {value}, but must be {allowed}.'
    assert expected in str(error.value)


def test_a_wrong_number_of_seeds_is_named(llvm):
    with pytest.raises(RuntimeError, match=r"there are 3 seeds, but must be 1 or as many as .* 8"):
        make_sampler(4).seed(mi.UInt32([1, 2, 3]), 8)


def test_any_number_of_samples_is_taken(variant):
    for count in (1, 7, 100, 1_000_003):
        assert make_sampler(count).sample_count() == count


# ----------------------------------------------------------------------------- within integrators


def small_room(fog=False):
    """Return a floor, a wall and a large lamp that sends light of smooth shadows."""
    up = mi.ScalarTransform4f().look_at(origin=[0, -4, 1.5], target=[0, 0, 0.7], up=[0, 0, 1])
    gray = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    lamp = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 180)
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": up,
            "fov": 40,
            "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "floor": {"type": "rectangle", "bsdf": gray},
        "ball": {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.6, "bsdf": gray},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area"}},
    }
    scene["sensor"]["film"] |= {"pixel_format": "luminance", "component_format": "float32"}
    if fog:
        size = mi.ScalarTransform4f().translate([0, 0, 1]).scale(0.99)
        medium = {"type": "homogeneous", "albedo": 0.7, "sigma_t": 0.3}
        scene["fog"] = {"type": "cube", "to_world": size, "bsdf": {"type": "null"}}
        scene["fog"]["interior"] = medium
    return scene


def with_sampler(scene, kind, samples=16):
    sampler = {"type": kind, "sample_count": samples}
    return mi.load_dict({**scene, "sensor": {**scene["sensor"], "sampler": sampler}})


INTEGRATORS = {
    "direct": ({"type": "direct"}, 0.4),
    "path": ({"type": "path", "max_depth": 4}, 0.4),
    "volpath": ({"type": "volpath", "max_depth": 4}, 0.9),
    "manylights_direct": ({"type": "manylights_direct"}, 0.4),
    "manylights_volpath": ({"type": "manylights_volpath", "max_depth": 4}, 0.9),
}
"""Integrators, and the share of the variance of independent samples that is allowed."""


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_images_are_right_and_have_less_noise(variant, name):
    integrator, share = INTEGRATORS[name]
    scene = small_room(fog="vol" in name)
    images = [
        render_seeds(with_sampler(scene, kind), mi.load_dict(integrator), 16, range(16))
        for kind in ("manylights_sobol", "independent")
    ]
    assert_same_mean(*images, bias=0.04, label=name)
    ours, independent = (image.var(axis=0, ddof=1).mean() for image in images)
    assert ours < share * independent


@pytest.mark.parametrize("variant", ["llvm_ad_rgb"], indirect=True)
def test_passes_of_an_integrator_share_one_sequence(variant):
    scene = with_sampler(small_room(), "manylights_sobol")
    passes = mi.load_dict({"type": "path", "max_depth": 3, "samples_per_pass": 4})
    whole = mi.load_dict({"type": "path", "max_depth": 3})
    images = [np.array(mi.render(scene, integrator=kind, spp=16)) for kind in (passes, whole)]
    np.testing.assert_allclose(*images, rtol=1e-5)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_bits_do_not_depend_on_threads(variant, thread_count):
    scene = with_sampler(small_room(), "manylights_sobol")
    images = []
    for threads in (1, 3):
        thread_count(threads)
        images.append(np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=8)))
    assert np.array_equal(*images)


def gradient_and_image(integrator, spp, seed):
    """The derivative by emission times emission, and the sum of the pixels."""
    scene = with_sampler(small_room(), "manylights_sobol")
    params = mi.traverse(scene)
    name = "lamp.emitter.radiance.value"
    dr.enable_grad(params[name])
    params.update()
    image = integrator.render(scene, seed=seed, spp=spp)
    ones = dr.full(mi.TensorXf, 1, image.shape)
    integrator.render_backward(scene, params, ones, seed=seed, spp=spp)
    derivative, value = (np.array(x, dtype=float) for x in (dr.grad(params[name]), params[name]))
    return np.sum(derivative * value), np.array(image).sum()


@pytest.mark.parametrize("integrator", ["path", "prb", "direct"])
def test_gradients_are_those_of_the_image(llvm, integrator):
    """Light is proportional to emission, and so is its derivative."""
    more = {} if integrator == "direct" else {"max_depth": 3}
    gradient, image = gradient_and_image(mi.load_dict({"type": integrator, **more}), 8, 1)
    assert gradient == pytest.approx(image, rel=1e-3)


def test_gradients_of_ours_are_those_of_the_image(llvm):
    """In the mean: images are rendered in passes, with other numbers than gradients."""
    integrator = mi.load_dict({"type": "manylights_direct"})
    pairs = np.array([gradient_and_image(integrator, 16, seed) for seed in range(12)])
    assert welch(*pairs.T).p > SIGNIFICANCE
    for factor in (1.02, 1 / 1.02):
        assert welch(factor * pairs[:, 0], pairs[:, 1]).p < SIGNIFICANCE


def test_it_can_be_frozen(llvm):
    scene = with_sampler(small_room(), "manylights_sobol")
    integrator = mi.load_dict({"type": "path", "max_depth": 3})

    def render(scene, seed):
        return mi.render(scene, integrator=integrator, spp=4, seed=seed)

    frozen = dr.freeze(render)
    for seed in (0, 1, 2):
        expected = np.array(render(scene, mi.UInt32(seed)))
        np.testing.assert_allclose(np.array(frozen(scene, mi.UInt32(seed))), expected, rtol=1e-5)


def test_an_integrator_may_be_nested(variant):
    scene = with_sampler(small_room(), "manylights_sobol")
    inner = {"type": "path", "max_depth": 3}
    nested = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": inner})
    image = np.array(mi.render(scene, integrator=nested, spp=4))
    alone = np.array(mi.render(scene, integrator=mi.load_dict(inner), spp=4))
    np.testing.assert_allclose(np.mean(image[..., 0]), np.mean(alone), rtol=0.2)

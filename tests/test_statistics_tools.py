"""The checkers keep their significance level and find a planted bias of 2 %."""

import functools

import numpy as np
import pytest
from scipy import stats

from tests import statistics_tools as tools

SHAPE = (16, 24, 3)
TRIALS = 400


def synthetic_images(seed, seeds=16, relative_error=0.08, shape=SHAPE):
    """Renderings of a known mean image with skewed (gamma distributed) pixel noise."""
    generator = np.random.default_rng(seed)
    rows = np.linspace(0.5, 2.0, shape[0])[:, np.newaxis, np.newaxis]
    mean = rows * np.ones(shape)
    concentration = 1 / relative_error**2
    return generator.gamma(concentration, mean / concentration, size=(seeds, *shape))


def rejections(significance, independent_pixels, **arguments):
    """Number of rejections among `TRIALS` comparisons of equal estimators."""
    count = 0
    for trial in range(TRIALS):
        a = synthetic_images(2 * trial, **arguments)
        b = synthetic_images(2 * trial + 1, **arguments)
        comparison = tools.compare_means(a, b, significance, independent_pixels=independent_pixels)
        count += not comparison.passes
    return count


@pytest.mark.parametrize(("seeds", "independent"), [(16, False), (8, True)])
@pytest.mark.parametrize("relative_error", [0.1, 2.0])
def test_comparison_keeps_its_level(relative_error, seeds, independent):
    """Equal means are rejected with the stated probability, also with very skewed pixels."""
    significance = 0.05
    count = rejections(significance, independent, relative_error=relative_error, seeds=seeds)
    low, high = tools.binomial_interval(count, TRIALS, 1e-4)
    assert low <= significance
    # The channels of the synthetic images are independent, so the level is met, not undercut.
    assert high >= significance


@pytest.mark.parametrize("independent", [False, True])
@pytest.mark.parametrize("seeds_b", [4, 8])
def test_comparison_keeps_its_level_with_unequal_sizes_and_variances(seeds_b, independent):
    """Welch's degrees of freedom hold when the reference has few, precise images."""
    significance = 0.05
    count = 0
    for trial in range(TRIALS):
        a = synthetic_images(2 * trial, relative_error=0.5)
        b = synthetic_images(2 * trial + 1, seeds=seeds_b, relative_error=0.1)
        comparison = tools.compare_means(a, b, significance, independent_pixels=independent)
        count += not comparison.passes
    assert tools.binomial_interval(count, TRIALS, 1e-4)[0] <= significance


def test_comparison_finds_planted_bias_of_the_image():
    """A uniform bias of 2 % is found wherever the power is claimed to suffice."""
    for trial in range(20):
        a, b = synthetic_images(2 * trial), synthetic_images(2 * trial + 1)
        assert tools.assert_same_mean(a, b).detectable_bias() <= 0.02
        assert not tools.compare_means(1.02 * a, b).passes
        assert not tools.compare_means(a / 1.02, b).passes


@pytest.mark.parametrize("independent", [False, True])
def test_comparison_finds_planted_bias_of_one_tile(independent):
    """An error in a single tile is found although it leaves the image mean unchanged."""
    a, b = (synthetic_images(seed, relative_error=0.03) for seed in (0, 1))
    a[:, :8, :8] *= 1.02
    a[:, 8:, 8:16] *= image_share(b)
    comparison = tools.compare_means(a, b, independent_pixels=independent)
    assert not comparison.passes
    assert (comparison.image.p >= comparison.image_threshold).all()
    assert "worst tile (row 0, column 0" in comparison.message()


def image_share(images):
    """Factor for the tile (1, 1) that compensates 2 % more in the tile (0, 0)."""
    tiles = tools.tile_means(images, 8).mean(axis=(0, 3))
    return 1 - 0.02 * tiles[0, 0] / tiles[1, 1]


@pytest.mark.parametrize("independent", [False, True])
def test_power_is_met(independent):
    """A bias of the size `detectable_bias(power)` is found in that share of the trials."""
    # Tiles cannot help here: one tile, the same as the image.
    compared = functools.partial(
        tools.compare_means, significance=1e-3, tile=24, independent_pixels=independent
    )
    found = 0
    for trial in range(TRIALS):
        a, b = synthetic_images(2 * trial), synthetic_images(2 * trial + 1)
        bias = compared(a, b).detectable_bias(power=0.5)
        found += not compared((1 + bias) * a[..., :1], b[..., :1]).passes
    assert tools.binomial_interval(found, TRIALS, 1e-4)[1] >= 0.5


def test_noisy_comparison_is_refused():
    """Two equal estimators that are too noisy to show 2 % do not pass silently."""
    a, b = (synthetic_images(seed, seeds=4, relative_error=2.0) for seed in (0, 1))
    assert tools.compare_means(a, b).passes
    with pytest.raises(AssertionError, match="too noisy"):
        tools.assert_same_mean(a, b)
    tools.assert_same_mean(a, b, bias=None)


def test_exact_reference_of_one_image():
    """A single reference image counts as exact."""
    a = synthetic_images(0)
    exact = synthetic_images(1, seeds=2000, relative_error=0.1).mean(axis=0, keepdims=True)
    mean = np.linspace(0.5, 2.0, SHAPE[0])[:, np.newaxis, np.newaxis] * np.ones(SHAPE)
    assert np.allclose(exact, mean, rtol=0.02)
    tools.assert_same_mean(a, mean[np.newaxis])
    assert not tools.compare_means(a, 1.02 * mean[np.newaxis]).passes


def test_images_without_variance():
    """Rounding differences of constant images pass, a difference of 0.1 % does not."""
    a = np.ones((4, *SHAPE))
    assert tools.compare_means(a, a * (1 + 1e-6)).passes
    assert not tools.compare_means(a, a * 1.001).passes
    assert tools.compare_means(0 * a, 0 * a).passes
    assert not tools.compare_means(0 * a, a).passes


@pytest.mark.parametrize("light, passes", [(1e-10, True), (1e-7, False)])
def test_light_that_only_one_estimator_finds(light, passes):
    """A billionth of the image mean is black, a little more in one tile is found."""
    a, b = synthetic_images(2), synthetic_images(3)
    a[:, :8, :8] = 0.0
    b[:, :8, :8] = light
    assert tools.compare_means(a, b).passes is passes


def test_values_that_are_not_finite_are_refused():
    """One bad pixel in one rendering is reported."""
    a, b = synthetic_images(0), synthetic_images(1)
    a[3, 2, 1, 0] = np.nan
    with pytest.raises(AssertionError, match="not finite"):
        tools.assert_same_mean(a, b)


def test_tile_means_cover_uneven_borders():
    """Tiles at the border are smaller; their means are those of their own pixels."""
    images = np.random.default_rng(0).random((2, 10, 13, 3))
    tiles = tools.tile_means(images, 8)
    assert tiles.shape == (2, 2, 2, 3)
    assert np.allclose(tiles[:, 1, 1], images[:, 8:, 8:].mean(axis=(1, 2)))
    assert np.allclose(tiles[:, 0, 1], images[:, :8, 8:].mean(axis=(1, 2)))


@pytest.mark.parametrize(("independent", "room"), [(False, 4), (True, 1.2)])
def test_sample_size_from_pilot(independent, room):
    """The planned sample size reaches the precision; a noisier estimator gets more.

    Where pixels are independent it is known from the same pilot to a few percent.
    """
    seeds, error = 16, 1e-3
    plan = functools.partial(tools.samples_for_precision, independent_pixels=independent)
    pilot = synthetic_images(0, relative_error=1.0)
    spp = plan(pilot, 4, seeds, error)
    pixels = SHAPE[0] * SHAPE[1]
    spread = np.linspace(0.5, 2.0, SHAPE[0])
    exact = 4 * np.mean(spread**2) / np.mean(spread) ** 2 / (pixels * seeds * error**2)
    assert exact <= spp <= room * exact
    noisier = synthetic_images(0, relative_error=3.0)
    assert plan(noisier, 4, seeds, error) > spp


def test_pixels_tell_the_variance_of_means():
    """It is that of the means of many images, of each tile and of the whole image."""
    images = synthetic_images(0, seeds=2000, relative_error=0.5)
    variances = tools.pixel_variances(images[:200])
    for tile in (8, 24):
        means, variance, dof = tools.moments(images[:200], tile, variances)
        of_many = tools.tile_means(images, tile)
        assert np.allclose(means, tools.tile_means(images[:200], tile).mean(axis=0))
        assert np.allclose(variance, of_many.var(axis=0, ddof=1) / 200, rtol=0.2)
        assert (dof > 199 * 0.5 * min(tile, 16) * min(tile, 24)).all()


def test_few_pixels_tell_less_of_the_variance():
    """Where one of many pixels has all the noise, its renderings are what counts."""
    images = np.ones((8, 6, 4, 1))
    images[:, 2, 1] = np.random.default_rng(0).normal(1, 0.5, (8, 1))
    variance, dof = tools.variance_of_image_mean(images)
    assert np.allclose(variance, images[:, 2, 1].var(ddof=1) / 24**2) and np.allclose(dof, 7)
    even = np.random.default_rng(0).normal(1, 0.5, (8, 6, 4, 1))
    assert tools.variance_of_image_mean(even)[1] > 7 * 12


def probabilities_with_tail(cells=40):
    """Probabilities over several orders of magnitude, some of them too small to test alone."""
    weights = 0.7 ** np.arange(cells)
    return weights / weights.sum()


def test_chi_square_keeps_its_level():
    """Pooled cells follow the chi-square distribution: p is below 5 % in 5 % of the trials."""
    generator = np.random.default_rng(0)
    probabilities = probabilities_with_tail()
    counts = generator.multinomial(2000, probabilities, size=TRIALS)
    rejected = sum(tools.chi_square(row, probabilities).p < 0.05 for row in counts)
    low, high = tools.binomial_interval(rejected, TRIALS, 1e-4)
    assert low <= 0.05 <= high


def test_chi_square_finds_planted_bias():
    """2 % more of every second cell is found once the counts suffice."""
    generator = np.random.default_rng(1)
    cells = 16
    probabilities = np.full(cells, 1 / cells)
    planted = probabilities * np.where(np.arange(cells) % 2, 1.02, 0.98)
    # Noncentrality trials * 0.02^2 puts the statistic far above the critical value.
    critical = stats.chi2.isf(tools.SIGNIFICANCE, cells - 1)
    trials = int(4 * critical / 0.02**2)
    assert stats.ncx2.sf(critical, cells - 1, trials * 0.02**2) > tools.POWER
    tools.assert_frequencies(generator.multinomial(trials, probabilities), probabilities)
    with pytest.raises(AssertionError, match="chi-square"):
        tools.assert_frequencies(generator.multinomial(trials, planted), probabilities)


def test_chi_square_pools_small_cells():
    """No cell expects fewer than five, no count is lost, an impossible event gives p = 0."""
    probabilities = probabilities_with_tail()
    observed = np.random.default_rng(2).multinomial(1000, probabilities)
    pooled, expected = tools.pool_small_cells(observed, 1000 * probabilities)
    assert (expected >= 5).all()
    assert pooled.sum() == 1000
    assert expected.sum() == pytest.approx(1000)
    assert tools.chi_square([5, 5, 1], [0.5, 0.5, 0.0]).p == 0
    assert tools.chi_square([5, 6, 0], [0.5, 0.5, 0.0]).p > 0.5
    with pytest.raises(ValueError, match="sum to"):
        tools.chi_square([5, 5], [0.5, 0.6])


def test_binomial_interval_covers():
    """The interval misses the true probability no more often than stated, and is not trivial."""
    generator = np.random.default_rng(3)
    for probability in (0.002, 0.3, 0.999):
        successes = generator.binomial(1000, probability, size=TRIALS)
        low, high = tools.binomial_interval(successes, 1000, 0.05)
        missed = int(((probability < low) | (probability > high)).sum())
        assert tools.binomial_interval(missed, TRIALS, 1e-4)[0] <= 0.05
        assert (high - low < 0.1).all()
    assert tools.binomial_interval(0, 10, 0.05)[0] == 0
    assert tools.binomial_interval(10, 10, 0.05)[1] == 1


def test_binomial_check_finds_planted_bias():
    """A probability that is off by 2 % is found with enough trials."""
    trials, probability = 400_000, 0.4
    error = np.sqrt(probability * (1 - probability) / trials)
    needed = stats.norm.isf(tools.SIGNIFICANCE / 4) + stats.norm.ppf(tools.POWER)
    assert 0.02 * probability > needed * error
    generator = np.random.default_rng(4)
    good = generator.binomial(trials, probability, size=2)
    tools.assert_binomial(good, trials, probability)
    bad = generator.binomial(trials, [probability, 1.02 * probability])
    with pytest.raises(AssertionError, match="1 of 2 frequencies differ"):
        tools.assert_binomial(bad, trials, probability)

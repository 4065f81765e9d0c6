"""Statistical comparison of renderings, with thresholds that follow from a significance level.

The unit of observation is one whole rendering: `render_seeds` returns one image per seed, and
seeds are independent, so the mean of any set of pixels over one image is one number per seed.
Those numbers are compared with Welch's t test, which needs no equal variances. The image mean is
the sensitive test (it sees a uniform bias of a fraction of a percent), the tile means find an
error that is confined to a part of the image.

Half of the significance goes to the image mean and half to the tiles; within each half, Sidak's
correction covers the channels and tiles. `significance` is therefore the probability that one
comparison of two unbiased estimators fails.

Where no sample counts in two pixels, these are independent, too: the variance of the mean of a set
of pixels is then known from the variances of each, with many more degrees of freedom.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights.threads import thread_count
from scipy import stats

PROCESSES = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
THREADS = max(1, dr.thread_count() // PROCESSES) if PROCESSES > 1 else None
"""A process's share of the cores, `None` if it is alone. Renders of means take it, unless a test
chooses a number (the fixture `thread_count`): processes that share cores wait for each other."""

SIGNIFICANCE = 1e-5
"""Default probability of a false alarm of one comparison; a whole run has a few hundred."""

BIAS = 0.02
"""Relative bias of the image mean that a comparison has to detect."""

POWER = 0.99
"""Probability with which it has to detect that bias."""

ROUNDING = 2e-5
"""Relative difference that single precision sums of thousands of samples may show.

It enters as a standard error, so that pixels without any variance (a background, a light seen
directly) do not fail for the last digits.
"""

BLACK = 1e-9
"""Tile mean, relative to the image mean, that counts as an error, too.

What is darker is the tail of some lobe, of which a reference may find nothing with all its seeds.
"""


def render_seeds(scene, integrator=None, spp=16, seeds=range(16), sensor=0):
    """Render `scene` once per seed; returns an array of shape (seeds, height, width, channels)."""
    images = []
    with thread_count(THREADS):
        for seed in seeds:
            image = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=int(seed))
            images.append(np.array(image, dtype=np.float64))
    images = np.stack(images)
    return images if images.ndim == 4 else images[..., np.newaxis]


def tile_sums(images, tile):
    """Sums over square tiles of `tile` pixels (smaller at the right and lower border)."""
    rows = np.arange(0, images.shape[1], tile)
    columns = np.arange(0, images.shape[2], tile)
    return np.add.reduceat(np.add.reduceat(images, rows, axis=1), columns, axis=2)


def tile_means(images, tile):
    """Means over them."""
    return tile_sums(images, tile) / tile_sums(np.ones((1, *images.shape[1:3], 1)), tile)


def image_means(images):
    """Mean over the pixels: an array of shape (seeds, channels)."""
    return images.mean(axis=(1, 2))


@dataclass(frozen=True)
class WelchTest:
    """Result of elementwise Welch tests of the means of two samples."""

    mean_a: np.ndarray
    mean_b: np.ndarray
    error: np.ndarray
    """Standard error of the difference, with the allowance for rounding."""
    dof: np.ndarray
    """Degrees of freedom (Welch and Satterthwaite)."""

    @property
    def t(self):
        """Difference of the means in standard errors."""
        return (self.mean_a - self.mean_b) / np.maximum(self.error, np.finfo(float).tiny)

    @property
    def p(self):
        """Two-sided p-values."""
        return 2 * stats.t.sf(np.abs(self.t), self.dof)


def variance_of_mean(samples):
    """Variance of the mean over axis 0 and its degrees of freedom; 0 for a single exact value."""
    count = len(samples)
    if count == 1:
        return np.zeros(samples.shape[1:]), 1
    return samples.var(axis=0, ddof=1) / count, count - 1


def pixel_variances(images):
    """Variance of each pixel, an array without seeds."""
    return images.var(axis=0, ddof=1)


def moments(images, tile, variances=None):
    """Means over all images and one tile each, their variances, and the degrees of freedom.

    `variances` are those of pixels that are independent; without them tiles are compared.
    """
    means = tile_means(images, tile)
    if len(images) == 1 or variances is None:
        return means.mean(axis=0), *variance_of_mean(means)
    variance, dof = variance_of_tile_mean(variances, tile)
    return means.mean(axis=0), variance / len(images), dof * (len(images) - 1)


def variance_of_tile_mean(variances, tile):
    """Variance of each tile's mean from those of its independent pixels, and a number of pixels.

    Satterthwaite's: few where few pixels have nearly all of the variance.
    """
    variances = variances[np.newaxis]
    size = tile_sums(np.ones_like(variances), tile)[0]
    sums, squares = tile_sums(variances, tile)[0], tile_sums(variances**2, tile)[0]
    return sums / size**2, np.divide(sums**2, squares, out=np.ones_like(sums), where=squares > 0)


def welch(a, b, rounding=ROUNDING, black=0.0):
    """Welch tests of the means over axis 0. A sample of length one counts as an exact value."""
    variance_a, dof_a = variance_of_mean(a)
    variance_b, dof_b = variance_of_mean(b)
    return welch_from_moments(
        a.mean(axis=0), variance_a, dof_a, b.mean(axis=0), variance_b, dof_b, rounding, black
    )


def welch_from_moments(
    mean_a, variance_a, dof_a, mean_b, variance_b, dof_b, rounding=ROUNDING, black=0.0
):
    """Welch tests from means, variances of these means, and their degrees of freedom.

    Errors beside those of the samples: `rounding`, relative to each mean, and `black`, absolute.
    """
    variance = variance_a + variance_b
    spread = variance_a**2 / dof_a + variance_b**2 / dof_b
    dof = np.divide(variance**2, spread, out=np.full_like(variance, 1e9), where=spread > 0)
    rounding = rounding * np.maximum(np.abs(mean_a), np.abs(mean_b))
    error = np.sqrt(variance + rounding**2 + black**2)
    return WelchTest(mean_a, mean_b, error, dof)


def sidak(significance, tests):
    """Significance of each of `tests` independent tests that share `significance`."""
    return -np.expm1(np.log1p(-significance) / tests)


CHANNEL = sidak(SIGNIFICANCE / 2, 3)
"""Threshold of the image mean of one of three channels."""


def visible_errors(dof, threshold=CHANNEL, power=POWER):
    """How many standard errors a difference has that is found with probability `power`."""
    return stats.t.isf(threshold / 2, dof) + stats.t.ppf(power, dof)


@dataclass(frozen=True)
class Comparison:
    """Welch tests of the image means and of the tile means of two sets of renderings."""

    image: WelchTest
    tiles: WelchTest
    significance: float

    @property
    def image_threshold(self):
        """Smallest acceptable p-value of an image mean."""
        return sidak(self.significance / 2, self.image.p.size)

    @property
    def tile_threshold(self):
        """Smallest acceptable p-value of a tile mean."""
        return sidak(self.significance / 2, self.tiles.p.size)

    @property
    def passes(self):
        """True if no difference is significant."""
        return bool(
            (self.image.p >= self.image_threshold).all()
            and (self.tiles.p >= self.tile_threshold).all()
        )

    def detectable_bias(self, power=POWER):
        """Relative bias of the image mean that this comparison finds with probability `power`.

        A bias of t_alpha + t_power standard errors exceeds the threshold t_alpha with that
        probability. The worst of the channels that are not black counts.
        """
        lit = self.image.mean_b != 0
        if not lit.any():
            return np.inf
        errors = visible_errors(self.image.dof, self.image_threshold, power) * self.image.error
        return float(np.max(errors[lit] / np.abs(self.image.mean_b[lit])))

    def message(self, label=""):
        """A report in words: the image means and the worst tile."""
        lines = [f"{label or 'comparison'}: significance {self.significance:g}"]
        ratio = self.image.mean_a / np.where(self.image.mean_b == 0, np.nan, self.image.mean_b)
        for channel in range(self.image.p.size):
            lines.append(
                f"  image mean, channel {channel}: {self.image.mean_a[channel]:.6g} against "
                f"{self.image.mean_b[channel]:.6g} (ratio {ratio[channel]:.5f}), "
                f"t = {self.image.t[channel]:.2f}, p = {self.image.p[channel]:.2e} "
                f"(at least {self.image_threshold:.2e})"
            )
        row, column, channel = np.unravel_index(np.argmin(self.tiles.p), self.tiles.p.shape)
        worst = (row, column, channel)
        lines.append(
            f"  worst tile (row {row}, column {column}, channel {channel}): "
            f"{self.tiles.mean_a[worst]:.6g} against {self.tiles.mean_b[worst]:.6g}, "
            f"t = {self.tiles.t[worst]:.2f}, p = {self.tiles.p[worst]:.2e} "
            f"(at least {self.tile_threshold:.2e})"
        )
        failing = int((self.tiles.p < self.tile_threshold).sum())
        lines.append(f"  {failing} of {self.tiles.p.size} tile means differ")
        lines.append(f"  a bias of {100 * self.detectable_bias():.2f} % would be found")
        return "\n".join(lines)


def compare_means(
    a, b, significance=SIGNIFICANCE, tile=8, rounding=ROUNDING, independent_pixels=False
):
    """Compare two sets of renderings of shape (seeds, height, width, channels).

    A set of one image counts as the exact expectation (a closed form). `independent_pixels` says
    that no sample counts in two pixels of an image, in neither set.
    """
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"images differ in shape: {a.shape[1:]} and {b.shape[1:]}")

    variances = [
        pixel_variances(images) if independent_pixels and len(images) > 1 else None
        for images in (a, b)
    ]

    def compared(tile, black=0.0):
        of_a, of_b = (moments(*parts) for parts in zip((a, b), (tile, tile), variances))
        return welch_from_moments(*of_a, *of_b, rounding, black)

    image = only_tile(compared(max(a.shape[1:3])))
    black = BLACK * np.abs(image.mean_b).max()
    return Comparison(image, compared(tile, black), significance)


def only_tile(test):
    """The test of a single tile, an array for each channel."""
    parts = (getattr(test, part.name) for part in fields(test))
    return WelchTest(*(np.broadcast_to(part, test.error.shape)[0, 0] for part in parts))


def assert_finite(images, label=""):
    """No pixel is infinite or not a number."""
    bad = ~np.isfinite(images)
    assert not bad.any(), f"{label}: {bad.sum()} values are not finite, first {np.argwhere(bad)[0]}"


def assert_same_mean(
    a,
    b,
    significance=SIGNIFICANCE,
    tile=8,
    bias=BIAS,
    power=POWER,
    power_channels=None,
    label="",
    independent_pixels=False,
):
    """Assert that two estimators have the same mean, and that a relative `bias` would show.

    The second assertion keeps the first one honest: a comparison that is too noisy to find the
    bias fails too. `power_channels` limits it to those channels (signed ones have no relative
    bias); `bias=None` leaves it out.
    """
    assert_finite(a, label)
    assert_finite(b, label)
    how = {"tile": tile, "independent_pixels": independent_pixels}
    comparison = compare_means(a, b, significance, **how)
    assert comparison.passes, comparison.message(label)
    if bias is not None:
        channels = slice(None) if power_channels is None else power_channels
        visible = compare_means(a[..., channels], b[..., channels], significance, **how)
        found = visible.detectable_bias(power)
        assert found <= bias, (
            f"{label}: too noisy, only a bias of {100 * found:.2f} % would be found with "
            f"probability {power}; use more samples\n" + comparison.message(label)
        )
    return comparison


def samples_for_precision(pilot, spp, seeds, error, largest=1 << 14, independent_pixels=False):
    """Samples per pixel that give the image mean a relative standard error of `error`.

    `pilot` are renderings with `spp` samples, not used for anything else: a sample size that
    depends on the compared data themselves would bias the test. `independent_pixels` says that no
    sample counts in two pixels: the variance is then known from fewer renderings.
    """
    average = np.abs(image_means(pilot).mean(axis=0))
    lit = average > 0
    if not lit.any():
        return spp
    observations = pilot if independent_pixels else image_means(pilot)[:, np.newaxis, np.newaxis]
    variance, dof = variance_of_image_mean(observations)
    variance = variance[lit]
    # The upper end of a one-sided 90 % interval of the variance: pilots are short.
    relative = variance * dof[lit] / stats.chi2.ppf(0.1, dof[lit]) / average[lit] ** 2
    needed = max(1.0, spp * np.max(relative) / (seeds * error**2))
    return int(min(largest, np.ceil(needed)))


def variance_of_image_mean(images):
    """Variance of the mean of one image of independent pixels, and its degrees of freedom."""
    variance, pixels = variance_of_tile_mean(pixel_variances(images), max(images.shape[1:3]))
    return variance[0, 0], pixels[0, 0] * (len(images) - 1)


@dataclass(frozen=True)
class ChiSquare:
    """Result of a chi-square test of goodness of fit."""

    statistic: float
    dof: int
    p: float
    cells: int
    """Number of cells after pooling."""


def pool_small_cells(observed, expected, smallest=5.0):
    """Merge the cells of smallest expectation until each one expects at least `smallest`."""
    order = np.argsort(expected, kind="stable")
    observed, expected = np.asarray(observed)[order], np.asarray(expected)[order]
    pooled_observed, pooled_expected = [], []
    count = mass = 0.0
    for cell_count, cell_mass in zip(observed, expected):
        count, mass = count + cell_count, mass + cell_mass
        if mass >= smallest:
            pooled_observed.append(count)
            pooled_expected.append(mass)
            count = mass = 0.0
    if (count or mass) and pooled_observed:
        pooled_observed[-1] += count
        pooled_expected[-1] += mass
    elif count or mass:
        pooled_observed, pooled_expected = [count], [mass]
    return np.array(pooled_observed), np.array(pooled_expected)


def chi_square(observed, probabilities, smallest=5.0):
    """Test counts against probabilities that sum to one, with pooling of small cells.

    A count in a cell of probability zero gives p = 0.
    """
    observed = np.asarray(observed, dtype=float).ravel()
    probabilities = np.asarray(probabilities, dtype=float).ravel()
    if abs(probabilities.sum() - 1) > 1e-4:
        raise ValueError(f"the probabilities sum to {probabilities.sum()}, not to 1")
    if observed[probabilities <= 0].any():
        return ChiSquare(np.inf, 0, 0.0, 0)
    possible = probabilities > 0
    observed, probabilities = observed[possible], probabilities[possible]
    expected = probabilities / probabilities.sum() * observed.sum()
    observed, expected = pool_small_cells(observed, expected, smallest)
    if len(observed) < 2:
        return ChiSquare(0.0, 0, 1.0, len(observed))
    result = stats.chisquare(observed, expected, sum_check=False)
    return ChiSquare(
        float(result.statistic), len(observed) - 1, float(result.pvalue), len(observed)
    )


def assert_frequencies(observed, probabilities, significance=SIGNIFICANCE, label=""):
    """Assert that counts follow the probabilities."""
    result = chi_square(observed, probabilities)
    assert result.p >= significance, (
        f"{label}: chi-square {result.statistic:.1f} with {result.dof} degrees of freedom, "
        f"p = {result.p:.2e} < {significance:g}"
    )
    return result


def binomial_interval(successes, trials, significance=SIGNIFICANCE):
    """Clopper and Pearson's interval of the success probability (elementwise)."""
    successes = np.asarray(successes, dtype=float)
    failures = trials - successes
    low = stats.beta.ppf(significance / 2, successes, failures + 1)
    high = stats.beta.isf(significance / 2, successes + 1, failures)
    low = np.where(successes == 0, 0.0, low)
    return low, np.where(failures == 0, 1.0, high)


def assert_binomial(successes, trials, probability, significance=SIGNIFICANCE, label=""):
    """Assert that each count of successes fits its probability (Sidak over the elements)."""
    successes = np.atleast_1d(np.asarray(successes, dtype=float))
    probability = np.broadcast_to(probability, successes.shape)
    share = sidak(significance, successes.size)
    low, high = binomial_interval(successes, trials, share)
    outside = (probability < low) | (probability > high)
    if outside.any():
        first = tuple(np.argwhere(outside)[0])
        raise AssertionError(
            f"{label}: {outside.sum()} of {successes.size} frequencies differ, first {first}: "
            f"{successes[first]:g} of {trials:g}, expected probability {probability[first]:.6g}, "
            f"interval [{low[first]:.6g}, {high[first]:.6g}]"
        )

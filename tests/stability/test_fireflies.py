"""The tail of the distribution of samples: how bright rare samples get.

For each case the 99.99th percentile q of a sample is estimated with all lights as candidates,
resampled like the default's. A firefly is a sample of the default that is brighter than `tail` q,
with `tail` = 10 unless the case says why not. It must not be more frequent than samples above q
are in that reference: 1 in 10,000, tested with the binomial distribution. The maximum is listed in
README.md: it grows with the number of samples, and no test is made of it.

The variance of a sample has a limit, too, for each case: it tells when a cure stops working that
leaves mean and tail alone.
"""

import numpy as np
import pytest
from scipy import stats

from tests.path_references import quick_and_slow
from tests.stability import samples
from tests.stability.cases import CASES, QUICK
from tests.statistics_tools import SIGNIFICANCE

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

RARE = 1e-4
REFERENCE_SEEDS = 2
MANY_LIGHTS = (
    "coincident-10000",
    "bright-far",
    "huge-and-tiny-rough",
    "huge-and-tiny-specular",
)
"""Cases with thousands of lights: all of them as candidates leave so little noise that a small
image tells the percentile to 1 %."""


def assert_no_fireflies(values, reference, tail):
    """Samples beyond `tail` times the reference's 99.99th percentile are at most as rare."""
    limit = tail * np.quantile(reference, 1 - RARE)
    count = int((values > limit).sum())
    allowed = int(stats.binom.isf(SIGNIFICANCE, values.size, RARE))
    assert count <= allowed, f"{count} of {values.size} samples above {limit:g}, {allowed} allowed"


def assert_little_variance(values, limit):
    """The relative variance, one number for each seed, is not significantly above the limit."""
    relative = values.var(axis=1) / (values.mean() or 1) ** 2
    if relative.mean() <= limit:
        return
    p = stats.ttest_1samp(relative, limit, alternative="greater").pvalue
    assert p >= SIGNIFICANCE, f"relative variance {relative.mean():.3g}, {limit:.3g} allowed"


@pytest.mark.parametrize("name", quick_and_slow(CASES, QUICK))
def test_distribution_of_samples(llvm, name):
    """Bright samples are as rare as in exhaustive resampling; the variance is what it was."""
    values = samples.single_samples(name)
    many = name in MANY_LIGHTS
    seeds, size = (1, samples.TAIL_SIZE // 2) if many else (REFERENCE_SEEDS, samples.TAIL_SIZE)
    reference = samples.single_samples(name, seeds, size, method="exhaustive")
    assert_no_fireflies(values, reference, CASES[name].tail)
    assert_little_variance(values, CASES[name].variance)


def test_fireflies_are_found(llvm):
    """One descent of the tree where the default has sixteen does not pass."""
    reference = samples.single_samples("spots-5", REFERENCE_SEEDS, method="exhaustive")
    values = samples.single_samples("spots-5", method="tree")
    with pytest.raises(AssertionError, match="allowed"):
        assert_no_fireflies(values, reference, CASES["spots-5"].tail)
    with pytest.raises(AssertionError, match="variance"):
        assert_little_variance(values, CASES["spots-5"].variance)

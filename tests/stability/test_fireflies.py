"""The tail of the distribution of samples: how bright rare samples get.

For each case percentiles.json has the 99.99th percentile q of a sample with all lights as
candidates, resampled like the default's. A firefly is a sample of the default that is brighter than
`tail` q, with `tail` = 10 unless the case says why not. It must not be more frequent than samples
above q are in that reference: 1 in 10,000, tested with the binomial distribution; three times
as many are found with 99 %. The maximum is listed in README.md: it grows with
the number of samples, and no test is made of it.

The variance of a sample has a limit, too, for each case: it tells when a cure stops working that
leaves mean and tail alone.
"""

import pytest
from scipy import stats

from tests.path_references import quick_and_slow
from tests.stability import samples
from tests.stability.cases import CASES, QUICK
from tests.statistics_tools import POWER, SIGNIFICANCE

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

FOUND = 3
"""Fireflies that are so many times too frequent have to be found."""


def assert_no_fireflies(values, name):
    """Samples beyond `tail` times the reference's 99.99th percentile are at most as rare."""
    limit = CASES[name].tail * samples.reference_tail(name).percentile
    count, of = int((values > limit).sum()), values.size
    allowed = int(stats.binom.isf(SIGNIFICANCE, of, samples.RARE))
    assert count <= allowed, f"{count} of {of} samples above {limit:g}, {allowed} allowed"
    assert stats.binom.sf(allowed, of, FOUND * samples.RARE) >= POWER, f"{of} samples are too few"


def assert_tail_of_reference(values, name):
    """No more and no fewer samples are above the percentile than when it was measured."""
    tail = samples.reference_tail(name)
    above, before = int((values > tail.percentile).sum()), tail.above
    if above + before > 0:
        share = values.size / (values.size + tail.of)
        p = stats.binomtest(above, above + before, share).pvalue
        assert p >= SIGNIFICANCE, f"{above} of {values.size} samples, {before} of {tail.of} before"


def assert_little_variance(values, limit):
    """The relative variance, four numbers for each seed, is not significantly above the limit.

    Quarters of an image share what it has learnt: the level is nominal where visibility is learnt.
    """
    quarters = values.reshape(len(values), -1, 4)
    relative = quarters.var(axis=1).ravel() / (values.mean() or 1) ** 2
    if relative.mean() <= limit:
        return
    p = stats.ttest_1samp(relative, limit, alternative="greater").pvalue
    assert p >= SIGNIFICANCE, f"relative variance {relative.mean():.3g}, {limit:.3g} allowed"


@pytest.mark.parametrize("name", quick_and_slow(CASES, QUICK))
def test_distribution_of_samples(llvm, name):
    """Bright samples are as rare as in exhaustive resampling; the variance is what it was."""
    values = samples.single_samples(name)
    assert_no_fireflies(values, name)
    assert_little_variance(values, CASES[name].variance)


def test_fireflies_are_found(llvm):
    """One descent of the tree where the default has sixteen does not pass."""
    values = samples.single_samples("spots-5", method="tree")
    with pytest.raises(AssertionError, match="allowed"):
        assert_no_fireflies(values, "spots-5")
    with pytest.raises(AssertionError, match="variance"):
        assert_little_variance(values, CASES["spots-5"].variance)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_percentile_is_that_of_exhaustive_resampling(llvm, name):
    """The file still says what make_readme would find."""
    assert_tail_of_reference(samples.reference_samples(name), name)


def test_another_percentile_is_found(llvm):
    """One descent of the tree has another tail than exhaustive resampling."""
    with pytest.raises(AssertionError, match="before"):
        assert_tail_of_reference(samples.single_samples("spots-5", 2, method="tree"), "spots-5")

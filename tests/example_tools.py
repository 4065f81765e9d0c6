"""Examples drawn by Hypothesis with a fixed seed, and means compared over many of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from scipy import stats

from tests import statistics_tools as tools


def for_examples(check, strategy, count):
    """Call `check` with `count` examples, the same ones in every run."""

    # Which ones they are follows from the text of this function, decorators included
    @settings(
        max_examples=count,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(example):
        check(example)

    run()


def for_examples_and_smaller(check, strategy, count):
    """The same, but where one fails Hypothesis looks for a smaller one, and prints that."""
    chosen = settings(
        max_examples=count,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    chosen(given(strategy)(check))()


def quick_and_slow(quick, slow):
    """Numbers of examples of a quick test, and of its slow twin."""
    return pytest.mark.parametrize(
        "examples", [quick, pytest.param(slow, marks=pytest.mark.slow)], ids=["quick", "slow"]
    )


NOISY_REFERENCE = 0.01
"""Relative standard error of a reference above which it has no part in averages."""
SEEDS = 16
"""Renderings of each estimate."""

ERROR = 4.5e-3
"""Relative standard error of an image mean that the number of samples is chosen for."""


def images(loaded, integrator, first_seed, largest=1 << 13):
    """Renderings (seeds, height, width, channels), with as many samples as their error needs.

    At most `largest` samples a pixel: a test of many scenes can do with less of single ones.

    Each scene has seeds of its own: with equal ones, free flights through fog are the same in all
    scenes, and so are the errors of their means.
    """
    pilot = tools.render_seeds(loaded, integrator, 64, range(first_seed, first_seed + 8))
    spp = tools.samples_for_precision(pilot, 64, SEEDS, ERROR, largest)
    seeds = range(first_seed + 100, first_seed + 100 + SEEDS)
    return tools.render_seeds(loaded, integrator, max(64, spp), seeds)


def assert_equal_in_scenes(estimates):
    """Two estimates in each of some scenes: they differ in no scene, nor on average.

    Of `tools.SIGNIFICANCE` one half is divided among the scenes, the other is for the average of
    the relative differences. The whole family thereby has one false alarm in 100,000 runs, and the
    average finds a bias of 2 % that no scene shows alone. Scenes are not weighted by the precision
    that they were found to have: it is higher where rare bright samples have not come. Where the
    reference alone is noisy, because next to nothing of a light is seen, a scene is compared by
    itself but has no part in the average.
    """
    differences = []
    for ours, expected, scene in estimates:
        tools.assert_finite(ours)
        assert (ours >= 0).all()
        if not expected.any():
            assert not ours.any(), scene
            continue
        share = tools.SIGNIFICANCE / 2 / len(estimates)
        comparison = tools.compare_means(ours, expected, share, tile=1)
        assert comparison.passes, comparison.message(str(scene))
        means = [estimate.mean(axis=(1, 2, 3)) for estimate in (ours, expected)]
        test = tools.welch(*means)
        if means[1].std(ddof=1) > NOISY_REFERENCE * np.sqrt(len(means[1])) * test.mean_b:
            continue
        relative = (test.mean_a - test.mean_b, test.error)
        differences.append((*(value / test.mean_b for value in relative), test.dof))
    assert_zero_on_average(*map(np.array, zip(*differences)))


def assert_zero_on_average(differences, errors, dof):
    """No significant difference on average, and one of 2 % would be found (Satterthwaite)."""
    average, variances = differences.mean(), (errors / len(errors)) ** 2
    error = np.sqrt(variances.sum())
    quantiles = stats.t.isf(
        [tools.SIGNIFICANCE / 4, 1 - tools.POWER], variances.sum() ** 2 / (variances**2 / dof).sum()
    )
    message = f"{average:.2%} +- {error:.2%} on average: significance {tools.SIGNIFICANCE / 2}"
    assert abs(average) <= quantiles[0] * error, message
    found = quantiles.sum() * error
    assert found <= tools.BIAS, f"too noisy: on average only {found:.2%} would be found"


def compare_in_scenes(strategy, count, estimate):
    """Compare what `estimate` returns for each of the drawn scenes; 2 % too much must be found."""
    estimates = []
    for_examples(lambda scene: estimates.append((*estimate(scene), scene)), strategy, count)
    assert len(estimates) == count
    assert_equal_in_scenes(estimates)
    with pytest.raises(AssertionError, match="significance"):
        assert_equal_in_scenes([(1.02 * ours, *others) for ours, *others in estimates])

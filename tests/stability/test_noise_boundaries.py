"""The noise has no step along a line of receivers, and has one where clusters are split by a rule.

The strip of `scenes.cut_boundary` is rendered with one sample per pixel: all pixels of a column
are samples of one receiver. Its logarithm of the variance is estimated once for each seed. At each
border between two columns a straight line is fitted to the `REACH` columns on either side, and the
difference of the two lines' values at the border is a step. Over the seeds its mean divided by its
standard error follows Student's t where the noise is smooth. The largest of all borders is
compared with the quantile for that many borders (Sidak).

Not tested are rates above 1: there candidates are dealt greedily to reservoirs, which is a rule.
With a rate of 4 the noise has steps of up to a third next to a cluster's centre, where all its
lights are candidates for sure.

The columns are 4 mm wide, for strong bends not to look like steps: with columns of 6 cm they do.
"""

import functools

import mitsuba as mi
import numpy as np
import pytest
from manylights import scenes
from scipy import stats

from tests import statistics_tools as tools

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

COLUMNS, ROWS, SEEDS, REACH = 4096, 64, 32, 6


@functools.cache
def log_deviations(**parameters):
    """Logarithm of the standard deviation in each column, (seeds, columns)."""
    scene = mi.load_dict(scenes.cut_boundary(300, width=COLUMNS, height=ROWS))
    integrator = mi.load_dict({"type": "manylights_direct", **parameters})
    images = tools.render_seeds(scene, integrator, spp=1, seeds=range(SEEDS))
    return np.log(images.mean(axis=-1).std(axis=1, ddof=1))


def steps(values):
    """Difference of the fits on both sides of each border, (seeds, borders)."""
    offsets = np.arange(REACH) + 0.5
    design = np.stack([np.ones(REACH), offsets], axis=1)
    at_border = np.linalg.pinv(design)[0]
    windows = np.lib.stride_tricks.sliding_window_view(values, REACH, axis=1)
    right, left = windows[:, REACH:], windows[:, :-REACH, ::-1]
    return (right - left) @ at_border


def largest_step(values):
    """Student's t of the most significant step, and what chance alone may give."""
    t = stats.ttest_1samp(steps(values), 0.0, axis=0).statistic
    threshold = stats.t.isf(tools.sidak(tools.SIGNIFICANCE, t.size) / 2, len(values) - 1)
    return np.abs(t).max(), threshold


@pytest.mark.parametrize(
    "parameters",
    [{}, {"splitting_rate": 0.25}, pytest.param({"method": "talk"}, marks=pytest.mark.slow)],
    ids=str,
)
def test_noise_has_no_step_with_stochastic_splitting(llvm, parameters):
    """Whatever splits with a random number changes gradually."""
    step, threshold = largest_step(log_deviations(**parameters))
    assert step <= threshold


def test_noise_has_steps_with_adaptive_splitting(llvm):
    """The same statistic finds the borders of a rule without random numbers."""
    step, threshold = largest_step(log_deviations(method="adaptive_splitting"))
    assert step > threshold


def test_planted_step_is_found(llvm):
    """A fifth more noise beyond the middle."""
    values = log_deviations().copy()
    values[:, COLUMNS // 2 :] += np.log(1.2)
    step, threshold = largest_step(values)
    assert step > threshold

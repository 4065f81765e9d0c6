"""Measures the cases and writes README.md, percentiles.json and noise.svg.

    python -m tests.stability.make_readme

Takes some minutes in llvm_ad_rgb.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

from tests.stability import samples
from tests.stability.cases import CASES

FOLDER = Path(__file__).parent

HEADER = """\
# Where methods fail

Scenes that each make one thing hard. All of them are tested: the mean against a closed form or
Mitsuba's own emitters one by one (`test_cases.py`), the tail of the distribution of samples against
exhaustive resampling (`test_fireflies.py`), the noise along a line of receivers
(`test_noise_boundaries.py`). Nothing is clamped anywhere. This file is written by `python -m
tests.stability.make_readme`, in llvm_ad_rgb, a million samples of one pixel each for the default
and 131,072 for `exhaustive`, which has every light as a candidate and resamples them to 16.

- *Variance*: of a sample, over the squared mean; default / exhaustive.
- *99.99 %*: that percentile of the samples over the median; default / exhaustive. A dash: the
  median is 0.
- *Maximum*: over the median; default / exhaustive. It grows with the number of samples.

| case | what is hard | variance | 99.99 % | maximum |
|---|---|---|---|---|
"""

NOISE = """
## Noise along a line

![Standard deviation along a strip of the floor](noise.svg)

A strip of floor under three clusters of 100 points each (`scenes.cut_boundary`), 4,096 receivers of
4 mm. Where clusters are split by a rule (`adaptive_splitting`) the noise jumps: the largest step of
its logarithm is {step:.2f}. (Its noise is lower: it considers more lights.)
The default and `talk` split by a random number and have none: what
looks steep here is continuous at that scale. The bends of the default are where a light's
probability of being a candidate reaches 1.
"""


def ratio(values, median):
    """A number over the median for the table."""
    return "-" if median <= 0 else f"{values / median:.3g}"


def measure(name):
    """A line of the table, and the tail of the reference."""
    case = CASES[name]
    pair = [samples.single_samples(name, samples.MILLION_SEEDS), samples.reference_samples(name)]
    tail = asdict(samples.tail_of(pair[1]))
    if case.black:
        assert not pair[0].any()
        return f"| `{name}` | {case.hard} | exactly black | | |\n", tail
    medians = [np.median(values) for values in pair]
    variances = [f"{values.var() / values.mean() ** 2:.2g}" for values in pair]
    tails = [ratio(np.quantile(v, 0.9999), m) for v, m in zip(pair, medians)]
    largest = [ratio(v.max(), m) for v, m in zip(pair, medians)]
    cells = [" / ".join(cell) for cell in (variances, tails, largest)]
    return f"| `{name}` | {case.hard} | {' | '.join(cells)} |\n", tail


def draw_noise(path):
    """Draw the noise along the strip for three methods; returns the largest step of the rule."""
    matplotlib.use("svg")
    from matplotlib import pyplot as plt

    from tests.stability import test_noise_boundaries as strip

    figure, axes = plt.subplots(figsize=(9, 3.6), layout="constrained")
    x = (np.arange(strip.COLUMNS) + 0.5) / strip.COLUMNS * 16 - 8
    for method, label in (
        ("adaptive_splitting", "adaptive splitting: by a rule"),
        ("talk", "talk: by a random number"),
        ("resampled_tree", "default: by a random number"),
    ):
        values = strip.log_deviations(method=method)
        every = slice(None, None, 4)  # a quarter of the columns: fewer points in the file
        axes.plot(x[every], np.exp(values.mean(axis=0))[every], label=label, linewidth=0.8)
        if method == "adaptive_splitting":
            step = np.abs(strip.steps(values).mean(axis=0)).max()
    axes.set(yscale="log", xlabel="position (m)", ylabel="standard deviation of a sample")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    with matplotlib.rc_context({"svg.hashsalt": "noise"}):
        figure.savefig(path, metadata={"Date": None})
    return step


def main():
    """Measure everything."""
    import manylights  # noqa: F401  (makes the plugins known)

    mi.set_variant("llvm_ad_rgb")
    rows, tails = zip(*map(measure, CASES))
    samples.PERCENTILES.write_text(json.dumps(dict(zip(CASES, tails)), indent=1) + "\n")
    step = draw_noise(FOLDER / "noise.svg")
    (FOLDER / "README.md").write_text(HEADER + "".join(rows) + NOISE.format(step=step))


if __name__ == "__main__":
    main()

"""Micro-benchmarks of building, traversal and resampling: `make microbench`, not part of the tests.

Results are in `microbench.json`; nothing here asserts a time.
"""

from __future__ import annotations

import drjit as dr
import manylights  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from manylights import _core, scenes

from tests.conftest import require_variant

COUNTS = [1_000, 10_000, 100_000]
RECEIVERS = 256


def field_of_lamps(count):
    """A tree over lamps that shine to the sides, of powers over two decades."""
    rng = np.random.default_rng(1)
    mean = rng.uniform([0, 0, 0], [100, 100, 20], (count, 3)).astype("f4")
    axis = rng.normal(size=(count, 3))
    axis *= 2 / 3 / np.linalg.norm(axis, axis=1, keepdims=True)
    flux = 10 ** rng.uniform(-1, 1, count)
    return mean, flux.astype("f4"), axis.astype("f4"), np.full(count, 0.01, "f4")


def receivers():
    rng = np.random.default_rng(2)
    return rng.uniform([0, 0, 0], [100, 100, 1], (RECEIVERS, 3)).astype("f4")


@pytest.mark.parametrize("count", [*COUNTS, 1_000_000])
def test_build(benchmark, count):
    """Tree over lights in memory, wide and binary nodes."""
    lights = field_of_lamps(count)
    benchmark(_core.Tree, *lights)


@pytest.mark.parametrize("expected", [1, 8, 24])
@pytest.mark.parametrize("count", COUNTS)
def test_traversal(benchmark, count, expected):
    """Candidates of 256 receivers, one after the other, with K = `expected`."""
    tree, points, up = _core.Tree(*field_of_lamps(count)), receivers(), np.float32([0, 0, 1])

    def traverse():
        for i, point in enumerate(points):
            tree.candidates(point, up, expected, u=(i + 0.5) / RECEIVERS, seed=i)

    benchmark(traverse)


@pytest.mark.parametrize("count", COUNTS)
def test_density(benchmark, count):
    """Probability of each light at one receiver, one walk from its leaf to the root each."""
    tree, up = _core.Tree(*field_of_lamps(count)), np.float32([0, 0, 1])
    benchmark(tree.probabilities, receivers()[0], up)


@pytest.mark.parametrize("reservoirs", [4, 8, 16])
def test_resampling(benchmark, reservoirs):
    """64 candidates dealt to reservoirs, and 4 of these chosen."""
    rng = np.random.default_rng(3)
    importance, probability = rng.uniform(0.1, 1, (2, 64)).astype("f4")

    def resample():
        _, weights = _core.resample(importance, probability, reservoirs, seed=1)
        _core.select(np.float32(weights), 4, 0.5)

    benchmark(resample)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_render(benchmark, variant, count):
    """All of it in a kernel: the city with default parameters, per render of 160 x 90 pixels."""
    require_variant(variant)
    scene = mi.load_dict(scenes.city(count, width=160, height=90))
    integrator = mi.load_dict({"type": "manylights_direct"})
    samples = 16 if dr.is_jit_v(mi.Float) else 1
    benchmark.extra_info["samples"] = 160 * 90 * samples

    def render(seed=0):
        dr.sync_thread()
        np.array(mi.render(scene, integrator=integrator, spp=samples, seed=seed))

    render()  # build and compile
    benchmark(render, seed=1)

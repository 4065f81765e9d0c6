"""The mean of every case equals that of an independent estimate, and nothing is NaN or black."""

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests import statistics_tools as tools
from tests.conftest import NO_INFINITY
from tests.path_references import quick_and_slow
from tests.references import reference_variant
from tests.shared_results import shared
from tests.stability import samples
from tests.stability.cases import CASES, QUICK, units

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")


def assert_mean(name, variant, images):
    """Compare images of a case with its reference."""
    if name == "broken-triangles" and variant.startswith("cuda"):
        pytest.skip(NO_INFINITY)
    tools.assert_finite(images, name)
    assert (images >= 0).all()
    if CASES[name].black:
        assert not images.any()
        return
    reference = samples.reference_images(name, reference_variant(variant))
    tools.assert_same_mean(
        images,
        reference,
        tile=samples.BLOCK,
        label=f"{name}, {variant}",
        independent_pixels=samples.has_box_filter(name),
    )


@pytest.mark.parametrize("name", quick_and_slow(CASES, QUICK))
def test_mean_equals_reference(llvm, name):
    """The default of the plugin in llvm_ad_rgb."""
    assert_mean(name, llvm, samples.images(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_mean_in_scalar_variant(scalar, name):
    """The same in scalar_rgb."""
    assert_mean(name, scalar, samples.images(name))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["talk", "adaptive_splitting", "tree", "exhaustive"])
@pytest.mark.parametrize("name", CASES)
def test_mean_of_other_methods(llvm, name, method):
    """The other methods of the plugin."""
    assert_mean(name, llvm, samples.images(name, method=method))


@pytest.mark.parametrize("name", CASES)
def test_every_sample_is_finite_in_scalar_variant(scalar, name):
    """No NaN, no negative light, and as dark as it has to be."""
    scene = samples.load(CASES[name].scene(), samples.MEAN_SIZE)
    for parameters in ({}, {"splitting_rate": 4}):
        integrator = samples.integrator(name, **parameters)
        images = tools.render_seeds(scene, integrator, spp=16, seeds=range(2))
        tools.assert_finite(images, name)
        assert (images >= 0).all()
        assert images.any() != CASES[name].black


def test_planted_bias_is_found(llvm):
    """Images of a case that are 2 % too bright do not pass."""
    images = samples.images("inside-cluster")
    with pytest.raises(AssertionError, match="significance"):
        assert_mean("inside-cluster", llvm, 1.02 * images)


def test_light_at_the_receiver_does_not_empty_reservoirs(llvm):
    """Its infinite importance would win every reservoir that it enters, and then give nothing."""
    for parameters in ({"method": "exhaustive"}, {"method": "talk", "splitting_rate": np.inf}):
        images = samples.images("at-receiver", **parameters)
        assert_mean("at-receiver", llvm, images)


@pytest.mark.parametrize("name", ["inside-cluster", "bright-far", "edge-on"])
def test_mean_with_one_sample_per_pixel(llvm, name):
    """A million pixels of one sample have the mean of the reference."""
    values = samples.single_samples(name, samples.MILLION_SEEDS)
    reference = samples.reference_images(name, llvm).mean(axis=(1, 2, 3))
    comparison = tools.compare_means(
        values.mean(axis=1).reshape(-1, 1, 1, 1), reference.reshape(-1, 1, 1, 1), tile=1
    )
    assert comparison.passes, comparison.message(name)
    assert comparison.detectable_bias() <= tools.BIAS


UNITS = (1e-4, 1e-2, 1e2, 1e5)


@shared
def noise(scale):
    """Relative variance of a sample in units of that scale, once for each seed."""
    default = mi.load_dict({"type": "manylights_direct"})
    values = samples.brightness(units(scale)(), default, samples.MILLION_SEEDS)
    return values.var(axis=1) / values.mean(axis=1) ** 2


def compare_noise(a, b):
    """Student's test of two relative variances; also what difference it would find."""
    result = stats.ttest_ind(np.log(a), np.log(b), equal_var=False)
    error = np.sqrt(np.log(a).var(ddof=1) / len(a) + np.log(b).var(ddof=1) / len(b))
    visible = error * stats.t.isf(tools.SIGNIFICANCE / 2, result.df)
    return result.pvalue, visible


@pytest.mark.parametrize("scale", quick_and_slow(UNITS, (UNITS[0], UNITS[-1])))
def test_noise_does_not_depend_on_units(llvm, scale):
    """The same scene in other units of length has the same relative variance."""
    p, visible = compare_noise(noise(scale), noise(1.0))
    assert p >= tools.SIGNIFICANCE
    assert visible < 0.1


def test_more_noise_is_found(llvm):
    """A tenth more variance is."""
    p, _ = compare_noise(1.1 * noise(1.0), noise(UNITS[0]))
    assert p < tools.SIGNIFICANCE

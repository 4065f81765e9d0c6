"""Renders that follow a plan: passes add up to the whole, whoever renders them, and learn once."""

import manylights
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.integrator_entries import ALL, REST, TRAIN, read, write
from tests.references import reference_variant
from tests.shared_results import shared
from tests.statistics_tools import SIGNIFICANCE

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")

VARIANTS = ["scalar_rgb", "llvm_ad_rgb"]
SIZE = {"width": 144, "height": 120}
SPP = 16
PLAN = [(0, 8, TRAIN, 0), (0, 8, REST, 0), (8, 8, ALL, 0)]
MANY = 32
"""Samples per pixel for comparisons of means."""


def hidden_points(sampler="independent", rfilter="gaussian", **film):
    """299 point lights behind a wall, 3 in front of it."""
    scene = manylights.scenes.behind_wall(302, **SIZE, spp=SPP)
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": SPP}
    scene["sensor"]["film"] |= {"rfilter": {"type": rfilter}, **film}
    return mi.load_dict(scene)


def integrator(**parameters):
    """An integrator that learns, unless it is told otherwise."""
    return mi.load_dict({"type": "manylights_direct", **parameters})


def sums(scene, method, plan, seed=3, spp=SPP):
    """The film's sums of the passes of a plan."""
    write(method, plan=plan)
    method.render(scene, scene.sensors()[0], seed=seed, spp=spp, develop=False)
    return np.array(scene.sensors()[0].film().develop(raw=True), dtype=np.float64)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("sampler", ["independent", "manylights_sobol"])
def test_passes_add_up_to_the_whole(variant, sampler):
    """Rendered at once, or one by one with another integrator: the same counts and sums."""
    scene = hidden_points(sampler)
    together, parts = integrator(), integrator()
    whole = sums(scene, together, PLAN)
    found = [sums(scene, parts, [one]) for one in PLAN]
    np.testing.assert_allclose(sum(found), whole, rtol=1e-5, atol=1e-5 * whole.max())
    counts = read(together, "visibility.counts")
    assert counts.sum() > 0
    assert np.array_equal(counts, read(parts, "visibility.counts"))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_written_counts_give_the_same_bits(variant):
    """Whoever did not train renders the other passes as who did; without counts it does not."""
    scene = hidden_points()
    learner, other, ignorant = integrator(), integrator(), integrator()
    found = [sums(scene, learner, [one]) for one in PLAN]
    counts = read(learner, "visibility.counts")
    write(other, visibility_counts=counts)
    for one, expected in zip(PLAN[1:], found[1:]):
        assert np.array_equal(sums(scene, other, [one]), expected)
        assert not np.array_equal(sums(scene, ignorant, [one]), expected)
    assert np.array_equal(read(other, "visibility.counts"), counts)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("threads", [1, 3])
def test_counts_do_not_depend_on_threads(variant, threads, thread_count):
    """They are integers."""
    scene = hidden_points()
    expected, found = integrator(), integrator()
    image = sums(scene, expected, PLAN)
    thread_count(threads)
    assert np.array_equal(sums(scene, found, PLAN), image)
    name = "visibility.counts"
    assert np.array_equal(read(expected, name), read(found, name))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_a_sixteenth_of_the_pixels_trains(variant):
    """One of each block of 4 x 4, and never those of the rest; another seed trains others."""
    scene = hidden_points(rfilter="box")
    weights = {
        (role, seed): sums(scene, integrator(), [(0, 2, role, 0)], seed)[..., -1]
        for role in (TRAIN, REST)
        for seed in (1, 2)
    }
    height, width = weights[TRAIN, 1].shape
    blocks = weights[TRAIN, 1].reshape(height // 4, 4, width // 4, 4).sum(axis=(1, 3))
    assert (blocks == 2.0).all()
    assert (weights[TRAIN, 1] + weights[REST, 1] == 2.0).all()
    assert not np.array_equal(weights[TRAIN, 1], weights[TRAIN, 2])


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_trained_pixels_are_unbiased(variant):
    """They have the light that these pixels have in whole images; 2 % more is noticed."""
    expected = plain_image(reference_variant(variant))
    scene, method, ratios = hidden_points(rfilter="box"), integrator(), []
    plan = [(0, MANY // 2, TRAIN, 0), (MANY // 2, MANY // 2, TRAIN, 0)]
    for seed in range(8):
        found = sums(scene, method, plan, seed, MANY)
        ratios.append(found[..., 1].sum() / (found[..., -1] * expected).sum())
    assert stats.ttest_1samp(ratios, 1.0).pvalue > SIGNIFICANCE
    assert stats.ttest_1samp(1.02 * np.array(ratios), 1.0).pvalue < SIGNIFICANCE


@shared
def plain_image(variant):
    """The green channel of an integrator that does not learn, rendered in a variant."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        scene = hidden_points(rfilter="box")
        plain = integrator(learn_visibility=False, splitting_rate=3, shadow_rays=8)
        plan, seeds = [(0, MANY, ALL, 0)], range(50, 56)
        whole = sum(sums(scene, plain, plan, seed, MANY)[..., :4] for seed in seeds)
        return whole[..., 1] / whole[..., 3]
    finally:
        mi.set_variant(before)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_passes_share_one_sequence(variant):
    """Samples by index are those of the whole, in any parts; another scramble has others."""
    scene, method = hidden_points("manylights_sobol"), integrator(learn_visibility=False)
    whole = sums(scene, method, [(0, 8, ALL, 0)])
    parts = [(3, 5, ALL, 0), (0, 3, TRAIN, 0), (0, 3, REST, 0)]
    found = sums(scene, method, parts)
    np.testing.assert_allclose(found, whole, rtol=1e-4, atol=1e-5 * whole.max())
    other = sums(scene, method, [(0, 8, ALL, 1)])
    assert not np.allclose(other, whole, rtol=1e-2)


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_a_plan_of_one_pass_is_the_default(variant):
    """As `mi.render` does where nothing is to be learnt."""
    scene = hidden_points()
    method, plain = (integrator(learn_visibility=False) for _ in range(2))
    planned = sums(scene, method, [(0, SPP, ALL, 0)])
    assert np.array_equal(planned, sums(scene, plain, []))


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_an_empty_plan_ends_the_job(variant):
    """Nothing is known of it any more, unless it is to be kept."""
    scene = hidden_points()
    method = integrator()
    sums(scene, method, PLAN)
    write(method, plan=[])
    assert len(read(method, "visibility.counts")) == 0
    assert np.array_equal(sums(scene, method, PLAN[2:]), sums(scene, integrator(), PLAN[2:]))


BAD_PLANS = {
    "length": ([0, 8, 0], r'"plan": has 3 numbers.*four for each pass'),
    "count": ([0, 4, 0, 0, 4, 0, 0, 0], r'"plan": pass 1 has no samples.*at least 1'),
    "role": ([0, 4, 3, 0], r'"plan": pass 0 has the role 3.*0 .all pixels.*1.*2'),
    "spp": ([0, 8, 0, 0, 8, 9, 0, 0], r'"plan": pass 1 .*8 to 16.*16 per pixel: 0 to 15'),
}


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("case", BAD_PLANS)
def test_bad_plans_are_refused(variant, case):
    """The message names the entry, the value and what is allowed; the next plan is followed."""
    plan, message = BAD_PLANS[case]
    scene, method = hidden_points(), integrator()
    with pytest.raises(RuntimeError, match=message):
        sums(scene, method, plan)
    assert sums(scene, method, [(0, 1, ALL, 0)])[..., -1].any()


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_counts_of_a_wrong_size_are_refused(variant):
    """As are any where there is nothing to learn."""
    for parameters, allowed in (
        ({}, "[0-9]+ for this scene"),
        ({"learn_visibility": False}, "none: nothing is to be learnt"),
    ):
        method = integrator(**parameters)
        write(method, visibility_counts=[1, 2, 3])
        with pytest.raises(RuntimeError, match=f'"visibility.counts" has 3 numbers.*{allowed}'):
            sums(hidden_points(), method, PLAN[2:])


def test_entries_within_other_integrators(llvm):
    """`aov` shows those of what it nests, and renders as it would without."""
    nested = mi.load_dict(
        {"type": "aov", "aovs": "depth:depth", "image": {"type": "manylights_direct"}}
    )
    assert "integrator_0.plan" in mi.traverse(nested)
    scene = hidden_points()
    image = np.array(mi.render(scene, integrator=nested, spp=4))
    alone = np.array(mi.render(scene, integrator=integrator(), spp=4))
    assert np.array_equal(image[..., :3], alone[..., :3])


FILMS = {
    "gaussian": {},
    "mitchell, crop": {
        "rfilter": {"type": "mitchell"},
        "crop_offset_x": 10,
        "crop_offset_y": 7,
        "crop_width": 31,
        "crop_height": 22,
    },
    "tent, alpha": {"rfilter": {"type": "tent"}, "pixel_format": "rgba"},
    "border": {"sample_border": True},
    "box": {"rfilter": {"type": "box"}},
}


@pytest.mark.parametrize("spp", [1, 12])
@pytest.mark.parametrize("film", FILMS)
def test_film_is_that_of_mitsuba(llvm, film, spp):
    """The sums are those that Mitsuba's own rendering makes of the same samples."""
    scene = manylights.scenes.behind_wall(60, width=64, height=48, spp=spp)
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 64, "height": 48, **FILMS[film]}
    scene = mi.load_dict(scene)
    ours = integrator(learn_visibility=False, counts=True)
    mitsubas = integrator(learn_visibility=False, counts=True, samples_per_pass=spp)
    expected = sums(scene, mitsubas, [], spp=spp)
    np.testing.assert_allclose(
        sums(scene, ours, [], spp=spp), expected, rtol=1e-4, atol=1e-5 * expected.max()
    )


@pytest.mark.slow
def test_parts_of_large_renders_add_up(llvm):
    """More samples than are evaluated at once: pixels have all of theirs, borders no seams."""
    scene = mi.load_dict(manylights.scenes.behind_wall(4, width=96, height=96, spp=8192))
    found = sums(scene, integrator(), [], spp=8192)
    parts = (sums(scene, integrator(), [(0, 1024, ALL, 0)], seed, 1024) for seed in range(8))
    expected = sum(parts)
    ratio = found[..., -1] / expected[..., -1]
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)

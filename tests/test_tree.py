"""The light tree: its probabilities, its candidates and its builder, in single precision.

`manylights._core` runs the code of the plugin's kernels without a scene. The exact probabilities
that samples are compared with come from `Tree.probabilities`, which walks from a leaf to the root;
sampling walks the other way.
"""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import statistics_tools as tools

core = pytest.importorskip(
    "manylights._core", reason="manylights._core was not built: it needs Python.h (python3-dev)"
)

EPSILON = float(np.finfo(np.float32).eps)
CERTAIN = 2.0**20
"""Number of points of systematic sampling that makes each light of moderate flux certain."""

HUGE_RATE = 1e20
STOCHASTIC = ("near", "far")
SPLIT_FUNCTIONS = (*STOCHASTIC, "variance")


# ------------------------------------------------------------------------------ lights, receivers


def make_tree(mean, flux, axis=None, variance=None):
    """A tree over lights without extent that shine in all directions, unless given."""
    count = len(flux)
    axis = np.zeros((count, 3)) if axis is None else axis
    variance = np.zeros(count) if variance is None else variance
    return core.Tree(*(np.ascontiguousarray(a, np.float32) for a in (mean, flux, axis, variance)))


def random_lights(count, seed=0, decades=2.0):
    """Arguments of `make_tree`: lights in the unit cube, half of them oriented, some extended."""
    generator = np.random.default_rng(seed)
    mean = generator.random((count, 3))
    flux = 10 ** generator.uniform(-decades, 0, count)
    axis = generator.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    axis[::2] = 0
    variance = 1e-4 * generator.integers(0, 2, count)
    return mean, flux, axis, variance


def receiver(p, n=(0, 0, 1), transmits=False):
    """Arguments that describe a shading point."""
    n = np.asarray(n, float) / np.linalg.norm(n)
    return {"p": np.asarray(p, np.float32), "n": n.astype(np.float32), "transmits": transmits}


RECEIVERS = {
    "below": receiver((0.4, 0.6, -0.3)),
    "inside": receiver((0.5, 0.45, 0.5), (1, 2, 3)),
    "inside, transmits": receiver((0.5, 0.45, 0.5), (1, 2, 3), transmits=True),
    "away": receiver((0.5, 0.5, 1.5), (0, 0, 1)),
    "far": receiver((1e4, 3e4, 2e4), (-1, -3, -2)),
}
every_receiver = pytest.mark.parametrize("at", RECEIVERS.values(), ids=RECEIVERS)


def probabilities(tree, at):
    """Probabilities of a descent, in double precision."""
    return np.array(tree.probabilities(**at), float)


def rounding(tree):
    """Relative error of a product over the levels: each has a sum of four and a division."""
    return 8 * tree.depth * EPSILON


def assert_distribution(tree, at):
    """The probabilities of a descent are positive and sum to one."""
    p = probabilities(tree, at)
    assert (p > 0).all()
    assert abs(p.sum() - 1) <= rounding(tree)


# -------------------------------------------------------------------------------------- sampling


def uniform(count, seed):
    """Independent numbers in [0, 1) that single precision holds exactly."""
    return np.random.default_rng(seed).random(count, dtype=np.float32).astype(float)


def draw(tree, at, expected, trials, seed=1):
    """Lights and probabilities of many independent systematic samples."""
    numbers = uniform(trials, seed)
    return [
        tree.candidates(**at, expected=expected, u=u, seed=seed * trials + index)
        for index, u in enumerate(numbers)
    ]


def draw_splitting(tree, at, rate, trials, function, xi=None, seed=1):
    """The same for stochastic splitting, with the given `xi` or a random one for each sample."""
    numbers = uniform(trials, seed) if xi is None else np.full(trials, xi)
    return [
        tree.splitting_candidates(
            **at, rate=rate, xi=x, seed=seed * trials + index, split_function=function
        )
        for index, x in enumerate(numbers)
    ]


def selection_counts(samples, count):
    """How often each light is a candidate."""
    return np.bincount(np.concatenate([lights for lights, _ in samples]), minlength=count)


def horvitz_thompson(samples, values):
    """The sums of value / probability over the candidates, as images of one pixel."""
    sums = [
        (values[:, lights] / np.asarray(p)).sum(axis=1) if lights else np.zeros(len(values))
        for lights, p in samples
    ]
    return np.array(sums)[:, np.newaxis, np.newaxis, :]


def exact_sums(values):
    """What the sums should be on average, as an image of one pixel."""
    return values.sum(axis=1)[np.newaxis, np.newaxis, np.newaxis, :]


def random_values(p, seed=3, functions=4):
    """Functions of the light, proportional to its probability `p` but for 40 %.

    Their sum over one candidate, divided by its probability, has a relative standard deviation of
    23 %: of the means of 20,000 such sums a bias of 2 % is 12 standard errors.
    """
    generator = np.random.default_rng(seed)
    return p * generator.uniform(0.6, 1.4, (functions, len(p)))


def assert_valid_candidates(sample, limit=math.inf):
    """Candidates are distinct, at most `limit`, of a probability in (0, 1]."""
    lights, p = sample
    assert len(set(lights)) == len(lights) <= limit
    assert all(0 < value <= 1 for value in p)


# ---------------------------------------------------------------- probabilities of a single descent


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 17, 1000])
@every_receiver
def test_probabilities_sum_to_one(count, at):
    """Trees that are a single node, and larger ones."""
    assert_distribution(make_tree(*random_lights(count)), at)


@pytest.mark.parametrize("expected", [1.0, 3.5, CERTAIN])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_few_lights(count, expected):
    """One to five lights need no special code."""
    tree = make_tree(*random_lights(count))
    for sample in draw(tree, RECEIVERS["below"], expected, trials=50):
        assert_valid_candidates(sample, math.ceil(expected))
        assert sample[0]
        assert expected < CERTAIN or sorted(sample[0]) == list(range(count))


LINE = np.linspace(0, 1, 10_000)[:, np.newaxis] * (1, 0.5, 0)
POWERS = 10.0 ** np.linspace(-6, 6, 200)
EXTREME = {
    "coincident": (np.full((64, 3), 0.25), np.ones(64)),
    "line": (LINE, np.ones(10_000)),
    "exponential": (POWERS[:, np.newaxis] * (1, 1, 1), np.ones(200)),
    "12 decades": (random_lights(300)[0], 10.0 ** np.linspace(-12, 0, 300)),
    "far from the origin": (1e6 + np.round(100 * random_lights(300)[0]), np.ones(300)),
    "deep": (17.0 ** -np.arange(30)[:, np.newaxis] * (1, 0, 0), np.ones(30)),
}
every_extreme = pytest.mark.parametrize("lights", EXTREME.values(), ids=EXTREME)


@every_extreme
@pytest.mark.parametrize("transmits", [False, True])
def test_probabilities_of_extreme_scenes(lights, transmits):
    """Also at the lights' positions, in their midst and far away."""
    tree, mean = make_tree(*lights), lights[0]
    places = [mean[0], mean[-1], mean.mean(axis=0), mean[0] + 1e-3, mean[0] - 1e9, mean[0] + 1e20]
    for place in places:
        assert_distribution(tree, receiver(place, (0.3, -0.5, 0.8), transmits))


@every_extreme
def test_candidates_of_extreme_scenes(lights):
    """Distinct, no more than expected, and of the probability that they should have."""
    tree, mean = make_tree(*lights), lights[0]
    for place in (mean[0], mean.mean(axis=0), mean[0] - 1e9):
        at = receiver(place, (0.3, -0.5, 0.8))
        exact = np.minimum(1, 24 * probabilities(tree, at))
        for sample in draw(tree, at, 24, trials=100):
            assert_valid_candidates(sample, 24)
            np.testing.assert_allclose(sample[1], exact[sample[0]], rtol=rounding(tree))


STORED = 2.0**-8
"""Relative rounding of variances and shares of the flux in the wide nodes."""


@pytest.mark.parametrize(
    "scale, rtol",
    [(2.0**-13, 1e3 * EPSILON), (2.0**17, 1e3 * EPSILON)]
    + [(scale, STORED) for scale in (1e-4, 1e-2, 1e3, 1e5)],
)
def test_unit_of_length_does_not_matter(scale, rtol):
    """The same scene in another unit has the same probabilities."""
    mean, flux, axis, variance = random_lights(500)
    tree, scaled = (make_tree(mean * s, flux, axis, variance * s * s) for s in (1, scale))
    assert list(tree.order) == list(scaled.order)
    for at in (RECEIVERS["below"], RECEIVERS["inside, transmits"]):
        large = {**at, "p": (at["p"] * scale).astype(np.float32)}
        np.testing.assert_allclose(probabilities(scaled, large), probabilities(tree, at), rtol=rtol)


def test_unit_of_flux_does_not_matter():
    """Only ratios of flux count: a power of two changes no bit, whatever its size."""
    mean, flux, axis, variance = random_lights(500)
    flux = flux.astype(np.float32)
    trees = [make_tree(mean, flux * factor, axis, variance) for factor in (1, 2.0**60, 2.0**-60)]
    assert trees[0].nodes == trees[1].nodes == trees[2].nodes


def test_refit_to_the_same_fluxes_changes_nothing():
    """Nor does another unit of flux: building a tree ends with the same pass."""
    mean, flux, axis, variance = random_lights(500)
    flux = flux.astype(np.float32)
    tree = make_tree(mean, flux, axis, variance)
    nodes = tree.nodes
    for factor in (1, 2.0**60, 2.0**-60):
        tree.refit(flux * np.float32(factor))
        assert tree.nodes == nodes


@pytest.mark.parametrize("count", [1, 2, 5, 1000, 40_000])
def test_probabilities_after_refits(count):
    """They sum to one, each light can be chosen, and nothing drifts."""
    mean, flux, axis, variance = random_lights(count)
    flux = flux.astype(np.float32)
    tree = make_tree(mean, flux, axis, variance)
    nodes = tree.nodes
    for seed in range(3):
        other = random_lights(count, seed + 1, decades=12)[1].astype(np.float32)
        tree.refit(other)
        for at in RECEIVERS.values():
            assert_distribution(tree, at)
    tree.refit(flux)
    assert tree.nodes == nodes


def test_moments_after_a_refit():
    """Flux, mean position, variance and axis of the root's children are those of their lights."""
    mean, flux, axis, variance = random_lights(300)
    tree = make_tree(mean, flux, axis, variance)
    other = 10 ** np.random.default_rng(9).uniform(-4, 0, 300)
    tree.refit(other.astype(np.float32))
    words = np.frombuffer(tree.nodes, np.uint32).reshape(-1, 24)
    means = words.view(np.float32)
    flux, spreads = ((words << shift & 0xFFFF0000).view(np.float32) for shift in (0, 16))
    share = other / other.sum()
    for slot in range(4):
        lights = np.array(tree.order)[lights_below(words, words[0, 16 + slot])]
        weights = share[lights] / share[lights].sum()
        center = weights @ mean[lights]
        spread = variance[lights] + ((mean[lights] - center) ** 2).sum(axis=1) / 3
        np.testing.assert_allclose(flux[0, 12 + slot], share[lights].sum(), rtol=STORED)
        np.testing.assert_allclose(means[0, slot:12:4], center, rtol=1e-5)
        np.testing.assert_allclose(spreads[0, 12 + slot], weights @ spread, rtol=STORED)
        packed = [words[0, 20 + slot] >> np.uint32(10 * k) & 1023 for k in range(3)]
        found = [(int(p) - 1024 * (p > 511)) / 511 for p in packed]
        # Steps of 1 / 511, rounded once for each light and once here
        assert np.abs(found - weights @ axis[lights]).max() <= 2 / 1022


def lights_below(words, child):
    """Numbers of the lights below an entry `child` of a node."""
    if child & 0x80000000:
        return [int(child & 0x7FFFFFFF)]
    node = words[child]
    return [
        light
        for slot in range(4)
        if node[16 + slot]
        for light in lights_below(words, node[16 + slot])
    ]


def test_refit_refuses_what_a_tree_refuses():
    """One positive flux for each light."""
    tree = make_tree(*random_lights(5))
    for flux in (np.ones(4), np.zeros(5), np.full(5, np.nan)):
        with pytest.raises(ValueError, match="flux"):
            tree.refit(flux.astype(np.float32))


shapes = st.sampled_from(["cube", "line", "coincident", "exponential"])
coordinates = st.floats(-2, 2, width=32)
places = st.tuples(coordinates, coordinates, coordinates)
directions = places.filter(lambda n: np.linalg.norm(n) > 0.1)
frugal = settings(max_examples=40, deadline=None, derandomize=True, database=None)


def lights_of_shape(shape, count, seed, decades):
    """Random lights of a drawn arrangement."""
    mean, flux, axis, variance = random_lights(count, seed, decades)
    if shape == "line":
        mean = mean[:, :1] * (1, 2, -1)
    elif shape == "coincident":
        mean = np.broadcast_to(mean[:1], mean.shape)
    elif shape == "exponential":
        mean = 10 ** (12 * mean - 6)
    return mean, flux, axis, variance


@frugal
@given(
    shape=shapes,
    count=st.integers(1, 60),
    seed=st.integers(0, 1 << 20),
    decades=st.sampled_from([0, 2, 12]),
    place=places,
    normal=directions,
    transmits=st.booleans(),
    expected=st.floats(1, 64, width=32),
    u=st.floats(0, 1, exclude_max=True, width=32),
)
def test_any_tree_and_receiver(shape, count, seed, decades, place, normal, transmits, expected, u):
    """All of the properties above for random trees, receivers and random numbers."""
    tree = make_tree(*lights_of_shape(shape, count, seed, decades))
    at = receiver(place, normal, transmits)
    assert_distribution(tree, at)
    lights, p = sample = tree.candidates(**at, expected=expected, u=u, seed=seed)
    assert_valid_candidates(sample, math.ceil(expected))
    exact = np.minimum(1, expected * probabilities(tree, at))
    np.testing.assert_allclose(p, exact[lights], rtol=rounding(tree))
    certain = np.flatnonzero(exact > 1 - rounding(tree))
    assert set(certain[expected * probabilities(tree, at)[certain] > 1.001]) <= set(lights)
    assert sorted(tree.order) == list(range(count))


@frugal
@given(
    shape=shapes,
    count=st.integers(1, 60),
    seed=st.integers(0, 1 << 20),
    place=places,
    normal=directions,
    rate=st.floats(0, 100, width=32),
    xi=st.floats(0, 1, exclude_max=True, width=32),
    function=st.sampled_from(SPLIT_FUNCTIONS),
)
def test_any_tree_and_receiver_of_splitting(shape, count, seed, place, normal, rate, xi, function):
    """Given xi the candidates' number is fixed: it is the sum of all probabilities."""
    tree = make_tree(*lights_of_shape(shape, count, seed, 2))
    at = receiver(place, normal)
    exact = np.array(tree.splitting_probabilities(**at, rate=rate, xi=xi, split_function=function))
    sample = tree.splitting_candidates(**at, rate=rate, xi=xi, seed=seed, split_function=function)
    assert_valid_candidates(sample, count)
    levels = 64 + math.ceil(math.log2(count))
    assert abs(len(sample[0]) - exact.sum()) <= 8 * levels * EPSILON * count
    np.testing.assert_allclose(sample[1], exact[sample[0]], rtol=8 * levels * EPSILON)


# --------------------------------------------------------------------------- systematic sampling

TRIALS = 20_000


@every_receiver
@pytest.mark.parametrize("expected", [1.0, 7.5, 24.0])
def test_mean_number_of_candidates(at, expected):
    """It is the sum of all inclusion probabilities; their number is at most ceil(K)."""
    tree = make_tree(*random_lights(300))
    samples = draw(tree, at, expected, TRIALS)
    for sample in samples[:500]:
        assert_valid_candidates(sample, math.ceil(expected))
    counts = np.array([len(lights) for lights, _ in samples], float).reshape(-1, 1, 1, 1)
    exact = np.minimum(1, expected * probabilities(tree, at)).sum().reshape(1, 1, 1, 1)
    tools.assert_same_mean(counts, exact)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(counts, 1.02 * exact)


@every_receiver
def test_single_descents_follow_the_probabilities(at):
    """K = 1: one light for each number, a chi-square test."""
    tree = make_tree(*random_lights(200))
    samples = draw(tree, at, 1.0, TRIALS)
    assert all(len(lights) == 1 for lights, _ in samples)
    tools.assert_frequencies(selection_counts(samples, 200), probabilities(tree, at))


@every_receiver
@pytest.mark.parametrize("expected", [4.0, 24.0, 80.5])
def test_selection_frequencies(at, expected):
    """Each light is chosen as often as min(1, K w) says."""
    tree = make_tree(*random_lights(300))
    counts = selection_counts(draw(tree, at, expected, TRIALS), 300)
    # The rounding of a border between two lights, in units of the distance of two points
    border = expected * rounding(tree)
    exact = np.minimum(1 - border, expected * probabilities(tree, at))
    tools.assert_binomial(counts, TRIALS, exact)


def tree_with_wrong_flux(count, light, factor):
    """A tree that takes one light for brighter than it is."""
    mean, flux, axis, variance = random_lights(count)
    flux[light] *= factor
    return make_tree(mean, flux, axis, variance)


def test_planted_wrong_frequencies_are_found():
    """Samples of a tree with one flux 30 % too high do not follow the right probabilities.

    The light has about a twelfth of the probability, 3,200 of the samples, whose standard
    deviation is 54: the error is more than ten of these.
    """
    at, trials = RECEIVERS["below"], 2 * TRIALS
    right = probabilities(make_tree(*random_lights(200)), at)
    wrong = tree_with_wrong_flux(200, int(right.argmax()), 1.3)
    counts = selection_counts(draw(wrong, at, 1.0, trials), 200)
    with pytest.raises(AssertionError, match="chi-square"):
        tools.assert_frequencies(counts, right)
    with pytest.raises(AssertionError, match="frequencies differ"):
        tools.assert_binomial(counts, trials, right)


def test_expecting_very_many_candidates_gives_every_light():
    """Each light once, with probability one, for any number."""
    tree = make_tree(*random_lights(300))
    for at in RECEIVERS.values():
        if CERTAIN * probabilities(tree, at).min() < 1.001:
            continue
        for lights, p in draw(tree, at, CERTAIN, trials=20):
            assert sorted(lights) == list(range(300))
            assert set(p) == {1.0}


@every_receiver
def test_every_light_is_chosen_at_some_time(at):
    """Lights of an expected 16 or more selections: 300 of them are missed with 300 exp(-16)."""
    tree = make_tree(*random_lights(300))
    counts = selection_counts(draw(tree, at, 24.0, TRIALS), 300)
    often = TRIALS * np.minimum(1, 24 * probabilities(tree, at)) >= 16
    assert (counts[often] > 0).all()
    assert often.sum() >= 150


@every_receiver
@pytest.mark.parametrize("expected", [1.0, 7.5, 24.0])
def test_sum_over_candidates_is_unbiased(at, expected):
    """The mean of sum f / p is the sum of f over all lights, and 2 % more would be found."""
    tree = make_tree(*random_lights(300))
    values = random_values(probabilities(tree, at))
    sums, exact = horvitz_thompson(draw(tree, at, expected, TRIALS), values), exact_sums(values)
    tools.assert_same_mean(sums, exact)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(1.02 * sums, exact)


def test_sum_is_unbiased_at_a_light():
    """A light on which the receiver lies takes most of the probability and gives nothing.

    Values are limited to five times the probability, which bounds a candidate's share of the sum.
    """
    mean, flux, axis, variance = random_lights(300)
    tree = make_tree(mean, flux, axis, 0 * variance)
    at = receiver(mean[7])
    values = random_values(np.full(300, 1 / 300))
    values[:, 7] = 0
    values = np.minimum(values, 5 * probabilities(tree, at))
    tools.assert_same_mean(
        horvitz_thompson(draw(tree, at, 24.0, 2 * TRIALS), values), exact_sums(values)
    )


@every_extreme
def test_sum_is_unbiased_in_extreme_scenes(lights):
    """The same from the middle of each extreme scene."""
    tree = make_tree(*lights)
    at = receiver(lights[0].mean(axis=0) - (0, 0, 0.2), (0.1, 0.2, 1))
    values = random_values(probabilities(tree, at))
    tools.assert_same_mean(
        horvitz_thompson(draw(tree, at, 24.0, TRIALS), values), exact_sums(values)
    )


# ------------------------------------------------- splitting of nodes (talk, adaptive_splitting)

every_function = pytest.mark.parametrize("function", SPLIT_FUNCTIONS)


def splitting_probabilities(tree, at, rate, xi, function):
    """Probabilities given xi, in double precision."""
    p = tree.splitting_probabilities(**at, rate=rate, xi=xi, split_function=function)
    return np.array(p, float)


@every_function
@every_receiver
def test_splitting_frequencies_given_xi(at, function):
    """Below the cut that xi makes, each light is chosen as often as its probability says."""
    tree = make_tree(*random_lights(100))
    for xi in (0.02, 0.3, 0.9):
        exact = splitting_probabilities(tree, at, 1.0, xi, function)
        samples = draw_splitting(tree, at, 1.0, TRIALS // 4, function, xi)
        assert len({len(lights) for lights, _ in samples}) == 1
        counts = selection_counts(samples, 100)
        tools.assert_binomial(counts, TRIALS // 4, np.minimum(exact, 1))


@pytest.mark.parametrize("function", STOCHASTIC)
def test_planted_wrong_splitting_frequencies_are_found(function):
    """The probabilities of another xi do not describe the samples."""
    tree, at = make_tree(*random_lights(100)), RECEIVERS["below"]
    exact = splitting_probabilities(tree, at, 1.0, 0.3, function)
    counts = selection_counts(draw_splitting(tree, at, 1.0, TRIALS // 4, function, 0.02), 100)
    with pytest.raises(AssertionError, match="frequencies differ"):
        tools.assert_binomial(counts, TRIALS // 4, np.minimum(exact, 1))


def test_planted_wrong_frequencies_of_variance_are_found():
    """The probabilities of another rate do not describe the samples."""
    tree, at = make_tree(*random_lights(100)), RECEIVERS["below"]
    exact = splitting_probabilities(tree, at, 0.3, 0.5, "variance")
    counts = selection_counts(draw_splitting(tree, at, 1.0, TRIALS // 4, "variance"), 100)
    with pytest.raises(AssertionError, match="frequencies differ"):
        tools.assert_binomial(counts, TRIALS // 4, np.minimum(exact, 1))


@every_receiver
def test_splitting_by_variance_is_deterministic(at):
    """The cut does not depend on the random number, and is the same in other units."""
    lights = random_lights(300)
    exact = splitting_probabilities(make_tree(*lights), at, 1.0, 0.0, "variance")
    assert (splitting_probabilities(make_tree(*lights), at, 1.0, 0.9, "variance") == exact).all()
    mean, flux, axis, variance = lights
    larger = make_tree(8 * mean, 4 * flux, axis, 64 * variance)
    moved = {**at, "p": (8 * np.asarray(at["p"])).astype(np.float32)}
    np.testing.assert_allclose(
        splitting_probabilities(larger, moved, 1.0, 0.0, "variance"), exact, rtol=1e-4
    )


@every_function
@every_receiver
def test_splitting_sum_is_unbiased(at, function):
    """Over random xi the mean of sum f / p is the sum of f, and 2 % more would be found."""
    tree = make_tree(*random_lights(100))
    values = random_values(splitting_probabilities(tree, at, 0.0, 0.5, function))
    sums = horvitz_thompson(draw_splitting(tree, at, 1.0, TRIALS, function), values)
    tools.assert_same_mean(sums, exact_sums(values))
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(1.02 * sums, exact_sums(values))


@every_function
@every_receiver
@pytest.mark.parametrize("xi", [0.0, 0.5, 1 - 2.0**-24])
def test_splitting_without_splitting_gives_one_candidate(at, xi, function):
    """A splitting rate of zero is a single descent."""
    tree = make_tree(*random_lights(100))
    for lights, _ in draw_splitting(tree, at, 0.0, 20, function, xi):
        assert len(lights) == 1


@every_function
@pytest.mark.parametrize("rate", [HUGE_RATE, math.inf])
def test_splitting_with_infinite_rate_gives_every_light(rate, function):
    """Each light once, with probability one, whatever xi."""
    tree = make_tree(*random_lights(100))
    for at, xi in itertools.product(RECEIVERS.values(), (0.0, 0.5, 1 - 2.0**-24)):
        for lights, p in draw_splitting(tree, at, rate, 5, function, xi):
            assert sorted(lights) == list(range(100))
            assert set(p) == {1.0}


@every_function
@every_receiver
def test_splitting_splits_less_for_larger_xi(at, function):
    """A smaller xi, or a larger rate, cuts the tree at the same depth or further down."""
    tree = make_tree(*random_lights(300))

    def finer(rate, xi):
        return splitting_probabilities(tree, at, rate, xi, function)

    slack = 1 + 8 * 64 * EPSILON
    for xi in (0.01, 0.1, 0.4, 0.8):
        assert (finer(1, xi) * slack >= finer(1, xi + 0.1)).all()
        assert (finer(3, xi) * slack >= finer(1, xi)).all()
        assert finer(3, xi).sum() >= finer(1, xi).sum() * (1 - 1e-5)


def test_unknown_split_function_is_refused():
    """The message names those that exist."""
    tree = make_tree(*random_lights(5))
    with pytest.raises(ValueError, match='"near", "far" or "variance"'):
        draw_splitting(tree, RECEIVERS["below"], 1.0, 1, "middle")


# ----------------------------------------------------------------------------------------- builder


def test_builder_is_deterministic():
    """The same lights give the same bytes, alone and while other threads build."""
    lights = random_lights(10_000)
    first = make_tree(*lights).nodes
    assert len(first) % 96 == 0
    with ThreadPoolExecutor(2) as pool:
        trees = list(pool.map(lambda _: make_tree(*lights), range(4)))
    assert all(tree.nodes == first for tree in trees)


def test_order_of_the_lights_does_not_matter():
    """Shuffled lights have the same probabilities, but for the rounding of the nodes' sums."""
    lights = random_lights(1000)
    shuffle = np.random.default_rng(5).permutation(1000)
    tree, shuffled = make_tree(*lights), make_tree(*(field[shuffle] for field in lights))
    for at in (RECEIVERS["below"], RECEIVERS["inside, transmits"], RECEIVERS["far"]):
        np.testing.assert_allclose(
            probabilities(shuffled, at), probabilities(tree, at)[shuffle], rtol=1e3 * EPSILON
        )


@every_extreme
def test_shape_of_extreme_trees(lights):
    """Leaves are a permutation of the lights; nodes have two to four children."""
    tree, count = make_tree(*lights), len(lights[1])
    assert sorted(tree.order) == list(range(count))
    assert math.ceil((count - 1) / 3) <= tree.node_count <= count - 1
    assert len(tree.nodes) == 96 * tree.node_count


@every_extreme
def test_depth_is_bounded(lights):
    """Below a depth of 64 ranges are halved; four-wide nodes are never deeper than binary ones."""
    tree, count = make_tree(*lights), len(lights[1])
    assert math.ceil(math.log(count, 4)) <= tree.depth <= 64 + math.ceil(math.log2(count))


def test_coincident_lights_give_a_shallow_tree():
    """Where cost cannot decide ranges are halved, so 64 lights have at most six levels."""
    mean, flux = EXTREME["coincident"]
    tree = make_tree(mean, flux)
    assert tree.depth <= 6
    p = probabilities(tree, RECEIVERS["below"])
    np.testing.assert_allclose(p, 1 / 64, rtol=rounding(tree))


def test_single_light():
    """One light makes one node, and is always chosen."""
    tree = make_tree(*random_lights(1))
    assert (tree.depth, tree.node_count, list(tree.order)) == (1, 1, [0])
    for at in RECEIVERS.values():
        for lights, p in draw(tree, at, 1.0, 3):
            assert lights == [0]
            np.testing.assert_allclose(p, [1], rtol=rounding(tree))


def row_of_lights(flux):
    """Lights at equal distances on a line."""
    mean = np.zeros((len(flux), 3))
    mean[:, 0] = np.arange(len(flux))
    return make_tree(mean, flux)


def slots_of(tree):
    """The children of each node: leaves have the highest bit, empty slots are 0."""
    return np.frombuffer(tree.nodes, np.uint32).reshape(-1, 24)[:, 16:20]


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8, 9, 14, 15, 16])
def test_few_equal_lights_have_the_fewest_nodes(count):
    """On the fewest levels; with other numbers the halves of the binary tree do not fit."""
    tree = row_of_lights(np.ones(count))
    assert tree.node_count == math.ceil((count - 1) / 3)
    assert tree.depth == 1 + (count > 4)


def test_bright_lights_hang_high():
    """One of sixteen that outshines the others hangs at the root, wherever it is."""
    for bright in range(16):
        flux = np.ones(16)
        flux[bright] = 1e4
        tree = row_of_lights(flux)
        leaf = list(tree.order).index(bright) + 0x80000000
        assert leaf in slots_of(tree)[0]


def test_nodes_of_many_lights_are_full():
    """Nodes of small subtrees are few: two of five lights, where four of nine would be full."""
    assert make_tree(*random_lights(10000)).node_count < 0.42 * 10000


def test_lengths_must_agree():
    """Arrays of different lengths are refused."""
    mean, flux, axis, variance = random_lights(5)
    with pytest.raises(ValueError, match="same length"):
        make_tree(mean[:4], flux, axis, variance)

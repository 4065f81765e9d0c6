"""Selection of shadow rays and reservoirs: exact on small cases, statistical on larger ones.

Small cases are enumerated. A selection is piecewise constant in its offset, so one offset from
each piece gives its exact expectation; reservoirs make a finite number of random decisions, so
all of their outcomes and the outcomes' probabilities can be listed.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import statistics_tools as tools

core = pytest.importorskip(
    "manylights._core", reason="manylights._core was not built: it needs Python.h (python3-dev)"
)

EPSILON = float(np.finfo(np.float32).eps)


def single(values):
    """An array as the functions under test take it."""
    return np.ascontiguousarray(values, np.float32)


# ----------------------------------------------------------- threshold-systematic selection: exact


def threshold(targets, picks):
    """The tau with sum min(g, tau) = picks tau, or 0 if no more than `picks` are positive.

    Independent of the code under test: the number of items that are taken for sure is tried.
    """
    order = np.sort(targets[targets > 0])[::-1]
    if len(order) <= picks:
        return 0.0
    for sure in range(picks):
        tau = order[sure:].sum() / (picks - sure)
        if order[sure] < tau:
            return tau
    raise AssertionError("there is always a threshold")


def inclusion(targets, picks):
    """Probability with which each item should be selected."""
    tau = threshold(targets, picks)
    return np.where(targets > 0, np.minimum(1, targets / tau if tau > 0 else 1.0), 0.0)


def pieces(targets, picks):
    """Midpoints and lengths of the offsets' intervals within which the selection is the same."""
    tau = threshold(targets, picks)
    ends = np.cumsum(np.minimum(targets, tau)) / tau if tau > 0 else np.zeros(1)
    borders = np.unique(np.concatenate([[0, 1], ends % 1]))
    return (borders[1:] + borders[:-1]) / 2, np.diff(borders)


def selections(targets, picks):
    """For each piece: its length, and the weight of every item (0 where it is not selected).

    A piece that is narrower than the rounding of a sum over the items is left out.
    """
    narrow = rounding(targets, picks)
    result = []
    for offset, length in zip(*pieces(targets, picks)):
        if length <= 2 * narrow:
            continue
        items, weights = core.select(single(targets), picks, offset)
        assert len(set(items)) == len(items) <= picks
        row = np.zeros(len(targets))
        row[items] = weights
        result.append((length, row))
    lengths, weights = zip(*result)
    return np.array(lengths), np.array(weights)


def rounding(targets, picks):
    """Error of an end of an item in single precision, in steps: sums and products of `picks`."""
    return 2 * EPSILON * (len(targets) + 2) * picks


def assert_exact_selection(targets, picks):
    """Inclusion probabilities, weights, and the expectation of sum weight * value."""
    targets = single(targets).astype(float)
    lengths, weights = selections(targets, picks)
    # Each of the borders moves by the rounding, and pieces of twice that may be left out
    slack = 4 * (len(targets) + 2) * rounding(targets, picks)
    exact = inclusion(targets, picks)
    np.testing.assert_allclose(lengths @ (weights > 0), exact, atol=slack)
    expected_weight = np.broadcast_to(1 / np.maximum(exact, 1e-300), weights.shape)
    chosen = weights > 0
    np.testing.assert_allclose(
        weights[chosen], expected_weight[chosen], rtol=4 * EPSILON * len(targets)
    )
    # E[sum weight * value] = sum value: an item's error is that of its probability, times 1 / p
    means = lengths @ weights
    positive = targets > 0
    bound = slack / exact[positive] + 4 * EPSILON * len(targets)
    assert (np.abs(means[positive] - 1) <= bound).all()
    assert (means[~positive] == 0).all()


SMALL = {
    "equal": [1, 1, 1, 1, 1],
    "one large": [1, 2, 100, 1, 3],
    "two large": [50, 1, 2, 3, 400, 1],
    "large ones follow": [16, 8, 4, 2, 1, 1],
    "zeros between": [0, 3, 0, 0, 1, 2, 0, 5],
    "one positive": [0, 0, 2, 0],
    "one item": [7],
    "exactly at the threshold": [2, 1, 1],
}


@pytest.mark.parametrize("picks", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("targets", SMALL.values(), ids=SMALL)
def test_selection_is_exact(targets, picks):
    """All offsets of some small cases."""
    assert_exact_selection(targets, picks)


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(
    targets=st.lists(
        st.one_of(st.just(0.0), st.floats(1 / 64, 64, width=32)), min_size=1, max_size=12
    ),
    picks=st.integers(1, 12),
)
def test_selection_is_exact_for_random_targets(targets, picks):
    """All offsets of random cases."""
    assert_exact_selection(targets, picks)


def test_planted_wrong_selection_is_found(monkeypatch):
    """Weights that are 2 % too large, or offsets from [0, 1/2) only, do not pass."""
    select = core.select

    def heavier(targets, picks, offset):
        items, weights = select(targets, picks, offset)
        return items, [1.02 * weight for weight in weights]

    def halved(targets, picks, offset):
        return select(targets, picks, offset / 2)

    for wrong in (heavier, halved):
        monkeypatch.setattr(core, "select", wrong)
        with pytest.raises(AssertionError):
            assert_exact_selection(SMALL["two large"], 3)


@pytest.mark.parametrize("targets", SMALL.values(), ids=SMALL)
def test_all_are_taken_where_there_are_enough_picks(targets):
    """No more positive items than picks: each of them, with a weight of one, at any offset."""
    positive = [index for index, target in enumerate(targets) if target > 0]
    for picks in range(len(positive), len(positive) + 3):
        for offset in (0.0, 0.25, 0.5, 0.999):
            items, weights = core.select(single(targets), picks, offset)
            assert sorted(items) == positive
            np.testing.assert_allclose(weights, 1, rtol=4 * EPSILON * len(targets))


@pytest.mark.parametrize("picks", [1, 2, 4])
@pytest.mark.parametrize("count", [1, 5, 64])
def test_nothing_is_selected_from_zeros(count, picks):
    """Without a positive target there is nothing to choose."""
    assert core.select(np.zeros(count, np.float32), picks, 0.5) == ([], [])


@pytest.mark.parametrize("picks", [1, 2, 4, 8])
@pytest.mark.parametrize("seed", range(5))
def test_sum_of_weighted_targets_is_exact(seed, picks):
    """For the targets themselves every offset gives their sum, also over twelve decades."""
    generator = np.random.default_rng(seed)
    targets = single(10 ** generator.uniform(-12, 0, 64))
    total = targets.astype(float).sum()
    for offset in (np.arange(1000) + 0.5) / 1000:
        items, weights = core.select(targets, picks, offset)
        assert len(items) == picks
        found = np.dot(targets[items].astype(float), weights)
        # A sum of 64 numbers, divided by tau and multiplied with it again
        assert abs(found / total - 1) <= 64 * 2 * EPSILON


def test_select_refuses_too_many_targets():
    """Limits of the function, with a message."""
    for targets, picks in ((np.ones(65), 1), (np.ones(0), 1), (np.ones(3), 0)):
        with pytest.raises(ValueError, match="1 to 64"):
            core.select(single(targets), picks, 0.5)


# -------------------------------------------------------------------------- reservoirs: enumerated

GREEDY = pytest.mark.parametrize("greedy", [True, False], ids=["greedy", "random"])


def choices(totals, greedy):
    """Reservoirs that the next candidate may be dealt to, each with its probability."""
    if greedy:
        return [(min(range(len(totals)), key=lambda k: totals[k]), 1.0)]
    return [(k, 1 / len(totals)) for k in range(len(totals))]


def outcomes(importance, probability, reservoirs, greedy):
    """All states that dealing can end in: lists of (probability, held items, sums of weights)."""
    states = [(1.0, (None,) * reservoirs, (0.0,) * reservoirs)]
    for item, (h, p) in enumerate(zip(importance, probability)):
        following = []
        for chance, held, totals in states:
            for k, share in choices(totals, greedy):
                total = totals[k] + h / p
                new_totals = (*totals[:k], total, *totals[k + 1 :])
                replaced = (*held[:k], item, *held[k + 1 :])
                taken = h / p / total
                following.append((chance * share * taken, replaced, new_totals))
                following.append((chance * share * (1 - taken), held, new_totals))
        states = [state for state in following if state[0] > 0]
    return states


def outcome_key(held):
    """What `resample` returns of a state: the items, without the empty reservoirs."""
    return tuple(item for item in held if item is not None)


def distribution(importance, probability, reservoirs, greedy):
    """Probability of each result, by the items held."""
    result = {}
    for chance, held, _ in outcomes(importance, probability, reservoirs, greedy):
        result[outcome_key(held)] = result.get(outcome_key(held), 0.0) + chance
    return result


def small_case(count, seed=2):
    """Importances and probabilities of a few candidates."""
    generator = np.random.default_rng(seed)
    return single(10 ** generator.uniform(-1, 1, count)), single(generator.uniform(0.1, 1, count))


def results(importance, probability, reservoirs, greedy, seeds):
    """What the function under test returns for many seeds."""
    importance, probability = single(importance), single(probability)
    return [core.resample(importance, probability, reservoirs, greedy, seed) for seed in seeds]


TRIALS = 20_000


@GREEDY
@pytest.mark.parametrize("reservoirs", [1, 2, 3])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_held_items_follow_the_enumeration(count, reservoirs, greedy):
    """A chi-square test of the held items against the enumerated probabilities."""
    importance, probability = small_case(count)
    exact = distribution(importance.astype(float), probability.astype(float), reservoirs, greedy)
    assert_held_items(importance, probability, reservoirs, greedy, exact)


def assert_held_items(importance, probability, reservoirs, greedy, exact):
    """Count the results of many seeds."""
    keys = sorted(exact)
    counts = dict.fromkeys(keys, 0)
    for items, _ in results(importance, probability, reservoirs, greedy, range(TRIALS)):
        counts[tuple(items)] += 1
    tools.assert_frequencies([counts[key] for key in keys], [exact[key] for key in keys])


def test_planted_wrong_weights_of_items_are_found():
    """One importance 15 % too high: in a half of 20,000 samples, 7 % are ten standard errors."""
    importance, probability = small_case(3)
    wrong = importance.copy()
    wrong[np.argmax(importance / probability)] *= 1.15
    exact = distribution(wrong.astype(float), probability.astype(float), 1, True)
    with pytest.raises(AssertionError, match="chi-square"):
        assert_held_items(importance, probability, 1, True, exact)


@GREEDY
@pytest.mark.parametrize("reservoirs", [1, 2, 4])
def test_enumerated_expectation(reservoirs, greedy):
    """The mean of sum C f over all outcomes is sum f / p: exact, for arbitrary values f."""
    importance, probability = (field.astype(float) for field in small_case(5))
    values = np.random.default_rng(9).uniform(-1, 1, 5)
    mean = sum(
        chance * sum(w / importance[i] * values[i] for i, w in zip(held, totals) if i is not None)
        for chance, held, totals in outcomes(importance, probability, reservoirs, greedy)
    )
    assert math.isclose(mean, (values / probability).sum(), rel_tol=1e-12)


@GREEDY
@pytest.mark.parametrize("reservoirs", [1, 2, 4])
def test_contribution_weights_follow_the_enumeration(reservoirs, greedy):
    """Each result's items and C are those of one of the enumerated outcomes."""
    importance, probability = small_case(5)
    exact = set()
    for _, held, totals in outcomes(
        importance.astype(float), probability.astype(float), reservoirs, greedy
    ):
        weights = (total / float(importance[i]) for i, total in zip(held, totals) if i is not None)
        exact.add((outcome_key(held), tuple(f"{weight:.3e}" for weight in weights)))
    for items, weights in results(importance, probability, reservoirs, greedy, range(500)):
        assert (tuple(items), tuple(f"{weight:.3e}" for weight in weights)) in exact


@pytest.mark.parametrize("reservoirs", [1, 2, 8, 64])
def test_no_more_candidates_than_reservoirs(reservoirs):
    """All of them are kept, with C = 1 / p."""
    for count in {1, reservoirs // 2, reservoirs} - {0}:
        importance, probability = small_case(count, seed=count)
        for items, weights in results(importance, probability, reservoirs, True, range(10)):
            assert sorted(items) == list(range(count))
            np.testing.assert_allclose(weights, 1 / probability[items], rtol=4 * EPSILON)


# ------------------------------------------------------------------------- reservoirs: statistical


def many_candidates(count=60, seed=4, decades=1.5):
    """Candidates of systematic sampling: importance and probability are loosely related."""
    generator = np.random.default_rng(seed)
    probability = 10 ** generator.uniform(-decades, 0, count)
    return single(probability * generator.uniform(0.2, 1, count)), single(probability)


def random_values(importance, functions=4, seed=5):
    """Functions of the candidate, proportional to its importance but for 40 %."""
    generator = np.random.default_rng(seed)
    return importance * generator.uniform(0.6, 1.4, (functions, len(importance)))


def weighted_sums(samples, values):
    """The sums of C f, as images of one pixel."""
    sums = [(values[:, items] * np.asarray(weights)).sum(axis=1) for items, weights in samples]
    return np.array(sums)[:, np.newaxis, np.newaxis, :]


def exact_sums(values, probability):
    """What they should be on average: the sums of f / p."""
    return (values / probability.astype(float)).sum(axis=1)[np.newaxis, np.newaxis, np.newaxis, :]


@GREEDY
@pytest.mark.parametrize("reservoirs", [1, 4, 16, 64])
def test_sum_of_contributions_is_unbiased(reservoirs, greedy):
    """The mean of sum C f is sum f / p, and 2 % more would be found."""
    importance, probability = many_candidates()
    values = random_values(importance)
    samples = results(importance, probability, reservoirs, greedy, range(TRIALS))
    sums, exact = weighted_sums(samples, values), exact_sums(values, probability)
    tools.assert_same_mean(sums, exact)
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(1.02 * sums, exact)


def test_planted_wrong_contribution_weight_is_found():
    """With C = 1 / p, as if nothing had been resampled, the sum would be wrong."""
    importance, probability = many_candidates()
    values = random_values(importance)
    samples = [
        (items, 1 / probability[items])
        for items, _ in results(importance, probability, 16, True, range(TRIALS // 4))
    ]
    with pytest.raises(AssertionError, match="significance"):
        tools.assert_same_mean(weighted_sums(samples, values), exact_sums(values, probability))


@GREEDY
@pytest.mark.parametrize("reservoirs", [1, 4, 16])
def test_no_weight_is_lost(reservoirs, greedy):
    """For f = H every seed gives the exact sum, also over twelve decades."""
    generator = np.random.default_rng(6)
    importance, probability = single(10 ** generator.uniform(-12, 0, 60)), np.ones(60)
    total = importance.astype(float).sum()
    for items, weights in results(importance, probability, reservoirs, greedy, range(200)):
        assert len(set(items)) == len(items) <= reservoirs
        found = np.dot(importance[items].astype(float), weights)
        assert abs(found / total - 1) <= 60 * 2 * EPSILON


BAD = {
    "zero": (0.0, 0.5),
    "negative": (-1.0, 0.5),
    "not a number": (math.nan, 0.5),
    "infinite": (math.inf, 0.5),
    "impossible": (1.0, 0.0),
    "of unknown probability": (1.0, math.nan),
}


@GREEDY
@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
@pytest.mark.parametrize("place", [0, 3, 5])
def test_weights_that_are_not_positive_and_finite_are_ignored(place, bad, greedy):
    """Such a candidate is never held and changes no other candidate's weight."""
    importance, probability = small_case(5)
    importance_bad = np.insert(importance, place, bad[0])
    probability_bad = np.insert(probability, place, bad[1])
    total = (importance / probability).sum()
    for items, weights in results(importance_bad, probability_bad, 2, greedy, range(200)):
        assert place not in items
        assert math.isclose(np.dot(importance_bad[items], weights), total, rel_tol=20 * EPSILON)


@GREEDY
def test_nothing_is_held_without_candidates(greedy):
    """No candidates, and candidates of no importance."""
    for importance in ([], [0.0, 0.0, -1.0]):
        probability = np.ones(len(importance))
        assert results(importance, probability, 4, greedy, range(3)) == [([], [])] * 3


def test_greedy_dealing_is_less_noisy_than_random_dealing():
    """The variances differ by more than a factor of 1.2, which F tests of 20,000 samples see."""
    importance, probability = many_candidates()
    values = random_values(importance)
    variances = [
        weighted_sums(results(importance, probability, 16, greedy, range(TRIALS)), values).var(
            axis=0
        )
        for greedy in (True, False)
    ]
    assert (variances[1] > 1.2 * variances[0]).all()


def test_resample_refuses_bad_arguments():
    """Limits of the function, with a message."""
    for lengths, reservoirs in itertools.chain([((3, 2), 4)], [((3, 3), 0), ((3, 3), 65)]):
        with pytest.raises(ValueError, match="1 to 64"):
            core.resample(*(single(np.ones(n)) for n in lengths), reservoirs, True, 0)

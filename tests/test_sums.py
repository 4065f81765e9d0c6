"""Sums of passes: exact, so that order and grouping do not matter."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from manylights.rendering.sums import Sums


def raws(count, decades, seed=3, shape=(9, 11, 4)):
    """Films of passes: random numbers of both signs over so many powers of ten."""
    generator = np.random.default_rng(seed)
    exponents = generator.uniform(-decades / 2, decades / 2, (count, *shape))
    return (generator.standard_normal((count, *shape)) * 10**exponents).astype(np.float32)


def added(arrays):
    """The sums of arrays, in their order."""
    sums = Sums()
    for array in arrays:
        sums.add(array)
    return sums


@pytest.mark.parametrize("decades", [0, 6, 12])
def test_order_and_grouping_do_not_matter(decades):
    films = raws(4, decades)
    whole = added(films).parts.tobytes()
    for order in itertools.permutations(range(4)):
        ordered = films[list(order)]
        assert added(ordered).parts.tobytes() == whole
        for cut in range(1, 4):
            merged = added(ordered[:cut])
            merged.merge(added(ordered[cut:]))
            assert merged.parts.tobytes() == whole
    at_once = Sums()
    at_once.merge(*(added([film]) for film in films))
    assert at_once.parts.tobytes() == whole


def test_order_matters_in_single_precision():
    """What the test above finds where nothing is done about it."""
    films = raws(5, 6)
    assert sum(films).tobytes() != sum(films[::-1]).tobytes()


def test_sums_of_many_passes_are_exact():
    """From 1e-4 to 1e4: what is bright rounds what is dark away in single precision."""
    films = raws(300, 8, shape=(2, 2, 2))
    sums = added(films)
    assert sums.parts.dtype == np.float32
    for at in np.ndindex(2, 2, 2):
        exact = sum(Fraction(float(film[at])) for film in films)
        assert sum(Fraction(float(part[at])) for part in sums.parts) == exact
        assert sums.rounded[at] == np.float32(float(exact))


def test_bits_that_are_too_many_are_rounded_away():
    film = np.ones((1, 1, 1), np.float32)
    sums = added([film * 2.0**60, film * 2.0**-60])
    assert sums.parts.ravel().tolist() == [2.0**60, 2.0**-60, 0.0]
    sums.add(film)
    assert sums.parts.ravel().tolist() == [2.0**60, 1.0, 0.0]


def test_smallest_numbers_are_exact():
    film = np.array([[[1e-44]]], np.float32)
    assert added([film] * 5).rounded == 5 * film


def test_infinite_and_undefined_channels_stay_so():
    sums = Sums()
    for values in ([1.0, np.inf, 1.0, 3e38], [1.0, 2.0, np.nan, 3e38], [1.0, 2.0, 1.0, 3e38]):
        sums.add(np.array([[values]], np.float32))
    np.testing.assert_array_equal(sums.rounded, [[[3.0, np.inf, np.nan, np.inf]]])
    assert not sums.parts[1:].any()


def test_nothing_is_added_to_sums_by_empty_ones():
    sums = added(raws(2, 3))
    before = sums.parts.tobytes()
    sums.merge(Sums(), Sums())
    assert sums.parts.tobytes() == before

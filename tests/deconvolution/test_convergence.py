"""Changes still to come, and where an image changes most."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turbrestore.deconvolution.stopping import FEWEST, MOST, SPAN, TILE, relative_change, still_to_come, tile_sums


@given(st.floats(0.01, MOST / (1 + MOST)), st.floats(1e-9, 1e3), st.integers(FEWEST + 1, 40))
def test_the_rest_of_a_geometric_series_is_foreseen(ratio, first, count):
    changes = first * ratio ** np.arange(count)
    rest = first * ratio ** np.arange(count, count + 2000)
    assert still_to_come(changes) == pytest.approx(rest.sum(), rel=1e-6, abs=0)


@given(st.floats(MOST / (1 + MOST), 2), st.integers(FEWEST + 1, 40))
def test_no_more_is_foreseen_of_slow_or_growing_changes(ratio, count):
    changes = ratio ** np.arange(count)
    assert still_to_come(changes) == pytest.approx(MOST * changes[-1], rel=1e-9, abs=0)


@given(st.lists(st.floats(0.1, 1), min_size=FEWEST + 1, max_size=20), st.floats(1e-3, 1e3))
def test_only_the_last_changes_count_and_only_their_ratio(changes, scale):
    found = still_to_come(changes)
    assert still_to_come([scale * change for change in changes]) == pytest.approx(scale * found)
    if len(changes) > SPAN:
        assert still_to_come(changes[-1 - SPAN :]) == found


def test_as_much_is_foreseen_while_there_are_too_few_changes_to_tell():
    changes = [0.5**number for number in range(FEWEST + 1)]
    for count in range(1, FEWEST + 1):
        assert still_to_come(changes[:count]) == MOST * changes[count - 1]
    assert still_to_come(changes) == pytest.approx(changes[-1])


def test_what_stands_still_is_there():
    assert still_to_come([0.0]) == still_to_come([0.0] * 9) == still_to_come([1.0, 0.0]) == 0


def test_changes_that_differ_by_rounding_are_as_good_as_equal():
    assert still_to_come([1.0] * SPAN + [np.nextafter(1.0, 0.0)]) == pytest.approx(MOST)


def test_what_is_no_number_is_never_there():
    assert not still_to_come([1.0] * SPAN + [np.nan]) <= 1
    assert np.isnan(relative_change(np.array([np.nan, 0.0]), np.array([1.0, np.nan])))


@given(st.integers(1, 3 * TILE), st.integers(1, 3 * TILE), st.data())
def test_strips_add_up_to_the_sums_over_tiles(height, width, data):
    image = np.random.default_rng(height * width).random((height, width), np.float32)
    cuts = sorted({0, height, *data.draw(st.lists(st.integers(1, height), max_size=3))})
    sums = np.zeros((-(-height // TILE), -(-width // TILE)))
    for start, end in itertools.pairwise(cuts):
        found = tile_sums(image[start:end], start)
        sums[start // TILE : start // TILE + len(found)] += found
    expected = [
        [image[y : y + TILE, x : x + TILE].sum(dtype=np.float64) for x in range(0, width, TILE)]
        for y in range(0, height, TILE)
    ]
    np.testing.assert_allclose(sums, expected, rtol=1e-12)


def test_change_is_that_of_the_worst_tile_relative_to_the_brightest():
    moved, size = np.array([[0.04, 0.01], [0.0, 0.0]]), np.array([[0.0, 1.0], [4.0, 2.0]])
    assert relative_change(moved, size) == pytest.approx(0.1)
    assert relative_change(0 * moved, 0 * size) == 0
    assert relative_change(moved, 0 * size) == 1

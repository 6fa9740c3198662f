"""Changes still to come, and where an image changes most."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turbrestore.convergence import FEWEST, MOST, SPAN, TILE, relative_change, still_to_come, tile_sums


@given(st.floats(0.01, MOST / (1 + MOST)), st.floats(1e-9, 1e3), st.integers(FEWEST + 1, 40))
def test_the_rest_of_a_geometric_series_is_foreseen(ratio, first, count):
    changes = first * ratio ** np.arange(count)
    rest = first * ratio ** np.arange(count, count + 2000)
    assert still_to_come(changes) == pytest.approx(rest.sum(), rel=1e-6)


@given(st.floats(MOST / (1 + MOST), 2), st.integers(FEWEST + 1, 40))
def test_no_more_is_foreseen_of_slow_or_growing_changes(ratio, count):
    changes = ratio ** np.arange(count)
    assert still_to_come(changes) == pytest.approx(MOST * changes[-1])


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
    # What begins to move again may go on.
    assert still_to_come([0.0] * FEWEST + [1.0]) == MOST


@given(st.integers(1, 3 * TILE), st.integers(1, 3 * TILE), st.data())
def test_strips_add_up_to_the_sums_over_tiles(height, width, data):
    image = np.random.default_rng(height * width).random((height, width), np.float32)
    cuts = [0, *sorted(data.draw(st.lists(st.integers(0, height), max_size=3))), height]
    strips = [tile_sums(image[start:end], start, height) for start, end in itertools.pairwise(cuts)]
    expected = [
        [image[y : y + TILE, x : x + TILE].sum(dtype=np.float64) for x in range(0, width, TILE)]
        for y in range(0, height, TILE)
    ]
    np.testing.assert_allclose(sum(strips), expected, rtol=1e-12)


def test_change_is_that_of_the_worst_tile_relative_to_the_brightest():
    moved, size = np.array([[0.04, 0.01], [0.0, 0.0]]), np.array([[0.0, 1.0], [4.0, 2.0]])
    assert relative_change(moved, size) == pytest.approx(0.1)
    assert relative_change(0 * moved, 0 * size) == 0
    assert relative_change(moved, 0 * size) == 1

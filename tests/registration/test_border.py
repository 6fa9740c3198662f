"""Coverage of an image by frames that move, and the rectangle that is well seen."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.registration.coverage import coverage, well_seen


def shifts(displacements, height=40, width=50):
    return np.array([np.broadcast_to((dx, dy), (height, width, 2)) for dx, dy in displacements], np.float32)


def test_a_shift_to_the_left_uncovers_the_left_columns():
    seen = coverage(shifts([(-3, 0), (0, 0)]))
    assert np.allclose(seen[:, :3], 0.5)
    assert np.allclose(seen[:, 3:], 1)


@given(st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=6))
@settings(deadline=None)
def test_whole_shifts_leave_the_intersection_of_the_frames(displacements):
    x, y, width, height = well_seen(coverage(shifts(displacements)), least=1.0)
    dx, dy = np.array(displacements).T
    left, top = max(0, -dx.min()), max(0, -dy.min())
    right, bottom = 50 - max(0, dx.max()), 40 - max(0, dy.max())
    assert (x, y, x + width, y + height) == (left, top, right, bottom)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.0))
@settings(deadline=None)
def test_what_is_left_is_seen_well_enough_or_small(seed, least):
    seen = np.random.default_rng(seed).uniform(0.5, 1, (30, 34))
    x, y, width, height = well_seen(seen, least)
    assert 0 <= x < x + width <= 34
    assert 0 <= y < y + height <= 30
    view = seen[y : y + height, x : x + width]
    edges = np.concatenate([view[0], view[-1], view[:, 0], view[:, -1]])
    assert edges.min() >= least or (width, height) == (34, 30)


def test_where_hardly_anything_is_seen_nothing_is_trimmed():
    assert well_seen(np.zeros((64, 60))) == (0, 0, 60, 64)


def test_a_margin_never_leaves_less_than_the_smallest_side():
    assert well_seen(np.ones((20, 60)), margin=10) == (2, 2, 56, 16)

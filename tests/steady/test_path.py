"""The smooth path: what turbulence moves whole frames by is averaged out, and what the camera does is not."""

import numpy as np
import pytest

from turbrestore.steady.camera_path.path import LONGEST, _alikeness, smooth_motion

SHAPE = (120, 160)


def wander(count, correlation, rng):
    """Shifts of unit variance whose successive values are alike."""
    shifts = rng.standard_normal((count, 2))
    for number in range(1, count):
        shifts[number] = correlation * shifts[number - 1] + np.sqrt(1 - correlation**2) * shifts[number]
    return shifts


def steadied(shifts, velocity=0.0):
    """Where frames end up from where they are, each with the frames before it and some after it."""
    ends = []
    for number in range(LONGEST, len(shifts) - 12):
        known = [*range(number - LONGEST, number), *(number + later for later in (1, 3, 6, 9, 12))]
        path = {}
        for other in known:
            path[other - number] = np.zeros((2, 3))
            path[other - number][:, 2] = shifts[other] - shifts[number] + velocity * (other - number)
        ends.append(shifts[number] + smooth_motion(path, 1.4, SHAPE)[:, 2])
    return np.array(ends)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_residuals_that_are_alike_count_as_fewer(correlation):
    shifts = wander(4000, correlation, np.random.default_rng(0))
    left = np.zeros((len(shifts), 2, 3))
    left[..., 2] = shifts
    expected = np.sqrt((1 + correlation) / (1 - correlation))
    for every in (1, 2):
        times = np.arange(0, len(shifts), every)
        assert _alikeness(times, left[times].reshape(-1, 6)) == pytest.approx(expected, rel=0.1)


def test_slow_wander_of_whole_frames_is_averaged_over_the_longest_path():
    shifts = wander(160, 0.8, np.random.default_rng(1))
    means = np.array([shifts[max(number - LONGEST, 0) : number + 13].mean(0) for number in range(LONGEST, 148)])
    # A path that takes successive frames for independent leaves 0.21.
    assert np.sqrt(np.square(steadied(shifts) - means).mean()) < 0.18


def test_a_pan_through_slow_wander_is_followed():
    shifts = wander(160, 0.8, np.random.default_rng(2))
    assert np.abs((steadied(shifts, velocity=2.0) - shifts[LONGEST:-12]).mean(0)).max() < 0.2

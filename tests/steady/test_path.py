"""The smooth path: what turbulence moves whole frames by is averaged out, and what the camera does is not."""

import numpy as np
import pytest

from turbrestore.steady.camera_path.camera import camera_size
from turbrestore.steady.camera_path.path import LONGEST, _models, smooth_motion
from turbrestore.steady.displacement import camera_steadiness, displacement_sizes, likely_turbulence, whole_displacement
from turbrestore.steady.settings import SteadyParams

SHAPE = (120, 160)


def wander(count, correlation, rng):
    """Shifts of unit variance whose successive values are alike."""
    shifts = rng.standard_normal((count, 2))
    for number in range(1, count):
        shifts[number] = correlation * shifts[number - 1] + np.sqrt(1 - correlation**2) * shifts[number]
    return shifts


def steadied(shifts, velocity=0.0, numbers=None):
    """Where frames end up from where they are, each with the frames before it and some after it."""
    ends = []
    for number in range(LONGEST, len(shifts) - 12) if numbers is None else numbers:
        known = [*range(number - LONGEST, number), *(number + later for later in (1, 3, 6, 9, 12))]
        path = {}
        for other in known:
            path[other - number] = np.zeros((2, 3))
            path[other - number][:, 2] = shifts[other] - shifts[number] + velocity * (other - number)
        ends.append(shifts[number] + smooth_motion(path, 1.4, SHAPE)[:, 2])
    return np.array(ends)


def test_weights_and_evidence_are_those_of_a_gaussian_process_with_a_wide_prior_of_the_constant():
    times = (-9, -6, -3, -2, -1, 0, 1, 2, 5)
    models, time, wide = _models(times), np.array(times, float), 1e7
    y, number = np.random.default_rng(0).standard_normal(len(times)), 0
    cameras = [*((line, walk, None) for line, walk in ((0, 0), (5, 0), (5, 1e-6), (5, 1e-4), (5, 1e-2), (5, 1.0)))]
    cameras += [(5, 0, turn) for turn in range(-6, 7)]
    for correlated in (1.0, 3.0, 9.0):
        air = np.exp(-np.abs(time[:, None] - time) / correlated)
        for line, walk, turn in cameras:
            steps = np.linspace(0, 9, 9001)
            # An integrated random walk is the sum of its steps, each of which moves all that comes later.
            ahead = np.clip(np.abs(time)[:, None] - steps, 0, None)
            same_side = np.sign(time[:, None]) == np.sign(time)
            camera = line**2 * np.outer(time, time) + walk * same_side * (ahead @ ahead.T) * (steps[1] - steps[0])
            if turn is not None:
                later = np.where((time > turn) if turn >= 0 else (time < turn), np.abs(time - turn), 0)
                camera = camera + line**2 * np.outer(later, later)
            total = wide + camera + air
            assert models.here[number] @ y == pytest.approx(wide * np.linalg.solve(total, y).sum(), abs=1e-3)
            assert y @ models.left[number] @ y == pytest.approx(y @ np.linalg.solve(total, y), rel=1e-3)
            prior = -np.log(4 if walk else 1 if turn is None else 13)
            evidence = prior - (np.linalg.slogdet(total)[1] - np.log(wide)) / 2
            assert models.evidence[number] == pytest.approx(evidence, abs=1e-2)
            number += 1
    assert number == len(models.evidence) == 3 * len(cameras)


def test_slow_wander_of_whole_frames_is_averaged_over_the_longest_path():
    shifts = wander(160, 0.8, np.random.default_rng(1))
    means = np.array([shifts[max(number - LONGEST, 0) : number + 13].mean(0) for number in range(LONGEST, 148)])
    # A path that takes successive frames for independent leaves 0.21.
    assert np.sqrt(np.square(steadied(shifts) - means).mean()) < 0.18


def test_a_pan_through_slow_wander_is_followed():
    shifts = wander(160, 0.8, np.random.default_rng(2))
    assert np.abs((steadied(shifts, velocity=2.0) - shifts[LONGEST:-12]).mean(0)).max() < 0.2


def test_strong_air_moves_whole_frames_and_is_no_shake():
    rng = np.random.default_rng(3)
    path = {offset: np.zeros((2, 3)) for offset in (-12, -9, -6, -3, -1, 1, 3, 6, 9, 12)}
    for camera in path.values():
        camera[:, 2] = 1.5 * rng.standard_normal(2)
    flows = {offset: 2 * rng.standard_normal((40, 50, 2)).astype(np.float32) for offset in path}
    air = whole_displacement(displacement_sizes(flows)[0])
    assert air == pytest.approx(1.4 * np.sqrt(2 * np.log(2) * 4 / 2), rel=0.05)
    assert camera_steadiness(path, SHAPE, air) > 0.8
    assert camera_steadiness(path, SHAPE, 0.0) < 0.5
    shaken = {offset: 2.5 * camera for offset, camera in path.items()}
    assert camera_steadiness(shaken, SHAPE, air) < 0.1


PLACE = LONGEST + 10
TIMES = np.arange(PLACE + 20.0) - PLACE
TURNS = {
    "stops now": np.minimum(TIMES, 0),
    "stopped two frames ago": np.minimum(TIMES, -2),
    "starts in the next frame": np.maximum(TIMES, 1),
    "turns gradually": 0.04 * TIMES**2,
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_camera_that_turns_stays_where_it_is(turn):
    shifts = 2 * TURNS[turn][:, None] * [0.8, 0.6]
    assert np.abs(steadied(shifts, numbers=[PLACE]) - shifts[PLACE]).max() < 0.01


def test_a_stop_is_not_rounded_because_whole_frames_wander():
    rng, stop = np.random.default_rng(3), 2 * TURNS["stops now"][:, None] * [1, 0]
    wanders = [0.3 * wander(len(TIMES), 0.8, rng) for _ in range(200)]
    ends = np.concatenate([steadied(stop + one, numbers=[PLACE]) for one in wanders])
    # A parabola alone lies 1.2 pixels off.
    assert np.abs(ends.mean(0)).max() < 0.1


def test_a_camera_at_rest_loses_little_by_turns_that_are_possible():
    wanders = [wander(LONGEST + 72, 0.8, np.random.default_rng(seed)) for seed in range(8)]
    ends = np.concatenate([steadied(0.3 * one) for one in wanders])
    of_mean = 0.3 * np.sqrt((1 + 0.8) / (1 - 0.8) / (LONGEST + 13))
    assert np.sqrt(np.square(ends).mean()) < 1.3 * of_mean


@pytest.mark.parametrize("reach", [12, 20, 50, 58])
def test_all_neighbours_of_a_window_count(reach):
    # A static camera, whose frames turbulence moves: the mean over few frames.
    rng, ends = np.random.default_rng(5), []
    distances = SteadyParams(reach=reach).distances
    for _ in range(200):
        path = {offset: np.zeros((2, 3)) for one in distances for offset in (one, -one)}
        here = rng.standard_normal(2)
        for camera in path.values():
            camera[:, 2] = rng.standard_normal(2) - here
        ends.append(here + smooth_motion(path, 4.0, SHAPE)[:, 2])
    assert np.sqrt(np.square(ends).mean()) < 0.7


def test_displacements_that_grow_with_the_distance_in_time_are_no_turbulence():
    times = np.array([1, 3, 6, 9, 12])
    for correlated in (1.0, 9.0):
        alike, twice = np.exp(-times / correlated), np.exp(-2 * times / correlated)
        assert likely_turbulence(np.sqrt(1.5 + twice / 2 - 2 * alike).tolist()) > 0.95
    assert likely_turbulence((0.06 * times**1.5).tolist()) < 0.01


def coefficients(values):
    """Path whose six coefficients have these values (times, 2, 3), scaled to pixels, from the frame in the middle."""
    sizes = np.array([camera_size(np.outer([1, 0], unit), SHAPE) for unit in np.eye(3)])
    middle = len(values) // 2
    return {k - middle: (one - values[middle]) / sizes for k, one in enumerate(values) if k != middle}


def test_a_sway_in_a_pan_is_told_from_wander_by_the_correlation_time_of_the_other_coefficients():
    rng, times, ends = np.random.default_rng(0), np.arange(-48, 49), []
    for _ in range(60):
        values = rng.standard_normal((97, 2, 3))
        values[:, 0, 2] = 0.4 * values[:, 0, 2] + 0.8 * np.sin(times / 6 + rng.uniform(0, 6)) + 0.1 * times
        ends.append(values[48, 0, 2] + smooth_motion(coefficients(values), 4.0, SHAPE)[0, 2])
    # The sway has 0.57 pixels; alone, this coefficient keeps 0.18.
    assert np.std(ends) > 0.4


def test_a_camera_that_shakes_further_than_turbulence_is_left_as_it_is():
    values = 3 * np.random.default_rng(1).standard_normal((97, 2, 3))
    assert np.abs(smooth_motion(coefficients(values), 0.3, SHAPE)).max() < 0.01

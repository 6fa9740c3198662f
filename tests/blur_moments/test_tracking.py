"""Tracking of targets whose motion is known."""

import numpy as np
import pytest
from scipy.linalg import expm

from turbrestore.blur_moments.sensor import GaussianKernel, PixelGrid
from turbrestore.blur_moments.targets import ConstantVelocity, Oscillation, RandomWalk, lift_motion
from turbrestore.blur_moments.tracking import TrackParams, track_blur
from turbrestore.core.errors import ConfigurationError, DataError

STEPS = 16
SIGMA, LIGHT, NOISE = 1.2, 20.0, 0.05
FIELD = PixelGrid(-0.5, 63.5, 64)


def expose_plane(path, sigma, columns, rows):
    """Exposure operator of the plane for a round Gaussian: the image of a path (x, y), shape (..., N_e, 2)."""
    along_x, along_y = (
        GaussianKernel(sigma).response(grid.centres - path[..., axis, None], grid)
        for axis, grid in enumerate((columns, rows))
    )
    return np.swapaxes(along_y, -1, -2) @ along_x / path.shape[-2]


def times(count):
    """Middles of the fast steps, shape (count, STEPS)."""
    return (np.arange(count * STEPS) + 0.5).reshape(count, STEPS) / STEPS


def film(path, rng, exposed=STEPS, noise=NOISE):
    """Frames of a target on an even background."""
    frames = LIGHT * expose_plane(path[:, :exposed], SIGMA, FIELD, FIELD)
    return 0.1 + frames + rng.normal(0, noise, frames.shape)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_constant_velocity_is_recovered_and_beats_centroids():
    position, centroid, within = [], [], []
    for seed in range(6):
        path = np.array([10.0, 50.0]) + times(24)[..., None] * np.array([1.7, -1.3])
        frames = film(path, np.random.default_rng(seed))
        track = track_blur(frames, (3, 42, 16, 16), TrackParams(ConstantVelocity(1e-4), SIGMA))
        assert track.velocities[-1] == pytest.approx([1.7, -1.3], abs=0.05)
        assert track.total == pytest.approx(LIGHT, rel=0.05)
        assert track.noise == pytest.approx(NOISE, rel=0.05)
        assert track.background == pytest.approx(0.1, abs=0.005)
        position.append(track.positions[5:] - path[5:].mean(axis=1))
        centroid.append(track.centroids[5:] - path[5:].mean(axis=1))
        within.append(track.paths[5:] - path[5:])
    assert rms(position) < 0.6 * rms(centroid)
    assert rms(within) < 0.7 * rms(centroid)


def test_innovations_and_errors_are_as_large_as_the_filter_says():
    squared, errors = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        velocity = np.array([0.4, 0.3]) + np.cumsum(rng.normal(0, np.sqrt(0.005 / STEPS), (25 * STEPS, 2)), axis=0)
        path = 25 + (np.cumsum(velocity, axis=0) / STEPS).reshape(25, STEPS, 2)
        track = track_blur(film(path, rng), (17, 17, 16, 16), TrackParams(ConstantVelocity(0.005), SIGMA))
        squared += list(track.misfits[3:].ravel())
        errors += list(((track.positions - path.mean(axis=1)) ** 2 / track.position_variances)[3:].ravel())
    # 95 % bands for 2 and 1 degrees of freedom; the total is known to a percent only, which widens both a little.
    assert np.mean(squared) == pytest.approx(2, abs=2.5 * np.sqrt(4 / len(squared)) + 0.12)
    assert np.mean(errors) == pytest.approx(1, abs=2.5 * np.sqrt(2 / len(errors)) * 2)


@pytest.mark.parametrize("motion", [RandomWalk(0.3), ConstantVelocity(0.3), Oscillation(0.7, 0.2, 0.3, drift=0.1)])
def test_random_force_over_a_frame_is_that_of_many_small_steps(motion):
    params = TrackParams(motion, SIGMA, frame_period=0.8)
    lifted = lift_motion(motion, params.timing())
    A, intensity = motion.dynamics()
    cov, step = np.zeros_like(A), 0.8 / 4000
    F = np.eye(len(A)) + step * A
    for _ in range(4000):
        cov = F @ cov @ F.T + step * intensity
    assert pytest.approx(cov, rel=2e-3, abs=2e-4) == lifted.Q
    assert lifted.free[0] == pytest.approx(expm(A * 0.8 / STEPS / 2)[0])


def test_a_clean_film_is_followed_exactly():
    path = np.array([10.0, 50.0]) + times(12)[..., None] * np.array([1.7, -1.3])
    frames = film(path, np.random.default_rng(0), noise=1e-4)
    track = track_blur(frames, (1, 41, 20, 20), TrackParams(ConstantVelocity(1e-4), SIGMA))
    assert np.abs(track.paths[5:] - path[5:]).max() < 0.01


def test_the_window_keeps_up_with_a_fast_target():
    path = 8 + times(9)[..., None] * np.array([6.0, 5.0])
    frames = film(path, np.random.default_rng(0), exposed=4)
    params = TrackParams(ConstantVelocity(1e-3), SIGMA, exposure=0.25)
    track = track_blur(frames, (2, 2, 12, 12), params)
    assert track.velocities[-1] == pytest.approx([6.0, 5.0], abs=0.1)


def vibration(frequency, count):
    phase = 2 * np.pi * frequency * times(count)
    return np.stack([32 + 3 * np.sin(phase), 30 + 2 * np.sin(phase + 1)], axis=-1)


@pytest.mark.parametrize("frequency", [0.13, 0.7])
def test_frequency_is_found_also_above_half_the_frame_rate(frequency):
    path = vibration(frequency, 16)
    frames = film(path, np.random.default_rng(0))
    params = TrackParams(Oscillation(0.1, 0.0, 1e-3, highest=0.9), SIGMA)
    track = track_blur(frames, (22, 20, 20, 20), params)
    assert track.frequency == pytest.approx(frequency, abs=0.005)
    assert rms(track.positions[8:] - path[8:].mean(axis=1)) < 0.6 * rms(track.centroids[8:] - path[8:].mean(axis=1))
    assert rms(track.paths[8:] - path[8:]) < 0.3 * rms(track.centroids[8:, None] - path[8:])


def test_centroids_alone_take_a_fast_vibration_for_a_slow_one():
    """An alias fits the centroids as well; how far the target moves within an exposure is not in them."""
    frames = film(vibration(0.7, 32), np.random.default_rng(0))
    likelihoods = {
        (order, frequency): track_blur(
            frames, (22, 20, 20, 20), TrackParams(Oscillation(frequency, 0.0, 1e-3), SIGMA, order=order)
        ).log_likelihood
        for order in (1, 2)
        for frequency in (0.3, 0.7)
    }
    assert abs(likelihoods[1, 0.7] - likelihoods[1, 0.3]) < 10
    assert likelihoods[2, 0.7] > likelihoods[2, 0.3] + 100


def test_random_walk_is_followed_better_than_by_centroids():
    position, centroid = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        path = 32 + np.cumsum(rng.normal(0, np.sqrt(0.05 / STEPS), (40 * STEPS, 2)), axis=0).reshape(40, STEPS, 2)
        track = track_blur(film(path, rng), (24, 24, 16, 16), TrackParams(RandomWalk(0.05), SIGMA))
        position.append(track.positions[3:] - path[3:].mean(axis=1))
        centroid.append(track.centroids[3:] - path[3:].mean(axis=1))
    assert rms(position) < 0.95 * rms(centroid)
    assert np.isnan(track.velocities).all()


def test_shutter_and_seconds():
    """The same motion seen with half the exposure and timed in seconds."""
    path = 15 + 1.2 * times(16)[..., None] * np.ones(2)
    frames = film(path, np.random.default_rng(0), exposed=STEPS // 2)
    params = TrackParams(ConstantVelocity(1.0), SIGMA, exposure=0.5, frame_period=0.04)
    track = track_blur(frames, (8, 8, 16, 16), params)
    assert track.velocities[-1] == pytest.approx([30.0, 30.0], rel=0.05)
    assert track.positions[-1] == pytest.approx(path[-1, : STEPS // 2].mean(axis=0), abs=0.25)
    assert track.paths[-1, -1] == pytest.approx(path[-1, -1], abs=0.3)


def test_streak_shows_in_the_second_moments():
    path = np.array([10.0, 50.0]) + times(10)[..., None] * np.array([3.0, -3.0])
    frames = film(path, np.random.default_rng(0), noise=0.002)
    track = track_blur(frames, (2, 40, 20, 20), TrackParams(ConstantVelocity(1e-3), SIGMA))
    still, moved = SIGMA**2 + 1 / 12, 9 / 12 * (1 - 1 / STEPS**2)
    expected = still * np.eye(2) + moved * np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert track.spreads.mean(axis=0) == pytest.approx(expected, abs=0.05)


def test_colour_is_tracked_by_luminance():
    path = 15 + 1.0 * times(6)[..., None] * np.ones(2)
    frames = film(path, np.random.default_rng(0)).astype(np.float32)
    params = TrackParams(ConstantVelocity(1e-3), SIGMA)
    grey, colour = (track_blur(f, (8, 8, 16, 16), params) for f in (frames, np.stack([frames] * 3, axis=-1)))
    assert colour.positions == pytest.approx(grey.positions, abs=1e-4)


def test_bad_input_is_named():
    path = 15 + 1.0 * times(4)[..., None] * np.ones(2)
    frames, params = film(path, np.random.default_rng(0)), TrackParams(ConstantVelocity(1e-3), SIGMA)
    with pytest.raises(DataError, match="at least 2 frames"):
        track_blur(frames[:1], (8, 8, 16, 16), params)
    with pytest.raises(ConfigurationError, match="roi"):
        track_blur(frames, (60, 8, 16, 16), params)
    with pytest.raises(ConfigurationError, match="7 pixels"):
        track_blur(frames, (8, 8, 4, 16), params)
    dark = frames.copy()
    dark[2] = 0.1
    with pytest.raises(DataError, match="frame 2"):
        track_blur(dark, (8, 8, 16, 16), params)
    with pytest.raises(ConfigurationError, match="observable"):
        track_blur(frames, (8, 8, 16, 16), TrackParams(Oscillation(0.5, 0.0, 1e-3), SIGMA))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: RandomWalk(0.0), "diffusion"),
        (lambda: ConstantVelocity(np.nan), "acceleration"),
        (lambda: Oscillation(1.0, 1.0, 0.1), "damping"),
        (lambda: Oscillation(1.0, 0.1, 0.1, highest=0.5), "highest"),
        (lambda: TrackParams(RandomWalk(1.0), -1.0), "sigma"),
        (lambda: TrackParams(RandomWalk(1.0), 1.0, order=3), "order"),
        (lambda: TrackParams(RandomWalk(1.0), 1.0, exposure=0.51), "exposure"),
    ],
)
def test_settings_are_checked(make, named):
    with pytest.raises(ConfigurationError, match=named):
        make()

"""Tracking of targets whose motion is known, and the 2-D filter against 1-D ones and against sampling."""

import numpy as np
import pytest
from scipy.linalg import expm

from turbrestore.blur_moments.moments import BlurModel, predicted_moments
from turbrestore.blur_moments.sensor import ExposureTiming, GaussianKernel, LineSensor, PixelGrid
from turbrestore.blur_moments.state_estimation.lifting import FastSystem, lift
from turbrestore.blur_moments.state_estimation.observers import MomentFilter, run_observer
from turbrestore.blur_moments.targets import (
    ConstantVelocity,
    Oscillation,
    PlaneModel,
    PlaneMomentFilter,
    RandomWalk,
    lift_motion,
)
from turbrestore.blur_moments.tracking import TrackParams, track_blur
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.filtering.kalman import Gaussian

STEPS = 16
SIGMA, LIGHT, NOISE = 1.2, 20.0, 0.05
FIELD = PixelGrid(-0.5, 63.5, 64)
TIMING = ExposureTiming(fast_period=1 / STEPS, exposure=0.75, readout=0.0, frame_period=1.0)


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


def plane_model(noise=0.01, size=(24, 20)):
    """A target with velocity along x, another along y, in the middle of a window."""
    h = TIMING.fast_period
    fast = FastSystem([[1.0, h], [0.0, 0.98]], [0.0, 0.0], [1.0, h / 2])
    motion = lift(fast, TIMING, np.diag([1e-4, 1e-3]))
    columns, rows = (PixelGrid(-n / 2, n / 2, n) for n in size)
    return PlaneModel(motion, 1.2, columns, rows, noise, total=2.0)


def line_models(model):
    """What the sums over rows and over columns show: the noise of a sum over n pixels has n times the density."""
    for grid, other in ((model.columns, model.rows), (model.rows, model.columns)):
        line = LineSensor(GaussianKernel(model.sigma), grid, model.noise * other.count * other.width, model.total)
        yield BlurModel(model.axis, line)


def test_separable_motion_in_the_plane_equals_two_runs_on_lines():
    rng, model = np.random.default_rng(0), plane_model()
    frames = rng.normal(0.01, 0.1, (5, 20, 24))
    cov = np.diag([1.0, 4.0])
    start = Gaussian(np.array([0.5, 1.0, -1.0, 0.3]), np.kron(np.eye(2), cov))
    inputs = np.zeros((5, STEPS))
    plane, state = [], start
    for frame in frames:
        plane.append(PlaneMomentFilter(order=1).step(model, state, frame))
        state = model.advance(plane[-1][0])
    for axis, line in enumerate(line_models(model)):
        part = slice(2 * axis, 2 * axis + 2)
        sums = frames.sum(axis=1 + axis)
        alone = run_observer(MomentFilter((1,)), line, Gaussian(start.mean[part], cov), sums, inputs)
        for (both, _), (one, _) in zip(plane, alone, strict=True):
            assert both.mean[part] == pytest.approx(one.mean, abs=1e-12)
            assert both.cov[part, part] == pytest.approx(one.cov, abs=1e-12)


@pytest.mark.parametrize("basis", ["monomial", "legendre"])
def test_moments_along_an_axis_are_those_of_a_line(basis):
    model = plane_model()
    state = Gaussian(np.array([0.5, 1.0, -1.0, 0.3]), np.zeros((4, 4)))
    mean, H, spread = PlaneMomentFilter(2, basis).predicted(model, state)
    assert np.abs(spread).max() == 0
    for axis, line in enumerate(line_models(model)):
        part = slice(2 * axis, 2 * axis + 2)
        expected, slope, _ = predicted_moments(line, state.mean[part], np.zeros(STEPS), (1, 2), basis)
        chosen = [0, 2] if axis == 0 else [1, 4]
        assert mean[chosen] == pytest.approx(expected, abs=1e-12)
        assert H[chosen, part] == pytest.approx(slope, abs=1e-12)


@pytest.mark.parametrize("basis", ["monomial", "legendre"])
def test_mean_and_covariance_of_the_moments_are_exact(basis):
    """Against sampling; without the curvature the mean of the second moments would be off by up to P."""
    rng, model, observer = np.random.default_rng(0), plane_model(), PlaneMomentFilter(2, basis)
    root = rng.normal(0, 1, (4, 4))
    state = Gaussian(np.array([0.5, 1.0, -1.0, 0.3]), root @ root.T)
    mean, H, spread = observer.predicted(model, state)
    draws = state.mean + rng.normal(0, 1, (3000, 4)) @ root.T
    seen = np.stack([observer.predicted(model, Gaussian(draw, np.zeros((4, 4))))[0] for draw in draws])
    cov = H @ state.cov @ H.T + spread
    error = np.sqrt(np.diagonal(cov))
    assert np.abs((seen.mean(axis=0) - mean) / error).max() < 4 / np.sqrt(3000)
    assert np.abs((np.cov(seen.T) - cov) / np.outer(error, error)).max() < 0.15


def test_moments_of_a_rendered_frame_are_predicted():
    model, observer = plane_model(noise=1e-6), PlaneMomentFilter()
    state = Gaussian(np.array([0.5, 2.0, -1.0, 1.0]), np.zeros((4, 4)))
    path = np.einsum("san,n->sa", model.outputs(TIMING.exposure_steps), state.mean)
    frame = 2.0 * expose_plane(path, 1.2, model.columns, model.rows)
    _, innovation = observer.step(model, state, frame)
    assert innovation.values == pytest.approx(np.zeros(5), abs=1e-4)


def test_noise_of_the_moments_is_that_of_sampled_frames():
    rng, model, observer = np.random.default_rng(0), plane_model(noise=0.04), PlaneMomentFilter()
    still = Gaussian(np.zeros(4), np.zeros((4, 4)))
    draws = [observer.step(model, still, rng.normal(0, 0.2, (20, 24)))[1] for _ in range(1500)]
    cov = draws[0].cov
    error = np.sqrt(np.diagonal(cov))
    sampled = np.cov(np.stack([draw.values for draw in draws]).T)
    assert np.abs((sampled - cov) / np.outer(error, error)).max() < 0.15


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
        squared += [innovation.normalised_squared for innovation in track.innovations[3:]]
        away = (track.positions - path.mean(axis=1))[3:]
        errors += [e @ np.linalg.solve(P, e) for e, P in zip(away, track.position_cov[3:], strict=True)]
    # 95 % bands for 5 and 2 degrees of freedom; the total is known to a percent only, which widens both a little.
    assert np.mean(squared) == pytest.approx(5, abs=2.5 * np.sqrt(10 / len(squared)) + 0.3)
    assert np.mean(errors) == pytest.approx(2, abs=2.5 * np.sqrt(4 / len(errors)) * 2)


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
    path = vibration(frequency, 32)
    frames = film(path, np.random.default_rng(0))
    params = TrackParams(Oscillation(0.1, 0.0, 1e-3, highest=0.9), SIGMA)
    track = track_blur(frames, (22, 20, 20, 20), params)
    assert track.frequency == pytest.approx(frequency, abs=0.003)
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
    with pytest.raises(DataError, match="frame"):
        PlaneMomentFilter().step(plane_model(), Gaussian(np.zeros(4), np.eye(4)), np.zeros((20, 23)))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: RandomWalk(0.0), "diffusion"),
        (lambda: ConstantVelocity(np.nan), "acceleration"),
        (lambda: Oscillation(1.0, 1.0, 0.1), "damping"),
        (lambda: Oscillation(1.0, 0.1, 0.1, highest=0.5), "highest"),
        (lambda: TrackParams(RandomWalk(1.0), -1.0), "sigma"),
        (lambda: TrackParams(RandomWalk(1.0), 1.0, order=3), "order"),
        (lambda: TrackParams(RandomWalk(1.0), 1.0, basis="cosine"), "basis"),
        (lambda: TrackParams(RandomWalk(1.0), 1.0, exposure=0.51), "exposure"),
        (lambda: PlaneMomentFilter(order=0), "order"),
        (lambda: plane_model(noise=0.0), "noise"),
    ],
)
def test_settings_are_checked(make, named):
    with pytest.raises(ConfigurationError, match=named):
        make()

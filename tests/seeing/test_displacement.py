"""Displacement of blocks against known motion, and its statistics against simulated processes."""

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.seeing.displacement import (
    Displacement,
    block_displacement,
    block_means,
    motion_statistics,
    rotation_share,
    separation_correlation,
)
from turbrestore.seeing.strength import chi_square_interval
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows


def test_blocks_recover_what_a_smooth_flow_has_lost():
    # Optics blur every real image; differences of a sharper one are too small.
    chart, rng = cv2.GaussianBlur(resolution_chart(96, 96), (0, 0), 1.5), np.random.default_rng(0)
    true = smooth_flows(8, 96, 96, rng, SmoothFlowParams(rms=1.0))
    true -= true.mean(axis=0)
    frames = [warp(chart, invert_flow(flow)) for flow in true]
    found = block_displacement(frames, 0.7 * true, chart, 0.0)
    wanted = np.array([np.stack([block_means(flow[..., axis], 12) for axis in range(2)], axis=-1) for flow in true])
    measured, wanted = found.blocks[:, found.counts], (wanted - wanted.mean(axis=0))[:, found.counts]
    assert found.counts.mean() > 0.5
    assert np.sum(measured * wanted) / np.sum(wanted**2) == pytest.approx(1.0, abs=0.08)


def test_a_flat_image_has_no_displacement():
    still = np.zeros((4, 48, 48, 2), np.float32)
    found = block_displacement(
        list(np.full((4, 48, 48), 0.5, np.float32)), still, np.full((48, 48), 0.5, np.float32), 0
    )
    assert found.counts.sum() < 4
    with pytest.raises(DataError, match="at least 3"):
        block_displacement([still[0, ..., 0]] * 2, still[:2], still[0, ..., 0], 0.0)


def correlated(rng, frames, blocks, rho, spread=1.0):
    """Stationary first-order process with blocks that share half of their motion."""
    noise = np.sqrt(0.5) * (rng.normal(size=(frames, 1, 2)) + rng.normal(size=(frames, blocks, 2)))
    w = np.empty_like(noise)
    w[0] = noise[0]
    for t in range(1, frames):
        w[t] = rho * w[t - 1] + np.sqrt(1 - rho**2) * noise[t]
    return spread * (w - w.mean(axis=0))


@pytest.mark.parametrize("seed", range(6))
def test_motion_that_is_new_in_every_frame_is_coherent_for_less_than_one(seed):
    found = motion_statistics(correlated(np.random.default_rng(seed), 24, 12, 0.0), 0.0)
    assert found.autocorrelation.min() < np.exp(-1)
    assert found.independent_frames > 12


def test_variance_of_correlated_motion_is_unbiased_and_inside_its_interval():
    rng, inside, values = np.random.default_rng(1), 0, []
    for _ in range(200):
        found = motion_statistics(correlated(rng, 60, 12, 0.7), 0.0)
        interval = chi_square_interval(float(found.variance.mean()), found.freedom)
        inside += interval.low <= 1.0 <= interval.high
        values.append(interval.value)
    assert np.mean(values) == pytest.approx(1.0, abs=0.05)
    assert 0.88 <= inside / 200 <= 0.99


def test_noise_is_taken_out_and_never_more_than_there_is():
    w = correlated(np.random.default_rng(2), 2000, 6, 0.5)
    assert motion_statistics(w, 0.4).variance.mean() == pytest.approx(motion_statistics(w, 0.0).variance.mean() - 0.4)
    assert (motion_statistics(w, 9.0).variance > 0).all()


@pytest.mark.parametrize(("noise", "least"), [(0.01, 0.85), (0.06, 0.3)])
def test_noise_adds_at_most_what_is_taken_out(noise, least):
    chart, rng = cv2.GaussianBlur(resolution_chart(96, 96), (0, 0), 1.5), np.random.default_rng(5)
    flows = np.zeros((40, 96, 96, 2), np.float32) + rng.normal(size=(40, 1, 1, 2)).astype(np.float32)
    frames = [warp(chart, -flow) for flow in flows]
    noisy = [frame + noise * rng.standard_normal(frame.shape, np.float32) for frame in frames]
    clean, found = (block_displacement(clip, flows, chart, noise) for clip in (frames, noisy))
    assert found.counts.sum() >= 4
    added = np.mean((found.blocks - clean.blocks)[:, found.counts] ** 2)
    assert least * found.noise_variance < added < 1.1 * found.noise_variance


def test_gradients_do_not_rotate():
    y, x = np.mgrid[:9, :9] / 3.0
    rng = np.random.default_rng(3)
    phases = rng.normal(size=(40, 4))
    gradient = np.stack(
        [np.stack([a * np.cos(x + b) * np.cos(y), -a * np.sin(x + b) * np.sin(y)], -1) for a, b, _, _ in phases]
    )
    every = np.ones((9, 9), bool)
    assert rotation_share(Displacement(gradient, every, 8, 8.0, 0.0)) < 0.02
    rotating = np.stack([-gradient[..., 1], gradient[..., 0]], -1)
    assert rotation_share(Displacement(rotating, every, 8, 8.0, 0.0)) > 0.98
    assert np.isnan(rotation_share(Displacement(gradient, ~every, 8, 8.0, 0.0)))


def test_correlation_falls_with_separation():
    w = np.repeat(np.random.default_rng(4).normal(size=(300, 1, 8, 2)), 8, axis=1)
    found = separation_correlation(Displacement(w, np.ones((8, 8), bool), 8, 8.0, 0.0))
    # Blocks of a column move alike, those of a row do not.
    np.testing.assert_allclose(found[1:4], 0.5, atol=0.06)

"""Blur of frames against scenes whose blur is known, together and one by one."""

import cv2
import numpy as np
import pytest

from conftest import SCENES, blurred, moving_blur
from turbrestore.blur_moments.frame_blur import frame_blur
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.registration.warp import warp
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows


def tile_means(maps, grid):
    centres = grid.rows + grid.size[0] // 2, grid.columns + grid.size[1] // 2
    smooth = np.stack([cv2.GaussianBlur(m, (0, 0), 11) for m in maps])
    return smooth[:, centres[0]][:, :, centres[1]]


@pytest.mark.parametrize(("rms", "registered", "least"), [(0.0, False, 0.95), (1.5, True, 0.95), (1.5, False, 0.92)])
def test_frame_blur_follows_the_truth(rms, registered, least):
    for scene in SCENES.values():
        rng, image = np.random.default_rng(0), scene(144)
        frames, variance = moving_blur(image, 40, rng, noise=0.0)
        flows = smooth_flows(40, 144, 144, rng, SmoothFlowParams(rms=rms))
        frames = [distort(frame, flow[None], rng, noise=0.01)[0] for frame, flow in zip(frames, flows, strict=True)]
        if registered:
            frames = [warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)]
        found = frame_blur(np.stack(frames), 0.01)
        true = tile_means(variance, found.grid)
        true = true - true.mean(axis=0)
        seen = np.broadcast_to(np.median(found.deviation, axis=0) < 0.4, true.shape)
        assert seen.mean() > 0.8
        assert np.corrcoef(true[seen], found.relative[seen])[0, 1] > least
        assert np.polyfit(true[seen], found.relative[seen], 1)[0] == pytest.approx(1, abs=0.15)


def test_deviation_of_frame_blur_is_honest():
    errors = []
    for seed, scene in enumerate(2 * list(SCENES.values())):
        rng = np.random.default_rng(seed)
        image, sigma = scene(144), rng.uniform(0.8, 2.0, 30)
        found = frame_blur(np.stack([blurred(image, s, rng) for s in sigma]), 0.01)
        true = (sigma**2 - np.mean(sigma**2))[:, None, None]
        errors.append(((found.relative - true) / found.deviation).ravel())
    assert 0.6 < np.mean(np.concatenate(errors) ** 2) < 1.6


def test_frame_blur_of_equal_frames_draws_to_nothing():
    rng = np.random.default_rng(0)
    found = frame_blur(np.stack([blurred(SCENES["camera"](96), 1.0, rng) for _ in range(20)]), 0.01)
    assert found.relative.mean(axis=0) == pytest.approx(0, abs=1e-5)
    assert np.median(found.extra) < 0.05
    assert (found.extra >= 0).all()


def test_noise_alone_makes_no_frame_sharper():
    noise = np.random.default_rng(0).normal(0.5, 0.05, (20, 96, 96)).astype(np.float32)
    found = frame_blur(noise, 0.05)
    assert np.ptp(found.relative) > 0.3
    assert np.quantile(found.extra, 0.9) < 0.05


def test_batches_of_tiles_give_the_result_of_all_together(varied, monkeypatch):
    _, frames, _ = varied
    whole = frame_blur(frames, 0.01)
    # Three tiles of forty frames.
    monkeypatch.setattr("turbrestore.blur_moments.frame_blur._FITTED", 120)
    parts = frame_blur(frames, 0.01)
    for name in ("relative", "deviation", "extra"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), rel=1e-6, abs=1e-9), name


@pytest.mark.parametrize("shape", [(16, 16), (20, 100), (50, 49)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_frames_without_content_say_nothing_and_break_nothing(shape, noise):
    blur = frame_blur(np.full((3, *shape), 0.5, np.float32), noise)
    assert blur.extra.max() == 0
    assert blur.deviation == pytest.approx(np.full_like(blur.deviation, 2), abs=1e-3)


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    with pytest.raises(DataError, match="at least 2 frames"):
        frame_blur(image[None], 0.01)
    with pytest.raises(ConfigurationError, match="noise"):
        frame_blur(np.stack([image, image]), np.nan)

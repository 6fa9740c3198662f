"""Blur of frames against scenes whose blur is known, together and one by one."""

import cv2
import numpy as np
import pytest

from conftest import SCENES, blurred, moving_blur
from turbrestore.blur_moments.frame_blur import frame_blur, prepare_blur_reference, relative_frame_blur
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
    whole = prepare_blur_reference(frames, 0.01)
    against = relative_frame_blur(frames, whole[0], 0.02)
    # Three tiles of forty frames.
    monkeypatch.setattr("turbrestore.blur_moments.frame_blur._FITTED", 120)
    parts = prepare_blur_reference(frames, 0.01)
    for one, other in zip((*whole, against), (*parts, relative_frame_blur(frames, parts[0], 0.02)), strict=True):
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray):
                assert getattr(other, name) == pytest.approx(value, rel=1e-6, abs=1e-9), name


@pytest.mark.parametrize("shape", [(16, 16), (20, 100), (50, 49)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_frames_without_content_say_nothing_and_break_nothing(shape, noise):
    blur = frame_blur(np.full((3, *shape), 0.5, np.float32), noise)
    assert blur.extra.max() == 0
    assert blur.deviation == pytest.approx(np.full_like(blur.deviation, 2), abs=1e-3)


def test_frames_one_by_one_give_the_result_of_all_together(varied):
    _, frames, _ = varied
    reference, together = prepare_blur_reference(frames, 0.01)
    assert (together.extra == frame_blur(frames, 0.01).extra).all()
    for index in (0, 7, 39):
        alone = relative_frame_blur(frames[index : index + 1], reference)
        for name in ("relative", "deviation", "extra"):
            assert getattr(alone, name)[0] == pytest.approx(getattr(together, name)[index], abs=1e-5)


@pytest.mark.parametrize("scene", SCENES)
def test_blur_of_frames_that_the_reference_does_not_contain(scene):
    image, rng = SCENES[scene](144), np.random.default_rng(0)
    reference, _ = prepare_blur_reference(np.stack([blurred(image, sigma, rng) for sigma in 4 * [0.8, 1.2, 1.6]]), 0.01)
    for sigma, noise in ((1.0, 0.01), (1.4, 0.01), (1.8, 0.01), (1.4, 0.002), (1.4, 0.04)):
        found = relative_frame_blur(blurred(image, sigma, rng, noise)[None], reference, noise)
        seen = found.deviation < 0.3
        assert seen.sum() > 5
        # The error of a tile, and nothing that all tiles share beyond the sharpest frame being a little off.
        assert np.median(found.extra[seen]) == pytest.approx(sigma**2 - 0.8**2, rel=0.1, abs=0.1)
    assert relative_frame_blur(blurred(image, 0.6, rng)[None], reference).extra.min() == 0


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    with pytest.raises(DataError, match="at least 2 frames"):
        frame_blur(image[None], 0.01)
    with pytest.raises(ConfigurationError, match="noise"):
        frame_blur(np.stack([image, image]), np.nan)
    with pytest.raises(DataError, match=r"frames: expected the size \(32, 32\) of the reference"):
        relative_frame_blur(image[None, :, :31], prepare_blur_reference(np.stack([image, image]), 0.01)[0])

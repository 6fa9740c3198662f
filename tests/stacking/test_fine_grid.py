"""Fusion on a finer grid: the equation, the transfer function, and what undersampled and well-sampled clips gain."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import fft

from turbrestore.core.arrays import luminance
from turbrestore.core.errors import ConfigurationError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.pipeline import restore
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.settings import RestoreParams
from turbrestore.stacking.fine_grid import fine_psf, fine_shape, fuse_finely
from turbrestore.synthesis.drawn_scenes import street
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

# Pixels of the scene in a pixel of the frames, along each axis.
OVER, SIZE, COUNT = 4, (72, 88), 24


def reduced(image, shape):
    return cv2.resize(image, shape[1::-1], interpolation=cv2.INTER_AREA)


def recording(scene, lens, seed=3):
    """Frames through a lens of this blur, in pixels of the frames, with sensors that average over whole pixels."""
    rng, large = np.random.default_rng(seed), scene.shape[::-1]
    flows = smooth_flows(COUNT, *SIZE, rng, SmoothFlowParams(rms=0.8, correlation_length=14, persistence=0.3))
    flows -= flows.mean(axis=0)
    soft = cv2.GaussianBlur(scene, (0, 0), lens * OVER)
    frames = [
        reduced(warp(soft, invert_flow(OVER * cv2.resize(flow, large, interpolation=cv2.INTER_LINEAR))), SIZE)
        for flow in flows
    ]
    return np.clip(np.stack(frames) + rng.normal(0, 0.004, (COUNT, *SIZE)), 0, 1).astype(np.float32), flows


def psnr(image, truth):
    inner = np.s_[8:-8, 8:-8]
    return -10 * np.log10(np.mean(np.square(image[inner] - truth[inner])))


@pytest.fixture(scope="module")
def scene():
    return luminance(street(OVER * SIZE[0], OVER * SIZE[1]))


def test_the_fused_image_is_the_weighted_mean_of_the_samples_near_each_fine_pixel():
    rng = np.random.default_rng(0)
    frames = rng.random((16, 5, 6)).astype(np.float32)
    shifts = rng.uniform(-0.5, 0.5, (16, 2))
    flows = [np.full((5, 6, 2), shift, np.float32) for shift in shifts]
    weights = rng.uniform(0.5, 1.5, 16)
    halves = fuse_finely(zip(frames, flows, strict=True), weights, (5, 6), 2)
    for half, parity in ((halves.first, 0), (halves.second, 1)):
        total = held = 0.0
        for number in range(16):
            if number * 8 // 16 % 2 != parity:
                continue
            # Fine pixel (5, 6) lies a quarter of a pixel from pixel (2, 3), before it along x and after it along y.
            place = np.array([2.75, 2.25]) + shifts[number]
            near = np.rint(place)
            weight = weights[number] * np.exp(-8 * np.square(place - near).sum())
            total += weight * frames[number][int(near[1]), int(near[0])]
            held += weight
        # The rest is the little of the interpolated frame.
        assert half[5, 6] == pytest.approx(total / held, abs=0.01)


@pytest.mark.parametrize("scale", [1.5, 2.0, 3.0])
def test_the_transfer_function_has_the_box_of_a_pixel(scale):
    psf = fine_psf(0.0, 2.0, scale)
    assert min(psf.shape) % 2 == 1
    otf = np.abs(fft.rfft2(psf / psf.sum(), s=(240, 240)))[0]
    nu = fft.rfftfreq(240)
    # A box of s pixels has its first zero at 1 / s; g makes the rest narrower, at most by its own transfer function.
    box = np.abs(np.sinc(scale * nu))
    low = nu < 0.5 / scale
    assert (otf[low] <= box[low] + 0.02).all()
    assert (otf[low] >= box[low] * np.exp(-2 * (np.pi * nu[low] * 0.5) ** 2) - 0.02).all()


def test_fused_frames_of_a_known_motion_are_the_scene_under_that_transfer_function(scene):
    frames, flows = recording(scene, lens=0.01)
    halves = fuse_finely(zip(frames, flows, strict=True), np.ones(COUNT), SIZE, 2)
    fused = (halves.first + halves.second) / 2
    truth = reduced(scene, fine_shape(SIZE, 2))
    # The truth on the fine grid has the box of a fine pixel already.
    psf = fine_psf(0.0, 2.0, 2.0)
    expected = cv2.filter2D(truth, -1, psf / psf.sum())
    assert psnr(fused, expected) > psnr(cv2.resize(frames.mean(axis=0), truth.shape[::-1]), expected) + 10


def test_undersampled_clips_gain_over_enlargement_and_well_sampled_ones_lose_nothing(scene):
    for lens, sigma in ((0.2, None), (0.9, 0.95)):
        params = RestoreParams(scale=2)
        params = replace(params, deconvolution=replace(params.deconvolution, sigma=sigma, iterations=80))
        result = restore(FrameSource.from_array(recording(scene, lens)[0]), params)
        assert result.image.shape == SIZE and result.finer.shape == fine_shape(SIZE, 2)
        assert any(decision.subject == "scale" for decision in result.decisions)
        truth = reduced(scene, result.finer.shape)
        enlarged = cv2.resize(result.image, truth.shape[::-1], interpolation=cv2.INTER_CUBIC)
        if sigma is None:
            assert psnr(result.finer, truth) > psnr(enlarged, truth) + 1
        usual = reduced(scene, SIZE)
        assert psnr(reduced(result.finer, SIZE), usual) > psnr(result.image, usual) - 0.1


def test_the_command_writes_the_finer_image(run, tmp_path, scene):
    frames = recording(scene, lens=0.2)[0][:8]
    write_video(tmp_path / "a.npy", np.stack([frames, frames**0.9, frames**0.8], -1), 25, 32)
    quick = ("--centroid.iterations", "1", "--filter.inner-iterations", "1", "--sigma", "0.5", "--quiet")
    words = ("restore", tmp_path / "a.npy", tmp_path / "o.tif", "--scale", "1.5", "--border", "crop", *quick)
    assert run(*words) == (0, "", "")
    found = read_image(tmp_path / "o.tif").image
    assert found.ndim == 3 and found.shape[0] == pytest.approx(1.5 * SIZE[0], abs=16)
    assert "scale = 1.5" in (tmp_path / "o.tif.toml").read_text()
    with pytest.raises(ConfigurationError, match="1 to 3"):
        RestoreParams(scale=4)

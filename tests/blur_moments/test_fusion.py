"""Fusion weights against a general solver, and what they are worth where the blur of frames varies."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from conftest import SCENES, blurred
from turbrestore.blur_moments.frame_blur import FrameBlur, blur_against, frame_blur, refer_blur
from turbrestore.blur_moments.fusion import (
    frame_noise_factor,
    frame_weight,
    fuse_frames,
    fusion_rule,
    fusion_weights,
    laplacian_energy,
    noise_factor,
)
from turbrestore.blur_moments.tile_spectra import TileGrid, tile_map
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 7), st.floats(0.01, 1e3), st.floats(0.01, 1.0), st.integers(0, 1000))
def test_weights_are_those_of_a_general_solver(count, energy, noise, seed):
    s = np.random.default_rng(seed).exponential(1.0, count)
    s -= s.min()
    scale = energy / 4 * s.max() ** 2 + noise**2

    def cost(w):
        return (energy / 4 * (w @ s) ** 2 + noise**2 * (w @ w)) / scale

    weights = fusion_weights(s, np.array(energy), noise).astype(float)
    assert weights.sum() == pytest.approx(1, abs=1e-4)
    assert weights.min() >= 0
    total = {"type": "eq", "fun": lambda w: w.sum() - 1}
    best = minimize(cost, np.full(count, 1 / count), bounds=[(0, 1)] * count, constraints=total, method="SLSQP")
    assert cost(weights) <= best.fun * (1 + 1e-3) + 1e-7


def test_limits_of_the_weights():
    s = np.array([0.0, 1.0, 2.0])
    assert fusion_weights(s, np.array(0.0), 0.1) == pytest.approx(np.full(3, 1 / 3), abs=1e-4)
    assert fusion_weights(s, np.array(1.0), 0.0) == pytest.approx(np.array([1.0, 0.0, 0.0]), abs=1e-4)
    assert fusion_weights(np.zeros(3), np.array(1.0), 0.0) == pytest.approx(np.full(3, 1 / 3))


def test_weights_from_blur_beat_mean_and_inverse_variance(varied):
    scene, frames, variance = varied
    blur = frame_blur(frames, 0.01)
    mean = frames.mean(axis=0)
    energy = laplacian_energy(mean, 0.01 / np.sqrt(len(frames)))
    extra = np.stack([tile_map(tile, blur.grid) for tile in blur.extra])
    inverse = 1 / (energy / 4 * extra**2 + 0.01**2)
    known = fusion_weights(variance - variance.min(axis=0), energy, 0.01)
    fused = fuse_frames(frames, fusion_rule(blur, energy, 0.01))
    plain, by_variance, by_blur, by_truth = (
        psnr(image[8:-8, 8:-8].astype(np.float32), scene[8:-8, 8:-8])
        for image in (mean, (inverse * frames).sum(0) / inverse.sum(0), fused, (known * frames).sum(0))
    )
    assert by_blur > by_variance + 1 > plain + 2
    assert by_blur > plain + 3
    assert by_blur > by_truth - 1


def test_rule_and_weights_agree(varied):
    _, frames, _ = varied
    blur = frame_blur(frames, 0.01)
    energy = laplacian_energy(frames.mean(axis=0))
    rule = fusion_rule(blur, energy, 0.01)
    shares = np.stack([frame_weight(rule, index) for index in range(len(frames))])
    extra = np.stack([tile_map(tile, blur.grid) for tile in blur.extra])
    assert np.abs(shares - fusion_weights(extra, energy, 0.01)).max() < 1e-5
    assert np.abs(shares.sum(axis=0) - 1).max() < 1e-4
    factors = np.stack([frame_noise_factor(rule, index, largest=1e6) for index in range(len(frames))])
    assert np.abs((1 / factors).mean(axis=0) - 1).max() < 1e-3
    assert frame_noise_factor(rule, 0, largest=2.0).max() <= 2.0


def test_colour_is_fused_as_grey_is(varied):
    _, frames, _ = varied
    rule = fusion_rule(frame_blur(frames, 0.01), laplacian_energy(frames[0]), 0.01)
    grey = fuse_frames(frames, rule)
    assert np.abs(fuse_frames(np.stack([frames] * 3, axis=-1), rule) - grey[..., None]).max() < 1e-6


@pytest.mark.parametrize("shape", [(16, 16), (20, 100), (50, 49)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_frames_without_content_are_fused_to_themselves(shape, noise):
    flat = np.full((3, *shape), 0.5, np.float32)
    rule = fusion_rule(frame_blur(flat, noise), laplacian_energy(flat[0]), noise)
    assert fuse_frames(flat, rule) == pytest.approx(flat[0], abs=1e-6)


def test_laplacian_energy_of_noise_is_nothing_and_of_blur_its_error():
    rng = np.random.default_rng(0)
    noise = rng.normal(0.5, 0.05, (128, 128)).astype(np.float32)
    assert laplacian_energy(noise, 0.05).mean() < 0.1 * laplacian_energy(noise).mean()
    scene = cv2.GaussianBlur(SCENES["camera"](128), (0, 0), 2.0)
    error = np.mean((cv2.GaussianBlur(scene, (0, 0), 0.7) - scene)[8:-8, 8:-8] ** 2)
    assert 0.49**2 / 4 * laplacian_energy(scene)[8:-8, 8:-8].mean() == pytest.approx(error, rel=0.25)


def test_a_blurry_newcomer_is_trusted_least(varied):
    scene, frames, _ = varied
    reference, blur = refer_blur(frames, 0.01)
    rule = fusion_rule(blur, laplacian_energy(frames.mean(axis=0), 0.002), 0.01)
    assert (noise_factor(rule, blur.extra[3]) == frame_noise_factor(rule, 3)).all()
    newcomer = blurred(scene, 4.0, np.random.default_rng(1))
    factor = noise_factor(rule, blur_against(newcomer[None], reference).extra[0], largest=50.0)
    known = np.stack([frame_noise_factor(rule, index, largest=50.0) for index in range(len(frames))])
    assert (factor >= np.median(known, axis=0)).mean() > 0.95
    assert np.mean(factor == 50.0) > 0.5


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    grid = TileGrid(np.array([0]), np.array([0]), (32, 32), (32, 32))
    blur = FrameBlur(*(np.zeros((2, 1, 1), np.float32) for _ in range(3)), grid)
    with pytest.raises(DataError, match="energy"):
        fusion_weights(np.zeros((2, 3)), np.zeros(4), 0.1)
    with pytest.raises(DataError, match="0 or more"):
        fusion_weights(np.array([-1.0, 1.0]), np.array(1.0), 0.1)
    with pytest.raises(DataError, match="energy"):
        fusion_rule(blur, np.zeros((31, 32)), 0.1)
    with pytest.raises(DataError, match="frames"):
        fuse_frames(np.zeros((3, 32, 32)), fusion_rule(blur, image, 0.1))
    with pytest.raises(ConfigurationError, match="largest"):
        frame_noise_factor(fusion_rule(blur, image, 0.1), 0, largest=0.5)

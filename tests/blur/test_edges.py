"""Edges bound the width of the blur of a disc on black, and of nothing whose edges do not rise on either side."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from turbrestore.blur.edges import _widest_blur, edge_limit, has_black_background
from turbrestore.blur.estimation import estimate_blur
from turbrestore.blur.posterior import BlurWitnesses, blur_posterior
from turbrestore.blur.psf import GAUSSIAN, blur_otf, fused_exponent
from turbrestore.blur.witnesses.image_evidence import image_evidence
from turbrestore.deblurring.decisions import explain_blur
from turbrestore.deblurring.remove_blur import find_blur, remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.runtime.runtime import DEFAULT
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES


def planet(diameter, side=220):
    """Banded disc that darkens towards its limb, on black."""
    y, x = (np.mgrid[:side, :side] - side / 2) / (diameter / 2)
    radius = np.hypot(x, y)
    bands = 0.75 + 0.18 * np.sin(9 * y) + 0.08 * np.sin(23 * y + 2 * np.sin(6 * x))
    brightness = bands * (0.35 + 0.65 * np.sqrt(np.clip(1 - radius**2, 0, 1)))
    return (0.9 * brightness * np.clip((1 - radius) * diameter / 2 + 0.5, 0, 1)).astype(np.float32)


def seen(scene, sigma, noise=0.003):
    blurred = cv2.GaussianBlur(scene, (0, 0), sigma) if sigma else scene
    return np.clip(blurred + np.random.default_rng(1).normal(0, noise, scene.shape), 0, 1).astype(np.float32)


@pytest.mark.parametrize("diameter", [60, 100, 150])
@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.0])
def test_the_blur_of_a_planet_is_not_taken_for_a_wider_one(diameter, sigma):
    estimate = estimate_blur(seen(planet(diameter), sigma))
    assert sigma <= estimate.sigma < 1.35 * sigma
    assert estimate.edge_limited


@pytest.mark.parametrize("sigma", [1.2, 2.0])
def test_the_limb_bounds_the_width_where_most_edges_are_those_of_soft_bands(sigma):
    """The likeliest width is several times too large, and few of the edges rise on both sides."""
    y, x = np.mgrid[-128:128, -128:128] / 80
    bands = 0.55 + 0.2 * np.sin(14 * y + 1.7 * np.sin(6 * x))
    estimate = estimate_blur(seen((bands * np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))).astype(np.float32), sigma))
    assert sigma <= estimate.sigma < 1.75 * sigma
    assert estimate.edge_limited


@pytest.mark.parametrize("diameter", [60, 100, 150])
def test_nothing_is_removed_from_a_sharp_planet(diameter):
    assert estimate_blur(seen(planet(diameter), 0)).removable < 0.35


@pytest.mark.parametrize(("diameter", "sigma"), [(100, 1.2), (150, 0.8)])
def test_a_deblurred_planet_is_closer_to_the_scene(diameter, sigma):
    scene = planet(diameter)
    blurred = seen(scene, sigma)
    disc = cv2.dilate(np.uint8(scene > 0), np.ones((5, 5))) > 0
    restored = finish(remove_blur_steps(blurred, blurred)).deconvolution.image
    before, after = (10 * np.log10(1 / np.mean((image - scene)[disc] ** 2)) for image in (blurred, restored))
    assert after > max(before + 1, 35)


@pytest.mark.parametrize(("sky", "bounded"), [(0.0, True), (0.3, False)])
def test_edges_bound_what_frames_tell_of_a_body_before_black_only(monkeypatch, sky, bounded):
    image = seen(np.maximum(planet(150), sky * np.linspace(0, 1, 220, dtype=np.float32)), 1.2)
    assert edge_limit(image, 2.4, 1.4)
    evidence, wide = image_evidence(image), blur_posterior(None, BlurWitnesses(1.0, 40.0))
    told = evidence, replace(wide, removed=2.4, exponent=1.4)
    monkeypatch.setattr("turbrestore.deblurring.remove_blur.estimate_posterior", lambda *_: told)
    _, found = find_blur(image, DeconvolutionParams(), DEFAULT, BlurWitnesses(1.0, 40.0))
    assert found.edge_limited == bounded
    assert found.removed == (pytest.approx(1.2, rel=0.25) if bounded else 2.4)


@pytest.mark.parametrize("noise", [0.003, 0.01])
def test_noise_does_not_pass_for_black(noise):
    assert has_black_background(seen(planet(100), 1.2, noise))
    assert not has_black_background(seen(0.3 * SCENES["camera"](200, 200) + 0.2, 1.2, noise))


@pytest.mark.parametrize("exponent", [GAUSSIAN, fused_exponent(1.5)])
@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.5])
def test_the_bound_of_a_step_is_the_width_of_its_blur(sigma, exponent):
    y, x = np.mgrid[-100:100, -100:100]
    disc = (np.hypot(x, y) < 60).astype(np.float32)
    blurred = np.fft.irfft2(blur_otf(disc.shape, sigma, exponent) * np.fft.rfft2(disc), s=disc.shape)
    assert sigma * 0.98 < _widest_blur(blurred.astype(np.float32), exponent, 10.0) < 1.2 * sigma


@pytest.mark.parametrize("name", ["words", "brick", "grass", "chart", "camera"])
def test_the_width_of_other_scenes_stands(name):
    assert not estimate_blur(seen(SCENES[name](200, 200), 1.5)).edge_limited


def test_the_decision_says_that_edges_decided():
    estimate = estimate_blur(seen(planet(100), 1.2))
    assert "edges are too steep" in explain_blur(estimate, estimate.removable).reason

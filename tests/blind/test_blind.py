"""Blind deconvolution: what is removed, what the guards say, and how it is told."""

from dataclasses import replace

import numpy as np
import pytest

from turbrestore.blind.guards import GuardParams
from turbrestore.blind.remove_blur import remove_blur
from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.metrics import psnr
from turbrestore.synthesis.scenes import SCENES

WIENER = DeconvolutionParams(method="wiener")


@pytest.fixture(scope="module")
def camera():
    scene = SCENES["camera"](128, 128)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, 1.6, KOLMOGOROV)
    noise = np.random.default_rng(0).normal(0, 0.002, scene.shape)
    return scene, (np.fft.irfft2(spectrum, scene.shape) + noise).astype(np.float32)


def test_a_blind_result_is_sharper_and_closer_to_the_scene(camera):
    scene, image = camera
    result = remove_blur(image, image, WIENER)
    assert result.blur.sigma == pytest.approx(1.6, rel=0.25)
    assert result.deconvolution.sigma == result.blur.removable == result.readings[0].sigma
    assert psnr(result.deconvolution.image, scene) > psnr(image, scene) + 1
    assert [decision.subject for decision in result.decisions] == ["blur", "guards"]
    assert result.decisions[1].choice == "passed"


def test_where_a_guard_objects_less_is_removed_and_it_is_said(camera):
    _, image = camera
    free = remove_blur(image, image, WIENER)
    bound = free.readings[0].noise_gain * 0.9
    result = remove_blur(image, image, WIENER, GuardParams(noise_gain=bound))
    assert 0 < result.deconvolution.sigma < free.deconvolution.sigma
    assert [reading.passed for reading in result.readings][-2:] == [False, True]
    assert result.decisions[1].choice.startswith(f"blur lowered from {free.deconvolution.sigma:.2f} to")


def test_where_every_width_fails_nothing_is_removed(camera):
    _, image = camera
    result = remove_blur(image, image, WIENER, GuardParams(noise_gain=1.0, overshoot=0.0, tries=2))
    assert result.deconvolution.sigma == 0
    assert np.array_equal(result.deconvolution.image, image)
    assert "no blur removed" in result.decisions[1].choice


def test_a_width_asked_for_is_removed_whatever_the_guards_say(camera):
    _, image = camera
    result = remove_blur(image, image, replace(WIENER, sigma=4.0))
    assert result.blur is None
    assert result.deconvolution.sigma == 4.0
    assert not result.readings[0].passed
    assert result.decisions[0].reason == "asked for"
    assert result.decisions[1].choice == "failed, kept as asked"

"""What has two tones tells its blur; photographs, which have many, say that they do not."""

from dataclasses import replace

import numpy as np
import pytest

from turbrestore.blur.psf import GAUSSIAN, KOLMOGOROV, blur_otf
from turbrestore.blur.witnesses import two_tones as module
from turbrestore.blur.witnesses.two_tones import two_tones
from turbrestore.core.arrays import luminance
from turbrestore.core.noise_spectrum import white_noise
from turbrestore.synthesis.scenes import SCENES

NOISE = 0.002


def seen(scene, width, exponent):
    """A scene behind a blur, with noise."""
    blurred = np.fft.irfft2(np.fft.rfft2(scene) * blur_otf(scene.shape, width, exponent), scene.shape)
    return (blurred + np.random.default_rng(3).normal(0, NOISE, scene.shape)).astype(np.float32)


@pytest.mark.parametrize("exponent", [KOLMOGOROV, GAUSSIAN])
@pytest.mark.parametrize("width", [0.6, 0.9, 1.3])
def test_the_width_of_a_scene_of_two_tones_is_found(width, exponent):
    found = two_tones(seen(SCENES["chart"](192, 192), width, exponent), white_noise(NOISE), exponent)
    assert found.clear
    assert found.width == pytest.approx(width, rel=0.15)
    low, middle, high = found.quantiles
    assert low < middle == found.width < high


@pytest.mark.parametrize("name", ["camera", "cat", "brick", "grass"])
def test_a_photograph_does_not_have_two_tones(name):
    found = two_tones(seen(luminance(SCENES[name](192, 192)), 1.3, GAUSSIAN), white_noise(NOISE), GAUSSIAN)
    assert not found.clear


def test_brightness_and_contrast_do_not_matter():
    image = seen(SCENES["chart"](192, 192), 1.3, GAUSSIAN)
    bright = two_tones(image, white_noise(NOISE), GAUSSIAN)
    # The assumed noise is at least 0.001, so that it can be halved.
    dark = two_tones(0.25 + image / 2, white_noise(NOISE / 2), GAUSSIAN)
    assert dark == pytest.approx(bright, rel=1e-3)


def test_small_and_flat_images_tell_nothing():
    assert two_tones(SCENES["chart"](64, 64)[:30, :30], white_noise(NOISE), GAUSSIAN) is None
    assert two_tones(np.full((96, 96), 0.5, np.float32), white_noise(NOISE), GAUSSIAN) is None


def test_more_steps_change_nothing(monkeypatch):
    image = seen(SCENES["chart"](192, 192), 1.3, GAUSSIAN)
    usual = two_tones(image, white_noise(NOISE), GAUSSIAN)
    monkeypatch.setattr(module, "LIMITS", replace(module.LIMITS, steps=20))
    assert two_tones(image, white_noise(NOISE), GAUSSIAN) == pytest.approx(usual, rel=0.02)

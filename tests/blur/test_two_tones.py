"""What has two tones tells its blur; photographs, which have many, say that they do not."""

import numpy as np
import pytest

from turbrestore.blur.psf import GAUSSIAN, KOLMOGOROV, blur_otf
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


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize("scene", ["ramp", "vignette"])
def test_noise_on_a_smooth_scene_does_not_have_two_tones(scene, noise):
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    smooth = 0.5 + 0.1 * x if scene == "ramp" else 0.8 - 0.2 * (x**2 + y**2)
    for seed in range(4):
        image = smooth + np.random.default_rng(seed).normal(0, noise, smooth.shape)
        assert not two_tones(image.astype(np.float32), white_noise(noise), GAUSSIAN).clear


def test_brightness_and_contrast_do_not_matter():
    # The noise stays above the least that is assumed, that of 8 bits.
    scene, noise = SCENES["chart"](192, 192), np.random.default_rng(3).normal(0, 0.005, (192, 192))
    image = (seen(scene, 1.3, GAUSSIAN) + noise).astype(np.float32)
    bright = two_tones(image, white_noise(0.005), GAUSSIAN)
    dark = two_tones(0.25 + image / 2, white_noise(0.0025), GAUSSIAN)
    assert dark == pytest.approx(bright, rel=1e-3)


def test_small_and_flat_images_tell_nothing():
    assert two_tones(SCENES["chart"](64, 64)[:30, :30], white_noise(NOISE), GAUSSIAN) is None
    flat = np.full((100, 96), 0.5, np.float32)
    assert two_tones(flat, white_noise(NOISE), GAUSSIAN) is None
    # Rows that no tile covers do not count.
    flat[96:] = np.linspace(0, 1, 96)
    assert two_tones(flat, white_noise(NOISE), GAUSSIAN) is None

"""Guards: right widths pass, ringing and amplified noise are found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.blind.guards import GuardParams, evaluate_guards
from turbrestore.blur.psf import blur_otf
from turbrestore.core.arrays import luminance
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.runtime.scratch import to_scratch
from turbrestore.synthesis.scenes import SCENES

WIENER = DeconvolutionParams(method="wiener", exponent=2.0)


def blurred(name, sigma, noise=0.002, side=128):
    scene = SCENES[name](side, side)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, sigma, 2.0)
    noisy = np.fft.irfft2(spectrum, scene.shape) + np.random.default_rng(1).normal(0, noise, scene.shape)
    return scene, noisy.astype(np.float32)


@pytest.mark.parametrize("name", ["chart", "camera", "grass", "words"])
@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_the_right_width_passes(name, sigma):
    _, image = blurred(name, sigma)
    assert evaluate_guards(deconvolve(image, sigma, WIENER).image, image, sigma).passed


def test_amplified_noise_is_found():
    rng = np.random.default_rng(0)
    before = (0.5 + rng.normal(0, 0.01, (64, 64))).astype(np.float32)
    before[:, 32:] += 0.3
    after = before + rng.normal(0, 0.05, before.shape)
    reading = evaluate_guards(after, before, 1.0)
    assert reading.noise_gain == pytest.approx(np.hypot(0.05, 0.01) / 0.01, rel=0.1)
    assert not reading.passed


def test_a_grey_image_in_colour_gives_the_same_reading():
    _, image = blurred("camera", 1.0)
    colour = np.repeat(image[..., None], 3, axis=2)
    assert evaluate_guards(colour, colour, 1.0) == evaluate_guards(image, image, 1.0)


def test_images_in_files_give_the_same_reading(tmp_path):
    _, image = blurred("chart", 2.0)
    colour = np.stack([image, image[::-1], image.T], axis=-1)
    sharp = deconvolve(colour, 2.0, WIENER).image
    reading = evaluate_guards(to_scratch(sharp, tmp_path), to_scratch(colour, tmp_path), 2.0)
    planes = [
        (luminance(sharp), luminance(colour)),
        *zip(sharp.transpose(2, 0, 1), colour.transpose(2, 0, 1), strict=True),
    ]
    alone = [evaluate_guards(after, before, 2.0) for after, before in planes]
    for name in ("overshoot", "noise_gain"):
        found = [getattr(one, name) for one in alone]
        assert getattr(reading, name) == max(found) and len(set(found)) == 4


def test_rings_of_colour_without_luminance_are_found():
    before = np.full((64, 64, 3), 0.5, np.float32)
    before[:, 32:] = 0.6
    after = before.copy()
    after[:, 24:32] += np.float32([0.587, -0.299, 0.0]) * 0.8
    assert evaluate_guards(luminance(after), luminance(before), 1.0).overshoot < 0.01
    assert not evaluate_guards(after, before, 1.0).passed


@given(gain=st.floats(0.1, 1.0), offset=st.floats(-0.2, 0.2))
@settings(deadline=None)
def test_the_reading_depends_on_neither_gain_nor_offset(gain, offset):
    scene, image = blurred("camera", 2.0, side=48)
    first = evaluate_guards(scene, image, 2.0)
    second = evaluate_guards(gain * scene + offset, gain * image + offset, 2.0)
    assert second.overshoot == pytest.approx(first.overshoot, abs=0.002)
    assert second.noise_gain == pytest.approx(first.noise_gain, rel=0.1)


def test_different_shapes_and_bad_bounds_are_refused():
    with pytest.raises(DataError, match="expected the shape"):
        evaluate_guards(np.zeros((8, 8)), np.zeros((8, 9)), 1.0)
    with pytest.raises(ConfigurationError, match="back_off"):
        GuardParams(back_off=1.0)
    with pytest.raises(ConfigurationError, match="overshoot"):
        GuardParams(overshoot=2.0)

"""The spectrum of the noise is that which was made, whatever the scene and however badly it is registered."""

import cv2
import numpy as np
import pytest

from turbrestore.core.noise_spectrum import RINGS, SIDE, NoiseSpectrum, fit_noise_spectrum, window_powers
from turbrestore.synthesis.scenes import SCENES


def noise(length=0.0, deviation=0.02, seed=0, shape=(192, 256)):
    """White noise behind a Gaussian of a standard deviation ``length``, pixels."""
    white = np.random.default_rng(seed).normal(0, deviation, shape).astype(np.float32)
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1]))
    spectrum = np.fft.rfft2(white) * np.exp(-2 * (np.pi * length * frequency) ** 2)
    return np.fft.irfft2(spectrum, shape).astype(np.float32)


def of_gaussian(length, deviation=0.02):
    return deviation**2 * np.exp(-((2 * np.pi * length * RINGS) ** 2))


@pytest.mark.parametrize("length", [0.0, 0.7, 1.5, 2.5])
@pytest.mark.parametrize("scene", ["camera", "brick"])
def test_smooth_noise_has_its_power_at_every_frequency(length, scene):
    image = cv2.GaussianBlur(SCENES[scene](192, 256), (0, 0), 1.0)
    found = fit_noise_spectrum([noise(length)], image)
    expected = of_gaussian(length)
    # A ring is a mean over frequencies, within which steep spectra fall; the last one holds the corners, and the lowest
    # ones are like the third.
    seen = (expected > 0.05 * expected[0]) & (RINGS > 1 / SIDE) & (RINGS < 0.5)
    np.testing.assert_array_less(np.abs(found.power - expected)[seen], (0.2 * expected + 5 * found.error)[seen])
    assert found.deviation == pytest.approx(noise(length).std(), rel=0.15)


def test_detail_that_is_displaced_is_no_noise():
    image, shift = cv2.GaussianBlur(SCENES["camera"](192, 256), (0, 0), 1.0), 0.15
    displaced = shift * (np.roll(image, -1, axis=1) - np.roll(image, 1, axis=1)) / 2
    found, alone = (fit_noise_spectrum([noise(1.0) + part], image) for part in (displaced, 0))
    np.testing.assert_allclose(found.power[2:10], alone.power[2:10], rtol=0.25)
    # Along one of two axes: the power of the derivative is half of (2πν)² that of the scene, on average over a ring.
    expected = (shift * np.sin(2 * np.pi * RINGS)) ** 2 / 2
    np.testing.assert_allclose(found.relative[3:6], expected[3:6], rtol=0.5)
    assert alone.relative[3:6].max() < 0.2 * expected[3:6].min()


def test_what_few_of_the_differences_show_does_not_count():
    image = SCENES["camera"](96, 128)
    parts = [noise(1.0, seed=seed, shape=(96, 128)) for seed in range(8)]
    spoilt = [part + 0.5 * noise(2.0, 0.5, 20 + number, (96, 128)) * (number < 2) for number, part in enumerate(parts)]
    found, clean = fit_noise_spectrum(spoilt, image), fit_noise_spectrum(parts, image)
    assert found.deviation == pytest.approx(clean.deviation, rel=0.15)
    assert clean.deviation == pytest.approx(np.std(parts), rel=0.1)


@pytest.mark.parametrize("shape", [(16, 16), (16, 90), (31, 33)])
def test_small_images_have_all_rings(shape):
    found = fit_noise_spectrum([noise(shape=shape)], noise(seed=1, shape=shape))
    assert found.power.shape == RINGS.shape and np.isfinite(found.power).all() and (found.power > 0).all()
    assert window_powers(np.zeros(shape, np.float32)).max() == 0


def test_the_deviation_is_that_of_a_pixel():
    flat = NoiseSpectrum(np.full_like(RINGS, 4e-4), np.zeros_like(RINGS), np.zeros_like(RINGS))
    assert flat.deviation == pytest.approx(0.02)
    assert flat.scaled(0.25).deviation == pytest.approx(0.01)
    # e is a ratio, which the levels do not change.
    doubled = NoiseSpectrum(flat.power, flat.error, np.full_like(RINGS, 0.6)).scaled(4)
    np.testing.assert_array_equal(doubled.relative, 0.6)
    np.testing.assert_allclose(flat.at(np.array([0.0, 0.3, 0.7])), 4e-4)


def test_nothing_is_certain_where_windows_are_few():
    one, many = (
        fit_noise_spectrum([noise(shape=(side, side))], np.zeros((side, side), np.float32)) for side in (32, 96)
    )
    assert one.certain.deviation < 1e-3 * one.deviation
    assert many.certain.deviation > 0.8 * many.deviation

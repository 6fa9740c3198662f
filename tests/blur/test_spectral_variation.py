"""Variation of spectra: known variations are found, whatever the scene."""

import cv2
import numpy as np
import pytest

from turbrestore.blur.witnesses.spectral_variation import RINGS, SIDE, measure_variation, window_power
from turbrestore.core.noise_spectrum import RINGS as NOISE_RINGS
from turbrestore.core.noise_spectrum import NoiseSpectrum
from turbrestore.registration.registered_noise import noise_of_frames
from turbrestore.registration.warp import warp
from turbrestore.synthesis.scenes import SCENES

CLEAR = slice(2, 12)


@pytest.fixture(scope="module")
def scene():
    return SCENES["camera"](128, 128)


def still(frames):
    return np.zeros((*frames.shape[:3], 2), np.float32)


def measured(frames, flows=None):
    flows = still(frames) if flows is None else flows
    mean = np.mean([warp(*pair) for pair in zip(frames, flows, strict=True)], axis=0)
    return measure_variation(frames, flows, noise_of_frames(frames, flows, mean))


def noisy(frames, noise=0.004):
    return (frames + np.random.default_rng(1).normal(0, noise, frames.shape)).astype(np.float32)


@pytest.mark.parametrize("name", ["camera", "words"])
def test_contrast_that_varies_is_found_whatever_the_scene(name):
    spread, count = 0.2, 40
    factors = np.linspace(-1, 1, count) * np.sqrt(3) * spread + 1
    frames = noisy(factors[:, None, None] * SCENES[name](128, 128))
    found = measured(frames)
    squares = factors**2
    np.testing.assert_allclose(found.amplitude[CLEAR], factors.var(ddof=1), rtol=0.2)
    np.testing.assert_allclose(found.power[CLEAR], squares.var(ddof=1) / squares.mean() ** 2, rtol=0.2)
    assert found.frames == count


def test_frames_that_stand_still_do_not_vary(scene):
    frames = noisy(np.repeat(scene[None], 24, axis=0), 0.01)
    found = measured(frames)
    for value, error in ((found.amplitude, found.amplitude_error), (found.power, found.power_error)):
        assert (np.abs(value)[CLEAR] < 4 * error[CLEAR] + 0.3 / found.signal[CLEAR]).all()
    # The window has a mean square of 9/64, and frequencies are not normalised.
    np.testing.assert_allclose(np.median(found.noise_power), 0.01**2 * SIDE**2 * 9 / 64, rtol=0.15)


def test_shifts_vary_amplitudes_and_hardly_powers(scene):
    steps = np.random.default_rng(0).integers(-1, 2, (30, 2))
    frames = noisy(np.stack([np.roll(scene, step, axis=(0, 1)) for step in steps]))
    found = measured(frames)
    assert (found.power[4:12] < 0.3 * found.amplitude[4:12]).all()


def test_levels_of_the_frames_do_not_matter(scene):
    frames = noisy(np.repeat(scene[None], 8, axis=0))
    found, dark = (measured(gain * frames) for gain in (1.0, 0.25))
    np.testing.assert_allclose(found.amplitude[CLEAR], dark.amplitude[CLEAR], atol=1e-5)
    np.testing.assert_allclose(found.with_power(frames.mean(axis=0))[CLEAR], 1, atol=0.02)


def test_reduced_frames_have_the_spectrum_of_the_reduced_image():
    wide = SCENES["camera"](256, 256)
    small = wide.reshape(128, 2, 128, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(window_power(wide, 2), window_power(np.float32(small)), rtol=1e-3)


def test_few_frames_and_small_ones_are_not_measured(scene):
    frames = np.repeat(scene[None], 3, axis=0)
    assert measured(frames) is None
    frames = np.repeat(scene[None, :90], 8, axis=0)
    assert measured(frames) is None
    assert RINGS[-1] == 0.5


def test_a_camera_that_moves_far_adds_no_variation():
    wide = SCENES["camera"](192, 256)
    steps = (0, 9, 21, 30, 39, 44)
    frames = noisy(np.stack([wide[:, step : step + 200] for step in steps]))
    flows = still(frames)
    flows[..., 0] = np.mean(steps) - np.reshape(steps, (-1, 1, 1))
    found = measured(frames, flows)
    assert (np.abs(found.amplitude)[CLEAR] < 0.01).all()


def test_smooth_noise_is_no_variation(scene):
    rng, frames = np.random.default_rng(2), np.repeat(scene[None], 24, axis=0)
    white = rng.normal(0, 0.05, frames.shape).astype(np.float32)
    frames = frames + np.stack([cv2.GaussianBlur(part, (0, 0), 1.5) for part in white])
    nothing = np.zeros_like(NOISE_RINGS)
    unknown = NoiseSpectrum(nothing, nothing, nothing)
    told, untold = measured(frames), measure_variation(frames, still(frames), unknown)
    assert np.abs(told.amplitude)[3:8].max() < 0.4 * untold.amplitude[3:8].max()

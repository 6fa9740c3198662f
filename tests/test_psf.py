"""Transfer functions against their definitions, noise and blur estimates against known truth."""

import cv2
import numpy as np
import pytest
from scipy import fft
from skimage import data

from turbrestore.errors import ConfigurationError, DataError
from turbrestore.psf import (
    check_psf,
    estimate_blur,
    estimate_noise,
    gaussian_otf,
    gaussian_psf,
    laplacian_symbol,
    psf_to_otf,
    wiener_fidelity,
)


def camera(size: int = 256) -> np.ndarray:
    return data.camera()[60 : 60 + size, 120 : 120 + size].astype(np.float32) / 255


def natural_field(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> np.ndarray:
    """Random field with power ν^-2, blurred exactly by a Gaussian."""
    nu = np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1]))
    nu[0, 0] = np.inf
    spectrum = fft.rfft2(rng.normal(size=shape)) / nu * gaussian_otf(shape, sigma)
    field = fft.irfft2(spectrum, s=shape)
    return (0.5 + 0.15 * field / field.std()).astype(np.float32)


def test_gaussian_psf_has_its_standard_deviation():
    psf = gaussian_psf(1.7)
    x = np.arange(psf.shape[1]) - psf.shape[1] // 2
    assert psf.sum() == pytest.approx(1, abs=1e-6)
    assert np.sqrt(psf.sum(axis=0) @ x**2) == pytest.approx(1.7, rel=2e-3)
    assert np.array_equal(gaussian_psf(0), [[1]])


@pytest.mark.parametrize("shape", [(24, 31), (25, 30)])
def test_gaussian_otf_is_the_transform_of_the_sampled_gaussian(shape):
    sampled = psf_to_otf(gaussian_psf(1.4), shape)
    assert np.abs(sampled - gaussian_otf(shape, 1.4)).max() < 2e-4


def test_psf_to_otf_convolves_around_the_middle_pixel():
    rng = np.random.default_rng(0)
    image, psf = rng.random((12, 9)).astype(np.float32), rng.random((3, 5))
    blurred = fft.irfft2(psf_to_otf(psf, image.shape) * fft.rfft2(image), s=image.shape)
    expected = sum(
        psf[i, j] / psf.sum() * np.roll(image, (i - 1, j - 2), axis=(0, 1)) for i in range(3) for j in range(5)
    )
    assert np.abs(blurred - expected).max() < 1e-6


def test_laplacian_symbol_is_that_of_the_five_point_stencil():
    u = np.random.default_rng(1).random((8, 11)).astype(np.float32)
    stencil = 4 * u - sum(np.roll(u, shift, axis) for shift in (-1, 1) for axis in (0, 1))
    assert np.abs(fft.irfft2(laplacian_symbol(8, 11) * fft.rfft2(u), s=u.shape) - stencil).max() < 1e-5


@pytest.mark.parametrize("sigma", [-1.0, np.nan, np.inf])
def test_negative_and_undefined_sigmas_are_refused(sigma):
    with pytest.raises(ConfigurationError, match="sigma"):
        gaussian_psf(sigma)
    with pytest.raises(ConfigurationError, match="sigma"):
        gaussian_otf((4, 4), sigma)


@pytest.mark.parametrize("psf", [np.ones((2, 3)), np.ones(3), -np.ones((3, 3)), np.zeros((3, 3)), [[np.nan]]])
def test_unusable_psfs_are_refused(psf):
    with pytest.raises(DataError, match="psf"):
        check_psf(psf)


def test_a_psf_larger_than_the_image_is_refused():
    with pytest.raises(DataError, match="at most the size"):
        psf_to_otf(np.ones((5, 5)), (4, 8))


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_noise_is_found_beside_edges(noise):
    scene = cv2.GaussianBlur(camera(), (0, 0), 1.5)
    noisy = scene + np.random.default_rng(2).normal(0, noise, scene.shape).astype(np.float32)
    assert estimate_noise(noisy) == pytest.approx(noise, rel=0.1)
    assert estimate_noise(np.repeat(noisy[..., None], 3, axis=2)) == pytest.approx(noise, rel=0.1)


def test_images_too_small_to_judge_have_no_noise_and_no_blur():
    tiny = np.random.default_rng(3).random((2, 9))
    assert estimate_noise(tiny) == 0
    assert estimate_blur(tiny).sigma == 0
    assert estimate_blur(np.zeros((1, 1))).sigma == 0


@pytest.mark.parametrize("sigma", [0.8, 1.5, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_fit_recovers_the_blur_of_a_scene_that_obeys_its_model(sigma, noise):
    rng = np.random.default_rng(4)
    image = natural_field(rng, (192, 160), sigma)
    image += rng.normal(0, noise, image.shape).astype(np.float32)
    estimate = estimate_blur(image, noise)
    assert estimate.fitted == pytest.approx(sigma, rel=0.05)
    # The model has to follow what was measured, not only its width.
    assert np.abs(np.log(estimate.model / estimate.power)).mean() < 0.25


def test_noise_is_taken_out_of_the_spectrum():
    clean = natural_field(np.random.default_rng(8), (192, 160), 1.5)
    without = estimate_blur(clean, 0.0).power
    ratios = []
    for seed in range(12):
        noisy = clean + np.random.default_rng(seed).normal(0, 0.01, clean.shape).astype(np.float32)
        power = estimate_blur(noisy, 0.01).power
        # Near the cutoff, where noise adds 6 % on average.
        ratios.append((power / without[: len(power)])[-4:].mean())
    assert np.median(ratios) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.5])
def test_blur_of_a_photograph_is_found_within_a_quarter_pixel_and_not_exceeded_much(sigma):
    blurred = cv2.GaussianBlur(camera(), (0, 0), sigma)
    blurred += np.random.default_rng(5).normal(0, 0.002, blurred.shape).astype(np.float32)
    estimate = estimate_blur(blurred)
    assert abs(estimate.fitted - sigma) < 0.25
    # The overshoot limit errs low: cautious, not exact.
    assert 0.75 * sigma < estimate.sigma < 1.15 * sigma
    assert estimate.noise == pytest.approx(0.002, rel=0.15)
    assert 0.01 < estimate.uncertainty < 0.2
    assert len(estimate.frequencies) == len(estimate.power) == len(estimate.model)
    assert estimate.cutoff == estimate.frequencies[-1]


def test_a_sharp_photograph_and_white_noise_are_left_alone():
    assert estimate_blur(camera()).sigma == 0
    assert estimate_blur(np.random.default_rng(6).random((64, 64))).sigma == 0
    flat = estimate_blur(np.full((64, 64), 0.3))
    assert (flat.sigma, flat.uncertainty) == (0, np.inf)


def test_overshoot_limits_sigma():
    # Thin lines stand far above their blurred neighbourhood: a right fit is not trusted where it shows so much.
    rng = np.random.default_rng(7)
    lines = np.full((128, 128), 0.1, np.float32)
    lines[:, rng.integers(0, 128, 14)] = lines[rng.integers(0, 128, 14)] = 0.9
    estimate = estimate_blur(cv2.GaussianBlur(lines, (0, 0), 1.5), noise=0.001)
    assert 0.5 < estimate.sigma < 0.9 * estimate.fitted


def test_noise_must_be_a_number_of_zero_or_more():
    with pytest.raises(ConfigurationError, match="noise"):
        estimate_blur(np.zeros((32, 32)), noise=-0.1)


def test_wiener_fidelity_falls_with_noise_and_rises_with_contrast():
    image = camera(64)
    assert wiener_fidelity(image, 0.01) < wiener_fidelity(image, 0.001)
    assert wiener_fidelity(image / 2, 0.001) < wiener_fidelity(image, 0.001)

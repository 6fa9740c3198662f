"""Transfer functions against their definitions, noise and blur estimates against known truth."""

import cv2
import numpy as np
import pytest
from scipy import fft
from skimage import data
from small_problems import gaussian_psf

from turbrestore.blur.psf import (
    blur_otf,
    check_psf,
    half_frequency,
    laplacian_symbol,
    psf_to_otf,
)
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.core.noise import estimate_noise


def camera(size: int = 256) -> np.ndarray:
    return data.camera()[60 : 60 + size, 120 : 120 + size].astype(np.float32) / 255


@pytest.mark.parametrize("shape", [(24, 31), (25, 30)])
def test_gaussian_otf_is_the_transform_of_the_sampled_gaussian(shape):
    sampled = psf_to_otf(gaussian_psf(1.4), shape)
    assert np.abs(sampled - blur_otf(shape, 1.4)).max() < 2e-4


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
        blur_otf((4, 4), sigma)


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


def test_images_too_small_to_judge_have_no_noise():
    assert estimate_noise(np.random.default_rng(3).random((2, 9))) == 0


@pytest.mark.parametrize("exponent", [1.0, 5 / 3, 2.0])
def test_blur_of_any_exponent_passes_one_half_where_the_gaussian_does(exponent):
    otf = blur_otf((400, 400), 2.0, exponent)
    frequency = fft.rfftfreq(400)
    assert np.interp(half_frequency(2.0), frequency, otf[0]) == pytest.approx(0.5, abs=2e-3)
    assert otf[0, 0] == 1
    assert np.all(np.diff(otf[0]) < 0)
    assert np.array_equal(blur_otf((6, 5), 0.0, exponent), np.ones((6, 3)))


def test_an_exponent_of_two_is_the_gaussian():
    nu = np.hypot(fft.fftfreq(31)[:, None], fft.rfftfreq(40))
    assert np.abs(blur_otf((31, 40), 1.3) - np.exp(-2 * (np.pi * 1.3 * nu) ** 2)).max() < 1e-6


@pytest.mark.parametrize("exponent", [0.9, 2.1, float("nan")])
def test_exponents_beyond_the_family_are_refused(exponent):
    with pytest.raises(ConfigurationError, match="exponent"):
        blur_otf((8, 8), 1.0, exponent)

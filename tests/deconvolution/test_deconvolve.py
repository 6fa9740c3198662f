"""The whole stage: every method, the border, colour, guides, tiles, settings."""

import dataclasses
import itertools
import threading

import cv2
import numpy as np
import pytest
from blurred_images import camera, psnr
from small_problems import gaussian_psf

from turbrestore.blur.estimation import BlurEstimate
from turbrestore.blur.psf import half_frequency
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.core.noise_spectrum import RINGS, NoiseSpectrum
from turbrestore.deconvolution.deconvolve import (
    BOUNDARIES,
    METHODS,
    DeconvolutionParams,
    automatic_fidelity,
    deconvolve,
    deconvolve_steps,
    whole_image_fidelity,
)
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams, automatic_h
from turbrestore.deconvolution.tv import LocalPenalty
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES

TV = LocalPenalty()


@pytest.mark.parametrize("side", [16, 24])
@pytest.mark.parametrize("method", ["nltv", "tv"])
def test_a_start_that_is_solved_at_once_is_not_divided_by_nothing(method, side):
    params = DeconvolutionParams(method=method, boundary="periodic", iterations=20)
    for name, width, noise in itertools.product(("camera", "brick", "grass"), (0.5, 1.0, 2.5), (0.0, 0.01)):
        scene = SCENES[name](side, side) + np.random.default_rng(0).normal(0, noise, (side, side))
        assert np.isfinite(deconvolve(scene, width, params).image).all()


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", METHODS)
def test_a_constant_image_stays_what_it_is(method, boundary):
    flat = np.full((20, 24), 0.37, np.float32)
    result = deconvolve(flat, 1.5, DeconvolutionParams(method=method, boundary=boundary))
    assert result.image == pytest.approx(0.37, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_without_blur_the_image_is_left_alone(method):
    image = np.random.default_rng(11).normal(0.5, 0.3, (12, 12, 3)).astype(np.float32)
    for nothing in (0, np.ones((1, 1))):
        result = deconvolve(image, nothing, DeconvolutionParams(method=method))
        assert np.array_equal(result.image, image)
        assert (result.sigma, result.iterations, result.converged) == (0, 0, True)


@pytest.mark.parametrize(("method", "gain"), [("nltv", 3.5), ("tv", 3.5), ("wiener", 3.0), ("tikhonov", 2.5)])
def test_every_method_restores_a_photograph(method, gain):
    truth, blurred = camera(96, 1.5, 0.002)
    result = deconvolve(blurred, 1.5, DeconvolutionParams(method=method))
    assert psnr(result.image, truth) > psnr(blurred, truth) + gain
    assert result.noise == pytest.approx(0.002, rel=0.3)
    assert result.fidelity == pytest.approx(automatic_fidelity(method, blurred, result.noise))
    assert len(result.recorded) == len(result.objective) == len(result.changes)
    assert result.recorded[-1] == result.iterations


@pytest.mark.parametrize("method", ["nltv", "tv", "wiener"])
def test_the_border_is_restored_as_well_as_the_interior(method):
    sigma = 1.5
    truth, blurred = camera(96, sigma, 0.002)
    border = np.ones(truth.shape, bool)
    border[6:-6, 6:-6] = False
    errors = {}
    for boundary in BOUNDARIES:
        result = deconvolve(blurred, sigma, DeconvolutionParams(method=method, boundary=boundary))
        squares = (result.image - truth) ** 2
        errors[boundary] = np.sqrt(squares[border].mean()), np.sqrt(squares[~border].mean())
    at_border, inside = errors["unknown"]
    before = np.sqrt(((blurred - truth) ** 2)[border].mean())
    assert at_border < 1.5 * inside
    assert at_border < 0.75 * before
    assert at_border < 0.5 * errors["periodic"][0]


@pytest.mark.parametrize("method", METHODS)
def test_automatic_fidelity_is_near_the_best(method):
    truth, blurred = camera(80, 1.5, 0.008)
    automatic = deconvolve(blurred, 1.5, DeconvolutionParams(method=method))
    scores = [
        psnr(deconvolve(blurred, 1.5, DeconvolutionParams(method=method, fidelity=automatic.fidelity * f)).image, truth)
        for f in (0.1, 0.3, 3.0, 10.0)
    ]
    assert psnr(automatic.image, truth) > max(scores) - 0.4


def test_a_sampled_psf_does_as_its_gaussian():
    _, blurred = camera(48, 1.5, 0.002)
    params = DeconvolutionParams(method="tv")
    by_sigma, by_psf = deconvolve(blurred, 1.5, params), deconvolve(blurred, gaussian_psf(1.5), params)
    assert by_psf.sigma == pytest.approx(1.5, rel=0.01)
    assert np.abs(by_psf.image - by_sigma.image).mean() < 2e-3


def test_an_asymmetric_psf_moves_the_image_back():
    truth, _ = camera(48, 1.5, 0.0)
    psf = np.zeros((3, 5))
    psf[1, 4], psf[1, 2] = 0.6, 0.4
    blurred = cv2.filter2D(truth, -1, psf[::-1, ::-1], borderType=cv2.BORDER_REFLECT)
    result = deconvolve(blurred, psf, DeconvolutionParams(method="tv", fidelity=3000.0))
    assert psnr(result.image, truth) > psnr(blurred, truth) + 8


def test_channels():
    grey, blurred = camera(48, 1.5, 0.0)
    gain = np.array([0.9, 0.6, 0.3], np.float32)
    params = DeconvolutionParams(method="wiener", fidelity=300.0, tolerance=1e-6)
    each = deconvolve(blurred[..., None] * gain, 1.5, dataclasses.replace(params, channels="each"))
    for channel in range(3):
        alone = deconvolve(blurred * gain[channel], 1.5, params)
        assert each.image[..., channel] == pytest.approx(alone.image, abs=2e-3)
    kept = deconvolve(blurred[..., None] * gain + 0.05, 1.5, params)
    # The differences between channels, which are chroma, are those of the input.
    chroma = (kept.image - kept.image[..., :1]) - (blurred[..., None] * (gain - gain[0]))
    unclipped = ((kept.image > 0) & (kept.image < 1)).all(axis=-1)
    assert np.abs(chroma[unclipped]).max() < 1e-5
    assert psnr(kept.image, grey[..., None] * gain + 0.05) > psnr(blurred[..., None] * gain, grey[..., None] * gain)


def test_weights_come_from_the_guide():
    truth, blurred = camera(48, 1.5, 0.002)
    params = DeconvolutionParams(iterations=60)
    own = deconvolve(blurred, 1.5, params)
    same = deconvolve(blurred, 1.5, params, guide=np.repeat(blurred[..., None], 3, axis=2))
    # Nothing resembles anything in a guide of noise: other weights, another image.
    other = deconvolve(blurred, 1.5, params, guide=np.random.default_rng(12).random(blurred.shape))
    assert same.image == pytest.approx(own.image, abs=5e-3)
    assert np.abs(other.image - own.image).mean() > 5 * np.abs(same.image - own.image).mean()
    blurry = deconvolve(blurred, 1.5, dataclasses.replace(params, sharpen_guide=False))
    assert psnr(blurry.image, truth) > psnr(blurred, truth) + 2


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (3, 2), (5, 5, 3)])
@pytest.mark.parametrize("method", METHODS)
def test_tiny_images(method, shape):
    image = np.random.default_rng(13).random(shape).astype(np.float32)
    result = deconvolve(image, 1.0, DeconvolutionParams(method=method, iterations=20, channels="each"))
    assert result.image.shape == shape
    assert np.isfinite(result.image).all()
    assert result.image.min() >= 0
    assert result.image.max() <= 1


def test_every_iteration_is_yielded_and_inputs_stay():
    _, blurred = camera(32, 1.0, 0.0)
    colour = np.repeat(blurred[..., None], 3, axis=2)
    before, states = colour.copy(), []
    params = DeconvolutionParams(channels="each")
    result = finish(deconvolve_steps(colour, 1.0, params), states.append)
    assert [state.iteration for state in states] == list(range(1, result.iterations + 1))
    assert [states[number - 1].change for number in result.recorded] == result.changes.tolist()
    assert states[0].change == np.inf
    assert np.array_equal(colour, before)


def test_a_deconvolution_that_is_left_early_ends_its_threads():
    before = set(threading.enumerate())
    steps = deconvolve_steps(camera(64, 1.0, 0.0)[1], 1.0, runtime=Runtime(threads=3))
    next(steps)
    steps.close()
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("method", METHODS)
def test_the_same_bytes_whatever_the_number_of_threads(monkeypatch, method):
    for place in ("deconvolve", "nonlocal_prior.nonlocal_tv", "problem"):
        monkeypatch.setattr(f"turbrestore.deconvolution.{place}.PARALLEL_PIXELS", 1)
    _, blurred = camera(72, 1.5, 0.002)
    params, guide = DeconvolutionParams(method=method, iterations=10), blurred[::-1]
    images = [deconvolve(blurred, 1.5, params, guide, Runtime(threads=threads)).image for threads in (1, 2, 5)]
    assert len({image.tobytes() for image in images}) == 1


def test_unusable_inputs_are_refused():
    image = np.zeros((8, 8), np.float32)
    with pytest.raises(ConfigurationError, match="sigma_or_psf"):
        deconvolve(image, -1.0)
    with pytest.raises(DataError, match="psf"):
        deconvolve(image, np.ones((2, 2)))
    with pytest.raises(DataError, match="guide: expected the size"):
        deconvolve(image, 1.0, guide=np.zeros((8, 9)))
    with pytest.raises(DataError, match="image"):
        deconvolve(np.full((8, 8), np.nan), 1.0)


def test_an_estimate_stands_for_its_removable_width_and_its_shape():
    image = np.random.default_rng(20).random((48, 48)).astype(np.float32)
    nothing = np.zeros(0)
    estimate = BlurEstimate(1.2, 0.4, 5 / 3, 0.01, 1, 1.0, nothing, nothing)
    by_estimate = deconvolve(image, estimate, DeconvolutionParams(iterations=5))
    by_width = deconvolve(image, 1.0, DeconvolutionParams(iterations=5, exponent=5 / 3))
    assert np.array_equal(by_estimate.image, by_width.image)
    gaussian = DeconvolutionParams(iterations=5, exponent=2.0)
    assert np.array_equal(deconvolve(image, estimate, gaussian).image, deconvolve(image, 1.0, gaussian).image)


@pytest.mark.long
def test_a_tile_agrees_with_the_whole_away_from_its_border():
    """With a halo of 96 pixels; a sharpened guide makes the same choice of neighbours in a tile as in the whole."""
    halo, scene = 96, SCENES["camera"](256, 352)[64:192]
    image = cv2.GaussianBlur(scene, (0, 0), 1.5) + np.random.default_rng(21).normal(0, 0.005, scene.shape)
    params = with_whole_image_settings(image, image)
    guide = deconvolve(image, 1.5, DeconvolutionParams(method="wiener")).image
    exact = dataclasses.replace(with_whole_image_settings(image, guide), sharpen_guide=False, tolerance=1e-3)
    for settings, share, guide_of in ((params, 99, None), (exact, 100, guide)):
        whole = deconvolve(image, 1.5, settings, guide_of).image
        part = np.s_[:, 96:]
        tile = deconvolve(image[part], 1.5, settings, None if guide_of is None else guide_of[part]).image
        difference = np.abs(tile - whole[part])[:, halo:-halo]
        assert np.percentile(difference, share) < 1e-2
        assert np.sqrt(np.mean(difference**2)) < 2e-3


def with_whole_image_settings(image, guide):
    """Settings with λ of a whole image and h of its whole guide."""
    weights = NonlocalParams(h=automatic_h(np.asarray(guide, np.float32)))
    return DeconvolutionParams(fidelity=whole_image_fidelity(image, DeconvolutionParams()), weights=weights)


def test_the_fidelity_of_tiles_is_that_of_the_whole():
    image = np.random.default_rng(22).random((16, 16))
    assert whole_image_fidelity(image, DeconvolutionParams(fidelity=300.0)) == 300.0
    tv = DeconvolutionParams(method="tv", iterations=1)
    assert whole_image_fidelity(image, tv) == deconvolve(image, 1.0, tv).fidelity


def test_the_width_may_stand_in_the_settings():
    image = np.random.default_rng(23).random((24, 24)).astype(np.float32)
    params = DeconvolutionParams(method="tv", iterations=3, sigma=1.3)
    assert np.array_equal(deconvolve(image, params=params).image, deconvolve(image, 1.3, params).image)
    with pytest.raises(ConfigurationError, match="expected a blur here or in params.sigma, found neither"):
        deconvolve(image)


@pytest.mark.parametrize("method", METHODS)
def test_smooth_noise_that_is_certain_weakens_the_data(method):
    image = cv2.GaussianBlur(SCENES["camera"](64, 64), (0, 0), 1.5)
    params = DeconvolutionParams(method=method, iterations=1)
    # Second differences do not see noise of 3 % that is as smooth as that.
    power = 0.03**2 * 4 * np.pi * 1.5**2 * np.exp(-((2 * np.pi * 1.5 * RINGS) ** 2))
    certain, doubtful = (NoiseSpectrum(power, share * power, np.zeros(RINGS.size)) for share in (0.05, 0.6))
    plain, less, same = (
        finish(deconvolve_steps(image, 1.5, params, spectrum=spectrum)) for spectrum in (None, certain, doubtful)
    )
    assert same.fidelity == plain.fidelity and same.noise == plain.noise
    assert less.fidelity < 0.5 * plain.fidelity
    assert less.noise == pytest.approx(np.sqrt(0.9 * np.interp(half_frequency(1.5), RINGS, power)), rel=0.01)

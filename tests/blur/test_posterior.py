"""Posterior of the blur: what a hypothesis predicts leads back to it, and one wrong witness is outvoted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from turbrestore.blur.estimation import find_candidates
from turbrestore.blur.learnt import LearntBlur
from turbrestore.blur.posterior import EXCLUDED, BlurWitnesses, blur_posterior, estimate_posterior, measure_witnesses
from turbrestore.blur.psf import half_frequency, radial_otf
from turbrestore.blur.witnesses.hypotheses import hypotheses, shapes
from turbrestore.blur.witnesses.image_evidence import image_evidence, judged_candidate
from turbrestore.blur.witnesses.short_exposure import displacement_variance, short_exposures
from turbrestore.blur.witnesses.spectral_variation import RINGS, SpectralVariation
from turbrestore.blur.witnesses.two_tones import TwoTones
from turbrestore.core.noise_spectrum import white_noise
from turbrestore.deblurring.decisions import explain_posterior
from turbrestore.deblurring.remove_blur import find_blur, remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.runtime.runtime import DEFAULT
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES

# Share of the variation that windows over several isoplanatic patches leave.
SHARE = 0.33
# Frames that move are interpolated.
INTERPOLATION = radial_otf(RINGS, 0.35, 2.0)


def expected_variation(strength, diffraction):
    """Variation of frames with little noise, registered exactly, behind air of theory."""
    mean, amplitude, power = (
        values[0, 0] for values in short_exposures(np.array([strength]), np.array([diffraction]), RINGS)
    )
    error = np.full(len(RINGS), 1e-3)
    signal = 1e5 * mean**2
    ones = np.ones(len(RINGS))
    return SpectralVariation(SHARE * amplitude, error, SHARE * power, error, signal, ones, 0 * ones, 0.0, 40, 1), mean


@pytest.mark.parametrize(("strength", "diffraction"), [(1.2, 1.5), (2.5, 2.0), (4.0, 1.2)])
def test_theory_leads_back_to_its_blur(strength, diffraction):
    variation, mean = expected_variation(strength, diffraction)
    variance = float(displacement_variance(np.array(strength), np.array(diffraction)))
    (true,), _ = shapes((mean * INTERPOLATION)[None])
    found = blur_posterior(None, BlurWitnesses(variance, 40.0, variation=variation))
    low, middle, high = found.width
    assert low / 1.1 < true < high * 1.1 and low < middle < high
    assert abs(middle / true - 1) < 0.45
    assert found.air > 0.95


def test_shapes_of_power_laws_are_found():
    for sigma, exponent in ((0.9, 2.0), (1.5, 1.2), (2.5, 1.6)):
        (width,), (shape,) = shapes(radial_otf(RINGS, sigma, exponent)[None])
        assert width == pytest.approx(sigma, rel=0.02) and shape == pytest.approx(exponent, abs=0.05)
    assert half_frequency(width) < 0.5


def test_known_optics_narrow_the_blur():
    strength, diffraction = 4.0, 1.2
    variation, mean = expected_variation(strength, diffraction)
    (true,), _ = shapes((mean * INTERPOLATION)[None])
    variance = float(displacement_variance(np.array(strength), np.array(diffraction)))
    unknown = BlurWitnesses(variance, 40.0, variation=variation)
    before, after = (blur_posterior(None, one) for one in (unknown, replace(unknown, diffraction=diffraction)))
    assert before.width[0] < 0.9 * true < after.width[0] < true < after.width[1] < 1.15 * true


@pytest.mark.parametrize(
    ("widths", "preferred", "judged"),
    [
        # A soft scene, and letters behind a wide blur without and with noise in the original image.
        ({1: 1.33, 2: 2.32, 3: 2.55, 4: 3.64, 6: 4.38}, 6, 2),
        ({1: 1.37, 2: 2.46, 3: 3.24, 4: 4.06, 6: 4.83}, 6, 4),
        ({1: 0.81, 2: 2.42, 3: 3.47, 4: 4.38, 6: 5.97}, 1, 6),
        # One that is too wide for all of them.
        ({1: 2.6, 2: 5.18, 3: 7.77, 4: 10.32}, 1, 4),
        # Narrow blurs, which reduced images do not resolve.
        ({1: 1.2, 2: 1.4}, 1, 1),
        ({1: 0.9, 2: 1.25}, 2, 2),
    ],
)
def test_an_image_is_reduced_as_far_as_its_blur_is_resolved(widths, preferred, judged):
    (one, *_) = find_candidates(SCENES["camera"](96, 96))
    found = tuple(
        replace(one, estimate=replace(one.estimate, sigma=sigma, reduction=reduction))
        for reduction, sigma in widths.items()
    )
    assert judged_candidate(found, preferred).estimate.reduction == judged


def test_only_frames_that_stand_still_can_be_without_any_blur():
    still, moved = (blur_posterior(None, BlurWitnesses(variance, 40.0)) for variance in (0.0, 2.0))
    assert still.width[0] < 0.3 < moved.width[0]


def still_clip(scene, count=12, noise=0.004):
    frames = scene + np.random.default_rng(0).normal(0, noise, (count, *scene.shape))
    return frames.astype(np.float32), np.zeros((count, *scene.shape, 2), np.float32)


def test_nothing_is_removed_from_a_sharp_clip_that_stands_still():
    frames, flows = still_clip(SCENES["camera"](128, 128))
    image = frames.mean(axis=0)
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(0.0, 12.0))
    found = find_blur(image, DeconvolutionParams(), DEFAULT, witnesses)
    result = finish(remove_blur_steps(image, image, found=found))
    assert result.deconvolution.sigma == 0 and result.posterior.removed == 0
    np.testing.assert_array_equal(result.deconvolution.image, np.clip(image, 0, 1))
    assert "removing one is not expected to improve it" in result.decisions[0].reason


def test_a_lens_is_told_from_the_air():
    frames, flows = still_clip(cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), 2.0))
    image = frames.mean(axis=0)
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(0.0, 12.0))
    found = blur_posterior(image_evidence(image), witnesses, witnesses.variation.with_power(image))
    assert found.air < 0.2 and found.width[1] == pytest.approx(2.0, rel=0.25)
    assert found.exponent > 1.8


@pytest.mark.parametrize("sigma", [4.0, 8.0])
def test_a_wide_blur_that_stands_still_is_found(sigma):
    frames, flows = still_clip(cv2.GaussianBlur(SCENES["camera"](256, 256), (0, 0), sigma))
    image = frames.mean(axis=0)
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(0.0, 12.0))
    evidence = image_evidence(image)
    by_theory = blur_posterior(evidence, witnesses, witnesses.variation.with_power(image))
    assert by_theory.width[1] == pytest.approx(sigma, rel=0.3)
    _, found = estimate_posterior(image, witnesses, white_noise(0.004 / 12**0.5))
    assert 0.6 * sigma < found.width[1] < 1.3 * sigma
    # Hardly any training clip is blurred by more than six pixels: a loss may be expected, and then nothing is removed.
    assert 0.4 * sigma < found.removed < 1.2 * sigma or (sigma > 6 and found.removed == 0)


@pytest.mark.parametrize(("exponent", "depth", "removed"), [(None, 0.2, 1.1), (1.7, 0.2, 1.1), (1.7, 0.05, 0.9)])
def test_networks_get_the_quantiles_of_the_posterior_and_its_shape_is_removed(monkeypatch, exponent, depth, removed):
    frames, flows = still_clip(cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), 1.5))
    image, given = frames.mean(axis=0), []

    def learnt(_features, widths, alone):
        given.extend([widths, alone])
        return LearntBlur(np.array([1.0, 1.2, 1.4]), 1.1, 0.9)

    monkeypatch.setattr("turbrestore.blur.posterior.learnt_blur", learnt)
    monkeypatch.setattr("turbrestore.blur.posterior.two_tones", lambda *_: TwoTones(1.0, depth, 0.1))
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(0.0, 12.0))
    evidence, found = estimate_posterior(image, witnesses, white_noise(0.001), exponent=exponent)
    by_theory = blur_posterior(evidence, witnesses, witnesses.variation.with_power(image))
    np.testing.assert_array_equal(given[0], by_theory.width)
    assert given[1] == evidence.estimate.sigma > 1
    assert found.removed == removed and found.width.tolist() == [1.0, 1.2, 1.4]
    assert np.isnan(found.by_tones).all()
    assert found.exponent == (exponent or by_theory.exponent)
    _, careful = estimate_posterior(image, witnesses, white_noise(0.001), exponent=exponent, cautious=True)
    assert careful.removed == 0.9


@pytest.mark.parametrize("cautious", [False, True])
def test_two_tones_of_the_image_alone_tell_its_blur(cautious):
    scene = SCENES["chart"](192, 192)
    frames, flows = still_clip(cv2.GaussianBlur(scene, (0, 0), 1.2))
    image = frames.mean(axis=0)
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(0.0, 12.0))
    _, found = estimate_posterior(image, witnesses, white_noise(0.001), exponent=2.0, cautious=cautious)
    assert found.removed == found.width[1] == found.by_tones[1] == pytest.approx(1.2, rel=0.15)
    assert "by the two tones of the image" in explain_posterior(found, found.removed).reason


def test_one_wrong_witness_is_outvoted():
    variation, _ = expected_variation(2.5, 2.0)
    frames, _ = still_clip(SCENES["words"](128, 128))
    sharp = image_evidence(frames.mean(axis=0))
    still = BlurWitnesses(0.0, 40.0, variation=variation)
    assert blur_posterior(sharp, still).width[1] < blur_posterior(None, still).width[1]
    assert EXCLUDED[0] < EXCLUDED[1] < EXCLUDED[2] < EXCLUDED[0] + EXCLUDED[1]
    moving = replace(still, displacement=float(displacement_variance(np.array(2.5), np.array(2.0))))
    assert blur_posterior(sharp, moving).width[1] > 1


def test_weights_and_quantiles_are_in_order():
    variation, _ = expected_variation(2.0, 1.5)
    known = hypotheses()
    assert np.exp(known.prior).sum() == pytest.approx(1)
    found = blur_posterior(None, BlurWitnesses(0.7, 30.0, variation=variation))
    assert np.isnan(found.by_image).all()
    for quantiles in (found.width, found.by_displacement, found.by_variation):
        assert (np.diff(quantiles) >= 0).all()
    decision = explain_posterior(found, 0.5)
    assert decision.choice == "0.50 pixels removed"
    assert f"{found.width[1]:.2f} pixels ({found.width[0]:.2f} to {found.width[2]:.2f})" in decision.reason
    wider = explain_posterior(replace(found, by_variation=found.width + 3), 0.5)
    assert wider.reason.endswith("; the variation of the frames alone would give more")

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.metrics import align, appearance, compare, compare_flows, endpoint_error, overshoot, psnr, sharpness
from turbrestore.synthesis.scenes import resolution_chart


@pytest.fixture(scope="module")
def scene():
    return cv2.GaussianBlur(resolution_chart(160, 192), (0, 0), 1.6)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.4, -0.7), (-2.3, 0.2), (9.0, -6.5)])
def test_a_global_shift_costs_next_to_nothing(scene, shift):
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(scene, matrix, scene.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    # Unaligned, the same images are 12 to 20 dB apart.
    assert compare(moved, scene).psnr > 30


def test_gain_and_offset_are_fitted(scene):
    figures = compare(0.7 * scene + 0.1, scene)
    assert figures.psnr < 25
    assert figures.psnr_fit > 60
    assert figures.ssim > 0.999


def test_a_shift_is_taken_out_exactly_once():
    fine = cv2.GaussianBlur(resolution_chart(800, 960), (0, 0), 2)
    # Two of five fine pixels: a shift of 0.4 that no interpolation has touched.
    still, moved = (np.roll(fine, by, axis=1).reshape(160, 5, 192, 5).mean(axis=(1, 3)) for by in (0, 2))
    result, truth = align(moved, still)
    assert (truth == still[30:-30, 30:-30]).all()
    # Shifted not at all or twice, the whole of the difference would be left.
    before = np.sqrt(np.mean((moved - still)[30:-30, 30:-30] ** 2))
    assert np.sqrt(np.mean((result - truth) ** 2)) < before / 3


@pytest.mark.parametrize("crop", [(0, 0, 0, 0), (5, 9, 12, 3), (0, 20, 0, 30)])
@pytest.mark.parametrize("level", [0.02, 0.1])
def test_noise_on_a_crop_gives_the_psnr_of_the_noise(scene, crop, level):
    top, bottom, left, right = crop
    part = scene[top : 160 - bottom, left : 192 - right]
    noisy = part + np.random.default_rng(1).normal(0, level, part.shape).astype(np.float32)
    # At least 6,000 pixels: the mean square is known to 2 %, 0.08 dB.
    assert compare(noisy, scene).psnr == pytest.approx(-20 * np.log10(level), abs=0.25)


def test_figures_are_of_the_aligned_pair(scene):
    moved = np.roll(scene, (4, -3), axis=(0, 1))
    figures = compare(moved, scene)
    assert figures.sharpness == pytest.approx(1.0, abs=0.02)
    assert figures.overshoot == 0
    blurred = compare(cv2.GaussianBlur(moved, (0, 0), 2), scene)
    assert blurred.sharpness < 0.8
    assert compare(moved + 2 * (moved - cv2.GaussianBlur(moved, (0, 0), 2)), scene).overshoot > 0.05


def test_colour_is_averaged_over_the_channels(scene):
    colour = np.dstack([scene + 0.1, scene, scene - 0.1])
    assert compare(colour, scene).psnr > 80
    assert compare(scene, colour).psnr > 80


def test_appearance_against_a_reference(scene):
    blurred = cv2.GaussianBlur(scene, (0, 0), 2)
    seen = appearance(scene, blurred)
    assert seen.sharpness == pytest.approx(1 / appearance(blurred, scene).sharpness)
    assert seen.sharpness > 1.2
    brighter = scene.copy()
    brighter[:10] += 2.0
    assert appearance(brighter, scene).overshoot == pytest.approx(10 / 160)


def test_flows_are_compared_with_and_without_their_mean():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 1, (30, 12, 16, 2)).astype(np.float32)
    steady = np.full((12, 16, 2), (0.6, -0.8), np.float32)
    figures = compare_flows(truth + steady, truth)
    assert figures.endpoint_error == pytest.approx(1.0, abs=1e-6)
    assert figures.endpoint_error_centred == pytest.approx(0.0, abs=1e-6)
    # Mean length of a vector of two independent normal components: √(π / 2).
    assert figures.true_length == pytest.approx(np.sqrt(np.pi / 2), rel=0.03)
    noisy = compare_flows(truth + steady + rng.normal(0, 0.1, truth.shape), truth)
    # One of 30 degrees of freedom went into the mean.
    assert noisy.endpoint_error_centred == pytest.approx(0.1 * np.sqrt(np.pi / 2 * 29 / 30), rel=0.02)
    assert noisy.endpoint_error == pytest.approx(endpoint_error(truth + steady, truth), rel=0.05)
    assert np.isnan(compare_flows(truth[:1], truth[:1]).endpoint_error_centred)


def test_bad_input_is_refused(scene):
    with pytest.raises(DataError, match="at least 68 pixels"):
        compare(scene[:60], scene)
    with pytest.raises(DataError, match="at most the size of the truth"):
        compare(scene, scene[:80, :80])
    with pytest.raises(DataError, match="expected the shape"):
        psnr(scene, scene[1:])
    with pytest.raises(DataError, match="expected the size"):
        overshoot(scene, scene[1:])
    with pytest.raises(DataError, match="some contrast"):
        sharpness(scene, np.full((80, 80), 0.5))
    with pytest.raises(DataError, match="expected the shape"):
        endpoint_error(np.zeros((2, 2, 2)), np.zeros((3, 2, 2)))
    with pytest.raises(DataError, match="^truth: expected an image with some contrast"):
        compare(scene, np.full((160, 192), 0.5))
    with pytest.raises(DataError, match="expected the size"):
        appearance(scene[1:], scene)
    for flows, truth in (((2, 3, 3, 2), (3, 3, 3, 2)), ((3, 3, 2), (3, 3, 2))):
        with pytest.raises(DataError, match="^flows: expected shape"):
            compare_flows(np.zeros(flows), np.zeros(truth))


def test_small_images_whose_best_match_lies_outside_are_compared():
    truth, result = np.random.default_rng(0).random((2, 72, 72)).astype(np.float32)
    # The truth is continued by its mirror image, which the middle of the result is here.
    result[24:48, 24:48] = np.pad(truth, 24, mode="reflect")[40:64, 96:]
    assert np.isfinite(compare(result, truth).ssim)

import cv2
import numpy as np
import pytest

from turbrestore.errors import DataError
from turbrestore.metrics import align, compare, endpoint_error, overshoot, psnr, sharpness
from turbrestore.synthesis.scenes import resolution_chart


@pytest.fixture(scope="module")
def scene():
    return cv2.GaussianBlur(resolution_chart(160, 192), (0, 0), 1.6)


def test_psnr_of_known_noise(scene):
    noisy = scene + np.random.default_rng(0).normal(0, 0.05, scene.shape).astype(np.float32)
    assert compare(noisy, scene).psnr == pytest.approx(-20 * np.log10(0.05), abs=0.1)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.4, -0.7), (-2.3, 0.2), (9.0, -6.5)])
def test_a_global_shift_costs_next_to_nothing(scene, shift):
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(scene, matrix, scene.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    # Unaligned, the same images are 12 to 20 dB apart.
    assert compare(moved, scene).psnr > 30


def test_a_crop_is_found(scene):
    assert compare(scene[5:-9, 12:-3], scene).psnr > 60


def test_gain_and_offset_are_fitted(scene):
    figures = compare(0.7 * scene + 0.1, scene)
    assert figures.psnr < 25
    assert figures.psnr_fit > 60
    assert figures.ssim > 0.999


def test_aligned_images_are_the_interior(scene):
    result, truth = align(scene, scene)
    assert result.shape == truth.shape == (100, 132)
    assert (truth == scene[30:-30, 30:-30]).all()


def test_sharpness_and_overshoot(scene):
    blurred = cv2.GaussianBlur(scene, (0, 0), 2)
    assert sharpness(blurred, scene) < 0.8
    unsharp = scene + 2 * (scene - blurred)
    assert overshoot(unsharp, scene) > 0.05
    assert overshoot(blurred, scene) == 0


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

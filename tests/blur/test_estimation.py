"""Known blurs are found blindly, at the right reduction and with the right uncertainty."""

import threading

import cv2
import numpy as np
import pytest

from turbrestore.blur.estimation import (
    PART,
    BlurEstimate,
    _preference,
    _reduce,
    estimate_blur,
    find_candidates,
    most_detailed,
    removable_width,
    unreduced_width,
)
from turbrestore.blur.marginal_likelihood import WIDTHS, image_gradients, likeliest_width, width_costs
from turbrestore.blur.psf import GAUSSIAN, KOLMOGOROV, blur_otf, fused_exponent
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.threads import one_thread_each
from turbrestore.synthesis.scenes import SCENES


def blurred(name, sigma, noise, seed=0, size=256):
    scene = SCENES[name](size, size)
    scene = cv2.GaussianBlur(scene, (0, 0), sigma) if sigma else scene
    return (scene + np.random.default_rng(seed).normal(0, noise, scene.shape)).astype(np.float32)


@pytest.mark.parametrize("shape", [(16, 40), (130, 300), (257, 140), (700, 300)])
@pytest.mark.parametrize("kind", ["noise", "repeated", "flat"])
def test_the_part_with_most_detail_is_found_in_strips(shape, kind):
    image = np.random.default_rng(0).random(shape, dtype=np.float32)
    if kind != "noise":
        # Many parts have the same detail, except for rounding.
        image = np.tile(image[:16, :16], (45, 20))[: shape[0], : shape[1]] if kind == "repeated" else 0 * image
    part = most_detailed(image, PART)
    height, width = part.shape
    energy = np.square(cv2.Laplacian(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.CV_32F))
    total = np.pad(np.cumsum(np.cumsum(energy, 1, np.float64), 0), ((1, 0), (1, 0)))
    inside = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = divmod(part.ctypes.data - image.ctypes.data, image.strides[0])
    left //= image.itemsize
    assert inside[top, left] == pytest.approx(inside.max(), rel=1e-9)
    if kind == "noise":
        assert (top, left) == np.unravel_index(int(inside.argmax()), inside.shape)


@pytest.mark.parametrize("name", ["camera", "chart", "words", "grass"])
@pytest.mark.parametrize(("sigma", "noise"), [(1.0, 0.002), (2.0, 0.01), (4.0, 0.005)])
def test_the_width_of_a_gaussian_is_found(name, sigma, noise):
    estimate = estimate_blur(blurred(name, sigma, noise), exponent=GAUSSIAN)
    assert 0.75 * sigma < estimate.sigma < 1.25 * sigma
    assert 0 < estimate.uncertainty < 0.5 * sigma


def test_the_width_of_a_turbulent_blur_is_found_and_depends_on_the_shape():
    scene = SCENES["camera"](256, 256)
    for sigma, shape in ((1.6, KOLMOGOROV), (1.0, fused_exponent(1.0)), (1.6, fused_exponent(1.6))):
        image = np.fft.irfft2(blur_otf(scene.shape, sigma, shape) * np.fft.rfft2(scene), s=scene.shape)
        image = (image + np.random.default_rng(1).normal(0, 0.002, scene.shape)).astype(np.float32)
        asked = shape if shape == KOLMOGOROV else None
        found = estimate_blur(image, exponent=asked)
        assert found.sigma == pytest.approx(sigma, rel=0.2)
        assert found.exponent == (asked or fused_exponent(found.sigma))


def test_the_exponent_of_fused_frames_falls_with_their_width():
    shapes = [fused_exponent(sigma) for sigma in np.linspace(0, 20, 60)]
    assert np.all(np.diff(shapes) < 0)
    assert shapes[0] == KOLMOGOROV
    assert shapes[-1] == pytest.approx(1.2, abs=1e-3)


@pytest.mark.parametrize("name", ["chart", "words", "camera"])
def test_sharp_scenes_keep_the_width_of_their_pixels(name):
    assert estimate_blur(blurred(name, 0, 0.002)).sigma == 0.35


def test_wide_blurs_are_estimated_from_a_reduced_image():
    assert estimate_blur(blurred("words", 4.0, 0.005), exponent=GAUSSIAN).reduction >= 3
    assert estimate_blur(blurred("words", 0.9, 0.005), exponent=GAUSSIAN).reduction == 1


def test_more_noise_weakens_the_evidence_and_does_not_widen_the_blur():
    low, high = (estimate_blur(blurred("camera", 1.5, noise), exponent=GAUSSIAN) for noise in (0.002, 0.04))
    assert high.evidence < low.evidence
    assert high.sigma < 1.3 * 1.5


def test_small_and_uniform_images_have_no_width():
    for image in (np.zeros((1, 1)), np.random.default_rng(3).random((2, 90)), np.full((64, 64), 0.3)):
        estimate = estimate_blur(image)
        assert (estimate.sigma, estimate.uncertainty) == (0, np.inf)


def test_colour_is_reduced_to_luminance():
    image = blurred("camera", 1.5, 0.005, size=128)
    assert estimate_blur(np.repeat(image[..., None], 3, axis=2)).sigma == pytest.approx(
        estimate_blur(image).sigma, rel=1e-3
    )


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_the_uncertainty_is_half_the_difference_between_half_and_twice_the_noise(sigma):
    image = blurred("camera", sigma, 0.005)
    found = estimate_blur(image)
    gradients = image_gradients(most_detailed(_reduce(image, found.reduction), PART))
    with one_thread_each():
        shapes = [fused_exponent(found.reduction * width) for width in WIDTHS]
        both = [width_costs(gradients, shapes, factor * found.noise, 1) for factor in (0.5, 2.0)]
    less, more = (unreduced_width(likeliest_width(costs), found.reduction) for costs in both)
    assert found.uncertainty == abs(more - less) / 2


def test_caution_is_for_narrow_blurs():
    assert removable_width(1.5, 0.2) == pytest.approx(1.4)
    assert removable_width(4.0, 1.2) == 4.0
    assert removable_width(0.3, 1.0) == 0
    assert removable_width([1.5, 4.0], np.inf).tolist() == [0, 0]
    # A wider estimate is never removed less.
    assert (np.diff(removable_width(np.linspace(0.35, 8, 100), 0.5)) > 0).all()


def test_reduced_images_are_large_enough():
    image = blurred("words", 4.0, 0.005, size=250)
    assert [one.estimate.reduction for one in find_candidates(image)] == [1, 2, 3, 4]
    assert [one.estimate.reduction for one in find_candidates(image[:239])] == [1, 2, 3]


def test_two_threads_find_the_same(monkeypatch):
    image, both = blurred("camera", 1.5, 0.005), threading.Barrier(2, timeout=60)

    def costs(*settings, rises):
        if rises == 1:
            # A single thread would wait until the timeout.
            both.wait()
        return width_costs(*settings, rises)

    alone = estimate_blur(image, runtime=Runtime(threads=1))
    monkeypatch.setattr("turbrestore.blur.estimation.width_costs", costs)
    together = estimate_blur(image, runtime=Runtime(threads=2))
    for name in ("sigma", "uncertainty", "noise", "reduction", "evidence"):
        assert getattr(together, name) == getattr(alone, name)
    assert np.array_equal(together.costs, alone.costs)


@pytest.mark.parametrize(
    ("reductions", "uncertainties", "evidence", "chosen"),
    [
        ((2, 8), (0.27, 0.27), 1.0, 8),
        ((2, 8), (0.2, 0.27), 1.0, 2),
        ((1, 2), (0.27, 0.25), 1.0, 1),
        ((1, 2), (0.4, 0.25), 1.0, 2),
        ((1, 2), (0.27, 0.25), 0.15, 2),
        ((1, 2), (0.2, 0.25), 0.15, 1),
    ],
)
def test_among_similar_uncertainties_a_clearly_blurred_image_is_preferred_and_then_the_smallest(
    reductions, uncertainties, evidence, chosen
):
    pairs = zip(reductions, uncertainties, strict=True)
    none = np.zeros(0)
    estimates = [
        BlurEstimate(1.0, uncertainty, 5 / 3, 0.01, reduction, evidence, none, none) for reduction, uncertainty in pairs
    ]
    assert min(estimates, key=_preference).reduction == chosen


def test_a_reduction_averages_whole_blocks():
    image = np.random.default_rng(4).random((13, 9)).astype(np.float32)
    assert np.allclose(_reduce(image, 4), image[:12, :8].reshape(3, 4, 2, 4).mean(axis=(1, 3)), atol=1e-6)


def test_the_most_detailed_part_holds_the_detail():
    image = np.zeros((300, 400), np.float32)
    image[200:280, 250:350] = np.random.default_rng(5).random((80, 100))
    part = most_detailed(image, PART)
    assert part.shape == (129, 129)
    assert most_detailed(image[:128, :70], PART).shape == (121, 65)
    assert part.sum() == pytest.approx(image.sum())


def test_bad_input_is_refused():
    with pytest.raises(ConfigurationError, match="noise"):
        estimate_blur(np.zeros((32, 32)), noise=-0.1)
    with pytest.raises(ConfigurationError, match="exponent"):
        estimate_blur(np.zeros((32, 32)), exponent=3.0)
    with pytest.raises(DataError):
        estimate_blur(np.full((32, 32), np.nan))

"""Widths of known blurs, found blind, and the cost against its definition."""

import threading

import cv2
import numpy as np
import pytest

from turbrestore.blur.estimation import (
    _TOLERANCE,
    BlurEstimate,
    _costs,
    _doubt,
    _fit_scene,
    _gradients,
    _lowest,
    _most_detailed,
    _reduce,
    _widen,
    estimate_blur,
)
from turbrestore.blur.psf import GAUSSIAN, KOLMOGOROV, blur_otf
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.runtime.threads import one_thread_each
from turbrestore.synthesis.scenes import SCENES


def blurred(name, sigma, noise, seed=0, size=256):
    scene = SCENES[name](size, size)
    scene = cv2.GaussianBlur(scene, (0, 0), sigma) if sigma else scene
    return (scene + np.random.default_rng(seed).normal(0, noise, scene.shape)).astype(np.float32)


@pytest.mark.parametrize("shape", [(16, 40), (130, 300), (257, 140), (700, 300)])
@pytest.mark.parametrize("kind", ["noise", "repeated", "flat"])
def test_the_part_with_most_detail_is_that_of_sums_over_the_whole_image(shape, kind):
    image = np.random.default_rng(0).random(shape, dtype=np.float32)
    if kind != "noise":
        # Many parts have the same detail, but for rounding.
        image = np.tile(image[:16, :16], (45, 20))[: shape[0], : shape[1]] if kind == "repeated" else 0 * image
    part = _most_detailed(image)
    height, width = part.shape
    energy = cv2.Laplacian(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.CV_32F)
    total = np.pad(np.cumsum(np.cumsum(np.square(energy), 1, np.float64), 0), ((1, 0), (1, 0)))
    inside = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    assert part.ctypes.data == image[top:, left:].ctypes.data


@pytest.mark.parametrize("name", ["camera", "chart", "words", "grass"])
@pytest.mark.parametrize(("sigma", "noise"), [(1.0, 0.002), (2.0, 0.01), (4.0, 0.005)])
def test_the_width_of_a_gaussian_is_found(name, sigma, noise):
    estimate = estimate_blur(blurred(name, sigma, noise), exponent=GAUSSIAN)
    assert 0.75 * sigma < estimate.sigma < 1.25 * sigma
    assert 0 < estimate.uncertainty < 0.5 * sigma


def test_the_width_of_a_turbulent_blur_is_found_and_depends_on_the_shape():
    scene = SCENES["camera"](256, 256)
    image = np.fft.irfft2(blur_otf(scene.shape, 1.6, KOLMOGOROV) * np.fft.rfft2(scene), s=scene.shape)
    image = (image + np.random.default_rng(1).normal(0, 0.002, scene.shape)).astype(np.float32)
    assert estimate_blur(image).sigma == pytest.approx(1.6, rel=0.15)
    assert estimate_blur(image).exponent == KOLMOGOROV


@pytest.mark.parametrize("name", ["chart", "words", "camera"])
def test_sharp_scenes_keep_the_width_of_their_pixels(name):
    assert estimate_blur(blurred(name, 0, 0.002)).sigma == 0.35


def test_wide_blurs_are_read_from_a_reduced_image():
    assert estimate_blur(blurred("words", 4.0, 0.005), exponent=GAUSSIAN).reduction >= 3
    assert estimate_blur(blurred("words", 0.9, 0.005), exponent=GAUSSIAN).reduction == 1


def test_more_noise_makes_the_estimate_less_sure_and_not_wider():
    low, high = (estimate_blur(blurred("camera", 1.5, noise), exponent=GAUSSIAN) for noise in (0.002, 0.04))
    assert high.evidence < low.evidence
    assert high.sigma < 1.3 * 1.5


def test_images_that_say_nothing_are_left_alone():
    for image in (np.zeros((1, 1)), np.random.default_rng(3).random((2, 90)), np.full((64, 64), 0.3)):
        estimate = estimate_blur(image)
        assert (estimate.sigma, estimate.uncertainty) == (0, np.inf)


def test_colour_counts_as_luminance():
    image = blurred("camera", 1.5, 0.005, size=128)
    assert estimate_blur(np.repeat(image[..., None], 3, axis=2)).sigma == pytest.approx(
        estimate_blur(image).sigma, rel=1e-3
    )


def test_without_blur_the_cost_is_the_evidence_of_independent_gradients():
    # Gradients that do not mix have γ = max(y² − λ, 0) in closed form, and L = mean of y²/(λ+γ) + log(λ+γ).
    gradients = _gradients(SCENES["camera"](64, 64))
    noise, y = 0.02, gradients.planes.astype(float)
    total = np.maximum(y**2, 2 * noise**2)
    exact = np.mean(y**2 / total + np.log(total))
    scene, prior = gradients.planes, np.full_like(gradients.planes, float(np.mean(y**2)))
    costs = []
    for _ in range(12):
        scene, prior, cost = _fit_scene(gradients, scene, prior, blur=(1e-3, GAUSSIAN), noise=noise)
        costs.append(cost)
    assert np.all(np.diff(costs) < 1e-5)
    # γ → 0 is approached slowly.
    assert exact <= costs[-1] < exact + 0.05


def test_the_scene_of_a_blur_solves_its_normal_equations():
    gradients = _gradients(blurred("camera", 1.5, 0.01, size=48))
    y, noise, prior = gradients.planes, 0.01, np.full_like(gradients.planes, 1e-3)
    scene = y
    otf = np.exp(-2 * (np.pi * 1.5 * gradients.frequency) ** 2)

    def blur(v):
        return np.fft.ifft2(otf[..., None] * np.fft.fft2(v, axes=(0, 1)), axes=(0, 1)).real

    before = prior
    for _ in range(40):
        before = prior
        scene, prior, _ = _fit_scene(gradients, scene, prior, blur=(1.5, GAUSSIAN), noise=noise)
    gradient = blur(y - blur(scene)) / (2 * noise**2) - scene / before
    assert np.abs(gradient).max() < 0.02 * np.abs(blur(y) / (2 * noise**2)).max()


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_the_uncertainty_is_half_of_what_half_and_twice_the_noise_differ_by(sigma):
    image = blurred("camera", sigma, 0.005)
    found = estimate_blur(image)
    gradients = _gradients(_most_detailed(_reduce(image, found.reduction)))
    with one_thread_each():
        less, more = (_lowest(_costs(gradients, KOLMOGOROV, share * found.noise, 1)) for share in (0.5, 2.0))
    assert found.uncertainty == abs(_widen(more, found.reduction) - _widen(less, found.reduction)) / 2


def test_two_threads_find_the_same(monkeypatch):
    image, both = blurred("camera", 1.5, 0.005), threading.Barrier(2, timeout=60)

    def costs(*settings, rises):
        if rises == 1:
            # One thread by itself waits in vain.
            both.wait()
        return _costs(*settings, rises)

    alone = estimate_blur(image)
    monkeypatch.setattr("turbrestore.blur.estimation._costs", costs)
    together = estimate_blur(image, threads=2)
    for name in ("sigma", "uncertainty", "noise", "reduction", "evidence"):
        assert getattr(together, name) == getattr(alone, name)
    assert np.array_equal(together.costs, alone.costs)


@pytest.mark.parametrize("scene", ["chart", "camera", "brick"])
def test_steps_that_are_left_out_change_no_width(monkeypatch, scene):
    gradients, widths = _gradients(blurred(scene, 1.0, 0.002, size=96)), []
    for tolerance in (0.0, _TOLERANCE, 1e-2):
        monkeypatch.setattr("turbrestore.blur.estimation._TOLERANCE", tolerance)
        widths.append(_lowest(_costs(gradients, GAUSSIAN, 0.005, 2)))
    assert widths[1] == pytest.approx(widths[0], abs=1e-3)
    assert widths[2] != pytest.approx(widths[0], abs=1e-2)


@pytest.mark.parametrize("rises", [1, 2, 3])
def test_the_search_stops_once_the_cost_has_risen_so_many_times(rises):
    costs = _costs(_gradients(blurred("chart", 1.0, 0.002, size=96)), GAUSSIAN, 0.005, rises)
    lowest = int(np.argmin(costs))
    assert 0 < lowest == len(costs) - 1 - rises
    assert np.all(np.diff(costs[lowest:]) > 0)


@pytest.mark.parametrize(
    ("reductions", "uncertainties", "evidence", "believed"),
    [
        ((2, 8), (0.27, 0.27), 1.0, 8),
        ((2, 8), (0.2, 0.27), 1.0, 2),
        ((1, 2), (0.27, 0.25), 1.0, 1),
        ((1, 2), (0.4, 0.25), 1.0, 2),
        ((1, 2), (0.27, 0.25), 0.15, 2),
        ((1, 2), (0.2, 0.25), 0.15, 1),
    ],
)
def test_of_images_about_as_sure_a_blurred_whole_comes_first_and_then_the_smallest(
    reductions, uncertainties, evidence, believed
):
    pairs = zip(reductions, uncertainties, strict=True)
    none = np.zeros(0)
    estimates = [BlurEstimate(1.0, doubt, 5 / 3, 0.01, reduction, evidence, none, none) for reduction, doubt in pairs]
    assert min(estimates, key=_doubt).reduction == believed


def test_a_reduction_averages_whole_blocks():
    image = np.random.default_rng(4).random((13, 9)).astype(np.float32)
    assert np.allclose(_reduce(image, 4), image[:12, :8].reshape(3, 4, 2, 4).mean(axis=(1, 3)), atol=1e-6)


def test_the_most_detailed_part_holds_the_detail():
    image = np.zeros((300, 400), np.float32)
    image[200:280, 250:350] = np.random.default_rng(5).random((80, 100))
    part = _most_detailed(image)
    assert part.shape == (129, 129)
    assert _most_detailed(image[:128, :70]).shape == (121, 65)
    assert part.sum() == pytest.approx(image.sum())


def test_bad_input_is_refused():
    with pytest.raises(ConfigurationError, match="noise"):
        estimate_blur(np.zeros((32, 32)), noise=-0.1)
    with pytest.raises(ConfigurationError, match="exponent"):
        estimate_blur(np.zeros((32, 32)), exponent=3.0)
    with pytest.raises(DataError):
        estimate_blur(np.full((32, 32), np.nan))

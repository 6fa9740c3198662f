"""When deconvolution stops: predictions, what is measured, and how far the result is from a thousand iterations."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from blurred_images import camera, psnr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft

from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.deconvolution.primal_dual import REST
from turbrestore.deconvolution.problem import MARGIN_SIGMAS, Problem, margin_around
from turbrestore.deconvolution.stopping import FEWEST, MOST, SPAN, TILE, change_of, iterate, predicted_change, tile_sums
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES


@given(st.floats(0.01, MOST / (1 + MOST)), st.floats(1e-9, 1e3), st.integers(FEWEST + 1, 40))
def test_the_rest_of_a_geometric_series_is_predicted(ratio, first, count):
    changes = first * ratio ** np.arange(count)
    rest = first * ratio ** np.arange(count, count + 2000)
    assert predicted_change(changes) == pytest.approx(rest.sum(), rel=1e-6, abs=0)


@given(st.floats(MOST / (1 + MOST), 2), st.integers(FEWEST + 1, 40))
def test_the_prediction_is_limited_for_slow_or_growing_changes(ratio, count):
    changes = ratio ** np.arange(count)
    assert predicted_change(changes) == pytest.approx(MOST * changes[-1], rel=1e-9, abs=0)


@given(st.lists(st.floats(0.1, 1), min_size=FEWEST + 1, max_size=20), st.floats(1e-3, 1e3))
def test_only_the_last_changes_count_and_only_their_ratio(changes, scale):
    found = predicted_change(changes)
    assert predicted_change([scale * change for change in changes]) == pytest.approx(scale * found)
    if len(changes) > SPAN:
        assert predicted_change(changes[-1 - SPAN :]) == found


def test_the_prediction_is_largest_while_there_are_too_few_changes():
    changes = [0.5**number for number in range(FEWEST + 1)]
    for count in range(1, FEWEST + 1):
        assert predicted_change(changes[:count]) == MOST * changes[count - 1]
    assert predicted_change(changes) == pytest.approx(changes[-1])


def test_an_image_that_does_not_change_has_converged():
    assert predicted_change([0.0]) == predicted_change([0.0] * 9) == predicted_change([1.0, 0.0]) == 0


def test_changes_that_differ_by_rounding_count_as_equal():
    assert predicted_change([1.0] * SPAN + [np.nextafter(1.0, 0.0)]) == pytest.approx(MOST)


def test_nan_never_converges():
    assert not predicted_change([1.0] * SPAN + [np.nan]) <= 1
    nan = np.full((2, 2), np.nan, np.float32)
    assert not change_of([nan], [nan], np.ones_like(nan)) <= 1


@given(st.integers(1, 3 * TILE), st.integers(1, 3 * TILE))
@settings(deadline=None)
def test_sums_over_tiles(height, width):
    image = np.random.default_rng(height * width).random((height, width), np.float32)
    expected = [
        [image[y : y + TILE, x : x + TILE].sum(dtype=np.float64) for x in range(0, width, TILE)]
        for y in range(0, height, TILE)
    ]
    np.testing.assert_allclose(tile_sums(image), expected, rtol=1e-12)


def test_change_is_that_of_the_worst_tile_relative_to_the_brightest():
    before, measured = np.zeros((TILE, 2 * TILE), np.float32), np.ones((TILE, 2 * TILE), np.float32)
    before[:, TILE:] = 0.5
    after = before.copy()
    after[:, :TILE] = 0.05
    assert change_of([before], [after], measured) == pytest.approx(0.1)
    assert change_of([before, before], [after, before], measured) == pytest.approx(0.1 / np.sqrt(2))
    measured[:, :TILE] = 0
    assert change_of([before], [after], measured) == 0
    assert change_of([0 * before], [0 * before], measured) == 0
    assert change_of([before], [0 * before], measured) == 1
    # Images are shown between black and white.
    assert change_of([1 + before], [2 + before], measured) == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "scene", "noise", "size", "most"),
    [
        ("nltv", "camera", 0.01, 64, 60),
        ("nltv", "chart", 0.03, 64, 60),
        ("nltv", "words", 0.002, 64, 100),
        # The border cuts letters in two.
        ("nltv", "words", 0.002, 128, 160),
        # Bars that the blur has all but extinguished.
        ("nltv", "chart", 0.002, 128, 320),
        ("tv", "camera", 0.002, 64, 60),
        ("tv", "words", 0.03, 64, 60),
        ("wiener", "words", 0.002, 64, 40),
        ("tikhonov", "chart", 0.01, 64, 60),
    ],
)
def test_stopping_rule_is_as_good_as_a_thousand_iterations(method, scene, noise, size, most):
    sigma, params = 1.5, DeconvolutionParams(method=method, exponent=KOLMOGOROV)
    larger = SCENES[scene](size + 32, size + 32)
    blurred = fft.irfft2(blur_otf(larger.shape, sigma, KOLMOGOROV) * fft.rfft2(larger), s=larger.shape)
    blurred += np.random.default_rng(0).normal(0, noise, larger.shape)
    inside = (slice(16, 16 + size), slice(16, 16 + size))
    truth, seen = larger[inside], blurred[inside].astype(np.float32)
    stopped = deconvolve(seen, sigma, params)
    exhaustive = deconvolve(seen, sigma, dataclasses.replace(params, iterations=1000, tolerance=0))
    assert stopped.converged
    assert stopped.iterations <= most
    assert exhaustive.iterations > stopped.iterations
    assert abs(psnr(stopped.image, truth) - psnr(exhaustive.image, truth)) < 0.05
    assert exhaustive.objective[-1] < exhaustive.objective[0]


def test_ten_iterations_are_measured_together_where_they_change_most():
    # Without a margin, so that tiles are those of the image; what overshoots black is clipped, and does not count.
    blurred = np.random.default_rng(1).normal(0.5, 0.01, (128, 128)).astype(np.float32)
    blurred[8:56, 72:120] += 0.3 * (camera(48, 1.5, 0.002)[1] - 0.5)
    params, numbers = DeconvolutionParams(boundary="periodic", tolerance=0), (40, 50, 55)
    images = {n: deconvolve(blurred, 1.5, dataclasses.replace(params, iterations=n)).image for n in numbers}
    result = deconvolve(blurred, 1.5, dataclasses.replace(params, iterations=55))
    assert result.recorded.tolist() == [10, 20, 30, 40, 50, 55]
    tiles = [(slice(y, y + 64), slice(x, x + 64)) for y in (0, 64) for x in (0, 64)]
    for number, (before, after) in zip((4, 5), itertools.pairwise(numbers), strict=True):
        moved = max(np.linalg.norm((images[after] - images[before])[tile]) for tile in tiles)
        size = max(np.linalg.norm(images[after][tile]) for tile in tiles)
        assert result.changes[number] == pytest.approx(moved / size / (after - before), rel=0.02)
    predicted = np.array([predicted_change(10 * result.changes[:count]) for count in range(1, 6)])
    for tolerance in (1.001 * predicted.min(), 0.999 * predicted.min(), 1.001 * np.median(predicted)):
        stopped = deconvolve(blurred, 1.5, dataclasses.replace(params, iterations=50, tolerance=tolerance))
        enough = predicted <= tolerance
        assert stopped.converged == enough.any()
        assert stopped.iterations == (10 * (1 + int(enough.argmax())) if enough.any() else 50)


@pytest.mark.parametrize(
    ("device", "method", "numbers", "rim"),
    [("cpu", "nltv", (130, 140), 3), ("cpu", "wiener", (4, 6), 0), ("cpu:0", "wiener", (4, 6), 0)],
)
def test_changes_at_the_border_count_where_they_do_not_oscillate(device, method, numbers, rim):
    if device != "cpu":
        pytest.importorskip("torch")
    _, blurred = camera(96, 2.5, 0.002)
    params = DeconvolutionParams(method=method, tolerance=0)
    runtime = Runtime(device=device)
    runs = [
        deconvolve(blurred, 2.5, dataclasses.replace(params, iterations=number), runtime=runtime) for number in numbers
    ]
    before, after = (run.image for run in runs)

    def largest(image, left_out):
        """Root of the largest sum of squares of a tile of the image with its margin."""
        inner = np.pad(image[left_out : 96 - left_out, left_out : 96 - left_out], left_out)
        padded = np.pad(inner, margin_around((96, 96), math.ceil(MARGIN_SIGMAS * 2.5)).widths)
        return max(np.linalg.norm(padded[y : y + 64, x : x + 64]) for y in (0, 64) for x in (0, 64))

    moved, inside, everywhere = (largest(after - before, left_out) for left_out in (rim, 3, 0))
    assert runs[1].changes[-1] == pytest.approx(moved / largest(after, rim) / (numbers[1] - numbers[0]), rel=0.02)
    assert everywhere > 1.3 * inside


class Oscillating:
    """A solver that moves every pixel up and down, back where it was after some iterations."""

    window = 10

    def __init__(self, period, amplitude, drift, rest):
        self.period, self.amplitude, self.drift, self.rest = period, amplitude, drift, rest

    def start(self, image):
        return SimpleNamespace(image=image, number=0)

    def step(self, problem, state):
        number = state.number + 1
        level = 0.5 + self.amplitude * math.sin(2 * math.pi * number / self.period) + self.drift * number
        return SimpleNamespace(image=0 * state.image + level, number=number)

    def penalty(self, problem, u):
        return 0.0


@pytest.mark.parametrize(
    ("solver", "iterations", "stopped"),
    [
        # Of 0.5, the tolerance is 0.0015, and the prediction is six times the last change.
        (Oscillating(40, 0.0007, 0.0, REST), 200, 50),
        (Oscillating(40, 0.0007, 0.0, 0), 200, 200),
        (Oscillating(50, 0.1, 0.0, REST), 200, 200),
        (Oscillating(40, 0.0, 1e-4, REST), 200, 200),
        (Oscillating(40, 0.0007, 0.0, REST), 45, 45),
    ],
)
def test_an_image_at_rest_has_converged(solver, iterations, stopped):
    image = np.full((8, 8), 0.5, np.float32)
    one = np.ones_like(image)
    problem = Problem(image, one, np.ones((8, 5), np.float32), 1.0)
    found = finish(iterate(solver, [problem], [solver.start(image)], one, iterations, 3e-3))
    assert (found.iterations, found.converged) == (stopped, stopped == 50)


def test_half_of_a_small_image_is_measured_however_wide_the_blur(monkeypatch):
    seen = []

    def change(before, after, measured):
        seen.append(measured)
        return 1.0

    monkeypatch.setattr("turbrestore.deconvolution.stopping.change_of", change)
    image = np.random.default_rng(0).random((16, 24), np.float32)
    deconvolve(image, 20.0, DeconvolutionParams(method="tv", iterations=10))
    assert [int(seen[0].max(axis=axis).sum()) for axis in (1, 0)] == [8, 16]

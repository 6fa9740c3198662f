"""Where deconvolution stops: what is judged, and how far that is from two thousand iterations."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from blurred_images import camera, in_strips, psnr
from scipy import fft

from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deconvolution import deconvolve as deconvolution
from turbrestore.deconvolution import torch_deconvolution
from turbrestore.deconvolution.deconvolve import (
    MARGIN_SIGMAS,
    DeconvolutionParams,
    deconvolve,
)
from turbrestore.deconvolution.nonlocal_tv import NonlocalParams
from turbrestore.deconvolution.planes import margin_widths
from turbrestore.deconvolution.primal_dual import REST
from turbrestore.deconvolution.problem import Problem
from turbrestore.deconvolution.stopping import still_to_come
from turbrestore.deconvolution.strip_grid import StripGrid
from turbrestore.deconvolution.torch_deconvolution import SolverSettings
from turbrestore.synthesis.scenes import SCENES


@pytest.mark.parametrize(
    ("method", "scene", "noise", "size", "most"),
    [
        ("nltv", "camera", 0.01, 64, 60),
        ("nltv", "chart", 0.03, 64, 60),
        ("nltv", "words", 0.002, 64, 100),
        # The border cuts letters in two.
        ("nltv", "words", 0.002, 128, 160),
        ("nltv", "brick", 0.002, 128, 230),
        # Bars that the blur has all but extinguished.
        ("nltv", "chart", 0.002, 256, 360),
        ("tv", "camera", 0.002, 64, 60),
        ("tv", "words", 0.03, 64, 60),
        ("tv", "words", 0.002, 128, 60),
        ("wiener", "words", 0.002, 64, 40),
        ("tikhonov", "chart", 0.01, 64, 60),
    ],
)
def test_stopping_rule_is_as_good_as_two_thousand_iterations(method, scene, noise, size, most):
    sigma, params = 1.5, DeconvolutionParams(method=method, exponent=KOLMOGOROV)
    larger = SCENES[scene](size + 32, size + 32)
    blurred = fft.irfft2(blur_otf(larger.shape, sigma, KOLMOGOROV) * fft.rfft2(larger), s=larger.shape)
    blurred += np.random.default_rng(0).normal(0, noise, larger.shape)
    inside = (slice(16, 16 + size), slice(16, 16 + size))
    truth, seen = larger[inside], blurred[inside].astype(np.float32)
    stopped = deconvolve(seen, sigma, params)
    exhaustive = deconvolve(seen, sigma, dataclasses.replace(params, iterations=2000, tolerance=0))
    assert stopped.converged
    assert stopped.iterations <= most
    assert exhaustive.iterations > stopped.iterations
    assert abs(psnr(stopped.image, truth) - psnr(exhaustive.image, truth)) < 0.05
    assert exhaustive.objective[-1] < exhaustive.objective[0]


@pytest.mark.parametrize("strips", [False, True])
def test_ten_iterations_are_judged_together_where_they_change_most(monkeypatch, strips):
    if strips:
        in_strips(monkeypatch)
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
    foreseen = np.array([still_to_come(10 * result.changes[:count]) for count in range(1, 6)])
    for tolerance in (1.001 * foreseen.min(), 0.999 * foreseen.min(), 1.001 * np.median(foreseen)):
        stopped = deconvolve(blurred, 1.5, dataclasses.replace(params, iterations=50, tolerance=tolerance))
        enough = foreseen <= tolerance
        assert stopped.converged == enough.any()
        assert stopped.iterations == (10 * (1 + int(enough.argmax())) if enough.any() else 50)


@pytest.mark.parametrize("device", [None, "cpu:0"])
@pytest.mark.parametrize(("method", "numbers", "rim"), [("nltv", (130, 140), 3), ("wiener", (4, 6), 0)])
def test_changes_beside_the_border_are_judged_where_they_do_not_swing(device, method, numbers, rim):
    if device:
        pytest.importorskip("torch")
    _, blurred = camera(96, 2.5, 0.002)
    params = DeconvolutionParams(method=method, tolerance=0, device=device)
    runs = [deconvolve(blurred, 2.5, dataclasses.replace(params, iterations=number)) for number in numbers]
    before, after = (run.image for run in runs)

    def largest(image, left_out):
        """Root of the largest sum of squares of a tile of the image with its margin."""
        inner = np.pad(image[left_out : 96 - left_out, left_out : 96 - left_out], left_out)
        padded = np.pad(inner, margin_widths((96, 96), math.ceil(MARGIN_SIGMAS * 2.5)))
        return max(np.linalg.norm(padded[y : y + 64, x : x + 64]) for y in (0, 64) for x in (0, 64))

    moved, inside, everywhere = (largest(after - before, left_out) for left_out in (rim, 3, 0))
    assert runs[1].changes[-1] == pytest.approx(moved / largest(after, rim) / (numbers[1] - numbers[0]), rel=0.02)
    assert everywhere > 1.3 * inside


class Swinging:
    """A solver that moves every pixel up and down, back where it was after some iterations."""

    window = 10

    def __init__(self, period, swing, drift, rest):
        self.period, self.swing, self.drift, self.rest = period, swing, drift, rest

    def start(self, image):
        return SimpleNamespace(image=image, number=0)

    def step(self, problem, state):
        number = state.number + 1
        level = 0.5 + self.swing * math.sin(2 * math.pi * number / self.period) + self.drift * number
        return SimpleNamespace(image=0 * state.image + level, number=number)

    def penalty(self, problem, u):
        return 0.0


@pytest.mark.parametrize("device", [None, "cpu"])
@pytest.mark.parametrize(
    ("solver", "iterations", "stopped"),
    [
        # Of 0.5, the tolerance is 0.0015, and of what has moved last six times as much is foreseen.
        (Swinging(40, 0.0007, 0.0, REST), 200, 50),
        (Swinging(40, 0.0007, 0.0, 0), 200, 200),
        (Swinging(50, 0.1, 0.0, REST), 200, 200),
        (Swinging(40, 0.0, 1e-4, REST), 200, 200),
        (Swinging(40, 0.0007, 0.0, REST), 45, 45),
    ],
)
def test_an_image_that_stays_where_it_is_rests(device, solver, iterations, stopped):
    image = np.full((8, 8), 0.5, np.float32)
    problem = Problem(image, np.ones_like(image), np.ones((1, 8, 5), np.float32), 1.0, StripGrid((8, 8)))
    if device:
        torch = pytest.importorskip("torch")
        settings = SolverSettings("tv", iterations, 3e-3, 10, 40, True, NonlocalParams())
        loaded, start = torch_deconvolution._load(problem, device), solver.start(torch.from_numpy(image))
        found = torch_deconvolution._iterate(solver, [loaded], [start], settings, None)
    else:
        params = DeconvolutionParams(tolerance=3e-3, iterations=iterations)
        found = deconvolution._iterate(solver, [problem], [solver.start(image)], params, None)
    assert (found.iterations, found.converged) == (stopped, stopped == 50)


def test_of_a_small_image_half_is_judged_however_wide_the_blur(monkeypatch):
    judged = []

    def change(before, after, problem):
        judged.append(problem.judged)
        return 1.0

    monkeypatch.setattr("turbrestore.deconvolution.deconvolve._change", change)
    image = np.random.default_rng(0).random((16, 24), np.float32)
    deconvolve(image, 40.0, DeconvolutionParams(method="tv", iterations=10))
    assert [axis.sum() for axis in judged[0]] == [8, 16]

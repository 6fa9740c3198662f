"""Wiener and Tikhonov by conjugate gradients, against dense algebra and the closed form."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy import fft
from skimage import data
from small_problems import dense, dense_blur, small_problem

from turbrestore.blur.psf import blur_otf, laplacian_symbol, psf_to_otf
from turbrestore.deconvolution.conjugate_gradient import (
    ConjugateGradients,
    quadratic_solver,
    wiener_fidelity,
    wiener_filtered,
)
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.deconvolution.tv import local_gradient


@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("method", ["wiener", "tikhonov"])
def test_the_residual_is_the_slope_of_the_energy(method, steps):
    # An asymmetric kernel, for which a convolution and its adjoint differ.
    psf = np.random.default_rng(1).random((3, 3))
    problem = dataclasses.replace(small_problem(1, 7.0), otf=psf_to_otf(psf, (8, 8)))
    solver = quadratic_solver(problem, method)
    state = solver.start(problem)
    for _ in range(steps):
        state = solver.step(problem, state)
    u, direction = state.image, np.random.default_rng(2).random((8, 8)).astype(np.float32)
    down = fft.irfft2(state.residual, s=u.shape)

    def energy(image):
        return problem.misfit(image) + solver.penalty(problem, image)

    slope = (energy(u + 0.1 * direction) - energy(u - 0.1 * direction)) / 0.2
    assert -np.vdot(down, direction) == pytest.approx(slope, rel=1e-3, abs=2e-4)


@pytest.mark.parametrize("method", ["wiener", "tikhonov"])
def test_periodic_solution_is_the_closed_form(method):
    rng = np.random.default_rng(8)
    image = (0.3 + 0.4 * cv2.GaussianBlur(rng.random((20, 24)), (0, 0), 1.0)).astype(np.float32)
    params = DeconvolutionParams(method=method, boundary="periodic", fidelity=80.0)
    result = deconvolve(image, 0.9, params)
    otf = blur_otf(image.shape, 0.9).astype(np.float64)
    symbol = laplacian_symbol(*image.shape) if method == "wiener" else 1.0
    mean = image.mean()
    expected = mean + fft.irfft2(80.0 * otf * fft.rfft2(image - mean) / (80.0 * otf**2 + symbol), s=image.shape)
    assert expected.min() > 0
    assert expected.max() < 1
    assert result.image == pytest.approx(expected, abs=1e-5)
    assert (result.converged, result.iterations) == (True, 2)


@pytest.mark.parametrize("method", ["wiener", "tikhonov"])
def test_masked_solution_is_that_of_dense_least_squares(method):
    rng = np.random.default_rng(9)
    image = (0.3 + 0.4 * cv2.GaussianBlur(rng.random((9, 7)), (0, 0), 1.0)).astype(np.float32)
    sigma, fidelity, mean = 0.7, 50.0, image.mean(dtype=np.float64)
    result = deconvolve(image, sigma, DeconvolutionParams(method=method, fidelity=fidelity, tolerance=1e-7))
    # Margins of 4σ or more, on both sides, up to a size that transforms fast.
    shape = tuple(fft.next_fast_len(size + 2 * 3, real=True) for size in image.shape)
    top, left = ((p - n) // 2 for p, n in zip(shape, image.shape, strict=True))
    seen = np.zeros(shape, bool)
    seen[top : top + 9, left : left + 7] = True
    otf = blur_otf(shape, sigma)
    blur = dense(lambda u: fft.irfft2(otf * fft.rfft2(u), s=shape), shape)[seen.ravel()]
    penalty = dense(local_gradient, shape) if method == "wiener" else np.eye(seen.size)
    system = np.concatenate([np.sqrt(fidelity) * blur, penalty])
    right = np.concatenate([np.sqrt(fidelity) * (image.ravel() - mean), np.zeros(len(penalty))])
    solution = np.linalg.lstsq(system, right, rcond=None)[0]
    expected = mean + solution.reshape(shape)[seen].reshape(image.shape)
    assert result.converged
    assert result.image == pytest.approx(np.clip(expected, 0, 1), abs=2e-4)
    residual = system @ solution - right
    assert result.objective[-1] == pytest.approx(residual @ residual / 2, rel=1e-3)


def test_directions_are_conjugate():
    problem, solver = small_problem(10, 10.0), ConjugateGradients(laplacian_symbol(8, 8) + np.float32(0.1))
    blur, state, found = dense_blur(problem), solver.start(problem), []
    system = 10.0 * blur.T @ np.diag(problem.seen.ravel()) @ blur
    system += dense(lambda u: fft.irfft2(solver.symbol * fft.rfft2(u), s=(8, 8)), (8, 8))
    for _ in range(3):
        state = solver.step(problem, state)
        found.append(fft.irfft2(state.direction, s=(8, 8)).ravel().astype(np.float64))
    products = np.array(found) @ system @ np.array(found).T
    assert np.abs(products - np.diag(np.diag(products))).max() < 1e-3 * np.diag(products).min()


def test_conjugate_gradients_stay_where_they_are_when_solved():
    problem = dataclasses.replace(small_problem(10, 10.0), observed=np.full((8, 8), 0.5, np.float32))
    solver = ConjugateGradients(laplacian_symbol(8, 8))
    state = solver.start(problem)
    for _ in range(20):
        state = solver.step(problem, state)
    assert state.image == pytest.approx(0.5, abs=1e-5)


def test_wiener_fidelity_falls_with_noise_and_rises_with_contrast():
    image = data.camera()[60:124, 120:184].astype(np.float32) / 255
    assert wiener_fidelity(image, 0.01) < wiener_fidelity(image, 0.001)
    assert wiener_fidelity(image / 2, 0.001) < wiener_fidelity(image, 0.001)


@pytest.mark.parametrize("exponent", [5 / 3, 2.0])
@pytest.mark.parametrize("cycles", [(3, 0), (0, 8), (6, 10)])
def test_a_wave_behind_wieners_filter_has_the_amplitude_of_its_formula(cycles, exponent):
    # Whole half-cycles from border to border go on by reflection.
    angles = [np.pi * count * (np.arange(64) + 0.5) / 64 for count in cycles]
    image = np.float32(0.5 + 0.2 * np.outer(np.cos(angles[0]), np.cos(angles[1])))
    sigma, noise = 1.5, 0.01
    found = wiener_filtered(image, sigma, exponent, noise)
    nu = np.array(cycles) / 128
    otf = np.exp(-np.log(2) * (np.hypot(*nu) * np.pi * sigma / np.sqrt(np.log(2) / 2)) ** exponent)
    laplacian = np.sum(4 * np.sin(np.pi * nu) ** 2)
    gain = otf / (otf**2 + laplacian / wiener_fidelity(image, noise))
    inside = np.s_[12:-12, 12:-12]
    assert found[inside] == pytest.approx((0.5 + gain * (image - 0.5))[inside], abs=0.01)


def test_wieners_filter_of_less_noise_is_sharper():
    image = cv2.GaussianBlur(data.camera()[60:188, 120:248].astype(np.float32) / 255, (0, 0), 1.5)
    less, more = (np.abs(np.diff(wiener_filtered(image, 1.5, 2.0, noise))).mean() for noise in (0.002, 0.05))
    assert less > more > 1.1 * np.abs(np.diff(image)).mean()

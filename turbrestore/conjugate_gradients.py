"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .convolution_problem import Problem, inner, seen_mean
from .psf import Spectrum


class GradientState(NamedTuple):
    """u, residual of the normal equations, search direction, and ⟨residual, preconditioned residual⟩."""

    image: FloatArray
    residual: FloatArray
    direction: FloatArray
    decrease: float


@dataclass(frozen=True, eq=False)
class ConjugateGradients:
    """Solver for wiener and tikhonov: ``(λBᵀMB + R)(u − m) = λBᵀM(f − m)``, m the mean of what was seen.

    R is diagonal in Fourier (``symbol``), and ``(λBᵀB + R)⁻¹`` is the preconditioner. With M = 1 it is the solution.
    Both penalties are unaware of m or defined relative to it, so that a constant image stays what it is.
    """

    symbol: FloatArray

    def start(self, problem: Problem) -> GradientState:
        """Start from the solution for the continued image."""
        m = seen_mean(problem)
        right = fft.rfft2(problem.observed - m) * problem.otf.conj() * problem.fidelity
        u = m + self._precondition(problem, right)
        residual = -fft.irfft2(problem.gradient_spectrum(u) + self.symbol * fft.rfft2(u - m), s=u.shape)
        direction = self._precondition(problem, fft.rfft2(residual))
        return GradientState(u, residual, direction, inner(residual, direction))

    def step(self, problem: Problem, state: GradientState) -> GradientState:
        """One iteration of preconditioned conjugate gradients."""
        if state.decrease <= 0:
            return state
        spectrum = fft.rfft2(state.direction)
        blurred = problem.seen * fft.irfft2(problem.otf * spectrum, s=state.image.shape)
        data = problem.fidelity * problem.otf.conj() * fft.rfft2(blurred)
        image = fft.irfft2(data + self.symbol * spectrum, s=state.image.shape)
        length = np.float32(state.decrease / inner(state.direction, image))
        residual = state.residual - length * image
        preconditioned = self._precondition(problem, fft.rfft2(residual))
        decrease = inner(residual, preconditioned)
        direction = preconditioned + np.float32(decrease / state.decrease) * state.direction
        return GradientState(state.image + length * state.direction, residual, direction, decrease)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """½⟨u − m, R(u − m)⟩."""
        deviation = u - seen_mean(problem)
        return inner(deviation, fft.irfft2(self.symbol * fft.rfft2(deviation), s=u.shape)) / 2

    def _precondition(self, problem: Problem, spectrum: Spectrum) -> FloatArray:
        denominator = problem.fidelity * np.abs(problem.otf) ** 2 + self.symbol
        return fft.irfft2(spectrum / denominator, s=problem.observed.shape)

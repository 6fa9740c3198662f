"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .convolution_problem import Problem, inner, seen_mean, spectral_inner
from .psf import Spectrum


class GradientState(NamedTuple):
    """u, and of u − m in Fourier: residual of the normal equations, search direction; ⟨residual, preconditioned⟩."""

    image: FloatArray
    residual: Spectrum
    direction: Spectrum
    decrease: float


@dataclass(frozen=True, eq=False)
class ConjugateGradients:
    """Solver for wiener and tikhonov: ``(λBᵀMB + R)(u − m) = λBᵀM(f − m)``, m the mean of what was seen.

    R is diagonal in Fourier (``symbol``), and ``(λBᵀB + R)⁻¹`` is the preconditioner. With M = 1 it is the solution.
    Both penalties are unaware of m or defined relative to it, so that a constant image stays what it is.
    """

    symbol: FloatArray

    # Iterations that are judged together.
    window: ClassVar[int] = 1

    def start(self, problem: Problem) -> GradientState:
        """Start from the solution for the continued image."""
        m, shape = seen_mean(problem), problem.observed.shape
        deviation = fft.rfft2(problem.observed - m) * problem.otf.conj()
        deviation *= np.float32(problem.fidelity) * self._inverse(problem)
        u = m + fft.irfft2(deviation, s=shape)
        residual = -self.symbol * deviation
        deviation[0, 0] += m * u.size
        residual -= problem.gradient_spectrum(deviation)
        direction = residual * self._inverse(problem)
        return GradientState(u, residual, direction, spectral_inner(residual, direction, shape))

    def step(self, problem: Problem, state: GradientState) -> GradientState:
        """One iteration of preconditioned conjugate gradients.

        Inner products are those of the images, by Parseval, so that only u and what was seen of it are transformed.
        """
        if state.decrease <= 0:
            return state
        direction, shape = state.direction, state.image.shape
        image = problem.normal_spectrum(direction)
        image += self.symbol * direction
        length = np.float32(state.decrease / spectral_inner(direction, image, shape))
        image *= -length
        image += state.residual
        preconditioned = image * self._inverse(problem)
        decrease = spectral_inner(image, preconditioned, shape)
        u = fft.irfft2(direction, s=shape)
        u *= length
        u += state.image
        preconditioned += np.float32(decrease / state.decrease) * direction
        return GradientState(u, image, preconditioned, decrease)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """½⟨u − m, R(u − m)⟩."""
        deviation = u - seen_mean(problem)
        return inner(deviation, fft.irfft2(self.symbol * fft.rfft2(deviation), s=u.shape)) / 2

    def _inverse(self, problem: Problem) -> FloatArray:
        """Find the preconditioner in Fourier."""
        return np.reciprocal(np.float32(problem.fidelity) * problem.power + self.symbol)

"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .convolution_problem import Problem, inner, seen_mean, spectral_inner
from .psf import Spectrum

# Share of the energy of the data below which the residual is one of rounding.
ROUNDING = 1e-14


class GradientState(NamedTuple):
    """m; in Fourier u − m, residual of the normal equations and search direction; ⟨residual, preconditioned⟩.

    ``enough`` is that of a solution; from there on steps stay where they are.
    """

    mean: np.float32
    deviation: Spectrum
    residual: Spectrum
    direction: Spectrum
    decrease: float
    enough: float
    shape: tuple[int, int]

    @property
    def image(self) -> FloatArray:
        """u, transformed anew whenever it is asked for."""
        return self.mean + fft.irfft2(self.deviation, s=self.shape)


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
        residual, u = -self.symbol * deviation, deviation.copy()
        u[0, 0] += m * problem.observed.size
        residual -= problem.gradient_spectrum(u)
        direction = residual * self._inverse(problem)
        decrease = spectral_inner(residual, direction, shape)
        enough = ROUNDING * problem.fidelity * inner(problem.observed, problem.observed)
        return GradientState(m, deviation, residual, direction, decrease, enough, shape)

    def step(self, problem: Problem, state: GradientState) -> GradientState:
        """One iteration of preconditioned conjugate gradients.

        Inner products are those of the images, by Parseval, so that only what was seen of the direction is transformed.
        """
        if state.decrease <= state.enough:
            return state
        direction, shape = state.direction, state.shape
        image = problem.normal_spectrum(direction)
        image += self.symbol * direction
        length = np.float32(state.decrease / spectral_inner(direction, image, shape))
        image *= -length
        image += state.residual
        preconditioned = image * self._inverse(problem)
        decrease = spectral_inner(image, preconditioned, shape)
        preconditioned += np.float32(decrease / state.decrease) * direction
        deviation = length * direction
        deviation += state.deviation
        return state._replace(deviation=deviation, residual=image, direction=preconditioned, decrease=decrease)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """½⟨u − m, R(u − m)⟩."""
        deviation = u - seen_mean(problem)
        return inner(deviation, fft.irfft2(self.symbol * fft.rfft2(deviation), s=u.shape)) / 2

    def _inverse(self, problem: Problem) -> FloatArray:
        """Find the preconditioner in Fourier."""
        return np.reciprocal(np.float32(problem.fidelity) * problem.power + self.symbol)

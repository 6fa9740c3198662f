"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients.

Symbols as in :mod:`turbrestore.deconvolution.problem`, and

m : mean of the observed pixels.
R : operator of the penalty ``½⟨u − m, R(u − m)⟩``, diagonal in Fourier space: −Δ (wiener) or 1 (tikhonov).
d : search direction; r : residual of the normal equations.

The normal equations are ``(λBᵀMB + R)(u − m) = λBᵀM(f − m)``.  The preconditioner is ``(λBᵀB + R)⁻¹``, which solves
them if M = 1 everywhere.  Both penalties act on u − m, so a constant image is not changed.

All iterates are stored as half-spectra, and inner products of images are computed from these by Parseval's theorem.  An
iteration therefore needs only two Fourier transforms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import cv2
import numpy as np

from ..blur.psf import blur_otf, laplacian_symbol
from ..core.arrays import FloatArray
from ..runtime.fourier import irfft2, rfft2
from ..runtime.image_stacks import Stack, load, namespace, store
from .problem import MARGIN_SIGMAS, Problem, margin_around, total

# A residual below this share of the energy of the data, about the square of float32's precision, is rounding.
ROUNDING = 1e-14
# Iterations for the Wiener solution that nltv and tv start from; further ones change it only near the border.  Chosen.
_START_STEPS = 40
# Factor of contrast over noise in the fidelity of Wiener deconvolution; wiener_fidelity tells what it was chosen on.
FIDELITY = 6.0


class GradientState(NamedTuple):
    """State between two iterations."""

    problem: Problem
    # (P, Q // 2 + 1): half-spectra of u − m, r and d.
    deviation: Stack
    residual: Stack
    direction: Stack
    inverse: Stack  # (P, Q // 2 + 1): preconditioner
    decrease: float  # inner product of r and the preconditioned r
    enough: float  # value of ``decrease`` at which the problem is solved to rounding

    @property
    def image(self) -> Stack:
        """Image u, transformed at every access."""
        return self.problem.back(self.deviation) + self.problem.mean


@dataclass(frozen=True, eq=False)
class ConjugateGradients:
    """Solver for wiener and tikhonov."""

    symbol: Stack  # (P, Q // 2 + 1) or (1, 1): R in Fourier

    # Number of iterations over which a change is measured, as a single step may be short by chance.
    window: ClassVar[int] = 2
    # Conjugate gradients do not oscillate, so the test for an image at rest is not needed.
    rest: ClassVar[int] = 0

    def start(self, problem: Problem) -> GradientState:
        """Start from the solution for M = 1."""
        otf, m = problem.otf, problem.mean
        inverse = 1 / (problem.fidelity * problem.power + self.symbol)
        deviation = problem.fidelity * inverse * (otf.conj() * problem.forward(problem.observed - m))
        misfit = problem.seen * (problem.observed - m - problem.blur(deviation))
        residual = problem.fidelity * (otf.conj() * problem.forward(misfit)) - self.symbol * deviation
        direction = inverse * residual
        enough = ROUNDING * problem.fidelity * total(problem.observed**2)
        decrease = _inner(problem, residual, direction)
        return GradientState(problem, deviation, residual, direction, inverse, decrease, enough)

    def step(self, problem: Problem, state: GradientState) -> GradientState:
        """Do one iteration; the state of a solved problem is returned unchanged.

        With P the preconditioner:

        a = ⟨r, Pr⟩ / ⟨d, (λBᵀMB + R)d⟩
        u ← u + a d
        r ← r − a (λBᵀMB + R)d
        d ← Pr + (⟨r, Pr⟩ / its previous value) d
        """
        if state.decrease <= state.enough:
            return state
        _, deviation, residual, direction, inverse, decrease, enough = state
        blurred = problem.seen * problem.blur(direction)
        applied = problem.fidelity * (problem.otf.conj() * problem.forward(blurred)) + self.symbol * direction
        length = decrease / _inner(problem, direction, applied)
        deviation = deviation + length * direction
        residual = residual - length * applied
        preconditioned = inverse * residual
        left = _inner(problem, residual, preconditioned)
        direction = preconditioned + (left / decrease) * direction
        return GradientState(problem, deviation, residual, direction, inverse, left, enough)

    def penalty(self, problem: Problem, u: Stack) -> float:
        """``½⟨u − m, R(u − m)⟩``."""
        deviation = problem.forward(u - problem.mean)
        return _inner(problem, deviation, self.symbol * deviation) / 2


def quadratic_solver(problem: Problem, method: str) -> ConjugateGradients:
    """Solver of a quadratic method."""
    symbol = laplacian_symbol(*problem.shape) if method == "wiener" else np.ones((1, 1), np.float32)
    return ConjugateGradients(load(symbol, problem.otf.device))


def wiener_fidelity(image: FloatArray, noise: float) -> float:
    """Compute the weight λ of the data for Wiener deconvolution: ``6 s / √(n² + 0.002²)``.

    s is the standard deviation of the image. On photographs, brick and text blurred by σ = 1 to 3 px the result is
    within 0.5 dB of that of the best λ for n = 0.01 to 0.02. For less noise, a perfectly known blur would allow 3 to 10
    times more (0.2 to 1.5 dB better, 3 dB on thin text); the floor of 0.002 accounts for errors of the blur model.
    """
    # Unlike NumPy's, OpenCV's keeps no copy of the image in double precision.
    _, deviation = cv2.meanStdDev(image.reshape(-1, 1))
    return max(FIDELITY * float(deviation.item()) / float(np.hypot(noise, 0.002)), 1.0)


def wiener_image(problem: Problem, noise: float) -> Stack:
    """Wiener solution (P, Q) that nltv and tv start from, with a fidelity of its own."""
    problem = replace(problem, fidelity=wiener_fidelity(store(problem.observed), noise))
    solver = quadratic_solver(problem, "wiener")
    state = solver.start(problem)
    for _ in range(_START_STEPS):
        state = solver.step(problem, state)
    return state.image


def wiener_filtered(image: FloatArray, sigma: float, exponent: float, noise: float) -> FloatArray:
    """Wiener solution (H, W) for a blur of a given width and shape, as if the image went on by reflection."""
    margin = margin_around((image.shape[0], image.shape[1]), int(np.ceil(MARGIN_SIGMAS * sigma)))
    otf = blur_otf(margin.shape, sigma, exponent)
    restored = otf / (otf**2 + laplacian_symbol(*margin.shape) / wiener_fidelity(image, noise))
    return irfft2(rfft2(margin.pad(image)) * restored, margin.shape)[margin.inside()]


def _inner(problem: Problem, a: Stack, b: Stack) -> float:
    """Inner product of two images from their half-spectra, in double precision.

    The other half mirrors all columns except the first and, if the width is even, the last, so these count only once.
    """
    height, width = problem.shape
    columns = (a.conj() * b).real.sum(0, dtype=namespace(a).float64)
    once = columns[0] + columns[-1] * (1 - width % 2)
    return float(2 * columns.sum() - once) / (height * width)

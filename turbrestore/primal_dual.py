"""Deconvolution with a penalty that is not smooth (nltv, tv): Condat–Vũ primal-dual splitting.

Symbols as in :mod:`turbrestore.deconvolution`, and

K : gradient of the penalty; p : dual variable on its edges.
τ, s : primal and dual step; ρ : over-relaxation.

Condat–Vũ primal-dual splitting in the metric P = I/τ + λBᵀB. With ``h(u) = λ/2 ‖M(Bu − f)‖²``:

    u' = u − P⁻¹(∇h(u) + Kᵀp),  ∇h(u) = λBᵀM(Bu − f)
    p' = projection of p + sK(2u' − u) on |p|(x) ≤ 1
    (u, p) ← (u, p) + ρ(u' − u, p' − p)

P is diagonal in Fourier. The first line solves the data term exactly for data that are filled in where nothing was
seen, ``u' = P⁻¹(u/τ − Kᵀp + λBᵀ(Mf + (1−M)Bu))``, so with M = 1 it is the proximal step of h. The start is the
Wiener solution by conjugate gradients: it has a good margin already, which the splitting is slow to find.

It converges for sτ‖K‖² ≤ 1 and ρ < 3/2. M is a projection, so with d = u − v

    ‖∇h(u) − ∇h(v)‖² in the metric (λBᵀB)⁻¹  ≤  λ‖MBd‖²  =  ⟨∇h(u) − ∇h(v), d⟩,

and ``P − sKᵀK ⪰ λBᵀB``: ∇h is 1-cocoercive in the metric (P − sKᵀK)⁻¹, which is what a forward step of the
preconditioned splitting sees. Forward-backward splitting needs more than 1/2 and allows ρ < 2 − 1/2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .convolution_problem import Problem

_RELAXATION = 1.4
# τ‖K‖: small primal steps suit images in [0, 1] with fidelities from 300 to 30000.
_PRIMAL_STEP = 0.08


class Regulariser(NamedTuple):
    """A penalty ``J(u) = Σ_x |Ku|(x)``: K, Kᵀ, the projection on |p|(x) ≤ 1, J, and a bound of ‖K‖²."""

    gradient: Callable[[FloatArray], FloatArray]
    adjoint: Callable[[FloatArray], FloatArray]
    project: Callable[[FloatArray], FloatArray]
    value: Callable[[FloatArray], float]
    norm_squared: float


class PrimalDualState(NamedTuple):
    """u and p."""

    image: FloatArray
    dual: FloatArray


@dataclass(frozen=True, eq=False)
class PrimalDual:
    """Solver for nltv and tv; see the module's docstring."""

    regulariser: Regulariser

    def start(self, u: FloatArray) -> PrimalDualState:
        """Start from the image ``u`` and p = 0."""
        return PrimalDualState(u, np.zeros_like(self.regulariser.gradient(u)))

    def step(self, problem: Problem, state: PrimalDualState) -> PrimalDualState:
        """One iteration, over-relaxed."""
        norm = np.sqrt(self.regulariser.norm_squared)
        tau, s = _PRIMAL_STEP / norm, 1 / (_PRIMAL_STEP * norm)
        u, p = state
        metric = np.float32(1 / tau) + np.float32(problem.fidelity) * np.abs(problem.otf) ** 2
        force = fft.rfft2(self.regulariser.adjoint(p)) + problem.gradient_spectrum(u)
        down = fft.irfft2(force / metric, s=u.shape)
        ascent = self.regulariser.gradient(u - 2 * down)
        ascent *= np.float32(s)
        ascent += p
        forward = self.regulariser.project(ascent)
        forward -= p
        forward *= np.float32(_RELAXATION)
        forward += p
        return PrimalDualState(u - np.float32(_RELAXATION) * down, forward)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """J(u)."""
        return self.regulariser.value(u)

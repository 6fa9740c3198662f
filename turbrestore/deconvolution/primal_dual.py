"""Deconvolution with a penalty that is not smooth (nltv, tv): primal-dual splitting of penalty and data.

Symbols as in :mod:`turbrestore.deconvolution.problem`, and

K : gradient of the penalty ``J(u) = Σ_x |Ku|(x)``; p : dual variable of the penalty.
q : dual variable of the data, on the pixels; in the end λM(Bu − f).
τ, s, t : step sizes of u, p and q; ρ : over-relaxation.

With ``h(z) = λ/2 ‖M(z − f)‖²`` the problem is the saddle point ``min_u max_{p,q} ⟨Ku, p⟩ + ⟨Bu, q⟩ − h*(q)`` over
|p|(x) ≤ 1.  Primal-dual splitting (Chambolle and Pock 2011) in the metric P = I/τ + tBᵀB:

    u' = u − P⁻¹(Kᵀp + Bᵀq)
    p' = projection of p + sK(2u' − u) on |p|(x) ≤ 1
    q' = λ/(λ + t) M [q + t(B(2u' − u) − f)],  the proximal step of th*
    (u, p, q) ← (u, p, q) + ρ(u' − u, p' − p, q' − q)

P is diagonal in Fourier.  The iteration converges for sτ‖K‖² ≤ 1 and 0 < ρ < 2, whatever t is: with step sizes s and t
of the dual variables, the preconditioner of the splitting is positive semidefinite if ``P − sKᵀK − tBᵀB = I/τ − sKᵀK``
is.

With t = λ and M = 1, q stays λ(Bu − f) if it starts there, and the first line is the proximal step of the data term.  A
margin needs a smaller t: q = 0 there, but P limits the change of u by tBᵀB all the same, so that the margin, and what
crosses the border, converges slowly.  So t is λ/k in iteration k, and λ/50 from the fiftieth on, from where on the
splitting converges as from any other start.

The start is the Wiener solution by conjugate gradients, whose margin is good already, with q = λM(Bu − f) and the p
that one step from 0 gives.  An iteration needs four transforms: Bu is updated by B(u' − u), which is known in Fourier.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from .array_ops import Array
from .problem import Problem

# ρ.
RELAXATION = 1.8
# τ‖K‖: small primal steps suit images in [0, 1] with fidelities from 300 to 30000.
PRIMAL_STEP = 0.08
# t/λ falls with the number of iterations to this.
LEAST_DATA_STEP = 0.02
# Iterations that one change is measured over: most of an oscillation cancels over as many, a drift does not.
WINDOW = 10
# Windows for which an image has to stay the same to be at rest.
REST = 5


class Penalty(Protocol):
    """A penalty ``J(u) = Σ_x |Ku|(x)``."""

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        ...

    def zero_dual(self, u: Array) -> Array:
        """Dual variable p = 0 for an image of the size of u."""
        ...

    def ascend(self, p: Array, u: Array, step: float, relaxation: float) -> tuple[Array, Array]:
        """``p + ρ(p' − p)`` with p' the projection of ``p + sKu`` on |p|(x) ≤ 1, and Kᵀ of it; p is overwritten."""
        ...

    def value(self, u: Array) -> float:
        """J(u)."""
        ...


class PrimalDualState(NamedTuple):
    """u, Bu, q, p, Kᵀp, and the number k of the next iteration.  The step of a state overwrites its p."""

    image: Array
    blurred: Array
    pressure: Array
    dual: Array
    pull: Array
    number: int


@dataclass(frozen=True, eq=False)
class PrimalDual:
    """Solver for nltv and tv.

    Attributes
    ----------
    regulariser : Penalty
    """

    regulariser: Penalty

    window: ClassVar[int] = WINDOW
    rest: ClassVar[int] = REST

    def start(self, problem: Problem, u: Array) -> PrimalDualState:
        """Start from the image u with q = λM(Bu − f), and p one step from 0."""
        blurred = problem.blur(problem.ops.forward(u))
        q = problem.fidelity * problem.seen * (blurred - problem.observed)
        p, pull = self.regulariser.ascend(self.regulariser.zero_dual(u), u, self._steps[1], 1.0)
        return PrimalDualState(u, blurred, q, p, pull, 1)

    def step(self, problem: Problem, state: PrimalDualState) -> PrimalDualState:
        """One iteration, with d = u − u' = P⁻¹(Kᵀp + Bᵀq), so that 2u' − u = u − 2d."""
        (tau, s), forward, otf = self._steps, problem.ops.forward, problem.otf
        u, blurred, q, p, pull, k = state
        share = max(1 / k, LEAST_DATA_STEP)
        t = share * problem.fidelity
        spectrum = (forward(pull) + otf.conj() * forward(q)) / (1 / tau + t * problem.power)
        d, blurred_d = problem.ops.back(spectrum, problem.shape), problem.blur(spectrum)
        p, pull = self.regulariser.ascend(p, u - 2 * d, s, RELAXATION)
        q_new = problem.seen * (q + t * (blurred - 2 * blurred_d - problem.observed)) / (1 + share)
        q = q + RELAXATION * (q_new - q)
        return PrimalDualState(u - RELAXATION * d, blurred - RELAXATION * blurred_d, q, p, pull, k + 1)

    def penalty(self, problem: Problem, u: Array) -> float:
        """J(u)."""
        return self.regulariser.value(u)

    @property
    def _steps(self) -> tuple[float, float]:
        """τ and s."""
        norm = float(np.sqrt(self.regulariser.norm_squared))
        return PRIMAL_STEP / norm, 1 / (PRIMAL_STEP * norm)

"""Deconvolution with a penalty that is not smooth (nltv, tv): primal-dual splitting of penalty and data.

Symbols as in :mod:`turbrestore.deconvolution.problem`, and

K : gradient of the penalty ``J(u) = Σ_x |Ku|(x)``; p : dual variable of the penalty.
q : dual variable of the data term, an image; at the solution q = λM(Bu − f).
τ, s, t : step sizes of u, p and q; ρ : over-relaxation.

Iteration
---------
With ``h(z) = λ/2 Σ M(z − f)²`` the problem is the saddle point ``min_u max_{p,q} ⟨Ku, p⟩ + ⟨Bu, q⟩ − h*(q)`` over
|p|(x) ≤ 1.  It is found by primal-dual splitting (Chambolle and Pock 2011) in the metric P = I/τ + tBᵀB:

    u' = u − P⁻¹(Kᵀp + Bᵀq)
    p' = projection of p + sK(2u' − u) on |p|(x) ≤ 1
    q' = λM/(λM + t) [q + t(B(2u' − u) − f)],  the proximal step of th*
    (u, p, q) ← (u, p, q) + ρ(u' − u, p' − p, q' − q)

P is diagonal in Fourier space.  An iteration needs four Fourier transforms: Bu is not computed anew but updated by
B(u' − u), whose transform is known.

Step sizes
----------
The iteration converges if 0 < ρ < 2 and the preconditioner of the splitting is positive semidefinite.  With the dual
step sizes s and t this holds if ``P − sKᵀK − tBᵀB = I/τ − sKᵀK`` is positive semidefinite, that is, if sτ‖K‖² ≤ 1.  The
condition does not depend on t.

If t = λ and M = 1 everywhere, q stays equal to λ(Bu − f) once it has that value, and the step of u is the proximal step
of the data term.  In a margin, where M = 0, q is zero, but the term tBᵀB of P still limits the change of u.  With
t = λ the margin, and the part of the image that its light reaches, would therefore converge slowly.  With a small t the
image oscillates instead.  So t is λ/k in iteration k ≤ 5 and λ/5 up to k = 50, by when most images are at rest, in half
as many iterations as λ/50 takes from the start.  From then on it is λ/50, for images whose border holds detail.  The
first iterations thus only provide a starting point, from which the splitting with a constant t converges.

Start
-----
u is the Wiener solution by conjugate gradients, whose margin is already good; q is λM(Bu − f); and p is the result of
one dual step from p = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from ..runtime.image_stacks import Stack
from .problem import Problem

# Over-relaxation ρ, chosen below the 2 at which the iteration need not converge.
RELAXATION = 1.8
# τ‖K‖.  Small primal steps suit images in [0, 1] with λ between 300 and 30000.  Chosen.
PRIMAL_STEP = 0.08
# Smallest t/λ up to an iteration, and from then on: see "Step sizes".
EARLY_DATA_STEP, EARLY, LEAST_DATA_STEP = 0.2, 50, 0.02
# Number of iterations over which a change of the image is measured.  Oscillations mostly cancel within that many
# iterations; a drift does not.  Chosen.
WINDOW = 10
# An image is at rest if it has not changed over this many windows, chosen.
REST = 5


class Penalty(Protocol):
    """A penalty ``J(u) = Σ_x |Ku|(x)``."""

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        ...

    def ascend(self, p: Stack | None, u: Stack, step: float, relaxation: float) -> tuple[Stack, Stack]:
        """Return the new p, ``p + ρ(p' − p)`` with p' the projection of ``p + sKu`` on |p|(x) ≤ 1, and Kᵀp for it.

        The given p is overwritten; None is p = 0.
        """
        ...

    def value(self, u: Stack) -> float:
        """J(u)."""
        ...


class PrimalDualState(NamedTuple):
    """State before an iteration: u, Bu, q, p, Kᵀp, and its number k.  The iteration overwrites p."""

    image: Stack
    blurred: Stack
    data_dual: Stack
    penalty_dual: Stack
    adjoint: Stack
    number: int


@dataclass(frozen=True, eq=False)
class PrimalDual:
    """Solver for nltv and tv."""

    regulariser: Penalty

    window: ClassVar[int] = WINDOW
    rest: ClassVar[int] = REST

    def start(self, problem: Problem, u: Stack) -> PrimalDualState:
        """Start from the image u, with q = λM(Bu − f) and p after one dual step from 0."""
        blurred = problem.blur(problem.forward(u))
        q = problem.fidelity * problem.seen * (blurred - problem.observed)
        p, adjoint = self.regulariser.ascend(None, u, self._steps[1], 1.0)
        return PrimalDualState(u, blurred, q, p, adjoint, 1)

    def step(self, problem: Problem, state: PrimalDualState) -> PrimalDualState:
        """Do one iteration.  With d = u − u' = P⁻¹(Kᵀp + Bᵀq), the point 2u' − u is u − 2d."""
        (tau, s), forward, otf = self._steps, problem.forward, problem.otf
        u, blurred, q, p, adjoint, k = state
        share = max(1 / k, EARLY_DATA_STEP if k <= EARLY else LEAST_DATA_STEP)
        t = share * problem.fidelity
        spectrum = (forward(adjoint) + otf.conj() * forward(q)) / (1 / tau + t * problem.power)
        d, blurred_d = problem.back(spectrum), problem.blur(spectrum)
        p, adjoint = self.regulariser.ascend(p, u - 2 * d, s, RELAXATION)
        q_new = problem.seen * (q + t * (blurred - 2 * blurred_d - problem.observed)) / (problem.seen + share)
        q = q + RELAXATION * (q_new - q)
        return PrimalDualState(u - RELAXATION * d, blurred - RELAXATION * blurred_d, q, p, adjoint, k + 1)

    def penalty(self, problem: Problem, u: Stack) -> float:
        """J(u)."""
        return self.regulariser.value(u)

    @property
    def _steps(self) -> tuple[float, float]:
        """τ and s."""
        norm = float(np.sqrt(self.regulariser.norm_squared))
        return PRIMAL_STEP / norm, 1 / (PRIMAL_STEP * norm)

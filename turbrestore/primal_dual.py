"""Deconvolution with a penalty that is not smooth (nltv, tv): primal-dual splitting of penalty and data.

Symbols as in :mod:`turbrestore.deconvolution`, and

K : gradient of the penalty; p : dual variable on its edges.
q : dual variable of the data, on the pixels, λM(Bu − f) in the end.
τ, s, t : steps of u, p and q; ρ : over-relaxation.

With ``h(z) = λ/2 ‖M(z − f)‖²`` the problem is the saddle point ``min_u max_{p,q} ⟨Ku, p⟩ + ⟨Bu, q⟩ − h*(q)`` over
|p|(x) ≤ 1.  Primal-dual splitting (Chambolle and Pock 2011) in the metric P = I/τ + tBᵀB:

    u' = u − P⁻¹(Kᵀp + Bᵀq)
    p' = projection of p + sK(2u' − u) on |p|(x) ≤ 1
    q' = λ/(λ + t) M [q + t(B(2u' − u) − f)],  the proximal step of th*
    (u, p, q) ← (u, p, q) + ρ(u' − u, p' − p, q' − q)

P is diagonal in Fourier.  It converges for sτ‖K‖² ≤ 1 and 0 < ρ < 2, whatever t is: with steps s and t for the dual
variables, the preconditioner of the splitting is positive semidefinite if ``P − sKᵀK − tBᵀB = I/τ − sKᵀK`` is.

With t = λ and M = 1, q stays λ(Bu − f) if it starts there, and the first line is the proximal step of the data term.  A
margin that nobody saw asks for a smaller t: there q = 0, and P holds back what u may change by tBᵀB all the same, so
that what lies in the margin, and what crosses the border, is found slowly.  So t is λ/k in iteration k, and λ/50 from
the fiftieth on, for which the splitting converges as from any other start.

The start is the Wiener solution by conjugate gradients, which has a good margin already, with q = λM(Bu − f) and the p
that one step from 0 gives.

An iteration transforms four times: Bu follows u without transforms of its own, since what u moves by is found in
Fourier.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .compiled import compiled
from .convolution_problem import Problem

# ρ.
RELAXATION = 1.8
# τ‖K‖: small primal steps suit images in [0, 1] with fidelities from 300 to 30000.
PRIMAL_STEP = 0.08
# t/λ falls with the number of iterations to this.
LEAST_DATA_STEP = 0.02
# Iterations that are judged together: over as many, most of what swings cancels, and what drifts does not.
WINDOW = 10


class Penalty(Protocol):
    """A penalty ``J(u) = Σ_x |Ku|(x)``."""

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        ...

    def dual(self, image: FloatArray) -> Any:
        """Start from p = 0 for an image of this size."""
        ...

    def ascend(self, dual: Any, image: FloatArray, step: float, relaxation: float, pull: FloatArray) -> None:
        """Add ``step`` times K of the image to p, project and over-relax, in place; ``pull`` becomes Kᵀp.

        What is in the image is lost.
        """
        ...

    def value(self, image: FloatArray) -> float:
        """J(u)."""
        ...


class PrimalDualState(NamedTuple):
    """u, Bu, q, p, Kᵀp, and the number of the next iteration.  A step changes all arrays in place."""

    image: FloatArray
    blurred: FloatArray
    pressure: FloatArray
    dual: Any
    pull: FloatArray
    number: int


@dataclass(frozen=True, eq=False)
class PrimalDual:
    """Solver for nltv and tv; see the module's docstring."""

    regulariser: Penalty

    window: ClassVar[int] = WINDOW

    def start(self, problem: Problem, u: FloatArray) -> PrimalDualState:
        """Start from the image ``u``, with the q that it asks for and p one step from 0."""
        grid, p, u = problem.grid, self.regulariser.dual(u), problem.grid.copied(u)
        blurred, q, pull, ahead = problem.blurred(u), grid.image(), grid.image(), grid.spare
        weight = np.float32(problem.fidelity)

        def press(rows: slice) -> None:
            q[rows] = weight * problem.seen[rows] * (blurred[rows] - problem.observed[rows])
            ahead[rows] = u[rows]

        grid.over_rows(press, q, blurred, ahead, u, problem.seen, problem.observed)
        self.regulariser.ascend(p, ahead, self._steps[1], 1, pull)
        return PrimalDualState(u, blurred, q, p, pull, 1)

    def step(self, problem: Problem, state: PrimalDualState) -> PrimalDualState:
        """One iteration, over-relaxed."""
        grid, (falls, moves) = problem.grid, problem.grid.spectra
        (tau, s), share = self._steps, max(1 / state.number, LEAST_DATA_STEP)
        (u, blurred, q, p, pull, _), transfer = state, problem.transfer
        follow = compiled(follow_loops) or _follow
        steps = np.array([share * problem.fidelity, 1 / (1 + share), RELAXATION], np.float32)

        def transform(rows: slice) -> None:
            grid.transform_strip(q[rows], falls, rows)
            grid.transform_strip(pull[rows], moves, rows)

        def solve(block: int) -> None:
            down, otf = fft.fft(falls[block], axis=0), transfer[block]
            down *= otf.conj()
            down += fft.fft(moves[block], axis=0)
            down *= np.reciprocal(np.float32(1 / tau) + np.float32(share * problem.fidelity) * problem.power(block))
            falls[block] = fft.ifft(down * otf, axis=0, overwrite_x=True)
            moves[block] = fft.ifft(down, axis=0, overwrite_x=True)

        def move(rows: slice) -> None:
            moved, drop = grid.strip_of(moves, rows), grid.strip_of(falls, rows)
            changed = moved.ravel(), blurred[rows].reshape(-1), drop.ravel(), q[rows].reshape(-1)
            follow(u[rows].ravel(), *changed, problem.observed[rows].ravel(), problem.seen[rows].ravel(), steps)
            u[rows], grid.spare[rows] = moved, drop

        grid.over_rows(transform, falls, moves, q, pull)
        grid.over_blocks(solve, falls, moves, transfer)
        grid.over_rows(move, falls, moves, u, blurred, q, grid.spare, problem.observed, problem.seen)
        self.regulariser.ascend(p, grid.spare, s, RELAXATION, pull)
        return state._replace(number=state.number + 1)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """J(u)."""
        return self.regulariser.value(u)

    @property
    def _steps(self) -> tuple[float, float]:
        """τ and s."""
        norm = float(np.sqrt(self.regulariser.norm_squared))
        return PRIMAL_STEP / norm, 1 / (PRIMAL_STEP * norm)


def _follow(
    u: FloatArray,
    moved: FloatArray,
    blurred: FloatArray,
    drop: FloatArray,
    q: FloatArray,
    observed: FloatArray,
    seen: FloatArray,
    steps: FloatArray,
) -> None:
    """:func:`follow_loops` by NumPy."""
    step, shrink, relaxation = steps
    ahead = blurred - 2 * drop
    ahead -= observed
    ahead *= step
    ahead += q
    ahead *= seen
    ahead *= shrink
    ahead -= q
    ahead *= relaxation
    q += ahead
    drop *= relaxation
    blurred -= drop
    np.multiply(moved, -2, out=drop)
    drop += u
    moved *= -relaxation
    moved += u


def follow_loops(
    u: FloatArray,
    moved: FloatArray,
    blurred: FloatArray,
    drop: FloatArray,
    q: FloatArray,
    observed: FloatArray,
    seen: FloatArray,
    steps: FloatArray,
) -> None:
    """Follow u' with q, Bu, u, and 2u' − u; to be compiled.

    Parameters
    ----------
    u : ndarray, float32, shape (n,)
    moved : ndarray, float32, shape (n,)
        u − u'; becomes the next u.
    blurred, q : ndarray, float32, shape (n,)
        Bu, and q; become the next ones.
    drop : ndarray, float32, shape (n,)
        B(u − u'); becomes 2u' − u.
    observed, seen : ndarray, float32, shape (n,)
        f and M.
    steps : ndarray, float32, shape (3,)
        t, λ/(λ + t) and ρ.

    Examples
    --------
    >>> one = np.ones(1, np.float32)
    >>> moved, blurred, drop, q = 0.5 * one, 4 * one, 1 * one, 2 * one
    >>> follow_loops(3 * one, moved, blurred, drop, q, one, one, np.float32([4, 0.5, 1.5]))
    >>> [float(array[0]) for array in (moved, blurred, drop, q)]
    [2.25, 2.5, 2.0, 3.5]
    """
    step, shrink, relaxation = steps[0], steps[1], steps[2]
    for pixel in range(u.size):
        blur, fall, force, down = blurred[pixel], drop[pixel], q[pixel], moved[pixel]
        ahead = blur - fall - fall - observed[pixel]
        raised = (force + step * ahead) * seen[pixel] * shrink
        q[pixel] = force + relaxation * (raised - force)
        blurred[pixel] = blur - relaxation * fall
        drop[pixel] = u[pixel] - down - down
        moved[pixel] = u[pixel] - relaxation * down

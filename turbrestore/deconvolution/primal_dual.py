"""Deconvolution with a penalty that is not smooth (nltv, tv): primal-dual splitting of penalty and data.

Symbols as in :mod:`turbrestore.deconvolution.deconvolve`, and

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
Fourier.  Of an image that is one strip, it transforms two images at a time
(:mod:`turbrestore.deconvolution.paired_transform`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..blur.psf import Spectrum
from ..core.arrays import FloatArray
from ..runtime.jit import compiled
from .paired_transform import paired_descent
from .problem import Problem

# ρ.
RELAXATION = 1.8
# τ‖K‖: small primal steps suit images in [0, 1] with fidelities from 300 to 30000.
PRIMAL_STEP = 0.08
# t/λ falls with the number of iterations to this.
LEAST_DATA_STEP = 0.02
# Iterations that are judged together: over as many, most of what swings cancels, and what drifts does not.
WINDOW = 10
# An image rests where it has stayed for so many windows.
REST = 5


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
    rest: ClassVar[int] = REST

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
        (tau, s), share = self._steps, max(1 / state.number, LEAST_DATA_STEP)
        descend = _descend_at_once if problem.grid.one_strip else _descend_in_strips
        descend(problem, state, 1 / tau, share)
        self.regulariser.ascend(state.dual, problem.grid.spare, s, RELAXATION, state.pull)
        return state._replace(number=state.number + 1)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """J(u)."""
        return self.regulariser.value(u)

    @property
    def _steps(self) -> tuple[float, float]:
        """τ and s."""
        norm = float(np.sqrt(self.regulariser.norm_squared))
        return PRIMAL_STEP / norm, 1 / (PRIMAL_STEP * norm)


def _descend_at_once(problem: Problem, state: PrimalDualState, floor: float, share: float) -> None:
    """Move u, Bu and q of an image that is one strip; 2u' − u is left in the spare image."""
    arrays = state.image, state.blurred, state.pressure, state.pull, problem.observed, problem.seen, problem.transfer

    def descend(rows: slice) -> None:
        weight = share * problem.fidelity
        both = paired_descent(state.pressure, state.pull, problem.transfer[0], floor, weight)
        _move(problem, state, share, rows, both[..., 0], both[..., 1])

    problem.grid.over_rows(descend, problem.grid.spare, *arrays)


def _descend_in_strips(problem: Problem, state: PrimalDualState, floor: float, share: float) -> None:
    """Likewise of an image of several strips."""
    grid, (falls, moves), transfer = problem.grid, problem.grid.spectra, problem.transfer
    u, blurred, q, *_ = state
    scales = np.array([floor, share * problem.fidelity], np.float32)
    divide = compiled(divide_loops) or _divide

    def transform(rows: slice) -> None:
        grid.transform_strip(q[rows], falls, rows)
        grid.transform_strip(state.pull[rows], moves, rows)

    def solve(block: int) -> None:
        pressed, pulled = (fft.fft(spectrum[block], axis=0) for spectrum in (falls, moves))
        divide(pressed, pulled, transfer[block], scales)
        falls[block] = fft.ifft(pressed, axis=0, overwrite_x=True)
        moves[block] = fft.ifft(pulled, axis=0, overwrite_x=True)

    def move(rows: slice) -> None:
        _move(problem, state, share, rows, grid.strip_of(moves, rows), grid.strip_of(falls, rows))

    grid.over_rows(transform, falls, moves, q, state.pull)
    grid.over_blocks(solve, falls, moves, transfer)
    grid.over_rows(move, falls, moves, u, blurred, q, grid.spare, problem.observed, problem.seen)


def _move(
    problem: Problem, state: PrimalDualState, share: float, rows: slice, moved: FloatArray, drop: FloatArray
) -> None:
    """Follow what some rows move by, u − u' and B of it."""
    steps = np.array([share * problem.fidelity, 1 / (1 + share), RELAXATION], np.float32)
    images = state.image, state.blurred, state.pressure, problem.observed, problem.seen, problem.grid.spare
    u, blurred, q, observed, seen, ahead = (image[rows].reshape(-1) for image in images)
    follow = compiled(follow_loops) or _follow
    follow(u, blurred, q, observed, seen, ahead, moved.reshape(-1), drop.reshape(-1), steps)


def _divide(
    pressed: NDArray[np.complex64], pulled: NDArray[np.complex64], transfer: Spectrum, scales: FloatArray
) -> None:
    """:func:`divide_loops` by NumPy."""
    floor, weight = scales
    pressed *= transfer.conj()
    pulled += pressed
    pulled *= np.reciprocal(floor + weight * np.square(np.abs(transfer)))
    np.multiply(pulled, transfer, out=pressed)


def divide_loops(
    pressed: NDArray[np.complex64], pulled: NDArray[np.complex64], transfer: Spectrum, scales: FloatArray
) -> None:
    """Find the transforms of what u descends by and of B of it; to be compiled.

    Parameters
    ----------
    pressed : ndarray, complex64, shape (P, C)
        Transform of q; becomes that of ``BP⁻¹(Kᵀp + Bᵀq)``.
    pulled : ndarray, complex64, shape (P, C)
        Transform of Kᵀp; becomes that of ``P⁻¹(Kᵀp + Bᵀq)``.
    transfer : ndarray, float32 or complex64, shape (P, C)
        Transfer function of B.
    scales : ndarray, float32, shape (2,)
        1/τ and t.

    Examples
    --------
    >>> pressed, pulled = np.complex64([[8]]), np.complex64([[2j]])
    >>> divide_loops(pressed, pulled, np.float32([[0.5]]), np.float32([1, 4]))
    >>> pressed, pulled
    (array([[1.+0.5j]], dtype=complex64), array([[2.+1.j]], dtype=complex64))
    """
    floor, weight = scales
    for row in range(pressed.shape[0]):
        for column in range(pressed.shape[1]):
            blur = transfer[row, column]
            inverse = np.float32(1) / (floor + weight * (blur.real * blur.real + blur.imag * blur.imag))
            down = (blur.conjugate() * pressed[row, column] + pulled[row, column]) * inverse
            pulled[row, column], pressed[row, column] = down, blur * down


def _follow(
    u: FloatArray,
    blurred: FloatArray,
    q: FloatArray,
    observed: FloatArray,
    seen: FloatArray,
    ahead: FloatArray,
    moved: FloatArray,
    drop: FloatArray,
    steps: FloatArray,
) -> None:
    """:func:`follow_loops` by NumPy."""
    step, shrink, relaxation = steps
    np.multiply(drop, -2, out=ahead)
    ahead += blurred
    ahead -= observed
    ahead *= step
    ahead += q
    ahead *= seen
    ahead *= shrink
    ahead -= q
    ahead *= relaxation
    q += ahead
    np.multiply(drop, -relaxation, out=ahead)
    blurred += ahead
    np.multiply(moved, -2, out=ahead)
    ahead += u
    np.multiply(moved, relaxation, out=moved)
    u -= moved


def follow_loops(
    u: FloatArray,
    blurred: FloatArray,
    q: FloatArray,
    observed: FloatArray,
    seen: FloatArray,
    ahead: FloatArray,
    moved: FloatArray,
    drop: FloatArray,
    steps: FloatArray,
) -> None:
    """Follow u' with q, Bu, u, and 2u' − u; to be compiled.

    Parameters
    ----------
    u, blurred, q : ndarray, float32, shape (n,)
        u, Bu and q; become the next ones.
    observed, seen : ndarray, float32, shape (n,)
        f and M.
    ahead : ndarray, float32, shape (n,)
        Becomes 2u' − u.
    moved, drop : ndarray, float32, shape (n,)
        u − u', and B of it; what is in them may be lost.
    steps : ndarray, float32, shape (3,)
        t, λ/(λ + t) and ρ.

    Examples
    --------
    >>> one = np.ones(1, np.float32)
    >>> u, blurred, q, ahead = 3 * one, 4 * one, 2 * one, 0 * one
    >>> follow_loops(u, blurred, q, one, one, ahead, 0.5 * one, one, np.float32([4, 0.5, 1.5]))
    >>> [float(array[0]) for array in (u, blurred, q, ahead)]
    [2.25, 2.5, 3.5, 2.0]
    """
    step, shrink, relaxation = steps[0], steps[1], steps[2]
    for pixel in range(u.size):
        blur, fall, force, down = blurred[pixel], drop[pixel], q[pixel], moved[pixel]
        raised = (force + step * (blur - fall - fall - observed[pixel])) * seen[pixel] * shrink
        q[pixel] = force + relaxation * (raised - force)
        blurred[pixel] = blur - relaxation * fall
        ahead[pixel] = u[pixel] - down - down
        u[pixel] -= relaxation * down

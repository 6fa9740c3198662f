"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..blur.psf import Spectrum
from ..core.arrays import FloatArray
from ..runtime.jit import compiled
from .problem import Problem, seen_mean
from .strip_grid import StripGrid, spectral_inner

# Share of the energy of the data below which the residual is one of rounding.
ROUNDING = 1e-14


class GradientState(NamedTuple):
    """m; in Fourier u − m, residual of the normal equations, search direction and preconditioner, in blocks.

    ``decrease`` is ⟨residual, preconditioned⟩ and ``enough`` that of a solution, from which on steps stay where they
    are; ``turn`` is the share of the direction in the next one.  A step changes the spectra in place.
    """

    mean: np.float32
    deviation: Spectrum
    residual: Spectrum
    direction: Spectrum
    inverse: FloatArray
    turn: float
    decrease: float
    enough: float
    grid: StripGrid

    @property
    def image(self) -> FloatArray:
        """u, transformed anew whenever it is asked for."""
        grid, image, (spectrum, _) = self.grid, self.grid.image(), self.grid.spectra

        def transform(block: int) -> None:
            spectrum[block] = fft.ifft(self.deviation[block], axis=0)

        def put(rows: slice) -> None:
            np.add(grid.strip_of(spectrum, rows), self.mean, out=image[rows])

        grid.over_blocks(transform, spectrum, self.deviation)
        grid.over_rows(put, spectrum, image)
        return image


@dataclass(frozen=True, eq=False)
class ConjugateGradients:
    """Solver for wiener and tikhonov: ``(λBᵀMB + R)(u − m) = λBᵀM(f − m)``, m the mean of what was seen.

    R is diagonal in Fourier (``symbol``, float32, shape (B, P, C)), and ``(λBᵀB + R)⁻¹`` is the preconditioner.  With
    M = 1 it is the solution.  Both penalties are unaware of m or defined relative to it, so that a constant image stays
    what it is.
    """

    symbol: FloatArray

    # Iterations that are judged together: single steps may be short by chance.
    window: ClassVar[int] = 2
    # They do not swing: what has not moved for some iterations may move yet.
    rest: ClassVar[int] = 0

    def start(self, problem: Problem) -> GradientState:
        """Start from the solution for the continued image."""
        grid, m, (work, _), transfer = problem.grid, seen_mean(problem), problem.grid.spectra, problem.transfer
        deviation, residual, direction, inverse = grid.spectrum(), grid.spectrum(), grid.spectrum(), grid.multiplier()
        weight, symbol = np.float32(problem.fidelity), self.symbol

        def solve(block: int) -> None:
            found = fft.fft(deviation[block], axis=0)
            inverse[block] = np.reciprocal(weight * problem.power(block) + symbol[block])
            found *= transfer[block].conj() * (weight * inverse[block])
            deviation[block] = found
            if block == 0:
                found[0, 0] += m * problem.observed.size
            found *= transfer[block]
            work[block] = fft.ifft(found, axis=0, overwrite_x=True)

        def compare(rows: slice) -> None:
            strip = grid.strip_of(work, rows)
            strip -= problem.observed[rows]
            strip *= problem.seen[rows]
            grid.transform_strip(strip, work, rows)

        def descend(block: int) -> float:
            found = fft.fft(work[block], axis=0)
            found *= -weight * transfer[block].conj()
            found -= symbol[block] * deviation[block]
            residual[block], direction[block] = found, 0
            return grid.spectral_inner(found, found * inverse[block], block)

        observed, seen = problem.observed, problem.seen
        grid.over_rows(lambda rows: grid.transform_strip(observed[rows] - m, deviation, rows), deviation, observed)
        grid.over_blocks(solve, deviation, work, inverse, symbol, transfer)
        grid.over_rows(compare, work, observed, seen)
        decrease = sum(grid.over_blocks(descend, deviation, work, residual, direction, inverse, symbol, transfer))
        enough = ROUNDING * problem.fidelity * grid.inner(observed, observed)
        return GradientState(m, deviation, residual, direction, inverse, 0.0, decrease, enough, grid)

    def step(self, problem: Problem, state: GradientState) -> GradientState:
        """One iteration of preconditioned conjugate gradients.

        Inner products are those of the images, by Parseval, so that only what was seen of the direction is transformed.
        """
        if state.decrease <= state.enough:
            return state
        grid, (work, _), transfer = problem.grid, problem.grid.spectra, problem.transfer
        (_, deviation, residual, direction, inverse, *_), symbol = state, self.symbol
        turn, apply = compiled(turn_loops) or _turn, compiled(apply_loops) or _apply
        move = compiled(move_loops) or _move
        turned, weight = np.array([state.turn], np.float32), np.array([problem.fidelity], np.float32)

        def press(block: int) -> None:
            pressed = np.empty_like(work[block])
            turn(direction[block], residual[block], inverse[block], transfer[block], turned, pressed)
            work[block] = fft.ifft(pressed, axis=0, overwrite_x=True)

        def see(rows: slice) -> None:
            strip = grid.strip_of(work, rows)
            strip *= problem.seen[rows]
            grid.transform_strip(strip, work, rows)

        def pull(block: int) -> float:
            found, curvature = fft.fft(work[block], axis=0), np.zeros(1)
            apply(found, direction[block], symbol[block], transfer[block], weight, grid.shares[block], curvature)
            work[block] = found
            return float(curvature[0])

        def descend(block: int) -> float:
            along, change, left = direction[block], work[block], np.zeros(1)
            move(deviation[block], residual[block], along, change, inverse[block], length, grid.shares[block], left)
            return float(left[0])

        grid.over_blocks(press, residual, direction, inverse, work, transfer)
        grid.over_rows(see, work, problem.seen)
        curvature = sum(grid.over_blocks(pull, work, direction, symbol, transfer))
        length = np.array([state.decrease / curvature], np.float32)
        decrease = sum(grid.over_blocks(descend, deviation, residual, direction, inverse, work))
        return state._replace(turn=decrease / state.decrease, decrease=decrease)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """½⟨u − m, R(u − m)⟩."""
        grid, m, (work, _), symbol = problem.grid, seen_mean(problem), problem.grid.spectra, self.symbol

        def share(block: int) -> float:
            found = fft.fft(work[block], axis=0)
            return grid.spectral_inner(found, symbol[block] * found, block)

        grid.over_rows(lambda rows: grid.transform_strip(u[rows] - m, work, rows), work, u)
        return sum(grid.over_blocks(share, work, symbol)) / 2


def _turn(
    direction: Spectrum,
    residual: Spectrum,
    inverse: FloatArray,
    transfer: Spectrum,
    turn: FloatArray,
    pressed: Spectrum,
) -> None:
    """:func:`turn_loops` by NumPy."""
    direction *= turn[0]
    direction += np.multiply(inverse, residual, out=pressed)
    np.multiply(direction, transfer, out=pressed)


def turn_loops(
    direction: Spectrum,
    residual: Spectrum,
    inverse: FloatArray,
    transfer: Spectrum,
    turn: FloatArray,
    pressed: Spectrum,
) -> None:
    """Find the next direction, and B of it; to be compiled.

    Parameters
    ----------
    direction : ndarray, complex64, shape (P, C)
        Changed.
    residual, inverse, transfer : ndarray, shape (P, C)
        Residual, preconditioner, and transfer function of B.
    turn : ndarray, float32, shape (1,)
        Share of the direction that was.
    pressed : ndarray, complex64, shape (P, C)
        Filled.

    Examples
    --------
    >>> direction, residual, pressed = np.complex64([[2]]), np.complex64([[4j]]), np.empty((1, 1), np.complex64)
    >>> turn_loops(direction, residual, np.float32([[0.5]]), np.float32([[0.5]]), np.float32([1.5]), pressed)
    >>> direction, pressed
    (array([[3.+2.j]], dtype=complex64), array([[1.5+1.j]], dtype=complex64))
    """
    share = turn[0]
    for row in range(direction.shape[0]):
        for column in range(direction.shape[1]):
            towards = inverse[row, column] * residual[row, column] + share * direction[row, column]
            direction[row, column], pressed[row, column] = towards, towards * transfer[row, column]


def _apply(
    found: Spectrum,
    direction: Spectrum,
    symbol: FloatArray,
    transfer: Spectrum,
    weight: FloatArray,
    shares: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> None:
    """:func:`apply_loops` by NumPy."""
    found *= weight[0] * transfer.conj()
    found += symbol * direction
    curvature[0] += spectral_inner(direction, found, shares)


def apply_loops(
    found: Spectrum,
    direction: Spectrum,
    symbol: FloatArray,
    transfer: Spectrum,
    weight: FloatArray,
    shares: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> None:
    """Apply the normal equations to the direction; to be compiled.

    Parameters
    ----------
    found : ndarray, complex64, shape (P, C)
        MB of it; becomes ``λBᵀMB + R`` of it.
    direction, symbol, transfer : ndarray, shape (P, C)
        Direction, R, and transfer function of B.
    weight : ndarray, float32, shape (1,)
        λ.
    shares : ndarray, float64, shape (C,)
        What columns count in an inner product of images.
    curvature : ndarray, float64, shape (1,)
        Inner product of the direction and what is found is added.

    Examples
    --------
    >>> found, direction, one, curvature = np.complex64([[4]]), np.complex64([[2j]]), np.float32([[1]]), np.zeros(1)
    >>> apply_loops(found, direction, 3 * one, 0.5 * one, np.float32([10]), np.ones(1), curvature)
    >>> found, curvature
    (array([[20.+6.j]], dtype=complex64), array([12.]))
    """
    for row in range(found.shape[0]):
        total = 0.0
        for column in range(found.shape[1]):
            along = direction[row, column]
            back = weight[0] * (transfer[row, column].conjugate() * found[row, column]) + symbol[row, column] * along
            found[row, column] = back
            total += shares[column] * (along.real * back.real + along.imag * back.imag)
        curvature[0] += total


def _move(
    deviation: Spectrum,
    residual: Spectrum,
    direction: Spectrum,
    change: Spectrum,
    inverse: FloatArray,
    length: FloatArray,
    shares: NDArray[np.float64],
    left: NDArray[np.float64],
) -> None:
    """:func:`move_loops` by NumPy."""
    residual -= length[0] * change
    deviation += length[0] * direction
    left[0] += spectral_inner(residual, residual * inverse, shares)


def move_loops(
    deviation: Spectrum,
    residual: Spectrum,
    direction: Spectrum,
    change: Spectrum,
    inverse: FloatArray,
    length: FloatArray,
    shares: NDArray[np.float64],
    left: NDArray[np.float64],
) -> None:
    """Go along the direction; to be compiled.

    Parameters
    ----------
    deviation, residual : ndarray, complex64, shape (P, C)
        u − m and residual; changed.
    direction, change : ndarray, complex64, shape (P, C)
        Direction, and the normal equations applied to it.
    inverse : ndarray, float32, shape (P, C)
        Preconditioner.
    length : ndarray, float32, shape (1,)
        How far.
    shares : ndarray, float64, shape (C,)
        What columns count in an inner product of images.
    left : ndarray, float64, shape (1,)
        ⟨residual, preconditioned⟩ is added.

    Examples
    --------
    >>> deviation, residual, left, one = np.complex64([[1]]), np.complex64([[4]]), np.zeros(1), np.complex64([[1]])
    >>> move_loops(deviation, residual, one, 2j * one, np.float32([[0.5]]), np.float32([2]), np.ones(1), left)
    >>> deviation, residual, left
    (array([[3.+0.j]], dtype=complex64), array([[4.-4.j]], dtype=complex64), array([16.]))
    """
    for row in range(deviation.shape[0]):
        total = 0.0
        for column in range(deviation.shape[1]):
            deviation[row, column] += length[0] * direction[row, column]
            rest = residual[row, column] - length[0] * change[row, column]
            residual[row, column] = rest
            total += shares[column] * inverse[row, column] * (rest.real * rest.real + rest.imag * rest.imag)
        left[0] += total

"""Deconvolution with a quadratic penalty (wiener, tikhonov) by preconditioned conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .convolution_problem import Problem, seen_mean
from .psf import Spectrum
from .strip_grid import StripGrid

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

    R is diagonal in Fourier (``symbol``, in blocks), and ``(λBᵀB + R)⁻¹`` is the preconditioner.  With M = 1 it is the
    solution.  Both penalties are unaware of m or defined relative to it, so that a constant image stays what it is.
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
            residual[block] = found
            return grid.spectral_inner(found, found * inverse[block], block)

        observed, seen = problem.observed, problem.seen
        grid.over_rows(lambda rows: grid.transform_strip(observed[rows] - m, deviation, rows), deviation, observed)
        grid.over_blocks(solve, deviation, work, inverse, symbol, transfer)
        grid.over_rows(compare, work, observed, seen)
        decrease = sum(grid.over_blocks(descend, deviation, work, residual, inverse, symbol, transfer))
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

        def turn(block: int) -> None:
            found = inverse[block] * residual[block]
            if state.turn:
                found += np.float32(state.turn) * direction[block]
            direction[block] = found
            found *= transfer[block]
            work[block] = fft.ifft(found, axis=0, overwrite_x=True)

        def see(rows: slice) -> None:
            strip = grid.strip_of(work, rows)
            strip *= problem.seen[rows]
            grid.transform_strip(strip, work, rows)

        def apply(block: int) -> float:
            found = fft.fft(work[block], axis=0)
            found *= np.float32(problem.fidelity) * transfer[block].conj()
            found += symbol[block] * direction[block]
            work[block] = found
            return grid.spectral_inner(direction[block], found, block)

        def move(block: int) -> float:
            left = residual[block]
            left -= length * work[block]
            deviation[block] += length * direction[block]
            return grid.spectral_inner(left, left * inverse[block], block)

        grid.over_blocks(turn, residual, direction, inverse, work, transfer)
        grid.over_rows(see, work, problem.seen)
        length = np.float32(state.decrease / sum(grid.over_blocks(apply, work, direction, symbol, transfer)))
        decrease = sum(grid.over_blocks(move, deviation, residual, direction, inverse, work))
        return state._replace(turn=decrease / state.decrease, decrease=decrease)

    def penalty(self, problem: Problem, u: FloatArray) -> float:
        """½⟨u − m, R(u − m)⟩."""
        grid, m, (work, _), symbol = problem.grid, seen_mean(problem), problem.grid.spectra, self.symbol

        def share(block: int) -> float:
            found = fft.fft(work[block], axis=0)
            return grid.spectral_inner(found, symbol[block] * found, block)

        grid.over_rows(lambda rows: grid.transform_strip(u[rows] - m, work, rows), work, u)
        return sum(grid.over_blocks(share, work, symbol)) / 2

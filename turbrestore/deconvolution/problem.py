"""The data term of deconvolution, ``λ/2 ‖M(k∗u − f)‖²``, and its gradient.

Symbols as in :mod:`turbrestore.deconvolution.deconvolve`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from ..blur.psf import Spectrum
from ..core.arrays import FloatArray
from .strip_grid import Found, StripGrid


@dataclass(frozen=True, eq=False)
class Problem:
    """Data term ``λ/2 ‖M(k∗u − f)‖²`` on the padded domain.

    Attributes
    ----------
    observed : ndarray, float32, shape (P, Q)
        f, continued by reflection where nothing was seen.
    seen : ndarray, float32, shape (P, Q)
        M.
    transfer : ndarray, shape (B, P, C)
        Transfer function of k, in blocks.
    fidelity : float
        λ.
    grid : StripGrid
        Of these.
    judged : tuple of two ndarrays, float32, shapes (P,) and (Q,), optional
        1 for the rows and columns that changes are judged in; by default all are.
    """

    observed: FloatArray
    seen: FloatArray
    transfer: Spectrum
    fidelity: float
    grid: StripGrid
    judged: tuple[FloatArray, FloatArray] | None = None

    def weight(self, rows: slice) -> FloatArray:
        """Weigh squares of changes in some rows: 1 where they are judged."""
        if self.judged is None:
            return np.ones_like(self.observed[rows])
        down, across = self.judged
        return np.outer(down[rows], across)

    def blurred(self, u: FloatArray) -> FloatArray:
        """Bu, a new image."""
        blurred = self.grid.image()

        def put(rows: slice, strip: FloatArray) -> None:
            blurred[rows] = strip

        self._blur(u, put, blurred)
        return blurred

    def misfit(self, u: FloatArray) -> float:
        """``λ/2 ‖M(Bu − f)‖²``."""

        def squares(rows: slice, strip: FloatArray) -> float:
            strip -= self.observed[rows]
            strip *= self.seen[rows]
            return float(np.square(strip, out=strip).sum(dtype=np.float64))

        return self.fidelity / 2 * sum(self._blur(u, squares, self.observed, self.seen))

    def power(self, block: int) -> FloatArray:
        """|k̂|², which BᵀB multiplies by, of a block."""
        return np.square(np.abs(self.transfer[block]))

    def _blur(self, u: FloatArray, work: Callable[[slice, FloatArray], Found], *touched: object) -> list[Found]:
        """Do something to every strip of Bu."""
        grid, (spectrum, _), transfer = self.grid, self.grid.spectra, self.transfer

        def multiply(block: int) -> None:
            found = fft.fft(spectrum[block], axis=0)
            found *= transfer[block]
            spectrum[block] = fft.ifft(found, axis=0, overwrite_x=True)

        grid.over_rows(lambda rows: grid.transform_strip(u[rows], spectrum, rows), spectrum, u)
        grid.over_blocks(multiply, spectrum, transfer)
        return grid.over_rows(lambda rows: work(rows, grid.strip_of(spectrum, rows)), spectrum, *touched)


def seen_mean(problem: Problem) -> np.float32:
    """Mean of the pixels that were seen.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    numpy.float32

    Examples
    --------
    >>> grid = StripGrid((1, 3))
    >>> float(seen_mean(Problem(np.float32([[1, 2, 9]]), np.float32([[1, 1, 0]]), np.ones((1, 1, 2)), 1.0, grid)))
    1.5
    """
    inner = problem.grid.inner
    return np.float32(inner(problem.seen, problem.observed) / inner(problem.seen, problem.seen))

"""The data term of deconvolution, ``λ/2 ‖M(k∗u − f)‖²``, and its gradient.

Symbols as in :mod:`turbrestore.deconvolution`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from .arrays import FloatArray
from .psf import Spectrum


@dataclass(frozen=True, eq=False)
class Problem:
    """Data term ``λ/2 ‖M(k∗u − f)‖²`` on the padded domain.

    Attributes
    ----------
    observed : ndarray, float32, shape (P, Q)
        f, continued by reflection where nothing was seen.
    seen : ndarray, float32, shape (P, Q)
        M.
    otf : ndarray, shape (P, Q // 2 + 1)
        Transfer function of k.
    fidelity : float
        λ.
    """

    observed: FloatArray
    seen: FloatArray
    otf: Spectrum
    fidelity: float

    def gradient_spectrum(self, u: FloatArray) -> Spectrum:
        """Fourier transform of the gradient ``λBᵀM(Bu − f)``."""
        return self.fidelity * self.otf.conj() * fft.rfft2(self.residual(u))

    def residual(self, u: FloatArray) -> FloatArray:
        """``M(Bu − f)``."""
        return self.seen * (fft.irfft2(self.otf * fft.rfft2(u), s=u.shape) - self.observed)

    def misfit(self, u: FloatArray) -> float:
        """``λ/2 ‖M(Bu − f)‖²``."""
        return self.fidelity / 2 * float(np.square(self.residual(u)).sum(dtype=np.float64))


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
    >>> float(seen_mean(Problem(np.float32([[1, 2, 9]]), np.float32([[1, 1, 0]]), np.ones((1, 2)), 1.0)))
    1.5
    """
    return np.float32(inner(problem.seen, problem.observed) / problem.seen.sum(dtype=np.float64))


def inner(a: FloatArray, b: FloatArray) -> float:
    """Inner product, summed in double precision.

    Parameters
    ----------
    a, b : ndarray, float32, equal shapes

    Returns
    -------
    float

    Examples
    --------
    >>> inner(np.float32([1, 2]), np.float32([3, 4]))
    11.0
    """
    return float(np.sum(a * b, dtype=np.float64))

"""The data term of deconvolution, ``λ/2 ‖M(k∗u − f)‖²``, and its gradient.

Symbols as in :mod:`turbrestore.deconvolution`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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

    @cached_property
    def power(self) -> FloatArray:
        """|k̂|², which BᵀB multiplies by."""
        return np.square(np.abs(self.otf))

    def blurred(self, spectrum: Spectrum) -> FloatArray:
        """Bu, from the Fourier transform of u."""
        return fft.irfft2(self.otf * spectrum, s=self.observed.shape, overwrite_x=True)

    def gradient_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Fourier transform of the gradient ``λBᵀM(Bu − f)``, from that of u."""
        return self._back(self._residual(spectrum))

    def normal_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Fourier transform of ``λBᵀMBu``, from that of u."""
        blurred = self.blurred(spectrum)
        blurred *= self.seen
        return self._back(blurred)

    def residual(self, u: FloatArray) -> FloatArray:
        """``M(Bu − f)``."""
        return self._residual(fft.rfft2(u))

    def _residual(self, spectrum: Spectrum) -> FloatArray:
        found = self.blurred(spectrum)
        found -= self.observed
        found *= self.seen
        return found

    def _back(self, residual: FloatArray) -> Spectrum:
        found = fft.rfft2(residual, overwrite_x=True)
        found *= self.otf.conj()
        found *= np.float32(self.fidelity)
        return found

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


def spectral_inner(a: Spectrum, b: Spectrum, shape: tuple[int, int]) -> float:
    """Inner product of two real images from their half-spectra (Parseval), summed in double precision.

    Parameters
    ----------
    a, b : ndarray, complex64, shape (P, Q // 2 + 1)
    shape : (int, int)
        P and Q.

    Returns
    -------
    float

    Examples
    --------
    >>> a, b = np.float32([[1, 0, 2]]), np.float32([[3, 7, 4]])
    >>> round(spectral_inner(fft.rfft2(a), fft.rfft2(b), (1, 3)), 4)
    11.0
    """
    products = a.real * b.real
    products += a.imag * b.imag
    columns = products.sum(axis=0, dtype=np.float64)
    # The other half repeats every column but the first and, of an even number, the middle one.
    twice = columns[1 : (shape[1] + 1) // 2].sum()
    return float((columns.sum() + twice) / (shape[0] * shape[1]))

"""Blur: point spread functions and their transfer functions.

Symbols (paper 3, section 5)
----------------------------
k : point spread function (PSF), sums to 1; its Fourier transform is the transfer function (OTF)
σ : width of k, pixels: standard deviation of a Gaussian, or of the Gaussian whose OTF is one half at the same frequency
ν : spatial frequency, cycles per pixel; ν_h the one at which the OTF is one half
p : exponent of the transfer function
n : standard deviation of the noise, intensity

Transfer functions are half-spectra with the layout of :func:`numpy.fft.rfft2`, so
``irfft2(otf * rfft2(u), s=u.shape)`` is the periodic convolution k ∗ u.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray
from ..core.errors import DataError, require

Float64Array = NDArray[np.float64]

# Exponents of the transfer function: a Gaussian, and a long exposure through Kolmogorov turbulence (Fried 1966).
GAUSSIAN, KOLMOGOROV = 2.0, 5 / 3
# Exponent of wide blurs of fused frames, and the width halfway between it and that of narrow ones, pixels; chosen on
# six clips, whose average changes by 0.1 dB with an exponent of 1.1 or a width of 1.4.
_WIDE, _HALFWAY = 1.2, 1.3


def blur_otf(shape: tuple[int, int], sigma: float, exponent: float = GAUSSIAN) -> FloatArray:
    """Return the transfer function ``exp(−ln 2 (ν/ν_h)^p)`` on a periodic grid, ``ν_h = √(ln 2 / 2) / (π σ)``.

    p = 2 is the Gaussian, ``exp(−2π²σ²ν²)``. p = 5/3 is a long exposure through Kolmogorov turbulence (Fried
    1966), whose point spread function has a narrower core and wider wings. Fused frames have wider wings still, see
    :func:`fused_exponent`.
    Returns (H, W // 2 + 1).
    """
    require(np.isfinite(sigma) and sigma >= 0, f"sigma: expected a finite number of 0 or more pixels, found {sigma}")
    check_exponent(exponent)
    if sigma == 0:
        return np.ones((shape[0], shape[1] // 2 + 1), np.float32)
    rows, columns = _frequencies(shape)
    return np.exp(-np.log(2) * (np.hypot(rows, columns) / half_frequency(sigma)) ** exponent).astype(np.float32)


def radial_otf(frequencies: ArrayLike, sigma: float, exponent: float = GAUSSIAN) -> Float64Array:
    """Return the transfer function of :func:`blur_otf` at radial frequencies, cycles per pixel."""
    nu = np.asarray(frequencies, np.float64)
    return np.ones_like(nu) if sigma == 0 else np.exp(-np.log(2) * (nu / half_frequency(sigma)) ** exponent)


def fused_exponent(sigma: float) -> float:
    """Exponent of the transfer function of fused frames whose blur is this wide.

    Short exposures, and averages of blurs of different widths, have a sharp core in a wide halo: p is 1 to 1.3.
    Registration, interpolation and pixels add a blur of about half a pixel that is close to a Gaussian, so that p is
    larger where the whole is not much wider than that: ``1.2 + (5/3 − 1.2) / (1 + (σ / 1.3)⁴)``.
    """
    return _WIDE + (KOLMOGOROV - _WIDE) / (1 + (sigma / _HALFWAY) ** 4)


def half_frequency(sigma: float) -> float:
    """Return the frequency at which the transfer function of a Gaussian is one half: ``√(ln 2 / 2) / (π σ)``."""
    return float(np.sqrt(np.log(2) / 2) / (np.pi * sigma))


def check_exponent(exponent: float) -> None:
    """Check the exponent of :func:`blur_otf`."""
    require(1 <= exponent <= 2, f"exponent: expected 1 to 2 (a Gaussian), found {exponent}")


def psf_to_otf(psf: ArrayLike, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Compute the transfer function (H, W // 2 + 1) of a sampled PSF (h, w) on a periodic grid."""
    kernel = check_psf(psf)
    height, width = kernel.shape
    if height > shape[0] or width > shape[1]:
        raise DataError(f"psf: expected at most the size of the image {shape}, found {kernel.shape}")
    grid = np.zeros(shape)
    grid[:height, :width] = kernel
    grid = np.roll(grid, (-(height // 2), -(width // 2)), axis=(0, 1))
    return np.fft.rfft2(grid).astype(np.complex64)


def check_psf(psf: ArrayLike) -> Float64Array:
    """Return a PSF (h, w) as a float64 array that sums to 1."""
    kernel = np.asarray(psf, dtype=np.float64)
    if kernel.ndim != 2 or any(size % 2 == 0 for size in kernel.shape):
        raise DataError(f"psf: expected shape (h, w) with odd sizes, found {kernel.shape}")
    total = kernel.sum()
    if not (np.isfinite(total) and total > 0 and kernel.min() >= 0):
        raise DataError("psf: expected finite values of 0 or more with a positive sum")
    return kernel / total


def laplacian_symbol(height: int, width: int) -> FloatArray:
    """Return the Fourier symbol (H, W // 2 + 1) of −Δ for periodic forward differences."""
    rows, columns = (2 - 2 * np.cos(2 * np.pi * nu) for nu in _frequencies((height, width)))
    return (rows + columns).astype(np.float32)


def _frequencies(shape: tuple[int, ...]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    return np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])

"""Blur: Gaussian point spread functions, their transfer functions, and a cautious estimate of the blur of an image.

Symbols (paper 3, section 5)
----------------------------
k : point spread function (PSF), sums to 1; its Fourier transform is the transfer function (OTF).
σ : standard deviation of a Gaussian k, pixels.
ν : spatial frequency, cycles per pixel.
n : standard deviation of the noise, intensity.

Transfer functions are half-spectra as :func:`scipy.fft.rfft2` lays them out, so
``irfft2(otf * rfft2(u), s=u.shape)`` is the periodic convolution k ∗ u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from .arrays import FloatArray, check_image, luminance
from .errors import DataError, require

Float64Array = NDArray[np.float64]
Spectrum = NDArray[Any]

# Below this a Gaussian passes 30 % at the highest frequency of the grid: no more than pixels themselves blur.
_SMALLEST_SIGMA = 0.5
# Half-widths of rings in the spectrum, cycles per pixel, below and above which a fit means nothing.
_LOWEST_FREQUENCY = 0.02
_RING = 1 / 128
# Share of the noise floor at which the spectrum stops telling about the scene.
_FLOOR_MARGIN = 8.0
# Natural and drawn scenes have power ν^-1.6 to ν^-2.4; the fit assumes ν^-2.
_SLOPE_UNCERTAINTY = 0.4
# Intensity by which a result may leave the local range of the image, and the share of pixels that may do so.
_OVERSHOOT = 0.05
_OVERSHOOT_SHARE = 0.025


@dataclass(frozen=True, eq=False)
class BlurEstimate:
    """Estimated Gaussian blur of an image, with what it was read from.

    Attributes
    ----------
    sigma : float
        Standard deviation to remove, pixels; 0 means that the image should be left alone.
    uncertainty : float
        One standard deviation of ``fitted``: scatter of the fit, and scenes whose spectrum falls slower or faster
        than the fit assumes; infinite where no fit is possible.
    noise : float
        Standard deviation of the noise that was assumed, intensity.
    fitted : float
        σ that fits the spectrum best, before overshoot limits it.
    cutoff : float
        Highest frequency that was used, cycles per pixel.
    frequencies, power, model : ndarray, float64, shape (n,)
        Rings that were used: frequency (cycles per pixel), power above the noise, and the fitted curve.
    """

    sigma: float
    uncertainty: float
    noise: float
    fitted: float
    cutoff: float
    frequencies: Float64Array
    power: Float64Array
    model: Float64Array


def gaussian_psf(sigma: float) -> FloatArray:
    """Gaussian point spread function, sampled at pixel centres out to 4σ.

    Parameters
    ----------
    sigma : float
        Standard deviation, pixels; 0 gives a single 1.

    Returns
    -------
    ndarray, float32, shape (n, n), n odd
        Sums to 1.

    Raises
    ------
    ConfigurationError
        ``sigma`` is negative or not finite.

    Examples
    --------
    >>> gaussian_psf(0.5).shape
    (5, 5)
    """
    _check_sigma(sigma)
    radius = int(np.ceil(4 * sigma))
    if radius == 0:
        return np.ones((1, 1), np.float32)
    profile = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    profile /= profile.sum()
    return np.outer(profile, profile).astype(np.float32)


def gaussian_otf(shape: tuple[int, int], sigma: float) -> FloatArray:
    """Transfer function of a Gaussian on a periodic grid: ``exp(−2π²σ²ν²)``.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the image.
    sigma : float
        Standard deviation, pixels.

    Returns
    -------
    ndarray, float32, shape (H, W // 2 + 1)
        1 at frequency 0.

    Raises
    ------
    ConfigurationError
        ``sigma`` is negative or not finite.

    Examples
    --------
    >>> float(gaussian_otf((4, 4), 1.0)[0, 0])
    1.0
    """
    _check_sigma(sigma)
    rows, columns = (np.exp(-2 * (np.pi * sigma * nu) ** 2) for nu in _frequencies(shape))
    return (rows * columns).astype(np.float32)


def psf_to_otf(psf: ArrayLike, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Transfer function of a sampled point spread function on a periodic grid.

    Parameters
    ----------
    psf : array_like, shape (h, w), both odd
        Centred on its middle pixel; divided by its sum.
    shape : (int, int)
        Rows and columns of the image, at least (h, w).

    Returns
    -------
    ndarray, complex64, shape (H, W // 2 + 1)

    Raises
    ------
    DataError
        Even or too large PSF, one that is negative somewhere or sums to nothing.

    Examples
    --------
    >>> psf_to_otf([[0.0, 1.0, 0.0]], (2, 4))
    array([[1.+0.j, 1.+0.j, 1.+0.j],
           [1.+0.j, 1.+0.j, 1.+0.j]], dtype=complex64)
    """
    kernel = check_psf(psf)
    height, width = kernel.shape
    if height > shape[0] or width > shape[1]:
        raise DataError(f"psf: expected at most the size of the image {shape}, found {kernel.shape}")
    grid = np.zeros(shape)
    grid[:height, :width] = kernel
    grid = np.roll(grid, (-(height // 2), -(width // 2)), axis=(0, 1))
    return fft.rfft2(grid).astype(np.complex64)


def check_psf(psf: ArrayLike) -> Float64Array:
    """Return ``psf`` as a float64 array that sums to 1.

    Parameters
    ----------
    psf : array_like, shape (h, w), both odd
        Not negative.

    Returns
    -------
    ndarray, float64, shape (h, w)

    Raises
    ------
    DataError
        Not two odd axes, not finite, negative somewhere, or sum 0.

    Examples
    --------
    >>> check_psf([[2.0]])
    array([[1.]])
    """
    kernel = np.asarray(psf, dtype=np.float64)
    if kernel.ndim != 2 or any(size % 2 == 0 for size in kernel.shape):
        raise DataError(f"psf: expected shape (h, w) with odd sizes, found {kernel.shape}")
    total = kernel.sum()
    if not (np.isfinite(total) and total > 0 and kernel.min() >= 0):
        raise DataError("psf: expected finite values of 0 or more with a positive sum")
    return kernel / total


def laplacian_symbol(height: int, width: int) -> FloatArray:
    """Fourier symbol of −Δ for periodic forward differences.

    Parameters
    ----------
    height, width : int
        Size of the image.

    Returns
    -------
    ndarray, float32, shape (H, W // 2 + 1)

    Examples
    --------
    >>> laplacian_symbol(2, 2)
    array([[0., 4.],
           [4., 8.]], dtype=float32)
    """
    rows, columns = (2 - 2 * np.cos(2 * np.pi * nu) for nu in _frequencies((height, width)))
    return (rows + columns).astype(np.float32)


def wiener_fidelity(image: FloatArray, noise: float) -> float:
    """Weight λ of the data for Wiener deconvolution, from contrast and noise: ``6 s / √(n² + 0.002²)``.

    s is the standard deviation of the image. On photographs, brick and text blurred with σ 1–3 the result is within
    0.5 dB of the best λ for n = .01–.02; below, a perfectly known blur would bear 3 to 10 times more (0.2–1.5 dB,
    3 dB on thin text). The floor of .002 stands for what is wrong with the blur model.

    Parameters
    ----------
    image : ndarray, float32
        Blurred image.
    noise : float
        n, intensity.

    Returns
    -------
    float

    Examples
    --------
    >>> import numpy as np
    >>> round(wiener_fidelity(np.array([[0.0, 1.0]], np.float32), 0.0))
    1500
    """
    return max(6.0 * float(image.std(dtype=np.float64)) / float(np.hypot(noise, 0.002)), 1.0)


def estimate_noise(image: ArrayLike) -> float:
    """Estimate the noise: median of |second difference in x and y|, scaled to a standard deviation.

    The mask ``[1 −2 1]ᵀ[1 −2 1] / 6`` (Immerkær 1996) keeps the deviation of white noise and cancels planes; the
    median, unlike the mean, is not moved by edges. A fused image has smoother noise than a frame, because
    registration interpolates; its low frequencies hold more noise than this figure says.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.

    Returns
    -------
    float
        Intensity; 0 for images below 3×3.

    Raises
    ------
    DataError
        Wrong shape or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> noisy = np.random.default_rng(0).normal(0.5, 0.01, (64, 64))
    >>> round(estimate_noise(noisy), 3)
    0.01
    """
    grey = luminance(check_image(image))
    if min(grey.shape) < 3:
        return 0.0
    mask = np.array([1, -2, 1], np.float32)
    residual = cv2.sepFilter2D(grey, cv2.CV_32F, mask, mask)[1:-1, 1:-1] / 6
    return float(np.median(np.abs(residual)) / 0.6745)


def estimate_blur(image: ArrayLike, noise: float | None = None) -> BlurEstimate:
    """Estimate the Gaussian blur of an image, erring on the side of too little.

    The power spectrum of a scene falls about as ν^-2, so that of the blurred scene follows
    ``log P = c − 2 log ν − 4π²σ²ν²``. P is averaged over rings of the Hann-windowed image, the noise floor n² is
    subtracted, and σ fitted from 0.02 cycles per pixel to where P first falls below 8 n². Paper 3 picks σ by hand.

    σ is then lowered until a Wiener result leaves the local range (7×7) of the image by more than 5 % of full
    scale at no more than 2.5 % of the pixels, where ringing would show. Below 0.5 pixels it becomes 0: leave the
    image alone.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float, optional
        Standard deviation of the noise, intensity; estimated by default.

    Returns
    -------
    BlurEstimate

    Raises
    ------
    DataError
        Wrong shape or values that are not finite.
    ConfigurationError
        ``noise`` is negative or not finite.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> walk = np.random.default_rng(0).normal(size=(2, 128, 1)).cumsum(axis=1)
    >>> scene = (0.5 + 0.02 * (walk[0] + walk[1].T)).astype(np.float32)
    >>> bool(1.5 < estimate_blur(cv2.GaussianBlur(scene, (0, 0), 2.0)).fitted < 2.5)
    True
    """
    grey = luminance(check_image(image))
    noise = estimate_noise(grey) if noise is None else noise
    require(np.isfinite(noise) and noise >= 0, f"noise: expected a finite number of 0 or more, found {noise}")
    frequencies, power, counts = _informative_rings(grey, noise)
    if len(frequencies) < 4:
        return BlurEstimate(0.0, float("inf"), noise, 0.0, 0.0, frequencies, power, power)
    fitted, scatter, model = _fit_gaussian(frequencies, power, counts)
    flatter, steeper = (_fit_gaussian(frequencies, power, counts, 2 + sign * _SLOPE_UNCERTAINTY)[0] for sign in (-1, 1))
    uncertainty = float(np.hypot(scatter, (flatter - steeper) / 2))
    sigma = _without_overshoot(grey, fitted, noise)
    return BlurEstimate(sigma, uncertainty, noise, fitted, float(frequencies[-1]), frequencies, power, model)


def _informative_rings(grey: FloatArray, noise: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Frequency, power above the noise floor and count of the rings that the fit uses."""
    height, width = grey.shape
    window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    centred = (grey - np.average(grey, weights=window)) * window
    power = np.abs(fft.fft2(centred)) ** 2 / np.sum(window**2)
    radius = np.hypot(fft.fftfreq(height)[:, None], fft.fftfreq(width))
    ring = np.rint(radius / _RING).astype(np.intp)
    inside = (radius >= _LOWEST_FREQUENCY) & (radius <= 0.5)
    counts = np.bincount(ring[inside]).astype(np.float64)
    filled = counts > 0
    counts = counts[filled]
    mean_power, mean_radius = (np.bincount(ring[inside], v[inside])[filled] / counts for v in (power, radius))
    # An image without noise still ends somewhere: float32 keeps seven digits.
    floor = max(noise**2, 1e-7 * float(mean_power.max(initial=0)))
    below = np.flatnonzero(mean_power <= _FLOOR_MARGIN * floor)
    end = below[0] if len(below) else len(mean_power)
    return mean_radius[:end], mean_power[:end] - noise**2, counts[:end]


def _fit_gaussian(
    frequencies: Float64Array, power: Float64Array, counts: Float64Array, slope: float = 2.0
) -> tuple[float, float, Float64Array]:
    """Fit ``log P = c − slope·log ν − 4π²σ²ν²`` with rings weighed by their size: σ, its deviation, the curve."""
    weights = np.sqrt(counts)
    design = np.stack([np.ones_like(frequencies), -((2 * np.pi * frequencies) ** 2)], axis=1)
    target = np.log(power) + slope * np.log(frequencies)
    solution = np.linalg.lstsq(design * weights[:, None], target * weights, rcond=None)[0]
    residual = (target - design @ solution) * weights
    covariance = np.linalg.inv((design * weights[:, None]).T @ (design * weights[:, None]))
    deviation = np.sqrt(covariance[1, 1] * np.sum(residual**2) / (len(target) - 2))
    sigma = float(np.sqrt(max(solution[1], 0.0)))
    model = np.exp(design @ solution - slope * np.log(frequencies))
    # d(σ²) = 2σ dσ, which says nothing near 0.
    return sigma, float(deviation / (2 * max(sigma, _SMALLEST_SIGMA))), model


def _without_overshoot(grey: FloatArray, sigma: float, noise: float) -> float:
    """Lower ``sigma`` until a Wiener result stays within the local range of the image; 0 if nothing is left."""
    margin = int(np.ceil(4 * sigma))
    # Where the two sides of the reflected image meet it rings whatever the blur: look at the image proper.
    padded = cv2.copyMakeBorder(grey, margin, margin, margin, margin, cv2.BORDER_REFLECT)
    height, width = grey.shape
    fidelity = wiener_fidelity(grey, noise)
    box = np.ones((7, 7), np.uint8)
    high, low = cv2.dilate(grey, box) + _OVERSHOOT, cv2.erode(grey, box) - _OVERSHOOT
    while sigma >= _SMALLEST_SIGMA:
        result = _sharpen(padded, sigma, fidelity)[margin : margin + height, margin : margin + width]
        if np.mean((result > high) | (result < low)) <= _OVERSHOOT_SHARE:
            return sigma
        sigma *= 0.95
    return 0.0


def _sharpen(image: FloatArray, sigma: float, fidelity: float) -> FloatArray:
    """Wiener deconvolution of a periodic image: ``λ k*∗(k∗u − f) = Δu`` (paper 3, after eq. 21) in Fourier."""
    otf = gaussian_otf((image.shape[0], image.shape[1]), sigma)
    denominator = fidelity * otf**2 + laplacian_symbol(image.shape[0], image.shape[1])
    return fft.irfft2(fidelity * otf * fft.rfft2(image) / denominator, s=image.shape)


def _frequencies(shape: tuple[int, ...]) -> tuple[Float64Array, Float64Array]:
    return fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])


def _check_sigma(sigma: float) -> None:
    require(np.isfinite(sigma) and sigma >= 0, f"sigma: expected a finite number of 0 or more pixels, found {sigma}")

"""Standard deviation of every pixel of a restored image.

Symbols
-------
ρ : fused image; Σ : its variance per pixel, from the filter; u : restored image.
H : transfer function of the blur that was removed; k² : symbol of the negative Laplacian.
λ : weight of the data in a deconvolution with that prior, :func:`quadratic_fidelity`.
ε² : variance of the position of a pixel along one axis, squared pixels.

Model
-----
    var u = g Σ + ε² ⟨|∇u|²⟩ + ⟨(u_low − u_high)²⟩ / 4

*Deconvolution.*  Near its result, deconvolution is taken for a linear one with a Gaussian prior.  The posterior
variance of ``min λ/2 ‖Hu − ρ‖² + ½‖∇u‖²`` with noise Σ is ``g Σ`` with ``g = mean 1 / (|H|² + k²/λ)``, a mean over all
frequencies; where no blur is removed, g = 1.  It holds the amplified noise, ``mean |H|² / (…)²``, and detail that the
blur has left undetermined.

*Registration.*  A position that is uncertain by ε makes an intensity uncertain by ε times the gradient.  The flow
outside the subspace of its model, of variance R along one axis, is partly motion and partly error of the flow.
``ε² = 0.7 R`` is taken for error.  This share is the only constant that is taken from data: on three simulated clips 93
to 100 % of the pixels lie within two deviations of the scene at the mean geometry (``benchmarks/uncertainty.py``).

*Blur.*  u_low and u_high are the Wiener solutions for the 16 % and 84 % quantiles of the width of the blur, where a
posterior of it is known: what more or less sharpening would change.

*Geometry.*  The deviation is that from the scene at the mean geometry of the frames.  The mean geometry itself bends
the scene by :func:`turbrestore.dynamics.flow_model.mean_flow_error`; this is a length in pixels, the same error for
neighbouring pixels, and is reported as one, not as noise of intensities.

What no frame has shown, be it beside the frames or under an overlay, and what is saturated in all of them, has an
infinite deviation.  The chroma of a colour image is not considered: the deviation is that of the luminance.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..blur.psf import GAUSSIAN, blur_otf, laplacian_symbol
from ..core.arrays import FloatArray, luminance
from ..core.gradient import sobel_gradient
from ..deblurring.remove_blur import Deblurred
from ..deconvolution.conjugate_gradient import wiener_fidelity
from ..deconvolution.deconvolve import DeconvolutionParams, automatic_fidelity
from ..deconvolution.problem import MARGIN_SIGMAS, margin_around
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..runtime.fourier import irfft2, rfft2

# Full scale, less half a grey level of 8 bits.
SATURATED = 1 - 0.5 / 255
# Window in which the squared gradient is averaged, pixels, chosen.
_WINDOW = 1.5
# Share of R that is error, see "Registration", and the window in which R is averaged, pixels, chosen.
_ERROR_SHARE, _SMOOTH = 0.7, 4.0
# Longest side of the grid of frequencies; g hardly depends on it.
_GRID = 256


def measure_deviation(
    image: FloatArray,
    filtered: Filtered,
    dynamics: FlowDynamics,
    known: NDArray[np.bool_],
    params: DeconvolutionParams,
    deblurred: Deblurred | None,
) -> FloatArray:
    """Measure the standard deviation of every pixel of a restored image.

    ``image`` (H, W) or (H, W, 3); returns (H, W).
    """
    gain, by_blur = 1.0, np.zeros(1, np.float32)
    if deblurred is not None:
        done, posterior = deblurred.deconvolution, deblurred.posterior
        blur, exponent = posterior or deblurred.blur, params.exponent
        fidelity = quadratic_fidelity(filtered.image, params.method, done.fidelity, done.noise)
        exponent = blur.exponent if exponent is None and blur is not None else exponent
        gain = posterior_gain((image.shape[0], image.shape[1]), fidelity, done.sigma, exponent)
        if posterior is not None:
            low, _, high = posterior.width
            by_blur = variance_by_blur(filtered.image, fidelity, (float(low), float(high)), exponent or GAUSSIAN)
    return pixel_deviation(image, filtered.variance, gain, position_variance(dynamics), known, by_blur)


def pixel_deviation(
    image: FloatArray,
    variance: FloatArray,
    gain: float,
    position_variance: FloatArray,
    known: NDArray[np.bool_],
    blur_variance: FloatArray | float = 0.0,
) -> FloatArray:
    """Compute the standard deviation of every pixel.

    ``image`` (H, W) or (H, W, 3); the variances and ``known`` (H, W); returns (H, W).
    """
    grey = luminance(image)
    gx, gy = sobel_gradient(grey)
    square = cv2.GaussianBlur(gx * gx + gy * gy, (0, 0), _WINDOW)
    found = np.sqrt(np.float32(gain) * variance + position_variance * square + blur_variance)
    return np.where(known, found, np.float32(np.inf)).astype(np.float32)


def posterior_gain(size: tuple[int, int], fidelity: float, sigma: float, exponent: float | None) -> float:
    """Compute the posterior variance of a deconvolved pixel for noise of unit variance: g."""
    if sigma == 0:
        return 1.0
    shape = (min(size[0], _GRID), min(size[1], _GRID))
    power = np.abs(blur_otf(shape, sigma, exponent or GAUSSIAN)) ** 2
    # The first value of the inverse transform is the mean over all frequencies, of which half are stored.
    return float(np.fft.irfft2(1 / (power + laplacian_symbol(*shape) / fidelity), s=shape)[0, 0])


def variance_by_blur(fused: FloatArray, fidelity: float, widths: tuple[float, float], exponent: float) -> FloatArray:
    """Compute the variance that the uncertainty of the width leaves, from its 16 % and 84 % quantiles, pixels.

    ``fused`` (H, W) or (H, W, 3); returns (H, W).
    """
    reach = int(np.ceil(MARGIN_SIGMAS * widths[1]))
    margin = margin_around((fused.shape[0], fused.shape[1]), reach)
    spectrum = rfft2(margin.pad(luminance(fused)))
    prior = laplacian_symbol(*margin.shape) / fidelity
    otfs = (blur_otf(margin.shape, width, exponent) for width in widths)
    low, high = (otf / (otf**2 + prior) for otf in otfs)
    between = irfft2(spectrum * (high - low), margin.shape)[margin.inside()] / 2
    return cv2.GaussianBlur(np.square(between).astype(np.float32), (0, 0), _WINDOW)


def quadratic_fidelity(fused: FloatArray, method: str, fidelity: float, noise: float) -> float:
    """Return the weight λ with which a quadratic prior approximates that of a deconvolution.

    It is the automatic weight for wiener, times the ratio of the weight that was used to the automatic one; for wiener
    this is the weight that was used.
    ``fused`` (H, W) or (H, W, 3), with noise of the deviation ``noise``.
    """
    grey = luminance(fused)
    return wiener_fidelity(grey, noise) * fidelity / automatic_fidelity(method, grey, noise)


def position_variance(dynamics: FlowDynamics) -> FloatArray:
    """Compute the variance of the position of every pixel along one axis: ε².

    Returns (H, W).
    """
    return cv2.GaussianBlur(dynamics.residual_variance, (0, 0), _SMOOTH) * np.float32(_ERROR_SHARE)


def saturation_level(brightest: float, noise: float, step: float, saturated: float) -> float:
    """Return the intensity from which the temporal mean is saturated, where a frame is from ``saturated`` on.

    A camera of 12 bits saturates far below the full scale of a file of 16. A pixel that has the largest intensity of
    the clip in every frame is saturated if the frames are noisy, and else may be a white part of the scene.
    """
    return min(saturated, brightest - step / 2) if noise >= step else saturated

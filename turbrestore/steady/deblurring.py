"""Wiener filter of one blur for all frames of a clip.

Symbols
-------
B : transfer function of the blur; L that of −Δ; λ fidelity

``u = λ B (λ B² + L)⁻¹ f`` is the minimum of ``λ/2 ‖Bu − f‖² + ½ ‖∇u‖²`` (see
:mod:`turbrestore.deconvolution.conjugate_gradient`); the image is continued by reflection.  The filter is linear and
the same for every frame, so it adds no flicker.  λ follows the contrast and the noise; a floor of the noise stands for
what noise does not explain, registration that differs from frame to frame and video compression.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from scipy import fft

from ..blur.psf import blur_otf, laplacian_symbol
from ..core.arrays import FloatArray

# Weight of contrast over noise as in psf.wiener_fidelity, and floor of the noise.
_FIDELITY, _LEAST_NOISE = 6.0, 0.015
# Margin of the reflection, in widths of the blur.
_MARGIN = 6.0


def deblur(image: FloatArray, sigma: float, exponent: float, noise: float) -> FloatArray:
    """Remove a blur from an image by a linear filter.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    sigma, exponent : float
        Width, pixels, and shape of the blur, see :func:`turbrestore.blur.psf.blur_otf`; a width of 0 removes none.
    noise : float
        Standard deviation of the noise of the image, intensity.

    Returns
    -------
    ndarray, float32, shape of ``image``

    Examples
    --------
    >>> edge = np.repeat(np.float32([[0.2, 0.8]]), 16, 1).repeat(8, 0)
    >>> soft = cv2.GaussianBlur(edge, (0, 0), 1.0)
    >>> bool(np.ptp(deblur(soft, 1.0, 2.0, 0.0)[4, 14:18]) > np.ptp(soft[4, 14:18]))
    True
    """
    if sigma == 0:
        return image
    height, width = image.shape[:2]
    margin = min(int(np.ceil(_MARGIN * sigma)), height - 1, width - 1)
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    shape = fft.next_fast_len(padded.shape[0], real=True), fft.next_fast_len(padded.shape[1], real=True)
    below, right = shape[0] - padded.shape[0], shape[1] - padded.shape[1]
    padded = cv2.copyMakeBorder(padded, 0, below, 0, right, cv2.BORDER_REPLICATE)
    fidelity = _FIDELITY * float(image.std()) / float(np.hypot(noise, _LEAST_NOISE))
    power, otf, laplacian = _transfer(shape, sigma, exponent)
    gain = max(fidelity, 1.0) * otf / (max(fidelity, 1.0) * power + laplacian)
    planes = padded[None] if image.ndim == 2 else np.moveaxis(padded, -1, 0)
    filtered = fft.irfft2(fft.rfft2(planes) * gain, shape)
    cropped = filtered[:, margin : margin + height, margin : margin + width].astype(np.float32, copy=False)
    return cropped[0] if image.ndim == 2 else np.ascontiguousarray(np.moveaxis(cropped, 0, -1))


@functools.lru_cache(maxsize=2)
def _transfer(shape: tuple[int, int], sigma: float, exponent: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """B², B and L."""
    otf = blur_otf(shape, sigma, exponent)
    return otf * otf, otf, laplacian_symbol(*shape)

"""Wiener filters of one blur for all frames of a clip, and of another for what is remembered.

Symbols
-------
B : transfer function of the blur; L that of −Δ; λ fidelity
n : number of frames that the memory holds, for every pixel (:mod:`turbrestore.steady.memory`)

``u = λ B (λ B² + L)⁻¹ f`` is the minimum of ``λ/2 ‖Bu − f‖² + ½ ‖∇u‖²`` (see
:mod:`turbrestore.deconvolution.conjugate_gradient`); the image is continued by reflection.  The filter is linear and
the same for every frame, so it adds no flicker.  λ follows the contrast and the noise; a floor of the noise represents
what noise does not explain, registration that differs from frame to frame and video compression.

What is remembered has averaged that out: there a second filter has a lower floor and its own width, and the result is
``u_1 + (1 − 1/√n) (u_2 − u_1)``.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np

from ..blur.psf import blur_otf, laplacian_symbol
from ..core.arrays import FloatArray
from ..deconvolution.conjugate_gradient import FIDELITY
from ..runtime.fourier import fast_length, irfft2, rfft2

# Floors of the noise, of a frame and of what is remembered, both chosen.
_LEAST_NOISE = 0.015, 0.005
# Margin of the reflection, in widths of the blur, chosen.
_MARGIN = 6.0


def deblur(
    image: FloatArray, sigma: tuple[float, float], exponent: float, noise: tuple[float, float], held: FloatArray
) -> FloatArray:
    """Remove a blur from an image by linear filters.

    ``image`` (H, W) or (H, W, 3); ``held`` (H, W).
    """
    if sigma[0] == 0:
        return image
    height, width = image.shape[:2]
    margin = min(int(np.ceil(_MARGIN * max(sigma))), height - 1, width - 1)
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    shape = fast_length(padded.shape[0]), fast_length(padded.shape[1])
    below, right = shape[0] - padded.shape[0], shape[1] - padded.shape[1]
    padded = cv2.copyMakeBorder(padded, 0, below, 0, right, cv2.BORDER_REPLICATE)
    planes = rfft2(padded[None] if image.ndim == 2 else np.moveaxis(padded, -1, 0))
    contrast, inner = float(image.std()), np.s_[:, margin : margin + height, margin : margin + width]

    def filtered(kind: int) -> FloatArray:
        power, otf, laplacian = _transfer(shape, sigma[kind], exponent)
        fidelity = max(FIDELITY * contrast / float(np.hypot(noise[kind], _LEAST_NOISE[kind])), 1.0)
        return irfft2(planes * (fidelity * otf / (fidelity * power + laplacian)), shape)[inner].astype(np.float32)

    result = filtered(0)
    share = 1 - 1 / np.sqrt(held)
    if np.any(share):
        result += share * (filtered(1) - result)
    return result[0] if image.ndim == 2 else np.ascontiguousarray(np.moveaxis(result, 0, -1))


@functools.lru_cache(maxsize=2)
def _transfer(shape: tuple[int, int], sigma: float, exponent: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """B², B and L."""
    otf = blur_otf(shape, sigma, exponent)
    return otf * otf, otf, laplacian_symbol(*shape)

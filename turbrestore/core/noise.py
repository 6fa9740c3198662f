"""Estimation of the noise of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .arrays import check_image, luminance

# Rows that are filtered at once.
_NOISE_ROWS = 256


def estimate_noise(image: ArrayLike) -> float:
    """Estimate the standard deviation of the noise from the median of |second differences in x and y|.

    The mask ``[1 −2 1]ᵀ[1 −2 1] / 6`` (Immerkær 1996) keeps the deviation of white noise and cancels planes; the
    median, unlike the mean, is insensitive to edges.  A fused image has smoother noise than a frame, because
    registration interpolates; its low frequencies contain more noise than this estimate.

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
    mask, (height, width) = np.array([1, -2, 1], np.float32), grey.shape
    residual = np.empty((height - 2, width - 2), np.float32)
    for top in range(0, height - 2, _NOISE_ROWS):
        strip = residual[top : top + _NOISE_ROWS]
        seen = cv2.sepFilter2D(grey[top : top + len(strip) + 2], cv2.CV_32F, mask, mask)
        np.abs(np.divide(seen[1:-1, 1:-1], 6, out=strip), out=strip)
    return float(np.median(residual, overwrite_input=True) / 0.6745)

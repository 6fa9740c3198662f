"""Noise that the estimate of a blur assumes.

Symbols
-------
n : standard deviation of the noise and the model error of an image, intensity
s_1, s_2 : noise measured between neighbouring pixels, and between means of 2×2 pixels times 2; equal if it is white

n is larger than the noise of the image: no real blur follows the assumed shape exactly, and high contrast makes the
mismatch larger.  So n² is the sum of the squares of a multiple of s_1 and of a share of the contrast.

Registration interpolates, which smooths the noise of a fused image: s_1 misses a part of it, and the width would come
out too small.  So the multiple grows with s_2 / s_1.  In a clip with little noise this ratio is that of fine detail, so
the multiple grows only where s_1 is a clear share of the contrast.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..core.noise import estimate_noise

# Smallest n; share of the contrast; multiple of s_1.
LEAST_NOISE = 1e-4
_MISFIT, _MULTIPLES = 0.025, (1.5, 2.0)
# Ratios of s_2 to s_1, and shares of the contrast, between which the multiple grows.
_SMOOTH, _NOISY = (1.5, 2.0), (0.03, 0.05)


def noise_multiple(image: FloatArray) -> float:
    """Multiple of the noise that is measured in an image and in its reductions.

    ``image`` (H, W).
    """
    fine = max(estimate_noise(image), LEAST_NOISE)
    halved = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    smooth = np.interp(2 * estimate_noise(halved) / fine, _SMOOTH, (0, 1))
    noisy = np.interp(fine / max(float(image.std()), LEAST_NOISE), _NOISY, (0, 1))
    return float(np.interp(min(smooth, noisy), (0, 1), _MULTIPLES))


def assumed_noise(image: FloatArray, noise: float | None = None, multiple: float = _MULTIPLES[0]) -> float:
    """Return n.

    ``image`` (H, W).
    """
    level = estimate_noise(image) if noise is None else noise
    return max(float(np.hypot(multiple * level, _MISFIT * image.std())), LEAST_NOISE)

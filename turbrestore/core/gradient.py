"""Gradient of an image."""

from __future__ import annotations

import cv2
import numpy as np

from .arrays import FloatArray


def sobel_gradient(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute Sobel's derivatives along x and y, divided by 8.

    ``image`` (H, W) or (H, W, 3).
    """
    return (
        cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8),
        cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8),
    )


def gradient_noise(window: float) -> float:
    """Deviation of a derivative, in a Gaussian window of that deviation, of white noise of unit variance."""
    return 1 / (float(np.sqrt(8 * np.pi)) * window**2)

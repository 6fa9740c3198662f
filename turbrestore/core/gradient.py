"""Gradient of an image."""

from __future__ import annotations

import cv2

from .arrays import FloatArray


def sobel_gradient(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute Sobel's derivatives along x and y, divided by 8.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)

    Returns
    -------
    along_x, along_y : ndarray, float32, shape of ``image``
        Intensity per pixel.

    Examples
    --------
    >>> import numpy as np
    >>> along_x, along_y = sobel_gradient(np.tile(np.linspace(0, 1, 5, dtype=np.float32), (4, 1)))
    >>> float(along_x[1, 2]), float(along_y[1, 2])
    (0.25, 0.0)
    """
    return (
        cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8),
        cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8),
    )

"""Motion of the camera between two frames: the affine part of a flow.

Symbols
-------
F : flow from one frame to another, pixels
A : affine flow ``(dx, dy) = M (x − x̄, y − ȳ, 1)``, M of shape (2, 3), (x̄, ȳ) the centre of the image
r : distance of F from A at a sample, pixels; s the median of r

M is fitted to samples on a coarse grid by iterated least squares with Cauchy weights ``1 / (1 + (r / 2s)²)``, so that
objects that move, and flat regions whose flow is arbitrary, have little influence.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray

Matrix = NDArray[np.float64]

# Distance of the samples, at most, and number of fits.
_STEP, _FITS = 8, 4
# Smallest median distance, pixels, so that an exact fit has weights.
_LEAST_DISTANCE = 1e-3


def fit_camera(flow: FloatArray) -> Matrix:
    """Fit an affine flow that outliers hardly influence.

    ``flow`` (H, W, 2); returns (2, 3).
    """
    height, width = flow.shape[:2]
    step = max(min(_STEP, height // 8, width // 8), 1)
    rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    samples = flow[np.ix_(rows, columns)].reshape(-1, 2).astype(np.float64)
    x, y = np.meshgrid(columns - (width - 1) / 2, rows - (height - 1) / 2)
    basis = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    root_weights = np.ones((len(samples), 1))
    for _ in range(_FITS):
        solution = np.linalg.lstsq(basis * root_weights, samples * root_weights, rcond=None)[0]
        distance = np.linalg.norm(samples - basis @ solution, axis=1)
        scale = 2 * max(float(np.median(distance)), _LEAST_DISTANCE)
        root_weights = 1 / np.sqrt(1 + (distance[:, None] / scale) ** 2)
    return solution.T


def camera_flow(matrix: Matrix, shape: tuple[int, ...]) -> FloatArray:
    """Affine flow of an image.

    ``matrix`` (2, 3); returns (H, W, 2).
    """
    height, width = shape[:2]
    x = np.arange(width, dtype=np.float64) - (width - 1) / 2
    y = (np.arange(height, dtype=np.float64) - (height - 1) / 2)[:, None]
    planes = [matrix[axis, 0] * x + matrix[axis, 1] * y + matrix[axis, 2] for axis in (0, 1)]
    return np.stack(planes, -1).astype(np.float32)


def camera_size(matrix: Matrix, shape: tuple[int, ...]) -> float:
    """Root mean square of an affine flow over an image, pixels.

    ``matrix`` (2, 3).
    """
    height, width = shape[:2]
    # Variance of the coordinates of a grid about its centre.
    spread = np.array([(width**2 - 1) / 12, (height**2 - 1) / 12, 1.0])
    return float(np.sqrt((matrix**2 * spread).sum()))

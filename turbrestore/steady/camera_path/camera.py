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

from ...core.arrays import FloatArray

Matrix = NDArray[np.float64]

# Distance of the samples, at most, and number of fits, both chosen.
_STEP, _FITS = 8, 4
# Smallest median distance, pixels, so that an exact fit has weights.
_LEAST_DISTANCE = 1e-3


def fit_camera(flow: FloatArray, shape: tuple[int, ...] | None = None, weight: FloatArray | None = None) -> Matrix:
    """Fit an affine flow that outliers hardly influence.

    ``flow`` (H, W, 2), or (h, w, 2) on a grid over an image of this shape (:mod:`turbrestore.steady.grid`); ``weight``
    (H, W) or (h, w); returns (2, 3).
    """
    height, width = flow.shape[:2]
    shape = shape or flow.shape
    step = max(min(_STEP * height // shape[0], height // 8, width // 8), 1)
    every = np.s_[step // 2 :: step]
    samples = flow[every, every].reshape(-1, 2).astype(np.float64)
    x, y = np.meshgrid(*(places[every] for places in _places(flow.shape, shape)))
    basis = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    trusted = basis if weight is None else basis * weight[every, every].reshape(-1, 1)
    weighted = trusted
    for _ in range(_FITS):
        solution = np.linalg.solve(weighted.T @ basis, weighted.T @ samples)
        distance = np.linalg.norm(samples - basis @ solution, axis=1)
        scale = 2 * max(float(np.median(distance)), _LEAST_DISTANCE)
        weighted = trusted / (1 + (distance[:, None] / scale) ** 2)
    return np.asarray(solution.T, np.float64)


def camera_flow(matrix: Matrix, shape: tuple[int, ...], grid: tuple[int, ...] | None = None) -> FloatArray:
    """Affine flow of an image, sampled at its pixels or on a grid over it.

    ``matrix`` (2, 3); returns (H, W, 2) or (h, w, 2).
    """
    x, y = _places(grid or shape, shape)
    flow = np.empty((len(y), len(x), 2), np.float32)
    for axis, (along_x, along_y, shift) in enumerate(matrix):
        across, down = (along_x * x + shift).astype(np.float32), (along_y * y).astype(np.float32)
        np.add(across, down[:, None], out=flow[..., axis])
    return flow


def camera_size(matrix: Matrix, shape: tuple[int, ...]) -> float:
    """Root mean square of an affine flow over an image, pixels.

    ``matrix`` (2, 3).
    """
    height, width = shape[:2]
    # Variance of the coordinates of a grid about its centre.
    spread = np.array([(width**2 - 1) / 12, (height**2 - 1) / 12, 1.0])
    return float(np.sqrt((matrix**2 * spread).sum()))


def corner_motion(matrix: Matrix, shape: tuple[int, ...]) -> float:
    """How far an affine flow moves the corners of an image at most along one axis, pixels.

    ``matrix`` (2, 3).
    """
    return float((np.abs(matrix) @ [shape[1] / 2, shape[0] / 2, 1.0]).max())


def _places(grid: tuple[int, ...], shape: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates x and y of a grid over an image, pixels about the centre of the image."""
    pairs = zip(grid[:2], shape[:2], strict=True)
    y, x = ((np.arange(count) + 0.5) * length / count - length / 2 for count, length in pairs)
    return x, y

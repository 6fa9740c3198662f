"""Gauss–Newton steps that refine a flow at the resolution of the frames (Lucas and Kanade 1981).

Symbols
-------
R, I : reference and frame with normalised contrast, grey levels; W : flow, pixels; G : average in a Gaussian window
g : gradient of R; e : residual ``I ∘ (id + W) − R``, 0 where W leads out of the frame; σ² : its mean square
J : structure tensor ``G(g gᵀ)``; A : area of the window; τ : deviation of the displacement that is left

Near W the frame is ``R + e``, and moving the reference by δ changes it by ``g·δ``.  If the rest of e is noise, the
posterior mean of δ, which is 0 ± τ before, is::

    δ = −(J + ε)⁻¹ G(g e),    ε = σ² / (A τ²),    W ← W + δ

The gradient is that of the reference (Baker and Matthews 2004), so J is computed once for all frames.  A frame may be
sharper than the reference, and the part of e that no displacement explains is large then: ε keeps steps from following
it.  No component of δ exceeds one pixel, beyond which the linear model says nothing.

A flow that is smooth over the window needs no search at full resolution: it is searched for at half the resolution, and
steps find the rest.  Residuals are those of all pixels, but as a window averages over several, averages and flow lie on
a grid of half the resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...runtime.jit import jit

GreyImage = NDArray[np.uint8]
# Takes a frame (H, W) and a flow to it on the grid of :func:`half_grid`; returns the refined flow.
RefineFlow = Callable[[GreyImage, FloatArray], FloatArray]
# Standard deviation of the window, pixels: narrower ones follow noise and what a blurred reference lacks.
_WINDOW = 3.0
# τ, pixels: what a search at half the resolution leaves; half of it fails with known motion, twice with sharp frames.
_LEFT = 0.2
# Least ε, squared grey levels per squared pixel: below one grey level a pixel, a gradient is rounding.
_LEAST_TEXTURE = 1.0
# More gain nothing; one, in a window of 4 pixels, loses 0.04 dB.
_STEPS = 2


def half_grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of the grid on which flows of frames (H, W) are refined."""
    return -(-shape[0] // 2), -(-shape[1] // 2)


def flow_refinement(reference: GreyImage) -> RefineFlow:
    """Prepare steps from a reference (H, W)."""
    g_x, g_y = _gradient(reference)
    height, width = half_grid(reference.shape)
    xx, xy, yy = (
        _average(cv2.resize(product, (width, height), interpolation=cv2.INTER_AREA))
        for product in (g_x * g_x, g_x * g_y, g_y * g_y)
    )

    def refine(frame: GreyImage, flow: FloatArray) -> FloatArray:
        flow = np.array(flow, np.float32, order="C")
        projected, squares = np.empty((2, height, width), np.float32), np.empty(height, np.float32)
        for _ in range(_STEPS):
            fine = cv2.resize(flow, reference.shape[::-1], interpolation=cv2.INTER_LINEAR)
            project_residual(frame, reference, g_x, g_y, fine, projected, squares)
            damping = max(squares.mean() / (4 * np.pi * _WINDOW**2 * _LEFT**2), np.float32(_LEAST_TEXTURE))
            step(_average(projected[0]), _average(projected[1]), xx, xy, yy, damping, flow)
        return flow

    return refine


@jit
def project_residual(
    frame: GreyImage,
    reference: GreyImage,
    g_x: FloatArray,
    g_y: FloatArray,
    flow: FloatArray,
    projected: FloatArray,
    squares: FloatArray,
) -> None:
    """``g e``, averaged over the pixels of each cell of the coarser grid, and the mean of ``e²`` in each row of cells.

    The frame is sampled bilinearly.
    ``frame, reference, g_x, g_y`` (H, W); ``flow`` (H, W, 2); ``projected`` (2, h, w); ``squares`` (h,).
    """
    zero, one, height, width = np.float32(0), np.float32(1), reference.shape[0], reference.shape[1]
    bottom, right = np.float32(height - 1), np.float32(width - 1)
    squares[:] = zero
    for cell_row in range(projected.shape[1]):
        for cell_column in range(projected.shape[2]):
            along, across = zero, zero
            for row in range(2 * cell_row, min(2 * cell_row + 2, height)):
                for column in range(2 * cell_column, min(2 * cell_column + 2, width)):
                    x = np.float32(column) + flow[row, column, 0]
                    y = np.float32(row) + flow[row, column, 1]
                    if x >= zero and x <= right and y >= zero and y <= bottom:
                        # An unsigned index cannot count from the end, which would be checked at every access.
                        j, i = np.uint32(min(x, right - one)), np.uint32(min(y, bottom - one))
                        t, u = x - np.float32(j), y - np.float32(i)
                        upper = np.float32(frame[i, j])
                        upper += t * (np.float32(frame[i, j + np.uint32(1)]) - upper)
                        lower = np.float32(frame[i + np.uint32(1), j])
                        lower += t * (np.float32(frame[i + np.uint32(1), j + np.uint32(1)]) - lower)
                        rest = upper + u * (lower - upper) - np.float32(reference[row, column])
                        along += g_x[row, column] * rest
                        across += g_y[row, column] * rest
                        squares[cell_row] += rest * rest
            projected[0, cell_row, cell_column] = along / np.float32(4)
            projected[1, cell_row, cell_column] = across / np.float32(4)
        squares[cell_row] /= np.float32(2 * width)


@jit
def step(
    x: FloatArray,
    y: FloatArray,
    xx: FloatArray,
    xy: FloatArray,
    yy: FloatArray,
    damping: np.float32,
    flow: FloatArray,
) -> None:
    """Subtract ``(J + ε)⁻¹ G(g e)``, given as the planes of both (h, w), from a flow (h, w, 2) in place."""
    one = np.float32(1)
    for row in range(flow.shape[0]):
        for column in range(flow.shape[1]):
            u, v, b = x[row, column], y[row, column], xy[row, column]
            a, c = xx[row, column] + damping, yy[row, column] + damping
            scale = one / (a * c - b * b)
            flow[row, column, 0] -= min(max((c * u - b * v) * scale, -one), one)
            flow[row, column, 1] -= min(max((a * v - b * u) * scale, -one), one)


def _gradient(reference: GreyImage) -> tuple[Any, Any]:
    return cv2.Scharr(reference, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(reference, cv2.CV_32F, 0, 1, scale=1 / 32)


def _average(plane: FloatArray) -> Any:
    return cv2.GaussianBlur(plane, (0, 0), _WINDOW / 2)

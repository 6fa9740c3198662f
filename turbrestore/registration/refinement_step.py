"""Gauss–Newton steps that refine a flow at the resolution of the frames (Lucas and Kanade 1981).

Symbols
-------
R, I : reference and frame with normalised contrast, grey levels; W : flow, pixels; G : average in a Gaussian window
g : gradient of R; e : residual ``I ∘ (id + W) − R``, 0 where W leads out of the frame
J : structure tensor ``G(g gᵀ)``; ε : least variance that counts as texture

Near W the frame is ``R + e``, and moving the reference by δ changes it by ``g·δ``.  The sum of ``(e + g·δ)²`` in the
window around a pixel, and ``ε |δ|²``, is least for::

    δ = −(J + ε)⁻¹ G(g e),    W ← W + δ

The gradient is that of the reference (Baker and Matthews 2004), so J is computed once for all frames; a frame costs one
warp and two averages a step.  No component of δ exceeds one pixel, beyond which the linear model says nothing.  Two
steps come as near to the minimum as more do.

A flow that is smooth over the window needs no search at full resolution: it is searched for at half the resolution, and
steps find the rest.  The same steps follow a reference that has become sharper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..runtime.jit import jit

GreyImage = NDArray[np.uint8]
# Takes a frame (H, W) and a flow to it (H, W, 2); returns the refined flow.
RefineFlow = Callable[[GreyImage, FloatArray], FloatArray]
# Standard deviation of the window, pixels: narrower ones follow noise and what a blurred reference lacks.
_WINDOW = 3.0
# ε, squared grey levels per squared pixel: below one grey level a pixel, a gradient is rounding.
_LEAST_TEXTURE = 1.0
_STEPS = 2


def flow_refinement(reference: GreyImage) -> RefineFlow:
    """Prepare steps from a reference (H, W)."""
    g_x, g_y = _gradient(reference)
    xx, xy, yy = (_average(product) for product in (g_x * g_x, g_x * g_y, g_y * g_y))
    xx += np.float32(_LEAST_TEXTURE)
    yy += np.float32(_LEAST_TEXTURE)
    determinant = xx * yy - xy * xy
    inverse = yy / determinant, -xy / determinant, xx / determinant

    def refine(frame: GreyImage, flow: FloatArray) -> FloatArray:
        flow = np.array(flow, np.float32, order="C")
        projected = np.empty((2, *reference.shape), np.float32)
        for _ in range(_STEPS):
            project_residual(frame, reference, g_x, g_y, flow, projected)
            step(_average(projected[0]), _average(projected[1]), *inverse, flow)
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
) -> None:
    """``g e`` of every pixel, the frame sampled bilinearly.

    ``frame, reference, g_x, g_y`` (H, W); ``flow`` (H, W, 2); ``projected`` (2, H, W).
    """
    zero, height, width = np.float32(0), reference.shape[0], reference.shape[1]
    bottom, right = np.float32(height - 1), np.float32(width - 1)
    for row in range(height):
        for column in range(width):
            x = np.float32(column) + flow[row, column, 0]
            y = np.float32(row) + flow[row, column, 1]
            rest = zero
            if x >= zero and x <= right and y >= zero and y <= bottom:
                # An unsigned index cannot count from the end, which would be checked at every access.
                j, i = np.uint32(min(x, right - np.float32(1))), np.uint32(min(y, bottom - np.float32(1)))
                t, u = x - np.float32(j), y - np.float32(i)
                upper = np.float32(frame[i, j])
                upper += t * (np.float32(frame[i, j + np.uint32(1)]) - upper)
                lower = np.float32(frame[i + np.uint32(1), j])
                lower += t * (np.float32(frame[i + np.uint32(1), j + np.uint32(1)]) - lower)
                rest = upper + u * (lower - upper) - np.float32(reference[row, column])
            projected[0, row, column] = g_x[row, column] * rest
            projected[1, row, column] = g_y[row, column] * rest


@jit
def step(x: FloatArray, y: FloatArray, xx: FloatArray, xy: FloatArray, yy: FloatArray, flow: FloatArray) -> None:
    """Subtract ``(J + ε)⁻¹ G(g e)``, given as the planes of both (H, W), from a flow (H, W, 2) in place."""
    one = np.float32(1)
    for row in range(flow.shape[0]):
        for column in range(flow.shape[1]):
            u, v, b = x[row, column], y[row, column], xy[row, column]
            flow[row, column, 0] -= min(max(xx[row, column] * u + b * v, -one), one)
            flow[row, column, 1] -= min(max(b * u + yy[row, column] * v, -one), one)


def _gradient(reference: GreyImage) -> tuple[Any, Any]:
    return cv2.Scharr(reference, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(reference, cv2.CV_32F, 0, 1, scale=1 / 32)


def _average(plane: FloatArray) -> Any:
    return cv2.GaussianBlur(plane, (0, 0), _WINDOW)

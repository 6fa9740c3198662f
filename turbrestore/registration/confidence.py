"""How far the texture of an image determines a flow, and what replaces the flow in flat regions and along edges.

Symbols
-------
g : gradient of the reference, intensity per pixel
J : structure tensor, ``g gᵀ`` averaged over a window of area A
σ : noise of a frame, intensity
W : measured flow; W̄ its prior mean, τ the prior deviation of W from W̄

From a window the displacement is known at best to the covariance ``σ² (A J)⁻¹`` (the Cramér–Rao bound; Robinson and
Milanfar 2004): well across an edge, not at all along it, and not at all in a flat region.  Flow methods return a number
all the same; in flat regions dense inverse search matches noise with noise, over 5 px and more.

Given W̄ and τ, the posterior mean is ``Ŵ = (J + ε)⁻¹ (J W + ε W̄)``, ``ε = m σ² / (A τ²) + κ tr(J) / 2``, where J and
J W are averages over the window.  W̄ is the same estimate in a window twice as wide, and so on until the window is the
image, for which it is zero: this is normalised convolution (Knutsson and Westin 1993) with tensors and growing windows.
A grows fourfold from window to window, so ε falls to a quarter: in noise, wide windows show what narrow ones do not.
Texture keeps its flow, an edge takes the component along it from its neighbourhood, and a flat region takes both.

Two things keep the estimate from trusting the measurement too much.  A flow method errs by more than noise explains,
by a factor m in variance, and the part of its error that noise does not cause does not average out, so ε falls with A
only to its value for a noise of 0.01.  And the direction of an edge is known to a few degrees only: without κ, changes
of the tensor's direction from one pixel to the next would count as a measurement along the edge.  Results lie within
the range of the measured flow.

J also contains the noise of the reference, which must not count as texture, so its eigenvalues are lowered by it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import ROUNDING, FloatArray, check_grey
from ..core.gradient import gradient_noise
from ..core.noise import estimate_noise
from ..runtime.jit import jit

# Standard deviations of the windows of the gradient and of the tensor, pixels, both chosen.
_GRADIENT_WINDOW, _TENSOR_WINDOW = 1.0, 2.0
_AREA = 4 * np.pi * _TENSOR_WINDOW**2
# The noise of a derivative rarely exceeds three times its variance; chosen.
_NOISE_MARGIN = 3.0
# Variance of Scharr's derivative, in that window, of white noise of unit variance.
_SCHARR_NOISE = 0.0214
# m / τ² with m = 10 and τ = 0.5 pixels, per squared pixel; and κ.  Both chosen.
_METHOD_ERROR = 40.0
_TILT = 0.01
# Noise below which the errors of a flow method do not average out in a wider window, intensity.  Without this floor, a
# clip of that noise lost 0.1 dB.
_AVERAGED = 0.01
# Smallest noise, so that every tensor has an inverse: 1/4096 of full scale.
_LEAST_NOISE = 1 / 4096

# Components of a vector field: separate planes are read several times as fast as every second number of an array.
Planes = tuple[FloatArray, FloatArray]
# (3, h, w) each: J as planes xx, xy and yy, squared intensity per squared pixel.
Tensors = tuple[FloatArray, ...]


def flow_confidence(reference: ArrayLike) -> Tensors:
    """Structure tensors of the reference (H, W[, 3]), then those of windows and grids twice as coarse each time."""
    image = check_grey(reference, "reference")
    dx, dy = _gradient(image)
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), _TENSOR_WINDOW).ravel() for product in (dx * dx, dx * dy, dy * dy))
    noise = np.float32(_NOISE_MARGIN * (gradient_noise(_GRADIENT_WINDOW) * estimate_noise(image)) ** 2)
    tensor = np.empty((3, *image.shape), np.float32)
    subtract_noise(noise, xx, xy, yy, tensor.reshape(3, -1))
    tensors = [tensor]
    while min(tensors[-1].shape[1:]) > 1:
        tensors.append(np.stack([cv2.pyrDown(plane) for plane in tensors[-1]]))
    return tuple(tensors)


def noise_share(image: ArrayLike, noise: float) -> float:
    """Share of the squared gradient of an image (H, W[, 3]) that is noise."""
    squares = sum(float(np.square(part).mean(dtype=np.float64)) for part in _gradient(check_grey(image)))
    return 2 * _SCHARR_NOISE * noise**2 / max(squares, ROUNDING**2)


def regularise_flow(flow: FloatArray, tensors: Tensors, noise: float) -> FloatArray:
    """Draw a flow towards its neighbourhood where the texture does not determine it.

    ``flow`` (h, w, 2) on the grid of any of the tensors.
    """
    planes = cv2.split(flow)
    finest = next(level for level, tensor in enumerate(tensors) if tensor.shape[1:] == flow.shape[:2])
    (xx, xy, yy), (dx, dy) = tensors[finest], planes
    weighted = [(xx * dx + xy * dy, xy * dx + yy * dy)]
    for _ in tensors[finest + 1 :]:
        weighted.append((cv2.pyrDown(weighted[-1][0]), cv2.pyrDown(weighted[-1][1])))
    noise = max(noise, _LEAST_NOISE)
    u, v = (np.zeros_like(part) for part in weighted[-1])
    for level in range(len(tensors) - 1, finest - 1, -1):
        height, width = tensors[level].shape[1:]
        if u.shape != (height, width):
            u, v = (cv2.pyrUp(part, dstsize=(width, height)) for part in (u, v))
        expected, (u, v) = (u, v), np.empty((2, height, width), np.float32)
        left = max(noise / 2**level, min(noise, _AVERAGED))
        prior = _METHOD_ERROR * left**2 / _AREA
        planes_of_level = (*tensors[level], *weighted[level - finest], *expected, u, v)
        posterior_mean(np.float32(prior), *(plane.reshape(-1) for plane in planes_of_level))
    for part, plane in zip((u, v), planes, strict=True):
        low, high, _, _ = cv2.minMaxLoc(plane)
        np.clip(part, np.float32(min(low, 0)), np.float32(max(high, 0)), out=part)
    return cv2.merge([u, v])


@jit
def subtract_noise(noise: np.float32, xx: FloatArray, xy: FloatArray, yy: FloatArray, lowered: FloatArray) -> None:
    """Lower both eigenvalues of each pixel's tensor, planes (P,), by ``noise``, not below zero, into (3, P)."""
    zero, two, tiny = np.float32(0), np.float32(2), np.finfo(np.float32).tiny
    for pixel in range(xx.size):
        half, tilt = (xx[pixel] + yy[pixel]) / two, (xx[pixel] - yy[pixel]) / two
        spread = np.sqrt(tilt * tilt + xy[pixel] * xy[pixel])
        larger, smaller = max(half + spread - noise, zero), max(half - spread - noise, zero)
        kept = (larger - smaller) / max(two * spread, tiny)
        mean = (larger + smaller) / two
        lowered[0, pixel] = mean + kept * tilt
        lowered[1, pixel] = kept * xy[pixel]
        lowered[2, pixel] = mean - kept * tilt


def _gradient(image: FloatArray) -> Planes:
    smooth = cv2.GaussianBlur(image, (0, 0), _GRADIENT_WINDOW)
    return cv2.Scharr(smooth, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(smooth, cv2.CV_32F, 0, 1) / 32


@jit
def posterior_mean(
    noise: np.float32,
    xx: FloatArray,
    xy: FloatArray,
    yy: FloatArray,
    weighted_x: FloatArray,
    weighted_y: FloatArray,
    expected_x: FloatArray,
    expected_y: FloatArray,
    x: FloatArray,
    y: FloatArray,
) -> None:
    """``Ŵ = (J + ε)⁻¹ (J W + ε W̄)`` of each pixel.

    Where J is singular, along an edge, cancellation leaves few digits of its determinant; as ε is at least κ tr(J) / 2,
    single precision keeps four digits and a half of the flow there.
    ``xx, xy, yy`` (P,); ``weighted_x, weighted_y, expected_x, expected_y`` (P,); ``x, y`` (P,).
    """
    half = np.float32(_TILT / 2)
    for pixel in range(x.size):
        a, b, c = xx[pixel], xy[pixel], yy[pixel]
        prior = (a + c) * half + noise
        u, v = prior * expected_x[pixel] + weighted_x[pixel], prior * expected_y[pixel] + weighted_y[pixel]
        a += prior
        c += prior
        scale = np.float32(1) / (a * c - b * b)
        x[pixel] = (c * u - b * v) * scale
        y[pixel] = (a * v - b * u) * scale

"""A frame that is registered to the image, and its measurement noise at every pixel (paper 3, eq. 15).

Symbols
-------
I ∘ ŵ : frame I warped by the estimated flow; Z : its variance about the image
z : local sharpness of a frame, standardised over the frames; β its weight
v : variance of z over the frames
κ : share of the middle of the window that z leaves out, see :func:`local_sharpness`
d : squared deviation of a frame from the mean frame, in units of its usual variance
d' : the same from the median of the frames, in a window as small as a flake of snow; e = max(d / 6, d' / 8, 1)
m : 1 where the frame gives no measurement, because the map id + Ŵ folds or leaves the frame

The paper takes Z to be one number, Z₀.  So does this module for β = 0; for β > 0::

    Z = Z₀ e³ exp(β² v / 2 − β z + m log 1000),     z / e² in place of z where z > 0

with z limited to ±3 and the exponent to 40.  Z falls where a frame is locally sharper than usual, which is the idea of
lucky imaging inside the Kalman gain.  It rises where a frame shows something that the others do not (a bird, a flash),
and where its flow is invalid.

All functions here take NumPy arrays or torch tensors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..registration.warp import inside, warp
from ..runtime.device import CPU
from ..runtime.image_stacks import Stack, correlate, load, load_image, namespace, warp_stack

# Registered channels (C, H, W), their luminance (H, W), and where the warp samples the frame (H, W), 1 to 0.
Warped = tuple[Stack, Stack, Stack]

# A larger standardised sharpness is an outlier, not a better frame; chosen.
_LARGEST_SCORE = 3.0
# Largest logarithm of the factor on Z: Z then exceeds any variance of the image, and times the largest excess it is
# still finite in single precision.
_LARGEST_EXPONENT = 40.0
# Logarithm of the factor on Z where the flow is invalid, chosen: such pixels weigh a thousandth of others.
_LOG_INVALID = math.log(1e3)
# Pixels around a fold that are invalid too, on each side, and standard deviation of the fade around them, chosen.
_AROUND_FOLD, _FOLD_FADE = 3, 2.0
# A frame that deviates from the usual by more than this many variances does not show the scene: at six less than 1 % of
# clean clips did, at nine a part of a flash passed.  Deviation of the window that averages it, pixels, chosen.
OUTLIER, OUTLIER_WINDOW = 6.0, 3.0
# Standard deviation of the Gaussian window in which sharpness is measured, pixels, chosen.
SHARPNESS_WINDOW = 3.0
# The same for what is as small as a flake, against the median of the frames, without what is wider; all chosen.
_DISAGREES, AGREEMENT_WINDOW, _FINE_WINDOW, LEVEL_WINDOW = 8.0, 1.5, 0.8, 5.0
# Sobel's derivative divided by 8 is the first along one axis and the second along the other.
_DIFFERENCE, _BINOMIAL = np.array([-1, 0, 1], np.float32), np.array([0.125, 0.25, 0.125], np.float32)
_BOX = np.ones(2 * _AROUND_FOLD + 1, np.float32)


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Temporal statistics of the registered frames of the first block, which Z of every frame is measured against."""

    image_noise: float  # Z₀, squared intensity
    frame_noise: float  # standard deviation of the noise of a frame, smooth or not, intensity
    template: Stack  # (2, H, W): gradient along x and y of the image that frames are registered to, intensity per pixel
    template_energy: float  # sum of its square
    # (H, W): mean over the frames of the local sharpness where they agree, see :func:`project_gradient`.
    mean_sharpness: Stack
    score_scale: Stack  # (H, W): factor from a deviation of the local sharpness to z; 0 where an object has moved
    score_variance: Stack  # (H, W): v, variance of z over the frames
    left_out: float  # κ, 0 to 1/4
    mean_frame: Stack  # (H, W): mean luminance of the registered frames without outliers
    deviation: Stack  # (H, W): variance of the registered frames about it, locally averaged, squared intensity
    # (H, W): median luminance of the registered frames, and the square of their median deviation from it, scaled to a
    # variance and averaged in a small window.
    median: Stack
    spread: Stack


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame registered to the image (eq. 15)."""

    channels: Stack  # (C, H, W): I ∘ ŵ
    noise: Stack  # (H, W): Z, squared intensity
    sharpness: float


def register_frame(
    pixels: FloatArray, flow: FloatArray, statistics: FrameStatistics, sharpness_weight: float
) -> RegisteredFrame:
    """Warp a frame (H, W[, 3]) onto the image by Ŵ (H, W, 2) and estimate its noise Z (eq. 15)."""
    loaded = load(flow, statistics.median.device)
    channels, grey, seen = warp_frame(pixels, loaded)
    return RegisteredFrame(channels, *frame_noise_variance(grey, loaded, seen, statistics, sharpness_weight))


def warp_frame(pixels: FloatArray, flow: Stack) -> Warped:
    """Warp a frame (H, W[, 3]), a NumPy array, by a flow (H, W, 2) that is on the device already."""
    if isinstance(flow, np.ndarray):
        registered = warp(pixels, flow)
        return load_image(registered, CPU), luminance(registered), inside(flow)
    channels = warp_stack(load_image(pixels, flow.device), flow)
    # The luminance of the three unit colours is the weight of each channel.
    weights = luminance(np.eye(3, dtype=np.float32)[None])[0].tolist() if len(channels) == 3 else [1.0]
    grey = sum(weight * channel for weight, channel in zip(weights, channels, strict=True))
    height, width = flow.shape[:2]
    x, y = (namespace(flow).arange(length, dtype=flow.dtype, device=flow.device) for length in (width, height))
    seen = _within(x + flow[..., 0], width) * _within(y[:, None] + flow[..., 1], height)
    return channels, grey, seen


def _within(position: Stack, length: int) -> Stack:
    """1 where a position lies between the first and the last pixel, falling to 0 one pixel beyond."""
    return (1 - (-position).maximum(position - (length - 1))).clamp(0, 1)


def frame_noise_variance(
    grey: Stack, flow: Stack, seen: Stack, statistics: FrameStatistics, sharpness_weight: float
) -> tuple[Stack, float]:
    """Z of one frame, and how sharp the frame is.

    ``grey`` (H, W); ``flow`` (H, W, 2); ``seen`` (H, W); ``sharpness_weight`` is β; returns ``noise`` (H, W).
    """
    xp, beta = namespace(grey), float(sharpness_weight)
    projection = project_gradient(grey, statistics.template)
    sharpness = float(projection.sum()) / max(statistics.template_energy, ROUNDING**2)
    if beta == 0:
        return xp.full_like(grey, statistics.image_noise), sharpness
    excess = squared_deviation(grey, statistics.mean_frame, statistics.deviation) / OUTLIER
    difference = grey - statistics.median
    # Light that has changed is no disagreement.
    difference = difference - smooth(difference, LEVEL_WINDOW)
    disagreement = smooth(difference * difference, _FINE_WINDOW) / (statistics.spread * _DISAGREES)
    excess = xp.clip(xp.maximum(excess, disagreement), 1, None)
    squared = excess * excess
    local = local_sharpness(projection, statistics.left_out)
    score = (local - statistics.mean_sharpness) * statistics.score_scale
    score = xp.clip(score, -_LARGEST_SCORE, _LARGEST_SCORE)
    # z / e² where z > 0: something other than the scene may have more contrast than the scene.
    score = xp.minimum(score, score / squared)
    # For a normal score of variance v the mean of exp(β z − β² v / 2) is one: the information per frame stays 1 / Z₀.
    exponent = statistics.score_variance * (beta**2 / 2) - score * beta
    exponent = xp.clip(exponent + invalid_mask(flow, seen) * _LOG_INVALID, None, _LARGEST_EXPONENT)
    # The third power: a deviation of twice the tolerance reduces the weight to an eighth.
    return squared * excess * statistics.image_noise * xp.exp(exponent), sharpness


def invalid_mask(flow: Stack, seen: Stack) -> Stack:
    """Mark (H, W) where a frame gives no measurement: the map id + Ŵ (H, W, 2) folds, or leaves the frame.

    Beyond the frame its border is repeated, which is no measurement. Paper 3 assumes that the maps are diffeomorphisms:
    where the estimate folds it is wrong, and what it samples may have more contrast than the scene.
    """
    (ux, uy), (vx, vy) = (gradient(flow[..., axis]) for axis in (0, 1))
    folded = (ux + 1) * (vy + 1) <= uy * vx
    outside = 1 - seen
    if not bool(folded.any()):
        return outside
    # Widened by a box, and faded out: an abrupt change of weights would show as an edge.
    around = namespace(flow).clip(correlate(folded * np.float32(1), _BOX, _BOX), 0, 1)
    return namespace(flow).maximum(smooth(around, _FOLD_FADE), outside)


def squared_deviation(grey: Stack, mean_frame: Stack, deviation: Stack) -> Stack:
    """Local squared deviation of a frame from the mean frame in units of the usual one; about 1 for most frames."""
    difference = grey - mean_frame
    return smooth(difference * difference, OUTLIER_WINDOW) / deviation


def project_gradient(grey: Stack, template: Stack) -> Stack:
    """Gradient of a frame projected on that of the template; its average in a Gaussian window is the local sharpness.

    A blurred frame has a smaller projection.  So has a frame that is torn, misregistered or covered, although its
    gradient may be large: plain gradient energy would prefer it.  Noise enters linearly and averages out.
    """
    dx, dy = gradient(grey)
    return dx * template[0] + dy * template[1]


def local_sharpness(projection: Stack, left_out: float) -> Stack:
    """Average of the projected gradient (H, W) in a Gaussian window, of whose middle a share is left out.

    The noise n of a pixel is part of the score of the window around it. By Stein's lemma the weights ``exp(β z)``
    therefore shift the fused pixel by ``β cov(n, z)``, whatever the number of frames. The shift is proportional to the
    Laplacian of the template: noise is added that looks like sharpness, and a blind estimate of the blur believes it.
    """
    whole = smooth(projection, SHARPNESS_WINDOW)
    if left_out == 0:
        return whole
    return (whole - smooth(projection, SHARPNESS_WINDOW / 2) * left_out) / (1 - left_out)


def gradient(image: Stack) -> tuple[Stack, Stack]:
    """Sobel's derivatives along x and y, divided by 8."""
    return correlate(image, _DIFFERENCE, _BINOMIAL), correlate(image, _BINOMIAL, _DIFFERENCE)


def smooth(image: Stack, sigma: float) -> Stack:
    """Average in a Gaussian window that is cut off at 4σ."""
    kernel = cv2.getGaussianKernel(round(8 * sigma + 1) | 1, sigma, cv2.CV_32F).ravel()
    return correlate(image, kernel, kernel)

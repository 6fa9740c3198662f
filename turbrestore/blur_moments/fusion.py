"""Fusion of frames of different blur: shares that make squared blur plus noise smallest, pixel by pixel.

Symbols
-------
s : blur variance of a frame above that of the sharpest, squared pixels.
c : mean squared Laplacian of the image around a pixel.
n : standard deviation of the noise of a frame, intensity.
w : share of a frame in the fused image.
τ : blur variance from which on a frame gets no share.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_frames, check_image, luminance
from ..core.errors import DataError, require, require_between
from .frame_blur import FrameBlur
from .tile_spectra import check_noise, tile_map

# Rows of the fused image at a time: sorting 500 frames of 1024 columns takes 16 MB.
_STRIP = 8


@dataclass(frozen=True, eq=False)
class FusionRule:
    """Share of every frame in every pixel, ``w = scale · max(threshold − extra, 0)``; see :func:`fusion_rule`.

    Attributes
    ----------
    threshold : ndarray, float32, shape (H, W)
        τ, squared pixels.
    scale : ndarray, float32, shape (H, W)
        Makes the shares sum to 1, per squared pixel.
    blur : FrameBlur
    """

    threshold: FloatArray
    scale: FloatArray
    blur: FrameBlur


def laplacian_energy(image: ArrayLike, noise: float = 0.0, window: float = 3.0) -> FloatArray:
    """Mean squared Laplacian around every pixel, less what noise adds to it.

    A blur of variance s changes an image u by s/2 Δu to first order: s²/4 times this energy is the squared error.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float
        Standard deviation of the white noise in the image, intensity.
    window : float
        Standard deviation of the Gaussian window, pixels.

    Returns
    -------
    ndarray, float32, shape (H, W)
        c, squared intensity over pixels to the fourth.

    Raises
    ------
    ConfigurationError
        The noise is negative, or the window outside 0.5 to 100 pixels.

    Examples
    --------
    >>> import numpy as np
    >>> parabola = np.tile(np.arange(9.0) ** 2 / 2, (9, 1))
    >>> round(float(laplacian_energy(parabola, window=0.5)[4, 4]), 3)
    1.0
    """
    check_noise(noise)
    require_between("window", window, 0.5, 100, "pixels")
    squared = cv2.Laplacian(luminance(check_image(image)), cv2.CV_32F) ** 2
    # The mask (1, 1, −4, 1, 1) multiplies the variance of white noise by 20.
    smoothed: FloatArray = cv2.GaussianBlur(squared, (0, 0), window)
    return np.maximum(smoothed - 20 * noise**2, 0).astype(np.float32, copy=False)


def fusion_weights(blur: ArrayLike, energy: ArrayLike, noise: float) -> FloatArray:
    """Shares that make squared blur plus noise smallest: min c/4 (Σ w s)² + n² Σ w² with Σ w = 1, w ≥ 0.

    The optimum is ``w_t ∝ max(τ − s_t, 0)``, with τ where ``Σ s_t max(τ − s_t, 0) = 4 n²/c``: sorting and two running
    sums give it exactly. Flat regions average all frames, edges only the sharpest.

    Parameters
    ----------
    blur : array_like, shape (T, ...)
        s, at least 0: blur variance above that of the sharpest frame, squared pixels.
    energy : array_like, shape (...)
        c, from :func:`laplacian_energy`.
    noise : float
        Standard deviation of the noise of a frame, intensity.

    Returns
    -------
    ndarray, float32, shape (T, ...)
        w, sums to 1 over the first axis.

    Raises
    ------
    DataError
        Shapes do not agree, a value is negative or not finite.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> fusion_weights([[0.0, 0.0], [1.0, 1.0]], [0.0, 4.0], noise=1.0)[:, 1].astype(float).round(2).tolist()
    [0.67, 0.33]
    """
    s, c = np.asarray(blur, np.float32), np.asarray(energy, np.float32)
    check_noise(noise)
    if s.ndim < 1 or s.shape[1:] != c.shape:
        raise DataError(f"energy: expected the shape {s.shape[1:]} of one frame of blur, found {c.shape}")
    if not (np.isfinite(s).all() and np.isfinite(c).all() and s.min() >= 0 and c.min() >= 0):
        raise DataError("blur, energy: expected finite values of 0 or more, found others; subtract the sharpest frame")
    threshold, scale = _waterline(s, c, noise)
    return scale * np.maximum(threshold - s, 0)


def fusion_rule(blur: FrameBlur, energy: ArrayLike, noise: float) -> FusionRule:
    """Fusion weights of a sequence in a form that takes two images instead of one per frame.

    Parameters
    ----------
    blur : FrameBlur
    energy : array_like, shape (H, W)
        c, from :func:`laplacian_energy` of the best image there is.
    noise : float
        Standard deviation of the noise of a frame, intensity.

    Returns
    -------
    FusionRule

    Raises
    ------
    DataError
        The energy has another shape than the frames, is negative or not finite.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.frame_blur import frame_blur
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> round(float(frame_weight(rule, 0)[0, 0]), 3)
    0.2
    """
    c = np.asarray(energy, np.float32)
    check_noise(noise)
    if c.shape != blur.grid.shape:
        raise DataError(f"energy: expected the shape of a frame {blur.grid.shape}, found {c.shape}")
    if not (np.isfinite(c).all() and c.min() >= 0):
        raise DataError("energy: expected finite values of 0 or more, found others")
    s = np.stack([tile_map(frame, blur.grid) for frame in blur.extra])
    strips = [slice(top, top + _STRIP) for top in range(0, len(c), _STRIP)]
    lines = [_waterline(s[:, strip], c[strip], noise) for strip in strips]
    threshold, scale = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    return FusionRule(threshold, scale, blur)


def frame_weight(rule: FusionRule, index: int) -> FloatArray:
    """Share of one frame in every pixel of the fused image.

    Parameters
    ----------
    rule : FusionRule
    index : int
        Which frame.

    Returns
    -------
    ndarray, float32, shape (H, W)
        w, 0 to 1; over all frames it sums to 1.

    Examples
    --------
    See :func:`fusion_rule`.
    """
    return rule.scale * np.maximum(rule.threshold - tile_map(rule.blur.extra[index], rule.blur.grid), 0)


def frame_noise_factor(rule: FusionRule, index: int, largest: float = 100.0) -> FloatArray:
    """Measurement noise of a frame relative to an average one: 1 / (T w), for a filter that weighs by 1 / noise.

    Parameters
    ----------
    rule : FusionRule
    index : int
        Which frame.
    largest : float
        Instead of infinity where the frame gets no share.

    Returns
    -------
    ndarray, float32, shape (H, W)
        Positive; the mean of its inverse over all frames is 1, but for the limit.

    Raises
    ------
    ConfigurationError
        ``largest`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.frame_blur import frame_blur
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> round(float(frame_noise_factor(rule, 0)[0, 0]), 2)
    1.0
    """
    return noise_factor(rule, rule.blur.extra[index], largest)


def noise_factor(rule: FusionRule, extra: FloatArray, largest: float = 100.0) -> FloatArray:
    """Measurement noise of a frame that the rule was not made from, as :func:`frame_noise_factor` gives it.

    Parameters
    ----------
    rule : FusionRule
    extra : ndarray, float32, shape (m, n)
        Blur of the frame in every tile, above that of the sharpest frame of the rule, squared pixels.
    largest : float
        Instead of infinity where the frame gets no share.

    Returns
    -------
    ndarray, float32, shape (H, W)

    Raises
    ------
    ConfigurationError
        ``largest`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.frame_blur import blur_against, refer_blur
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> reference, blur = refer_blur(frames, noise=0.1)
    >>> rule = fusion_rule(blur, np.zeros((48, 48)), noise=0.1)
    >>> round(float(noise_factor(rule, blur_against(frames[:1], reference).extra[0])[0, 0]), 2)
    1.0
    """
    require(largest >= 1, f"largest: expected 1 or more, found {largest}")
    weight = rule.scale * np.maximum(rule.threshold - tile_map(extra, rule.blur.grid), 0)
    return np.reciprocal(np.maximum(len(rule.blur.extra) * weight, np.float32(1 / largest)))


def fuse_frames(frames: ArrayLike, rule: FusionRule) -> FloatArray:
    """Weighted mean of registered frames.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Registered.
    rule : FusionRule

    Returns
    -------
    ndarray, float32, shape (H, W) or (H, W, 3)

    Raises
    ------
    DataError
        The frames do not fit the rule.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.frame_blur import frame_blur
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> bool(np.abs(fuse_frames(frames, rule) - frames.mean(axis=0)).max() < 1e-5)
    True
    """
    stack = check_frames(frames)
    expected = (len(rule.blur.extra), *rule.blur.grid.shape)
    if stack.shape[:3] != expected:
        raise DataError(f"frames: expected shape {expected} as the rule has, found {stack.shape}")
    image = np.zeros(stack.shape[1:], np.float32)
    for index, frame in enumerate(stack):
        weight = frame_weight(rule, index)
        image += (weight[..., None] if frame.ndim == 3 else weight) * frame
    return image


def _waterline(s: FloatArray, c: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Threshold τ and scale of the weights ``max(τ − s, 0)``.

    ``Σ s max(τ − s, 0)`` is piecewise linear in τ with corners at the s: the last corner below 4 n²/c tells which
    frames take part.
    """
    goal = np.clip(4 * noise**2 / np.maximum(c.astype(np.float64), 1e-12), 1e-12, 1e9)
    ordered = np.sort(s, axis=0).astype(np.float64)
    first, second = np.cumsum(ordered, axis=0), np.cumsum(ordered**2, axis=0)
    taking_part = np.maximum((ordered * first - second < goal).sum(axis=0), 1)
    last = taking_part[None] - 1
    sums, squares = (np.take_along_axis(part, last, axis=0)[0] for part in (first, second))
    threshold = (goal + squares) / np.maximum(sums, 1e-12)
    total = taking_part * threshold - sums
    return threshold.astype(np.float32), (1 / total).astype(np.float32)

"""Cues from the relative blur of images of one scene: bounds on the width of a blur, and the size of the motion.

The second moments of successive blurs add, so the difference between the blurs of two images of one scene can be
measured without knowing the scene (:mod:`turbrestore.blur_moments.cues`).

Symbols
-------
σ² : second moment of a blur, squared pixels
F, M, R : the fused image, the temporal mean of the frames, the sharpest frames
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..blur_moments.cues import displacement_variance, relative_blur
from ..blur_moments.frame_blur import blur_against, refer_blur
from ..blur_moments.tiles import tile_map
from ..core.arrays import FloatArray
from ..core.noise import estimate_noise
from ..runtime.scratch import iter_frames
from .estimation import estimate_blur
from .psf import KOLMOGOROV

# Number of frames on which the noise of a frame is measured.
_NOISE_FRAMES = 8
# Tiles overlap by half along both axes, so one in four is independent.
_TILE_OVERLAP = 4
# Tiles whose measured variance has a standard deviation of this or more are ignored, squared pixels.
_LARGEST_DEVIATION = 0.5
# Smallest relative error of a width that is estimated blindly.
_WIDTH_ERROR = 0.1
# Bytes per pixel that the cues take; per pixel and frame that they are measured on; and of the tiles that are fitted
# together: at most, per pixel of two images, and per pixel and frame.
_BYTES, _FRAME_BYTES = 17.0, 0.25
_FIT_BYTES, _PAIR_FIT, _FRAME_FIT = 200e6, 80.0, 4.7


@dataclass(frozen=True)
class BlurBounds:
    """Bounds on the width of a blur.

    Attributes
    ----------
    low, high : float
        Pixels.
    """

    low: float
    high: float


def bound_blur(
    fused: ArrayLike, mean: ArrayLike, training: FloatArray, count: int, exponent: float = KOLMOGOROV
) -> BlurBounds:
    """Bound the width of the blur of a fused image by comparing it with other images of the same scene.

    ``σ_F² ≥ σ_F² − σ_R²``, where the difference is measured against the sharpest frames, and
    ``σ_F² = σ_M² − (σ_M² − σ_F²)``, where σ_M is estimated blindly and the difference is measured.  Both bounds are
    moved outwards by two standard deviations; that of σ_M is taken to be at least 10 %.

    Parameters
    ----------
    fused : array_like, shape (H, W) or (H, W, 3)
        Registered and averaged frames.
    mean : array_like, shape of ``fused``
        Temporal mean of ``count`` frames, not registered.
    training : ndarray, float32, shape (T, H, W) or (T, H, W, 3), at least two
        Some of the frames.
    count : int
        Number of frames that were averaged in ``mean``.
    exponent : float
        Shape of the blur, see :func:`turbrestore.blur.psf.blur_otf`.

    Returns
    -------
    BlurBounds
        Zero and infinity if the two bounds contradict each other.

    Raises
    ------
    DataError
        The shapes differ.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> from turbrestore.synthesis.scenes import SCENES
    >>> fused, soft = (cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), sigma) for sigma in (1.2, 2.0))
    >>> bounds = bound_blur(fused, soft, np.stack([soft, soft]), count=2)
    >>> bool(bounds.low < 1.2 < bounds.high < 2.5)
    True
    """
    noise, own_noise = typical_noise(training), estimate_noise(fused)
    sharpest, _ = refer_blur(training, noise)
    above = blur_against(np.asarray(fused)[None], sharpest, own_noise)
    usable = above.deviation < _LARGEST_DEVIATION
    low = 0.0
    if usable.any():
        weights = above.deviation[usable] ** -2.0
        low = np.average(above.extra[usable], weights=weights) - 2 * np.sqrt(_TILE_OVERLAP / weights.sum())
    wider = relative_blur(mean, fused, (noise / np.sqrt(count), own_noise))
    widest = estimate_blur(mean, exponent=exponent)
    error = max(widest.uncertainty, _WIDTH_ERROR * widest.sigma)
    high = (widest.sigma + 2 * error) ** 2 - (wider.variance - 2 * wider.deviation)
    low, high = (float(np.sqrt(max(bound, 0.0))) for bound in (low, high))
    return BlurBounds(low, high) if low <= high else BlurBounds(0.0, float("inf"))


def bound_blur_memory(shape: tuple[int, ...], frame_count: int) -> float:
    """Return the memory that :func:`bound_blur` takes beside its images.

    Parameters
    ----------
    shape : tuple of int
        (H, W) or (H, W, 3).
    frame_count : int
        Number of ``training`` frames.

    Returns
    -------
    float
        Bytes.

    Examples
    --------
    >>> bound_blur_memory((1000, 1000), frame_count=10)
    146500000.0
    """
    pixels = shape[0] * shape[1]
    fit = min(_FIT_BYTES, (_PAIR_FIT + _FRAME_FIT * frame_count) * pixels)
    return (_BYTES + _FRAME_BYTES * frame_count) * pixels + fit


def displacement_maps(training: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Map the variance of the displacement, measured from the blur of the temporal mean, and its standard deviation.

    Parameters
    ----------
    training : ndarray, float32, shape (T, H, W) or (T, H, W, 3), at least two

    Returns
    -------
    variance, deviation : ndarray, float32, shape (H, W)
        Squared pixels, mean over both axes; the deviation is infinite where the scene has no texture.

    Examples
    --------
    >>> import numpy as np
    >>> variance, deviation = displacement_maps(np.full((2, 32, 32), 0.5, np.float32))
    >>> bool(np.isinf(deviation).all())
    True
    """
    cue = displacement_variance(training, typical_noise(training))
    precision = tile_map(cue.tile_deviation**-2.0, cue.grid)
    weighted = tile_map(cue.tile_variance * cue.tile_deviation**-2.0, cue.grid)
    known = precision > 0
    variance = np.divide(weighted, precision, out=np.zeros_like(weighted), where=known)
    deviation = np.full_like(variance, np.inf)
    deviation[known] = precision[known] ** -0.5
    return variance, deviation


def typical_noise(frames: FloatArray) -> float:
    """Estimate the noise of a single frame: median over a few frames of its standard deviation.

    Parameters
    ----------
    frames : ndarray, float32, shape (T, H, W) or (T, H, W, 3)

    Returns
    -------
    float
        Intensity.

    Examples
    --------
    >>> import numpy as np
    >>> round(typical_noise(np.random.default_rng(0).normal(0.5, 0.01, (9, 64, 64)).astype(np.float32)), 3)
    0.01
    """
    step = max(len(frames) // _NOISE_FRAMES, 1)
    return float(np.median([estimate_noise(frame) for frame in iter_frames(frames[::step])]))

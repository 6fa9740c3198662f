"""What the pipeline takes from the relative blur of its images: size of the motion, bounds on the width of the blur.

Second moments of blur add, so the difference of two images of one scene is known without knowing the scene
(:mod:`turbrestore.blur_moments.cues`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..blur_moments.cues import displacement_variance, relative_blur
from ..blur_moments.frame_blur import prepare_blur_reference, relative_frame_blur
from ..blur_moments.tile_spectra import tile_map
from ..core.arrays import FloatArray
from ..core.noise import estimate_noise
from ..runtime.scratch import iter_frames
from .estimation import estimate_blur
from .psf import KOLMOGOROV

# Frames that the noise of a frame is measured on.
_NOISE_FRAMES = 8
# Tiles overlap by half along both axes: of four, one is independent.
_TILE_OVERLAP = 4
# Standard deviation of tiles from which on they say nothing of the blur, squared pixels.
_NOTHING_SEEN = 0.5
# Widths of two images, estimated blindly, agree within this share: they depend on the scene in the same way.
_WIDTH_ERROR = 0.1


@dataclass(frozen=True)
class BlurBounds:
    """What the width of a blur may be.

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
    """Bounds on the width of the blur of a fused image, from images of the same scene.

    Second moments of blur add, so the difference of two is known without knowing the scene.  The fused image is at
    least as blurred as it is more so than the sharpest frames; and the blur of the temporal mean, estimated blindly,
    less what the mean is wider, is what the fused image has at most.  Both bounds are moved outwards by two standard
    deviations, of which the estimated width has at least 10 %.

    Parameters
    ----------
    fused : array_like, shape (H, W) or (H, W, 3)
        Registered and averaged frames.
    mean : array_like, shape of ``fused``
        Temporal mean of ``count`` frames as they are.
    training : ndarray, float32, shape (T, H, W) or (T, H, W, 3), at least two
        Some of the frames.
    count : int
        Number of frames that the mean is one of.
    exponent : float
        Shape of the blur, see :func:`turbrestore.blur.psf.blur_otf`.

    Returns
    -------
    BlurBounds
        Zero and infinity where the bounds found contradict each other.

    Raises
    ------
    DataError
        Shapes do not agree.

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
    sharpest, _ = prepare_blur_reference(training, noise)
    above = relative_frame_blur(np.asarray(fused)[None], sharpest, own_noise)
    seen = above.deviation < _NOTHING_SEEN
    precision = np.sum(above.deviation[seen] ** -2.0)
    low = np.sum(above.extra[seen] / above.deviation[seen] ** 2) / precision if seen.any() else 0.0
    low -= 2 * np.sqrt(_TILE_OVERLAP / precision) if seen.any() else 0.0
    wider = relative_blur(mean, fused, (noise / np.sqrt(count), own_noise))
    widest = estimate_blur(mean, exponent=exponent)
    error = max(widest.uncertainty, _WIDTH_ERROR * widest.sigma)
    high = (widest.sigma + 2 * error) ** 2 - (wider.variance - 2 * wider.deviation)
    low, high = (float(np.sqrt(max(bound, 0.0))) for bound in (low, high))
    return BlurBounds(low, high) if low <= high else BlurBounds(0.0, float("inf"))


def displacement_maps(training: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement variance at every pixel, from the blur of the mean of frames, and its standard deviation.

    Parameters
    ----------
    training : ndarray, float32, shape (T, H, W) or (T, H, W, 3), at least two

    Returns
    -------
    variance, deviation : ndarray, float32, shape (H, W)
        Squared pixels, mean of both axes; the deviation is infinite where nothing is to be seen.

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
    seen = precision > 0
    variance = np.divide(weighted, precision, out=np.zeros_like(weighted), where=seen)
    deviation = np.full_like(variance, np.inf)
    deviation[seen] = precision[seen] ** -0.5
    return variance, deviation


def typical_noise(frames: FloatArray) -> float:
    """Measure the noise of a frame: standard deviation, median over a few frames.

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

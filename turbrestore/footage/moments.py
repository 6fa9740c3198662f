"""Mean and variance of the frames over time, from which what stands in them is found."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.noise import estimate_noise
from .survey import Survey


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of some frames of a clip, spread over its length.

    Attributes
    ----------
    mean : ndarray, float32, shape (H, W) or (H, W, 3)
    variance, change : ndarray, float32, shape (H, W)
        Variance of the luminance, and half of the mean squared difference from one frame to the next.
    noise : float
        Standard deviation of the noise of a frame, median over the frames.
    count : int
    """

    mean: FloatArray
    variance: FloatArray
    change: FloatArray
    noise: float
    count: int


def measure_moments(survey: Survey) -> Moments:
    """Take the moments of the whole frames of a survey."""
    shape = survey.clip.shape[1:]
    total, sums, noise = np.zeros(shape), np.zeros((3, *shape[:2])), []
    before: FloatArray | None = None
    for frame in survey:
        grey = luminance(frame)
        if before is not None:
            cv2.accumulateSquare(grey - before, sums[2])
        before = grey
        cv2.accumulate(frame, total)
        cv2.accumulate(grey, sums[0])
        cv2.accumulateSquare(grey, sums[1])
        noise.append(estimate_noise(grey))
    count = len(survey.numbers)
    change = (sums[2] / (2 * max(count - 1, 1))).astype(np.float32)
    sums /= count
    variance = np.maximum(sums[1] - np.square(sums[0]), 0).astype(np.float32)
    return Moments((total / count).astype(np.float32), variance, change, float(np.median(noise)), count)

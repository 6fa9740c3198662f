"""The range of a clip: frames that use a part of the scale are worked on in units of that part.

Twelve bits in a file of 16, or counts of a thermal camera from 7000 to 7400, leave most of the scale unused.  The
thresholds of the stages are shares of full scale, so such frames are stretched first.  All stages work at these levels;
:func:`turbrestore.results.at_levels_of_clip` brings their results back.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..core.errors import DataError
from ..core.noise import estimate_noise
from .survey import Survey

# Clips that span less than this share of full scale are stretched to it, so that their scale does not matter.
_SPAN = 0.7
# Percentage of the frames at either end whose extremes do not count.
_FEW = 10
# A contrast below one grey level of an 8-bit camera is a scene only if it is that many deviations of the noise.
_LEAST_CONTRAST, _DEVIATIONS = 1 / 255, 12.0


@dataclass(frozen=True)
class Levels:
    """Stretched intensities are ``gain * (intensity - low)``."""

    low: float = 0.0  # intensity that becomes 0
    gain: float = 1.0

    @property
    def changed(self) -> bool:
        """Whether anything is stretched."""
        return (self.low, self.gain) != (0.0, 1.0)

    @property
    def full_scale(self) -> tuple[float, float]:
        """Black and white of the clip, at the levels of the stages."""
        black = 0.0 - self.gain * self.low
        return black, black + self.gain

    def stretched(self, image: FloatArray) -> FloatArray:
        """Bring an image to the levels of the stages."""
        return (image - np.float32(self.low)) * np.float32(self.gain) if self.changed else image

    def original(self, image: FloatArray) -> FloatArray:
        """Bring an image back to the levels of the clip."""
        return image / np.float32(self.gain) + np.float32(self.low) if self.changed else image


def stretch_levels(survey: Survey) -> tuple[Survey, Levels, tuple[Decision, ...]]:
    """Stretch the frames of a clip that uses a part of the scale."""
    low, high = _range_of(survey)
    span = high - low
    if span >= _SPAN:
        return survey, Levels(), ()
    gain = _SPAN / span
    levels = Levels(low - (1 - _SPAN) / 2 / gain, gain)
    reason = f"the scene spans {low:.4g} to {high:.4g} of full scale, and results come back to these levels"
    decision = Decision("range", f"stretched {gain:.3g} times", reason)
    small = levels.stretched(survey.small)
    return survey.adjusted(lambda _, values, window: levels.stretched(values), small), levels, (decision,)


def _range_of(survey: Survey) -> tuple[float, float]:
    """Darkest and brightest intensity of most of some frames, without lone pixels.

    The mean of the frames would not do: that of a planet that the wind shakes is dark.
    """
    total = np.zeros(survey.clip.shape[1:])
    lows, highs = [], []
    for frame in survey:
        total += frame
        smooth = cv2.medianBlur(frame, 3)
        lows.append(float(smooth.min()))
        highs.append(float(smooth.max()))
    mean = (total / len(survey.numbers)).astype(np.float32)
    smooth = cv2.medianBlur(mean, 3)
    low, high = float(smooth.min()), float(smooth.max())
    coarse = high - low < _LEAST_CONTRAST
    if high <= low or (
        coarse and (survey.clip.bit_depth <= 8 or high - low < _DEVIATIONS * estimate_noise(luminance(mean)))
    ):
        raise DataError(
            f"frames: expected a scene with some contrast, found one intensity within {high - low:.1g} of full scale"
        )
    return min(low, float(np.percentile(lows, _FEW))), max(high, float(np.percentile(highs, 100 - _FEW)))

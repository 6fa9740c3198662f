"""The range of a clip: frames that use a part of the scale are worked on in units of that part.

Twelve bits in a file of 16, or counts of a thermal camera from 7000 to 7400, leave most of the scale unused.  The
thresholds of the stages are shares of full scale, so such frames are stretched first.  All stages work at these levels;
:func:`turbrestore.results.at_levels_of_clip` brings their results back.
"""

from __future__ import annotations

import cv2
import numpy as np

from ...core.arrays import luminance
from ...core.decision import Decision
from ...core.errors import DataError
from ...core.noise import estimate_noise
from ..correction import Correction
from ..levels import Levels
from ..survey import Survey

# Clips that span less than this share of full scale, chosen, are stretched to it, so that their scale does not matter.
_SPAN = 0.7
# Percentage of the frames at either end whose extremes do not count, chosen.
_FEW = 10
# A contrast below one grey level of an 8-bit camera is a scene only if it is that many deviations of the noise, chosen.
_LEAST_CONTRAST, _DEVIATIONS = 1 / 255, 12.0


def find_range(survey: Survey) -> Correction | None:
    """Find the range of a clip that uses a part of the scale, which is stretched."""
    low, high = _range_of(survey)
    span = high - low
    if span >= _SPAN:
        return None
    gain = _SPAN / span
    levels = Levels(low - (1 - _SPAN) / 2 / gain, gain)
    reason = f"the scene spans {low:.4g} to {high:.4g} of full scale, and results come back to these levels"
    decision = Decision("range", f"stretched {gain:.3g} times", reason)
    return Correction(
        (decision,), lambda _, values, window: levels.stretched(values), levels.stretched(survey.small), levels=levels
    )


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

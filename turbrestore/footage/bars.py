"""Black bars beside the picture of a letterboxed or upright video.

Bars are filled with the mirrored picture before the frames are worked on, because the step beside them would be taken
for an edge of the scene, and are put back into the result.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..io.source import Window
from .correction import Correction
from .placement import relative_window
from .survey import Survey

# Largest intensity of a bar, and largest range of it in place and time; least step to the picture beside it, intensity,
# and least share of the length of the bar that has it; all chosen.
_DARK, _EVEN, _STEP, _SHARE = 0.12, 3.5 / 255, 0.02, 0.5
# Narrowest bar, pixels, and least part of the frame that the picture takes; both chosen.
_NARROWEST, _LEAST_PICTURE = 2, 0.25


@dataclass(frozen=True, eq=False)
class Bars:
    """The picture between the bars."""

    picture: Window  # rows and columns of the frame
    frame: FloatArray  # (H, W) or (H, W, 3): mean of some frames, which has the bars

    def put_back(self, image: FloatArray, left: int = 0, top: int = 0) -> FloatArray:
        """Put the bars back into an image whose first pixel is at (left, top) of the frame."""
        window = np.s_[top : top + len(image), left : left + image.shape[1]]
        outside = np.ones(self.frame.shape[:2], bool)
        outside[self.picture] = False
        with_bars = image.copy()
        with_bars[outside[window]] = self.frame[window][outside[window]]
        return with_bars


def find_bars(survey: Survey) -> Correction | None:
    """Find bars, which are filled with the mirrored picture."""
    mean, lowest, highest = _extremes(survey)
    height, width = lowest.shape
    uneven = (highest - lowest > _EVEN) | (highest > _DARK)
    level = luminance(mean)
    rows, columns = _picture_of(np.any(uneven, axis=1), level), _picture_of(np.any(uneven, axis=0), level.T)
    picture = rows, columns
    sizes = {"top": rows.start, "bottom": height - rows.stop, "left": columns.start, "right": width - columns.stop}
    found = {side: size for side, size in sizes.items() if size}
    if not found or (rows.stop - rows.start) * (columns.stop - columns.start) < _LEAST_PICTURE * height * width:
        return None
    clip = survey.clip
    down, across = (_mirrored(part, length) for part, length in zip(picture, (height, width), strict=True))

    def fill(number: int, values: FloatArray, window: Window) -> FloatArray:
        if window != clip.window:
            # A window of the frame may not hold what is mirrored into it.
            whole = next(iter(dataclasses.replace(clip, numbers=(number,), timestamps=None)))
            return fill(number, whole, clip.window)[relative_window(clip.window, window)]
        return values[down][:, across]

    small = survey.small
    for axis, (part, length) in enumerate(zip(picture, (height, width), strict=True), 1):
        share = small.shape[axis] / length
        inside = slice(math.ceil(part.start * share), max(math.floor(part.stop * share), 1))
        small = small.take(_mirrored(inside, small.shape[axis]), axis)
    text = ", ".join(f"{side} {size}" for side, size in found.items())
    choice = f"left out of the computation and put back: {text} pixels"
    decision = Decision("bars", choice, "they are even and dark in every frame")
    return Correction((decision,), fill, small, picture=picture, put_back=Bars(picture, mean).put_back)


def _mirrored(inside: slice, length: int) -> NDArray[np.int_]:
    """Continue what is inside to the whole length by mirroring; returns indices."""
    return np.pad(np.arange(inside.start, inside.stop), (inside.start, length - inside.stop), mode="symmetric")


def _extremes(survey: Survey) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of some frames, and the least and greatest luminance."""
    shape = survey.clip.shape[1:]
    total = np.zeros(shape)
    lowest, highest = np.full(shape[:2], np.inf, np.float32), np.full(shape[:2], -np.inf, np.float32)
    for frame in survey:
        grey = luminance(frame)
        total += frame
        np.minimum(lowest, grey, out=lowest)
        np.maximum(highest, grey, out=highest)
    return (total / len(survey.numbers)).astype(np.float32), lowest, highest


def _picture_of(shows: NDArray[Any], level: FloatArray) -> slice:
    """Rows of the picture: all but even, dark ones at either end, if there is a step along the row beside them."""
    found = np.flatnonzero(shows)
    if not found.size:
        return slice(0, len(shows))
    ends = int(found[0]), len(shows) - 1 - int(found[-1])
    sizes = [
        size if size >= _NARROWEST and np.mean(np.abs(rows[size + 1] - rows[size - 1]) > _STEP) >= _SHARE else 0
        for size, rows in zip(ends, (level, level[::-1]), strict=True)
    ]
    return slice(sizes[0], len(shows) - sizes[1])

"""Black bars beside the picture of a letterboxed or upright video.

Bars are filled with the mirrored picture before the frames are worked on, because the step beside them would be taken
for an edge of the scene, and are put back into the result.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..io.source import FrameSource, Window

# Frames that are looked at.
_SAMPLES = 16
# A bar is darker than that, even to that in place and time, and the picture beside it differs by that in that share.
_DARK, _EVEN, _STEP, _SHARE = 0.12, 3.5 / 255, 0.02, 0.5
# Narrowest bar, pixels, and least part of the frame that the picture takes.
_NARROWEST, _LEAST_PICTURE = 2, 0.25


@dataclass(frozen=True, eq=False)
class Bars:
    """The picture between the bars."""

    picture: Window  # rows and columns of the frame
    frame: FloatArray  # (H, W) or (H, W, 3): mean of some frames, which has the bars

    def put_back(self, image: FloatArray, left: int = 0, top: int = 0) -> FloatArray:
        """Give an image, whose first pixel is at (left, top) of the frame, its bars."""
        window = np.s_[top : top + len(image), left : left + image.shape[1]]
        outside = np.ones(self.frame.shape[:2], bool)
        outside[self.picture] = False
        with_bars = image.copy()
        with_bars[outside[window]] = self.frame[window][outside[window]]
        return with_bars


def without_bars(source: FrameSource) -> tuple[FrameSource, Bars | None, tuple[Decision, ...]]:
    """Fill bars with the mirrored picture; a source without bars is returned as it is."""
    mean, lowest, highest = _extremes(source)
    height, width = lowest.shape
    uneven = (highest - lowest > _EVEN) | (highest > _DARK)
    level = luminance(mean)
    rows, columns = _picture_of(np.any(uneven, axis=1), level), _picture_of(np.any(uneven, axis=0), level.T)
    picture = rows, columns
    sizes = {"top": rows.start, "bottom": height - rows.stop, "left": columns.start, "right": width - columns.stop}
    found = {side: size for side, size in sizes.items() if size}
    if not found or (rows.stop - rows.start) * (columns.stop - columns.start) < _LEAST_PICTURE * height * width:
        return source, None, ()
    before, own = source.adjust, source.window
    around = ((sizes["top"], sizes["bottom"]), (sizes["left"], sizes["right"]))
    pairs = zip(picture, around, strict=True)
    places = [np.pad(np.arange(side.start, side.stop), size, mode="symmetric") for side, size in pairs]

    def adjust(number: int, values: FloatArray, window: Window) -> FloatArray:
        if window != own:
            # A window of the frame may not hold what is mirrored into it.
            whole = next(iter(dataclasses.replace(filled, numbers=(number,), timestamps=None)))
            rows, columns = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(window, own, strict=True))
            return whole[rows, columns]
        values = values if before is None else before(number, values, window)
        return values[places[0]][:, places[1]]

    filled = dataclasses.replace(source, adjust=adjust)
    text = ", ".join(f"{side} {size}" for side, size in found.items())
    choice = f"left out of the computation and put back: {text} pixels"
    decision = Decision("bars", choice, "they are even and dark in every frame")
    return filled, Bars(picture, mean), (decision,)


def _extremes(source: FrameSource) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of some frames, and the least and greatest luminance."""
    part = source.select((0, len(source), max(1, len(source) // _SAMPLES)))
    total = np.zeros(source.shape[1:])
    lowest, highest = np.full(source.shape[1:3], np.inf, np.float32), np.full(source.shape[1:3], -np.inf, np.float32)
    for frame in part:
        grey = luminance(frame)
        total += frame
        np.minimum(lowest, grey, out=lowest)
        np.maximum(highest, grey, out=highest)
    return (total / len(part)).astype(np.float32), lowest, highest


def _picture_of(shows: NDArray[Any], level: FloatArray) -> slice:
    """Rows of the picture: all but those at either end that show nothing and that a step along the row ends."""
    found = np.flatnonzero(shows)
    if not found.size:
        return slice(0, len(shows))
    ends = int(found[0]), len(shows) - 1 - int(found[-1])
    sizes = [
        size if size >= _NARROWEST and np.mean(np.abs(rows[size + 1] - rows[size - 1]) > _STEP) >= _SHARE else 0
        for size, rows in zip(ends, (level, level[::-1]), strict=True)
    ]
    return slice(sizes[0], len(shows) - sizes[1])

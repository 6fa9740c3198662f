"""Detection and repair of hot and dead pixels.

A stuck pixel differs from a small detail of the scene in one of two ways: its neighbours show nothing of it, although a
lens and motion would spread a detail; or it never changes while its neighbours do.  The end of a letter of a title
looks the same, but the letter also covers part of a neighbour.  Pairs, clusters, pixels at the border, and pixels that
a lossy codec has spread are not found.  Those of a Bayer sensor are looked for in its mosaic, among the neighbours of
their colour.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...io.counts import NEIGHBOURS
from ...io.pixels import PixelArray

# Share of stuck pixels from which they are something else, chosen.
_MOST_STUCK = 0.005
# Fewest frames: tests find stuck pixels in 14, and none in 6.
_FEWEST_FRAMES = 10
# Distance, as a share of full scale, by which a stuck pixel lies outside the range of its neighbours, chosen.
_EXCESS = 0.05
# Most frames in which all pixels are compared, for the cost; afterwards only the remaining candidates are followed.
_DENSE_FRAMES = 8
# A lone pixel exceeds its highest neighbour by this share of its distance from the median of all neighbours, chosen.
_ALONE = 0.8
# Largest change of a stuck pixel: rounding of both frames and half a level; and least mean change of its neighbours,
# chosen.
_STILL, _MOVING = 1.5 / 255, 8 / 255
# A neighbour belongs to the same letter if it always stands out by this share of the height of the pixel, chosen.
_OF_LETTER = 0.3
# Places of the eight neighbours, from the pixel.
_AROUND = np.argwhere(NEIGHBOURS) - 1


class StuckPixelDetector:
    """Finds pixels that lie outside the range of all their neighbours in every frame."""

    def __init__(self) -> None:
        self._frames = 0
        self._high: NDArray[np.bool_] | None = None
        self._low: NDArray[np.bool_] | None = None
        self._searching = True
        self._places = np.empty((0, 2), np.int64)

    def update(self, values: FloatArray) -> None:
        """Compare the next frame, shape (H, W) or (H, W, 3) in [0, 1]; frames below 3×3 pixels are ignored."""
        if min(values.shape[:2]) < 3:
            return
        self._frames += 1
        if self._searching:
            self._compare_all(values)
        elif len(self._places):
            self._follow(values)

    def found(self) -> NDArray[np.int64]:
        """Row, column, and channel of colour frames, of every stuck pixel: int64 of shape (N, 2) or (N, 3)."""
        none = np.empty((0, 2), np.int64)
        if self._searching or not len(self._places) or self._frames < _FEWEST_FRAMES:
            return none
        moves = self._highest - self._lowest
        moved = moves.mean(axis=1) >= _MOVING
        still = (self._most - self._least <= _STILL) & moved
        # A letter of a title covers a neighbour, which is still while others move, or a share of one, which stands out
        # by that share in every frame, and moves by the rest.
        left = (1 - self._shared) * moves.max(axis=1, keepdims=True) + _STILL
        covered = (self._shared >= _OF_LETTER) & (moves <= left)
        letter = moved & ((moves <= _STILL) | covered).any(axis=1)
        stuck = self._places[(still | (self._alone >= _ALONE)) & ~letter]
        return none if len(stuck) > _MOST_STUCK * self._size else stuck

    def _compare_all(self, values: FloatArray) -> None:
        around = cv2.dilate(values, NEIGHBOURS)
        high = np.subtract(values, around, out=around) > _EXCESS
        around = cv2.erode(values, NEIGHBOURS, dst=around)
        low = np.subtract(around, values, out=around) > _EXCESS
        self._high = high if self._high is None else self._high & high
        self._low = low if self._low is None else self._low & low
        count = np.count_nonzero(self._high) + np.count_nonzero(self._low)
        if count > _MOST_STUCK * values.size and self._frames < _DENSE_FRAMES:
            return
        self._size = values.size
        # At the border half of the neighbours are missing, and codecs and scalers leave artefacts.
        for marks in (self._high, self._low):
            marks[[0, -1]] = marks[:, [0, -1]] = False
        self._places = np.argwhere(self._high | self._low)
        if len(self._places) > 4 * _MOST_STUCK * values.size:
            self._places = self._places[:0]
        self._sign = np.where(self._high[tuple(self._places.T)], 1, -1).astype(np.float32)
        self._searching, self._high, self._low = False, None, None
        own, around = _with_neighbours(values, self._places)
        self._least, self._most, self._lowest, self._highest = own, own, around, around
        self._alone, self._shared = np.full(len(own), np.inf, np.float32), np.full_like(around, np.inf)

    def _follow(self, values: FloatArray) -> None:
        own, around = _with_neighbours(values, self._places)
        sign = self._sign[:, None]
        over = (sign * (own[:, None] - around)).min(axis=1)
        keep = over > _EXCESS
        middle = np.median(around, axis=1, keepdims=True)
        height = np.maximum(np.abs(own[:, None] - middle), _EXCESS)
        self._alone = np.minimum(self._alone, over / height[:, 0])[keep]
        self._shared = np.minimum(self._shared, sign * (around - middle) / height)[keep]
        self._places, self._sign = self._places[keep], self._sign[keep]
        self._least, self._most = np.minimum(self._least, own)[keep], np.maximum(self._most, own)[keep]
        self._lowest = np.minimum(self._lowest, around)[keep]
        self._highest = np.maximum(self._highest, around)[keep]


def _with_neighbours(values: PixelArray, places: NDArray[np.int64]) -> tuple[PixelArray, PixelArray]:
    """Values at places off the border, shape (N,), and at their eight neighbours, shape (N, 8)."""
    rows, columns = places[:, :1] + _AROUND[:, 0], places[:, 1:2] + _AROUND[:, 1]
    channels = [places[:, 2:3]] if places.shape[1] == 3 else []
    return values[tuple(places.T)], values[(rows, columns, *channels)]


def repair_stuck(pixels: PixelArray, stuck: NDArray[np.int64]) -> PixelArray:
    """Return a copy of a frame in which stuck pixels are the median of their eight neighbours."""
    _, around = _with_neighbours(pixels, stuck)
    middle = np.median(around, axis=1)
    repaired = pixels.copy()
    repaired[tuple(stuck.T)] = middle if np.issubdtype(pixels.dtype, np.floating) else np.rint(middle)
    return repaired

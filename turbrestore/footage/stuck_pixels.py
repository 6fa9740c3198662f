"""Hot and dead pixels, told from details of the scene.

A stuck pixel differs from a small detail of the scene in two ways, one of which has to hold: it stands alone, its
neighbours show nothing of it although any lens and any motion would spread it; or it never changes while its
neighbours do.  Pairs and clusters are not found, nor pixels at the border, nor what a lossy codec or a Bayer pattern
has spread.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..io.pixels import PixelArray

_MOST_STUCK = 0.005
_FEWEST_FRAMES = 10
# Frames in which pixels are compared everywhere before only few candidates are left to follow.
_DENSE_FRAMES = 8
# Share of its height over the median of the neighbours by which a lone pixel stands over the highest of them.
_ALONE = 0.8
_STILL, _MOVING = 1.5 / 255, 8 / 255
_RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_AROUND = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)])


class StuckPixels:
    """Pixels that have stood out of all their neighbours in every frame so far."""

    def __init__(self, excess: float) -> None:
        self._excess = excess
        self._frames = 0
        self._high: NDArray[np.bool_] | None = None
        self._low: NDArray[np.bool_] | None = None
        self._searching = True
        self._places = np.empty((0, 2), np.int64)

    def look(self, values: FloatArray) -> None:
        """Compare the next frame.

        Parameters
        ----------
        values : (H, W) or (H, W, 3) float32 array
            Frame on the scale of 0 to 1; below 3 pixels a side it is passed over.
        """
        if min(values.shape[:2]) < 3:
            return
        self._frames += 1
        if self._searching:
            self._look_everywhere(values)
        elif len(self._places):
            self._follow(values)

    def found(self) -> NDArray[np.int64]:
        """Row, column, and channel of colour frames."""
        none = np.empty((0, 2), np.int64)
        if self._searching or not len(self._places) or self._frames < _FEWEST_FRAMES:
            return none
        still = (self._most - self._least <= _STILL) & (self._moved() >= _MOVING)
        stuck = self._places[still | (self._alone >= _ALONE)]
        return none if len(stuck) > _MOST_STUCK * self._size else stuck

    def _look_everywhere(self, values: FloatArray) -> None:
        around = cv2.dilate(values, _RING)
        high = np.subtract(values, around, out=around) > self._excess
        around = cv2.erode(values, _RING, dst=around)
        low = np.subtract(around, values, out=around) > self._excess
        self._high = high if self._high is None else self._high & high
        self._low = low if self._low is None else self._low & low
        count = np.count_nonzero(self._high) + np.count_nonzero(self._low)
        if count > _MOST_STUCK * values.size and self._frames < _DENSE_FRAMES:
            return
        self._size = values.size
        # At the border half of the neighbours are missing, and codecs and scalers leave marks.
        for marks in (self._high, self._low):
            marks[[0, -1]] = marks[:, [0, -1]] = False
        self._places = np.argwhere(self._high | self._low)
        if len(self._places) > 4 * _MOST_STUCK * values.size:
            self._places = self._places[:0]
        self._sign = np.where(self._high[tuple(self._places.T)], 1, -1).astype(np.float32)
        self._searching, self._high, self._low = False, None, None
        own, around = _with_neighbours(values, self._places)
        self._least, self._most, self._lowest, self._highest = own, own, around, around
        self._alone = np.full(len(own), np.inf, np.float32)

    def _follow(self, values: FloatArray) -> None:
        own, around = _with_neighbours(values, self._places)
        sign = self._sign[:, None]
        over = (sign * (own[:, None] - around)).min(axis=1)
        keep = over > self._excess
        height = np.abs(own - np.median(around, axis=1))
        self._alone = np.minimum(self._alone, over / np.maximum(height, self._excess))[keep]
        self._places, self._sign = self._places[keep], self._sign[keep]
        self._least, self._most = np.minimum(self._least, own)[keep], np.maximum(self._most, own)[keep]
        self._lowest = np.minimum(self._lowest, around)[keep]
        self._highest = np.maximum(self._highest, around)[keep]

    def _moved(self) -> FloatArray:
        return (self._highest - self._lowest).mean(axis=1)


def _with_neighbours(values: PixelArray, places: NDArray[np.int64]) -> tuple[PixelArray, PixelArray]:
    """Values at places off the border, shape (N,), and those of their eight neighbours, shape (N, 8)."""
    rows, columns = places[:, :1] + _AROUND[:, 0], places[:, 1:2] + _AROUND[:, 1]
    channels = [places[:, 2:3]] if places.shape[1] == 3 else []
    return values[tuple(places.T)], values[(rows, columns, *channels)]


def without_stuck(pixels: PixelArray, stuck: NDArray[np.int64]) -> PixelArray:
    """Replace stuck pixels by the median of their eight neighbours.

    Parameters
    ----------
    pixels : (H, W) or (H, W, 3) array
        Frame of any dtype of pixels.
    stuck : (N, 2) or (N, 3) int64 array
        Row and column, and channel of colour frames, as :meth:`StuckPixels.found` gives them; none at the border.

    Returns
    -------
    array like pixels
        A copy.

    Examples
    --------
    >>> frame = np.zeros((3, 3), np.uint8)
    >>> frame[1, 1] = 255
    >>> int(without_stuck(frame, np.array([[1, 1]])).max())
    0
    """
    _, around = _with_neighbours(pixels, stuck)
    middle = np.median(around, axis=1)
    repaired = pixels.copy()
    repaired[tuple(stuck.T)] = middle if np.issubdtype(pixels.dtype, np.floating) else np.rint(middle)
    return repaired

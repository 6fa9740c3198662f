"""Black borders of a clip whose frames a stabiliser or an editor has moved, and left black where they show nothing.

A border is straight, and black in some frames where others show the scene, on at least three sides and along most of
them.  A planet that the wind shakes has a round edge; a field stop, a bar and a shadow stay.  Flow would bend a border
into the scene, and fusion would darken the result.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...io.pixels import PixelArray

# Largest level of black in 8 bits, after a codec, and pixels beside it that a codec or an interpolation has darkened.
_BLACK_OF_CODEC, _DARKENED = 4, 3
# Narrowest border, pixels, the share of the frames that have it, and of those that do not, and the least number.
_NARROWEST, _AT_TIMES, _FEWEST = 3, 0.02, 2
# Least share of a side that is black in such a frame, and that is black at times, and least number of such sides.
_OF_SIDE, _SIDES = 0.5, 3
# Largest distance of the edge of a border from a line, pixels, most of its length that lies beyond, as where the scene
# is black, and before the line, as the middle of an arc; least share of the borders whose edge is a line.
_OFF_LINE, _MOST_BEYOND, _MOST_BEFORE, _MOST_STRAIGHT = 2.0, 0.35, 0.05, 0.5
# Most of a frame that may be black: one without a picture has no border.
_MOST = 0.5


class BlackBorderDetector:
    """Counts, along the sides of the frames, where they are black, and in how many frames the edge is straight."""

    def __init__(self) -> None:
        self._frames = 0
        # Frames that are black and frames that are not, for every pixel of four sides; borders, and straight ones.
        self._black: list[NDArray[np.int64]] = []
        self._borders, self._straight = np.zeros((2, 4), np.int64)

    def update(self, pixels: PixelArray) -> None:
        """Look at the next frame, shape (H, W) or (H, W, 3)."""
        self._frames += 1
        black, turned = _black(pixels), pixels.swapaxes(0, 1)
        sides = pixels, pixels[::-1], turned, turned[::-1]
        self._black = self._black or [np.zeros((2, side.shape[1]), np.int64) for side in sides]
        for number, side in enumerate(sides):
            strip = _level(side[:_NARROWEST])
            dark = strip.max(axis=0) <= black
            if dark.mean() >= _OF_SIDE:
                straight = _is_straight(_level(side[: len(side) // 2]) > black)
                if straight is None:
                    continue
                self._borders[number] += 1
                self._straight[number] += straight
            self._black[number] += dark, strip[0] > black

    def found(self) -> bool:
        """Tell whether the frames have black borders that change."""
        fewest = max(_AT_TIMES * self._frames, _FEWEST)
        changing = np.array([np.mean((counts >= fewest).all(axis=0)) >= _OF_SIDE for counts in self._black])
        bordered = (self._borders >= fewest) & (self._straight >= _MOST_STRAIGHT * self._borders)
        return int(np.sum(changing & bordered)) >= _SIDES


def black_border(pixels: PixelArray) -> NDArray[np.bool_]:
    """Mark, (H, W), what is black and connected to the border of a frame, with the pixels beside it."""
    dark = (_level(pixels) <= _black(pixels)).astype(np.uint8)
    around = cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    cv2.floodFill(around, None, (0, 0), 2)
    border = (around[1:-1, 1:-1] == 2).astype(np.uint8)
    if border.mean() > _MOST:
        return np.zeros(border.shape, bool)
    return cv2.dilate(border, np.ones((2 * _DARKENED + 1,) * 2, np.uint8)) > 0


def _is_straight(shown: NDArray[np.bool_]) -> bool | None:
    """Tell whether the edge of what is shown, beyond a black border in the first rows, is a line; None without one."""
    places = np.flatnonzero(shown.any(axis=0) & ~shown[0])
    if not len(places):
        return None
    widths = shown.argmax(axis=0)[places]
    third = -(-len(places) // 3)
    left, right = (_narrow(places[part], widths[part]) for part in (slice(third), slice(-third, None)))
    line = left[1] + (places - left[0]) * (right[1] - left[1]) / max(right[0] - left[0], 1)
    beyond, before = np.mean(widths - line > _OFF_LINE), np.mean(line - widths > _OFF_LINE)
    return bool(beyond <= _MOST_BEYOND and before <= _MOST_BEFORE)


def _narrow(places: NDArray[np.int64], widths: NDArray[np.int64]) -> tuple[int, int]:
    """Place and width where the border is narrower than nearly everywhere: dark parts of the scene widen it."""
    chosen = np.argsort(widths, kind="stable")[len(widths) // 4]
    return int(places[chosen]), int(widths[chosen])


def _level(pixels: PixelArray) -> PixelArray:
    # The channels one by one: a maximum along the last axis takes ten times as long.
    return pixels if pixels.ndim == 2 else np.maximum.reduce([pixels[..., channel] for channel in range(3)])


def _black(pixels: PixelArray) -> int:
    return _BLACK_OF_CODEC if pixels.dtype == np.uint8 else 0

"""Black borders of a clip whose frames a stabiliser or an editor has moved, and left black where they show nothing.

A border is straight, and black in some frames where others show the scene, on at least three sides and along most of
them.  A planet that the wind shakes has a round edge; a field stop, a bar and a shadow stay.  Flow would bend a border
into the scene, and fusion would darken the result.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...io.pixels import PixelArray

# Largest level of black in 8 bits, after a codec, and pixels beside it that a codec or an interpolation has darkened.
_BLACK_OF_CODEC, _DARKENED = 4, 3
# Narrowest border, pixels; least share and number of the frames that have it, and of those that do not.
_NARROWEST, _AT_TIMES, _FEWEST = 3, 0.02, 2
# Least share of a side that is black in such a frame, and that is black at times, and least number of such sides.
_OF_SIDE, _SIDES = 0.5, 3
# The edge is a line through a place in either outer third of a border, where this share of it is narrower.  It is bent,
# as an arc, if more than a share of it is so many pixels before the line, and noise, if more than another is beyond.
_NARROW, _OFF_LINE, _BEFORE, _BEYOND = 0.1, 2.0, 0.05, 0.4
# Least share of the borders whose edge is straight.
_STRAIGHT = 0.5


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
        black, sides = _black(pixels), _sides(pixels)
        self._black = self._black or [np.zeros((2, side.shape[1]), np.int64) for side in sides]
        for number, side in enumerate(sides):
            strip = _level(side[:_NARROWEST])
            dark = strip.max(axis=0) <= black
            if dark.mean() >= _OF_SIDE:
                shown = _level(side[: len(side) // 2]) > black
                if not shown.any():
                    continue
                self._borders[number] += 1
                self._straight[number] += _edge(shown) is not None
            self._black[number] += dark, strip[0] > black

    def found(self) -> bool:
        """Tell whether the frames have black borders that change."""
        fewest = max(_AT_TIMES * self._frames, _FEWEST)
        bordered = (self._borders >= fewest) & (self._straight >= _STRAIGHT * self._borders)
        changing = [np.mean((counts >= fewest).all(axis=0)) >= _OF_SIDE for counts in self._black]
        # A mosaic is not looked at.
        return bool(self._black) and int(np.sum(bordered & changing)) >= _SIDES


def black_border(pixels: PixelArray) -> NDArray[np.bool_]:
    """Mark, (H, W), the black borders of a frame, with the pixels beside them."""
    marked, black = np.zeros(pixels.shape[:2], bool), _black(pixels)
    for side, place in zip(_sides(pixels), _sides(marked), strict=True):
        dark = _level(side[:1])[0] <= black
        edge = _edge(_level(side[: len(side) // 2]) > black) if dark.any() else None
        if edge is not None:
            near = np.convolve(dark, np.ones(2 * _DARKENED + 1), "same") > 0
            place[near & (np.arange(len(place))[:, None] < edge + _DARKENED)] = True
    return marked


def _edge(shown: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Find the straight edge, (W,), of what is shown beyond a black border in the first rows; None where it is bent.

    Where the scene is black, too, the border seems wider, never narrower.
    """
    places = np.flatnonzero(shown.any(axis=0) & ~shown[0])
    if not len(places):
        return None
    widths = shown.argmax(axis=0)[places]
    third = -(-len(places) // 3)
    left, right = (
        start + int(np.argsort(widths[start : start + third], kind="stable")[int(_NARROW * third)])
        for start in (0, len(places) - third)
    )
    slope = (widths[right] - widths[left]) / max(places[right] - places[left], 1)
    edge = np.asarray(widths[left] + slope * (np.arange(shown.shape[1]) - places[left]), np.float64)
    off = widths - edge[places]
    return edge if np.mean(off < -_OFF_LINE) <= _BEFORE and np.mean(off > _OFF_LINE) <= _BEYOND else None


def _sides(pixels: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return views of a frame whose first rows are its top, its bottom, its left and its right."""
    turned = pixels.swapaxes(0, 1)
    return pixels, pixels[::-1], turned, turned[::-1]


def _level(pixels: PixelArray) -> PixelArray:
    # The channels one by one: a maximum along the last axis takes ten times as long.
    return pixels if pixels.ndim == 2 else np.maximum.reduce([pixels[..., channel] for channel in range(3)])


def _black(pixels: PixelArray) -> int:
    return _BLACK_OF_CODEC if pixels.dtype == np.uint8 else 0

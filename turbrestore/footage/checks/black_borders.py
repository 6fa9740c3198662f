"""Finds the black borders that a stabiliser or an editor leaves where a moved frame shows nothing.

Such a border has a straight edge, moves, and is black in some frames where others show the scene, on at least three
sides and along most of them.  The edge of a shaking planet is round; field stops, bars and shadows do not move.  Flow
would bend a border into the scene, and fusion would darken the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...core.thresholds import threshold
from ...io.pixels import PixelArray


@dataclass(frozen=True)
class _Thresholds:
    """What tells a black border that moves from a dark scene."""

    black_of_codec: int = threshold(4, "8-bit levels", "test: test_black_of_a_codec")  # codecs add noise to black
    spot: int = threshold(3, "pixels", "test: test_black_of_a_codec")  # smaller bright spots are noise
    # Width of the rim that codecs and interpolation darken.
    darkened: int = threshold(3, "pixels", "test: test_borders_show_the_mean_of_other_frames")
    # Least width of a border, and least change of it.
    narrowest: int = threshold(3, "pixels", "test: test_a_sky_of_noise_around_zero, and test_a_bar_does_not_grow")
    # Frames in which it occurs, and in which it does not: a share and a number.
    at_times: float = threshold(0.02, "1", "chosen: half and double pass every test")
    fewest: int = threshold(2, "frames", "test: test_one_frame_that_was_moved")
    # Share of a side that it takes in such a frame, and at times, and the number of such sides.
    of_side: float = threshold(0.5, "1", "test: test_a_black_part_of_the_scene_beside_a_border")
    sides: int = threshold(3, "sides", "test: test_a_bright_board_and_a_star_on_black")
    # Its edge is the line through this quantile of the widths in either outer third, as a dark scene widens it.
    narrow: float = threshold(0.25, "1", "test: test_a_black_part_of_the_scene_beside_a_border")
    # It is an arc if a larger share of the widths is further before the line.
    off_line: float = threshold(2.0, "pixels", "test: test_a_planet_that_the_wind_shakes")
    before: float = threshold(0.15, "1", "chosen: half and double pass every test")
    straight: float = threshold(0.5, "1", "test: test_a_planet_that_the_wind_shakes")  # least share of borders


_LIMITS = _Thresholds()


class BlackBorderDetector:
    """Counts, along the sides of the frames, where they are black, and how often the edge is straight and where."""

    def __init__(self) -> None:
        self._frames = 0
        # Frames that are black and frames that are not, for every pixel of four sides; borders, and straight ones.
        self._black: list[NDArray[np.int64]] = []
        self._borders, self._straight = np.zeros((2, 4), np.int64)
        # Least and largest width of a border in the middle of a side.
        self._least, self._most = np.full(4, np.inf), np.full(4, -np.inf)

    def update(self, pixels: PixelArray) -> NDArray[np.bool_]:
        """Look at the next frame, shape (H, W) or (H, W, 3), and mark, (H, W), its black borders."""
        self._frames += 1
        marked, black, sides = np.zeros(pixels.shape[:2], bool), _black(pixels), _sides(pixels)
        self._black = self._black or [np.zeros((2, side.shape[1]), np.int64) for side in sides]
        for number, (side, place) in enumerate(zip(sides, _sides(marked), strict=True)):
            edge = _mark(side, place, black)
            strip = _level(side[: _LIMITS.narrowest])
            dark = strip.max(axis=0) <= black
            if dark.mean() >= _LIMITS.of_side:
                if edge is None and _level(side).max() <= black:
                    continue
                self._borders[number] += 1
                if edge is not None:
                    self._straight[number] += 1
                    middle = edge[len(edge) // 2]
                    self._least[number] = min(self._least[number], middle)
                    self._most[number] = max(self._most[number], middle)
            self._black[number] += dark, strip[0] > black
        return marked

    def found(self) -> bool:
        """Tell whether the frames have black borders that move."""
        if not self._frames or np.max(self._most - self._least) < _LIMITS.narrowest:
            return False
        fewest = max(_LIMITS.at_times * self._frames, _LIMITS.fewest)
        changing = np.array([np.mean((counts >= fewest).all(axis=0)) >= _LIMITS.of_side for counts in self._black])
        bordered = (self._borders >= fewest) & (self._straight >= _LIMITS.straight * self._borders)
        return int(np.sum(changing & bordered)) >= _LIMITS.sides


def black_border(pixels: PixelArray) -> NDArray[np.bool_]:
    """Mark, (H, W), the black borders of a frame, with the pixels beside them."""
    marked = np.zeros(pixels.shape[:2], bool)
    for side, place in zip(_sides(pixels), _sides(marked), strict=True):
        _mark(side, place, _black(pixels))
    return marked


def without_border(thumb: FloatArray, border: NDArray[np.bool_], before: FloatArray) -> FloatArray:
    """Cover a black border with the previous thumbnail, so that a changing border is not taken for a cut."""
    covered = cv2.resize(border.astype(np.float32), thumb.shape[::-1], interpolation=cv2.INTER_AREA) > 0
    if covered.all():
        return thumb
    filled = np.where(covered, before - before[~covered].mean(), thumb - thumb[~covered].mean())
    return np.asarray(filled - filled.mean(), np.float32)


def _mark(side: PixelArray, place: NDArray[np.bool_], black: int) -> NDArray[np.float64] | None:
    """Mark the black border in the first rows of a frame, with its rim; return its edge, if that is straight."""
    dark = _level(side[:1]) <= black
    if not dark.any():
        return None
    shown = (_level(side[: -(-len(side) // 2)]) > black).astype(np.uint8)
    edge = _edge(cv2.morphologyEx(shown, cv2.MORPH_OPEN, np.ones((_LIMITS.spot, _LIMITS.spot), np.uint8)) > 0)
    if edge is not None:
        near = cv2.dilate(dark.astype(np.uint8), np.ones((1, 2 * _LIMITS.darkened + 1), np.uint8)) > 0
        place[near & (np.arange(len(place))[:, None] < edge + _LIMITS.darkened)] = True
    return edge


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
        start + int(np.argsort(widths[start : start + third], kind="stable")[int(_LIMITS.narrow * third)])
        for start in (0, len(places) - third)
    )
    slope = (widths[right] - widths[left]) / max(places[right] - places[left], 1)
    edge = np.asarray(widths[left] + slope * (np.arange(shown.shape[1]) - places[left]), np.float64)
    return edge if np.mean(edge[places] - widths > _LIMITS.off_line) <= _LIMITS.before else None


def _sides(pixels: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return views of a frame whose first rows are its top, its bottom, its left and its right."""
    turned = pixels.swapaxes(0, 1)
    return pixels, pixels[::-1], turned, turned[::-1]


def _level(pixels: PixelArray) -> PixelArray:
    # The channels one by one: a maximum along the last axis takes ten times as long.
    return pixels if pixels.ndim == 2 else np.maximum.reduce([pixels[..., channel] for channel in range(3)])


def _black(pixels: PixelArray) -> int:
    return _LIMITS.black_of_codec if pixels.dtype == np.uint8 else 0

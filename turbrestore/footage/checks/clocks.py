"""Digits of a clock that is drawn over the frames, and the regions that strokes make.

Digits change, but from one frame to the next most of their strokes stay, as no edge does that the air moves.  Where an
overlay has been found, the places of such strokes belong to it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import luminance
from ...core.gradient import sobel_gradient
from ..survey import Survey

# Deviation of a static pixel, and gradient of an edge, in units of the noise of a frame: tests of titles and clocks
# fail at half and at double of either.
STILL, DEVIATIONS = 2.5, 8.0
# Largest change of a pixel that stays, in grey levels: rounding of both frames and half a level; least share of the
# frames that have an edge there, and of these in which it stays, both chosen; fewest connected pixels: a test finds a
# square of side four, whose edge has 12 pixels, and none of side three.
_LEAST_SAME, _OFTEN, _REMAINS, FEWEST_STROKES = 1.5, 0.2, 0.25, 12
# Fewest frames in which it stays: one repeats nothing.  Share that 10 % of the edges exceed in a scene that moves by a
# pixel.  Where they exceed the last times that share, strokes beside others do not count; chosen.
_TIMES, _USUAL, _ALMOST_USUAL = 2, 0.15, 1.5
# Largest part of the frame that digits take, chosen.
_MOST_DIGITS = 0.1
# Distance from other strokes, pixels, within which a stroke may stay in fewer frames, and the least share of them;
# both chosen.
BESIDE, _REMAINS_BESIDE = 8, 0.18
# Largest distance of digits from an overlay: the height of the frame over this, chosen.
LINE = 10
# Radius of the gaps between strokes, pixels, chosen.
_GAP = 2


def clock_digits(survey: Survey, level: float, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark strokes near an overlay that stay from one frame to the next, and change at times; with their gaps.

    ``level`` is the least change that counts.
    """
    moments = survey.moments
    same, clear = max(moments.noise, _LEAST_SAME * level), DEVIATIONS * max(moments.noise, level / STILL)
    edges, static = np.zeros((2, *mask.shape), np.int16)
    before = None
    for frame in survey:
        grey = luminance(frame)
        if before is not None:
            edge = np.hypot(*sobel_gradient(grey)) > clear
            edges += edge
            static += edge & (np.abs(grey - before) < same)
        before = grey
    # What is static all the time is found by its deviation.
    moving = (edges >= _OFTEN * (moments.count - 1)) & (moments.variance > (STILL * same) ** 2)
    if not moving.any():
        return moving
    share = np.where(moving, np.divide(static, np.maximum(edges, 1), dtype=np.float64), 0)
    near = around(mask, len(mask) // LINE)
    # Where the scene hardly moves, its edges stay at times as well; those near the overlay may be digits.
    scene = share[moving & ~near]
    usual = max(float(np.quantile(scene, 0.9)) / _USUAL, 1.0) if scene.size else 1.0
    share[static < _TIMES] = 0
    # A clock has a colon, a date or digits that do not change; blocks that a coder copies lie anywhere.
    digits = _large(near & (share > _REMAINS * usual))
    if digits.any() and usual <= _ALMOST_USUAL:
        beside = around(digits | mask, BESIDE)
        digits |= _large(beside & (share > _REMAINS_BESIDE * usual))
    return digits if digits.mean() <= _MOST_DIGITS else np.zeros_like(digits)


def _large(strokes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Regions of many strokes, with the gaps between them."""
    return regions(with_gaps(strokes), strokes, FEWEST_STROKES)


def with_gaps(strokes: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Add the gaps between strokes, 0 or 1."""
    closed = cv2.morphologyEx(strokes.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((2 * _GAP + 1,) * 2, np.uint8))
    return np.asarray(closed, np.uint8)


def regions(grown: NDArray[Any], marks: NDArray[np.bool_], fewest: int = 1) -> NDArray[np.bool_]:
    """Keep the connected regions that have enough marks."""
    _, labels = cv2.connectedComponents(grown.astype(np.uint8), connectivity=8)
    counts = np.bincount(labels[marks], minlength=int(labels.max()) + 1)
    counts[0] = 0
    return np.asarray((counts >= fewest)[labels])


def around(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """Mark what lies up to a radius from what is marked."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0

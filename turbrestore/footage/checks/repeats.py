"""Frames that repeat the one before but for noise of the recording or what a codec leaves.

Symbols
-------
d : difference of a frame from the one before, where edges are: the 80th percentile, as a deviation
σ : noise of the frame

Frames of a scene behind moving air differ along edges by its motion, and everywhere by √2 σ; a frame that is recorded
again, from a static picture, differs by less than σ and by far less than frames that are not.  In a clip in which
nearly all differ little, nothing moves, and no frame is taken for a repeat.
"""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...core.noise import estimate_noise

# Pixels of a frame that are compared, about, and the share of them that counts as edges.
_PIXELS, _EDGES = 1 << 15, 0.1
_PERCENTILE, _DEVIATIONS = 80, 1.2816
# Largest d of a repeat: in units of σ, relative to the contrast of the frame, and relative to the usual d.
_OF_NOISE, _OF_CONTRAST, _OF_USUAL = 0.7, 0.03, 1 / 3
# Shortest side of frames that are compared; fewer pixels are alike by chance.
_SMALLEST = 16
# Least share of frames that are no repeats.
_LEAST_LIVE = 0.1


class RepeatDetector:
    """Compares every frame with the one before."""

    def __init__(self) -> None:
        self._previous: FloatArray | None = None
        self._differences = array("d")
        self._bounds = array("d")

    def update(self, values: FloatArray) -> None:
        """Take the next frame, intensities of shape (H, W) or (H, W, 3)."""
        step = max(1, min(values.size // _PIXELS, len(values) // _SMALLEST))
        noise = estimate_noise(values)
        grey = luminance(np.ascontiguousarray(values[::step]))
        before, self._previous = self._previous, grey
        self._differences.append(np.inf if before is None else _difference(grey, before))
        self._bounds.append(max(_OF_NOISE * noise, _OF_CONTRAST * float(grey.std())))

    def found(self) -> NDArray[np.bool_]:
        """Tell which frames repeat the one before."""
        differences = np.frombuffer(self._differences)
        close = differences < np.frombuffer(self._bounds)
        live = differences[~close & np.isfinite(differences)]
        if len(live) < max(1.0, _LEAST_LIVE * len(differences)):
            return np.zeros(len(differences), bool)
        return np.asarray(close & (differences < _OF_USUAL * float(np.median(live))))


def _difference(grey: FloatArray, before: FloatArray) -> float:
    """Deviation of the difference where rows of the frame before are steepest."""
    if min(grey.shape) < _SMALLEST:
        return np.inf
    slope = np.abs(before[:, 2:] - before[:, :-2])
    steep = slope >= np.quantile(slope, 1 - _EDGES)
    change = np.abs(grey - before)[:, 1:-1][steep]
    return float(np.percentile(change, _PERCENTILE)) / _DEVIATIONS

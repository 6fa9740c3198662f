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
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...core.noise import estimate_noise
from ...core.thresholds import threshold


@dataclass(frozen=True)
class _Thresholds:
    """What tells a frame that is recorded again from one of a scene that hardly moves."""

    pixels: int = threshold(1 << 15, "pixels", "cost: as many, about, are compared while a frame is read")
    edges: float = threshold(0.1, "1", "test: test_air_that_calms_down_gives_no_repeats")  # share that counts as edges
    percentile: int = threshold(80, "%", "test: test_a_picture_that_stops_is_found_in_h264")
    # Largest d of a repeat: in units of σ, relative to the contrast of the frame, and relative to the usual d.
    of_noise: float = threshold(0.7, "1", "chosen: half and double pass every test")
    of_contrast: float = threshold(0.03, "1", "test: test_air_that_calms_down_gives_no_repeats")
    of_usual: float = threshold(1 / 3, "1", "chosen: half and double pass every test")
    # Shortest side of frames that are compared; fewer pixels are alike by chance.
    smallest: int = threshold(16, "pixels", "chosen: half and double pass every test")
    live: float = threshold(0.1, "1", "test: test_without_air_no_frame_repeats_another")  # least share of no repeats


_LIMITS = _Thresholds()
# Deviations of normal numbers within which that percentile of them is.
_PERCENTILE_DEVIATIONS = NormalDist().inv_cdf((1 + _LIMITS.percentile / 100) / 2)


class RepeatDetector:
    """Compares every frame with the one before."""

    def __init__(self) -> None:
        self._previous: FloatArray | None = None
        self._differences = array("d")
        self._bounds = array("d")

    def update(self, values: FloatArray) -> None:
        """Take the next frame, intensities of shape (H, W) or (H, W, 3)."""
        step = max(1, min(values.size // _LIMITS.pixels, len(values) // _LIMITS.smallest))
        noise = estimate_noise(values)
        grey = luminance(np.ascontiguousarray(values[::step]))
        before, self._previous = self._previous, grey
        self._differences.append(np.inf if before is None else _difference(grey, before))
        self._bounds.append(max(_LIMITS.of_noise * noise, _LIMITS.of_contrast * float(grey.std())))

    def found(self) -> NDArray[np.bool_]:
        """Tell which frames repeat the one before."""
        differences = np.frombuffer(self._differences)
        close = differences < np.frombuffer(self._bounds)
        live = differences[~close & np.isfinite(differences)]
        if len(live) < max(1.0, _LIMITS.live * len(differences)):
            return np.zeros(len(differences), bool)
        return np.asarray(close & (differences < _LIMITS.of_usual * float(np.median(live))))


def _difference(grey: FloatArray, before: FloatArray) -> float:
    """Deviation of the difference where rows of the frame before are steepest."""
    if min(grey.shape) < _LIMITS.smallest:
        return np.inf
    slope = np.abs(before[:, 2:] - before[:, :-2])
    steep = slope >= np.quantile(slope, 1 - _LIMITS.edges)
    change = np.abs(grey - before)[:, 1:-1][steep]
    return float(np.percentile(change, _LIMITS.percentile)) / _PERCENTILE_DEVIATIONS

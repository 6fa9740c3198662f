"""Static patterns of the sensor: columns, rows and lone pixels with an offset of their own, dead columns and rows.

Symbols
-------
m, v : mean of the frames, and variance from one to the next, which shadows hardly raise; n² that of the noise
c : offset of a column: median over the rows of m minus m smoothed across the columns
s : motion of the edges of the scene, pixels

Stripes of the scene move with the air, so v exceeds n² by s² times the squared slope of c.  Those of the sensor stay,
and do not raise v.  They are subtracted from every frame; a column that does not change while others do is filled from
beside it.  Rows are the columns of the transposed frames.  A warm pixel stands out alone in m and does not flicker as
moving detail of its height would.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...core.decision import Decision
from ...core.gradient import sobel_gradient
from ...core.thresholds import threshold
from ...io.counts import NEIGHBOURS
from ...io.source import Window
from ..correction import Correction
from ..placement import relative_window
from ..survey import FEWEST, Survey


@dataclass(frozen=True)
class _Thresholds:
    """What tells stripes, warm pixels and dead columns of the sensor from the scene."""

    # Smoothing across the stripes.
    across: float = threshold(3.0, "pixels", "test: test_offsets_of_columns_and_rows_are_subtracted")
    # Least offset, in standard errors of the mean of the frames and in intensity, that is worth a correction.
    clearly: float = threshold(4.0, "1", "chosen: half and double pass every test")
    least: float = threshold(5e-4, "intensity", "chosen: half and double pass every test")
    # Stripes of the sensor vary by less than this share of what moving stripes would.
    static: float = threshold(0.25, "1", "test: test_stripes_of_the_scene_are_left")
    # Gradient of the edges whose motion is measured, in deviations of the noise, and the least motion.
    edge: float = threshold(8.0, "1", "test: test_stripes_of_the_scene_are_left")
    steep: float = threshold(0.9, "1", "chosen: quantile of the slopes from which motion is measured")
    motion: float = threshold(0.3, "pixels", "chosen: half and double pass every test")
    # Parts along the stripes, and the least correlation of their offsets.
    parts: int = threshold(3, "parts", "test: test_offsets_of_columns_and_rows_are_subtracted")
    alike: float = threshold(0.5, "1", "test: test_offsets_of_columns_and_rows_are_subtracted")
    # Largest root mean square of the offsets of a sensor; strokes and bars are larger.
    largest: float = threshold(0.04, "intensity", "chosen: half and double pass every test")
    # Share of the height of a warm pixel over the median around by which it exceeds each neighbour; most that are warm.
    alone: float = threshold(0.7, "1", "test: test_warm_pixels_are_evened_out_and_points_of_the_scene_stay")
    most_warm: float = threshold(0.005, "1", "chosen: half and double pass every test")
    # Deviation of what is drawn over the noise, in units of it.
    drawn: float = threshold(0.25, "1", "chosen: half and double pass every test")
    # Pixels around it in which no pixel is warm: strokes, and a digit beside that changes.
    around_drawn: int = threshold(
        12, "pixels", "test: test_gaps_between_strokes_of_a_clock_that_ticks_are_no_warm_pixels"
    )
    # A dead column varies less than this share of the noise and of the columns around.
    dead: float = threshold(0.3, "1", "chosen: half and double pass every test")
    around: int = threshold(9, "pixels", "chosen: half and double pass every test")
    most_dead: float = threshold(0.05, "1", "chosen: half and double pass every test")
    noise: float = threshold(1 / 1020, "intensity", "chosen: half and double pass every test")


LIMITS = _Thresholds()


@dataclass(frozen=True, eq=False)
class _Stripes:
    """Offsets of columns and rows, those that are dead, and (H, W) or (H, W, 3) of warm pixels, of a window."""

    warm: FloatArray | None
    offsets: tuple[FloatArray, FloatArray]
    dead: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    window: Window

    def without(self, _: int, values: FloatArray, window: Window) -> FloatArray:
        """Take the stripes out of a frame, or of a window of it."""
        rows, columns = relative_window(self.window, window)
        pattern = self.offsets[0][None, columns] + self.offsets[1][rows, None]
        flat = values - (pattern if values.ndim == 2 else pattern[..., None])
        if self.warm is not None:
            flat -= self.warm[rows, columns]
        flat = _filled(flat, self.dead[0][columns])
        return _filled(flat.swapaxes(0, 1), self.dead[1][rows]).swapaxes(0, 1)


def find_stripes(survey: Survey) -> Correction | None:
    """Find stripes, dead columns and rows, and warm pixels of the sensor."""
    if len(survey.numbers) < FEWEST:
        return None
    moments = survey.moments
    mean, variance, usual = luminance(moments.mean), moments.change, max(moments.noise, 1e-4)
    motion = _motion(mean, variance, usual)
    if motion < LIMITS.motion:
        return None
    dead = (_dead(variance, usual), _dead(variance.T, usual))
    offsets = tuple(
        _offsets(_filled(image, gone), spread, usual / np.sqrt(moments.count), motion)
        for image, spread, gone in ((mean, variance, dead[0]), (mean.T, variance.T, dead[1]))
    )
    count = int(dead[0].sum() + dead[1].sum())
    size = float(np.sqrt(sum(np.mean(offset**2) for offset in offsets)))
    warm = _warm(mean, variance, usual, motion)
    if not count and size == 0 and not warm.any():
        return None
    excess = _above_around(moments.mean) * (warm if moments.mean.ndim == 2 else warm[..., None]) if warm.any() else None
    stripes = _Stripes(excess, (offsets[0], offsets[1]), dead, survey.clip.window)
    kinds = [
        *([f"offsets of {100 * size:.2g} % of full scale subtracted"] if size else ()),
        *([f"{count} dead columns or rows filled from beside them"] if count else ()),
        *([f"{warm.sum()} warm pixels evened out"] if warm.any() else ()),
    ]
    decision = Decision("sensor", "; ".join(kinds), "they are static while the air moves the scene")
    return Correction((decision,), stripes.without)


def _motion(mean: FloatArray, variance: FloatArray, noise: float) -> float:
    """Root of the median squared motion of the edges of the scene, across themselves."""
    smooth = cv2.GaussianBlur(mean, (0, 0), 1.0)
    squares = (cv2.Scharr(smooth, cv2.CV_32F, 1, 0) / 32) ** 2 + (cv2.Scharr(smooth, cv2.CV_32F, 0, 1) / 32) ** 2
    edges = squares > max((LIMITS.edge * noise) ** 2 / 4, float(np.quantile(squares, LIMITS.steep)))
    if not edges.any():
        return 0.0
    return float(np.sqrt(np.median(np.maximum(variance[edges] - noise**2, 0) / squares[edges])))


def _offsets(mean: FloatArray, variance: FloatArray, error: float, motion: float) -> FloatArray:
    """Column offsets; all zero if they belong to the scene."""
    fine = mean - cv2.GaussianBlur(mean, (0, 1), LIMITS.across)
    offsets = np.median(fine, axis=0).astype(np.float32)
    size = float(np.sqrt(np.mean(np.median(np.abs(offsets)) ** 2)))
    parts = [np.median(part, axis=0) for part in np.array_split(fine, LIMITS.parts)]
    clear = (
        size >= max(LIMITS.clearly * 1.25 * error / np.sqrt(len(mean)), LIMITS.least)
        and offsets.std() <= LIMITS.largest
    )
    if not clear or np.corrcoef(parts).min() < LIMITS.alike:
        return np.zeros_like(offsets)
    slope = np.gradient(offsets) ** 2
    level = np.median(variance, axis=0)
    # What v gains from the flattest columns to the steepest; edges of the scene are too few to move these medians.
    steep, flat = slope >= np.quantile(slope, 0.75), slope <= np.quantile(slope, 0.25)
    gained = float(np.median(level[steep]) - np.median(level[flat]))
    expected = motion**2 * float(np.median(slope[steep]) - np.median(slope[flat]))
    return offsets if gained < LIMITS.static * expected else np.zeros_like(offsets)


def _dead(variance: FloatArray, noise: float) -> NDArray[np.bool_]:
    """Mark the columns that have no noise while those around do."""
    level = np.sqrt(np.median(variance, axis=0)).astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(level, LIMITS.around, mode="reflect"), 2 * LIMITS.around + 1
    )
    around = np.median(windows, axis=1)
    dead = level < LIMITS.dead * np.minimum(around, noise if noise > LIMITS.noise else 0)
    if dead.mean() > LIMITS.most_dead:
        return np.zeros_like(dead)
    # Columns at the border are bars, or light that is clipped there.
    alive = np.flatnonzero(~dead)
    dead[: alive[0]] = dead[alive[-1] + 1 :] = False
    return dead


def _warm(mean: FloatArray, variance: FloatArray, noise: float, motion: float) -> NDArray[np.bool_]:
    """Mark static pixels that differ, each alone, from what is around them."""
    height, least = _above_around(mean), max(LIMITS.clearly * noise, 2 * LIMITS.least)
    over = np.where(height > 0, mean - cv2.dilate(mean, NEIGHBOURS), cv2.erode(mean, NEIGHBOURS) - mean)
    alone = (np.abs(height) > least) & (over > LIMITS.alone * np.abs(height))
    warm = alone & (variance - noise**2 < LIMITS.static * (motion * height) ** 2)
    # Letters are drawn over the noise; a lone pixel among their strokes is one of them.
    smooth = cv2.medianBlur(mean, 3)
    slope = np.hypot(*sobel_gradient(smooth))
    drawn = (variance < (LIMITS.drawn * noise) ** 2) & (slope > LIMITS.edge * noise)
    warm &= cv2.dilate(drawn.astype(np.uint8), np.ones((2 * LIMITS.around_drawn + 1,) * 2, np.uint8)) == 0
    return warm if warm.mean() <= LIMITS.most_warm else np.zeros_like(warm)


def _above_around(image: FloatArray) -> FloatArray:
    """Difference from the median of nine, in which a lone pixel does not count."""
    return image - cv2.medianBlur(image, 3)


def _filled(image: FloatArray, dead: NDArray[np.bool_]) -> FloatArray:
    """Fill dead columns linearly from beside them."""
    if not dead.any() or dead.all():
        return image
    filled, places = image.copy(), np.flatnonzero(~dead)
    for column in np.flatnonzero(dead):
        right = int(np.searchsorted(places, column))
        a, b = places[max(right - 1, 0)], places[min(right, len(places) - 1)]
        share = np.float32(0 if a == b else np.clip((column - a) / (b - a), 0, 1))
        filled[:, column] = image[:, a] * (1 - share) + image[:, b] * share
    return filled

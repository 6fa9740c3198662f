"""Static patterns of all pixels of the sensor, which change where a thermal camera calibrates itself.

Symbols
-------
P : offset of every pixel, in each segment of the clip; m : mean of the frames
v : half of the mean squared difference from one frame to the next, to which P adds nothing; n² its median
s : motion of the edges of the scene, pixels
S : mean of the registered frames; d : displacement of a frame

The air moves the scene by s, so that m shows little of it that is finer than s; P stays and is as fine as a pixel.
The high frequencies of m are P where they are far stronger than the noise of m, which is at most n² over the number of
frames, and where they do not add to v, as s² times the squared slope of what moves would.  Ordinary clips are told apart
by these two figures of m and v, which the survey has.  The frames without a first P, the high frequencies of the mean
of each segment, are registered, and ``P = mean of (frame − S ∘ d)`` over each segment is free of the scene.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..core.gradient import sobel_gradient
from ..io.source import Window
from ..registration.flow import MIN_SIDE, iterate_flows
from ..registration.flow_algebra import invert_flow
from ..registration.warp import inside, warp
from .placement import relative_window
from .survey import Moments, Survey


@dataclass(frozen=True)
class _Limits:
    """What tells a pattern of the sensor from the scene."""

    frames: int = 8  # fewest frames, as for stripes of the sensor
    motion: float = 0.3  # least s, pixels, as for stripes of the sensor
    # Least deviation of P in those of the noise of m.  Forty clips without a pattern reach 1.7, and thermal ones have 11.
    clear: float = 4.0
    # Most that P adds to v, relative to what moves.  Clips without a pattern have more, or less than nothing.
    static: float = 0.25
    outlier: float = 5.0  # deviations of P beyond which a pixel is an overlay or an object; normal ones stay below 4.5
    blur: float = 1.5  # deviation of the Gaussian that splits off the high frequencies, in units of s
    window: int = 4  # frames before and after a cut that are compared
    changed: float = 2.0  # least change of P at a cut, as a variance relative to what frames differ by elsewhere
    pixels: int = 1 << 16  # about how many pixels are compared for cuts


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class PixelPattern:
    """Offsets of all pixels of a window, for each segment of the clip."""

    starts: tuple[int, ...]  # number, in the file, of the first frame of each segment
    offsets: FloatArray  # (K, H, W) or (K, H, W, 3)
    window: Window

    def without(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Subtract the pattern from a frame, or from a window of it."""
        part = relative_window(self.window, window)
        return values - self.offsets[self.segment(number)][part]

    def segment(self, number: int) -> int:
        """Return the segment of a frame."""
        return max(bisect_right(self.starts, number) - 1, 0)


def without_pixel_pattern(survey: Survey, moments: Moments) -> tuple[Survey, tuple[Decision, ...]]:
    """Subtract the offsets of all pixels; frames without a clear pattern are returned as they are."""
    motion = _motion_beside_pattern(moments)
    if motion is None:
        return survey, ()
    flat = _flat(moments)
    starts = _segment_starts(survey, flat, motion)
    draft = _draft_pattern(survey, starts, motion)
    found = _registered_pattern(survey, draft)
    size = float(np.sqrt(np.mean(found.offsets**2)))
    if not size:
        return survey, ()
    changes = "" if len(starts) == 1 else f", which change at frame {', '.join(map(str, starts[1:]))},"
    choice = f"offsets of single pixels{changes} subtracted, {100 * size:.2g} % of full scale"
    decision = Decision("sensor", choice, "they are static while the air moves the scene")
    return survey.adjusted(found.without), (decision,)


def _flat(moments: Moments) -> NDArray[np.bool_]:
    """Mark the flatter half of the picture."""
    slopes = _squared_slope(cv2.GaussianBlur(luminance(moments.mean), (0, 0), 1.0))
    return np.asarray(slopes <= np.median(slopes))


def _motion_beside_pattern(moments: Moments) -> float | None:
    """Return s where the fine detail of the mean belongs to the sensor, and None where it need not."""
    mean, change = luminance(moments.mean), moments.change
    if moments.count < _LIMITS.frames or min(mean.shape) < MIN_SIDE:
        return None
    noise, slopes = float(np.median(change)), _squared_slope(cv2.GaussianBlur(mean, (0, 0), 1.0))
    edges = slopes > np.quantile(slopes, 0.9)
    if not edges.any():
        return None
    motion = float(np.sqrt(np.median(np.maximum(change[edges] - noise, 0) / slopes[edges])))
    if motion < _LIMITS.motion:
        return None
    fine = _fine(mean, motion)
    usual = _flat(moments) & _inliers(fine)
    if np.mean(fine[usual] ** 2) < _LIMITS.clear**2 * noise / moments.count:
        return None
    slope = _squared_slope(fine)[usual]
    gained = float(np.mean((slope - slope.mean()) * (change[usual] - change[usual].mean()))) / float(slope.var())
    return motion if abs(gained) < _LIMITS.static * motion**2 else None


def _segment_starts(survey: Survey, flat: NDArray[np.bool_], motion: float) -> tuple[int, ...]:
    """Find where the pattern changes: the means of a few frames before and after differ more than elsewhere."""
    places = np.flatnonzero(flat)[:: max(np.count_nonzero(flat) // _LIMITS.pixels, 1)]
    fine = np.stack([_fine(luminance(frame), motion).ravel()[places] for frame in survey])
    changes = np.zeros(len(fine))
    for cut in range(1, len(fine)):
        before, after = fine[max(cut - _LIMITS.window, 0) : cut], fine[cut : cut + _LIMITS.window]
        difference = np.square(before.mean(axis=0) - after.mean(axis=0)).mean()
        changes[cut] = difference / (1 / len(before) + 1 / len(after))
    usual, cuts = float(np.median(changes[1:])), list[int]()
    for cut in range(1, len(fine)):
        near = changes[max(cut - _LIMITS.window, 0) : cut + _LIMITS.window + 1]
        if changes[cut] == near.max() and changes[cut] > _LIMITS.changed * usual:
            cuts.append(cut)
    return (survey.clip.numbers[0], *(_first_after(survey, fine, places, motion, cut) for cut in cuts))


def _first_after(survey: Survey, fine: FloatArray, places: NDArray[np.int64], motion: float, cut: int) -> int:
    """Number of the first frame that has the pattern after a cut; frames between those of the survey are read."""
    last, first = survey.numbers[cut - 1], survey.numbers[cut]
    between = tuple(number for number in survey.clip.numbers if last < number < first)
    before, after = (part.mean(axis=0) for part in (fine[max(cut - _LIMITS.window, 0) : cut], fine[cut:][:_LIMITS.window]))
    for number, frame in zip(between, replace(survey.clip, numbers=between) if between else (), strict=True):
        values = _fine(luminance(frame), motion).ravel()[places]
        if np.square(values - after).sum() < np.square(values - before).sum():
            return number
    return first


def _draft_pattern(survey: Survey, starts: tuple[int, ...], motion: float) -> PixelPattern:
    """Take the high frequencies of the mean of each segment, in which fine detail of the scene is blurred by motion."""
    none = PixelPattern(starts, np.zeros((len(starts), *survey.clip.shape[1:]), np.float32), survey.clip.window)
    means = _means_of_segments(none, survey.numbers, survey)[0].mean(axis=0)
    return replace(none, offsets=np.stack([_without_outliers(_fine(mean, motion)) for mean in means]))


def _registered_pattern(survey: Survey, draft: PixelPattern) -> PixelPattern:
    """Take the mean, over each segment, of what is left of frames without the registered scene.

    Where nothing moves, offsets and scene cannot be told apart, and the offsets are 0.  They are drawn towards 0 by the
    share that two halves of the frames of a segment do not have in common.
    """
    numbers, window = survey.numbers, survey.clip.window

    def cleaned() -> Iterator[FloatArray]:
        return (draft.without(number, frame, window) for number, frame in zip(numbers, survey, strict=True))

    mean = _mean_of(cleaned())
    total, weight = 1e-3 * mean.astype(np.float64), np.full(mean.shape[:2], 1e-3)
    for frame, flow in iterate_flows(mean, cleaned()):
        seen = inside(flow)
        total += (warp(frame, flow).T * seen.T).T
        weight += seen
    scene = (total.T / weight.T).T.astype(np.float32)
    moved = np.zeros((2, *mean.shape[:2], 2))

    def residuals() -> Iterator[FloatArray]:
        for (_, flow), frame in zip(iterate_flows(scene, cleaned()), survey, strict=True):
            moved[0] += flow
            moved[1] += np.square(flow)
            yield frame - warp(scene, invert_flow(flow))

    halves, counts = _means_of_segments(draft, numbers, residuals())
    average, square = moved / len(numbers)
    moves = np.sum(square - average**2, axis=-1) / 2 >= _LIMITS.motion**2
    offsets = [
        _shared(first, second, moves) if count >= 2 else np.zeros_like(first)
        for first, second, count in zip(*halves, counts, strict=True)
    ]
    return replace(draft, offsets=np.stack(offsets))


def _means_of_segments(
    pattern: PixelPattern, numbers: Iterable[int], frames: Iterable[FloatArray]
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Means of every other frame, (2, K, H, W[, 3]), and the number of frames of each segment."""
    totals = np.zeros((2, *pattern.offsets.shape), np.float32)
    counts = np.zeros((2, len(pattern.starts)), np.int64)
    for number, frame in zip(numbers, frames, strict=True):
        segment = pattern.segment(number)
        half = counts[:, segment].sum() % 2
        totals[half, segment] += frame
        counts[half, segment] += 1
    means = (totals.T / np.maximum(counts, 1, dtype=np.float32).T).T
    # The only frame of a segment stands for both halves.
    means[1, counts[1] == 0] = means[0, counts[1] == 0]
    return means, counts.sum(axis=0)


def _shared(first: FloatArray, second: FloatArray, moves: NDArray[np.bool_]) -> FloatArray:
    """Average two estimates of the offsets, weighted by what they have in common."""
    offsets = _without_outliers((first + second) / 2)
    offsets *= moves if offsets.ndim == 2 else moves[..., None]
    used = offsets != 0
    alike = float(np.corrcoef(first[used], second[used])[0, 1]) if used.any() else 0.0
    # The reliability of the mean of two measurements (Spearman and Brown).
    return offsets * np.float32(max(2 * alike / (1 + alike), 0))


def _mean_of(frames: Iterable[FloatArray]) -> FloatArray:
    total, count = np.float64(0), 0
    for frame in frames:
        total, count = total + frame, count + 1
    return np.asarray(total / count, np.float32)


def _fine(image: FloatArray, motion: float) -> FloatArray:
    return image - cv2.GaussianBlur(image, (0, 0), max(_LIMITS.blur * motion, 1))


def _inliers(fine: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.abs(fine) < _LIMITS.outlier * 1.4826 * np.median(np.abs(fine)))


def _without_outliers(offsets: FloatArray) -> FloatArray:
    return offsets * _inliers(offsets - np.median(offsets))


def _squared_slope(image: FloatArray) -> FloatArray:
    across, along = sobel_gradient(image)
    return across**2 + along**2

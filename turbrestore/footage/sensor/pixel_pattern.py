"""Static patterns of all pixels of the sensor, which change where a thermal camera calibrates itself.

Symbols
-------
P : offset of every pixel, in each segment of the clip; m : mean of the frames
v : half of the mean squared difference from one frame to the next, to which P adds nothing; n² its median
s : motion of the scene, pixels

The air moves the scene by s, so that little of it in m is finer than s; P stays, and is as fine as a pixel.  The fine
detail of m belongs to the sensor where it is far stronger than the noise of m, which is at most n² over the number of
frames, and where it does not add to v, as detail that moves would, by s² times its squared slope.  The survey has m
and v, so clips without a pattern are told at no cost.

P is white, and the scene fades towards high frequencies.  Wiener's filter therefore finds P in the mean of the k frames
of a segment: at each frequency, P has the power of the highest frequencies, less n² / k, which is noise, and the scene
and the noise have the rest.  Of one frame, P can hardly be told from its noise, and hardly any of it is subtracted.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING, FloatArray, luminance
from ...core.decision import Decision
from ...core.gradient import sobel_gradient
from ...core.robust import robust_scale
from ...core.thresholds import threshold
from ...io.source import Window
from ..correction import Correction
from ..placement import relative_window
from ..survey import FEWEST, Moments, Survey
from .stripes import LIMITS as STRIPES


@dataclass(frozen=True)
class _Thresholds:
    """What tells a pattern of the sensor from the scene."""

    # Least deviation of fine detail of m in that of its noise.
    clear: float = threshold(4.0, "1", "measured: sixty clips without a pattern reach 1.7, patterns 11")
    # Deviations of P beyond which a pixel is of an overlay.
    outlier: float = threshold(5.0, "1", "measured: white noise reaches 4.5 in a frame")
    high: float = threshold(0.25, "cycles/pixel", "theory: half of the range of frequencies is high")
    window: int = threshold(4, "frames", "chosen: frames before and after a cut that are compared")
    # Least change of P at a cut, as a variance relative to what frames differ by elsewhere.
    changed: float = threshold(2.0, "1", "chosen: no figure is known")
    pixels: int = threshold(1 << 16, "pixels", "cost: as many, about, are compared at cuts")


_LIMITS = _Thresholds()


@dataclass(frozen=True, eq=False)
class PixelPattern:
    """Offsets of all pixels of a window, for each segment of the clip."""

    starts: tuple[int, ...]  # number, in the file, of the first frame of each segment
    offsets: FloatArray  # (K, H, W) or (K, H, W, 3)
    window: Window

    def without(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Subtract the pattern from a frame, or from a window of it."""
        return values - self.offsets[_segment(self.starts, number)][relative_window(self.window, window)]


def find_pixel_pattern(survey: Survey) -> Correction | None:
    """Find a clear pattern of the offsets of all pixels, which is subtracted."""
    moments = survey.moments
    motion = _motion_beside_pattern(moments)
    if motion is None:
        return None
    starts = _segment_starts(survey, moments)
    means, counts = _means_of_segments(survey, starts)
    noise = float(np.median(moments.change))
    offsets = np.stack([_white_part(mean, noise / count) for mean, count in zip(means, counts, strict=True)])
    # Where nothing moves, nobody can tell the offsets from the scene.
    offsets *= motion if offsets.ndim == 3 else motion[..., None]
    pattern = PixelPattern(starts, offsets, survey.clip.window)
    changes = "" if len(starts) == 1 else f", which change at frame {', '.join(map(str, starts[1:]))},"
    size = 100 * float(np.sqrt(np.mean(np.square(offsets))))
    choice = f"offsets of single pixels{changes} subtracted: {size:.2g} % of full scale"
    decision = Decision("sensor", choice, "they are static while the air moves the scene")
    return Correction((decision,), pattern.without)


def _motion_beside_pattern(moments: Moments) -> NDArray[np.bool_] | None:
    """Mark, (H, W), where the scene moves, if the fine detail of the mean belongs to the sensor; else return None."""
    mean, change = luminance(moments.mean), moments.change
    if moments.count < FEWEST:
        return None
    noise, slopes = float(np.median(change)), _squared_slope(cv2.GaussianBlur(mean, (0, 0), 2.0))
    edges = slopes > np.quantile(slopes, STRIPES.steep)
    if not edges.any():
        return None
    moved = np.maximum(change - np.float32(noise), 0)
    motion = float(np.sqrt(np.median(moved[edges] / slopes[edges])))
    if motion < STRIPES.motion:
        return None
    fine = mean - cv2.GaussianBlur(mean, (0, 0), max(motion, 1))
    usual = (slopes <= np.median(slopes)) & _usual(fine)
    if not usual.any() or np.mean(fine[usual] ** 2) < _LIMITS.clear**2 * noise / moments.count:
        return None
    slope, flicker = _squared_slope(fine)[usual], change[usual]
    gained = abs(float(np.mean((slope - slope.mean()) * (flicker - flicker.mean()))))
    if gained > STRIPES.static * motion**2 * float(slope.var()):
        return None
    # Edges are few, so that motion is known only over wide windows.
    moved, slopes = (cv2.GaussianBlur(some * edges, (0, 0), min(mean.shape) / 8) for some in (moved, slopes))
    return np.asarray(moved >= STRIPES.motion**2 * slopes)


def _segment_starts(survey: Survey, moments: Moments) -> tuple[int, ...]:
    """Find where the pattern changes: the means of a few frames before and after differ more than elsewhere."""
    slopes = _squared_slope(cv2.GaussianBlur(luminance(moments.mean), (0, 0), 2.0))
    flat = np.flatnonzero(slopes <= np.median(slopes))
    places = flat[:: max(len(flat) // _LIMITS.pixels, 1)]
    fine = np.stack([_fine_detail(frame, places) for frame in survey])
    changes = np.zeros(len(fine))
    for cut in range(1, len(fine)):
        before, after = fine[max(cut - _LIMITS.window, 0) : cut], fine[cut : cut + _LIMITS.window]
        difference = np.square(before.mean(axis=0) - after.mean(axis=0)).mean()
        changes[cut] = difference / (1 / len(before) + 1 / len(after))
    least = _LIMITS.changed * float(np.median(changes[1:]))
    starts = [survey.clip.numbers[0]]
    for cut in np.flatnonzero(changes > least).tolist():
        if changes[cut] == changes[max(cut - _LIMITS.window, 0) : cut + _LIMITS.window + 1].max():
            starts.append(_first_after(survey, fine, places, cut))
    return tuple(starts)


def _first_after(survey: Survey, fine: FloatArray, places: NDArray[np.int64], cut: int) -> int:
    """Return the first frame that has the pattern after a cut; frames between those of the survey are read."""
    last, first = survey.numbers[cut - 1], survey.numbers[cut]
    between = tuple(number for number in survey.clip.numbers if last < number < first)
    before, after = fine[max(cut - _LIMITS.window, 0) : cut].mean(axis=0), fine[cut:][: _LIMITS.window].mean(axis=0)
    for number, frame in zip(between, replace(survey.clip, numbers=between) if between else (), strict=True):
        values = _fine_detail(frame, places)
        if np.square(values - after).sum() < np.square(values - before).sum():
            return number
    return first


def _fine_detail(frame: FloatArray, places: NDArray[np.int64]) -> FloatArray:
    grey = luminance(frame)
    return (grey - cv2.GaussianBlur(grey, (0, 0), 1.0)).ravel()[places]


def _means_of_segments(survey: Survey, starts: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Means of the whole frames of each segment, (K, H, W) or (K, H, W, 3), and their numbers of frames, (K,)."""
    totals, counts = np.zeros((len(starts), *survey.clip.shape[1:]), np.float32), np.zeros(len(starts), np.float32)
    for number, frame in zip(survey.numbers, survey, strict=True):
        cv2.accumulate(frame, totals[_segment(starts, number)])
        counts[_segment(starts, number)] += 1
    return (totals.T / counts).T, counts


def _segment(starts: tuple[int, ...], number: int) -> int:
    return max(bisect_right(starts, number) - 1, 0)


def _white_part(image: FloatArray, noise: float = 0.0) -> FloatArray:
    """Filter a mean (H, W) or (H, W, 3) by Wiener's filter for white offsets of the power of the highest frequencies.

    ``noise`` is the part of that power which is noise of the mean.
    """
    if image.ndim == 3:
        return np.stack([_white_part(image[..., channel], noise) for channel in range(3)], axis=-1)
    # The cosine transform continues an image by its reflection, and keeps white noise white.
    import scipy.fft

    spectrum = scipy.fft.dctn(image, norm="ortho")
    height, width = image.shape
    frequency = np.hypot(np.arange(height)[:, None] / (2 * height), np.arange(width) / (2 * width))
    high = frequency >= _LIMITS.high
    fine = scipy.fft.idctn(spectrum * high, norm="ortho")
    white = robust_scale(fine) ** 2 / high.mean()
    rings = (frequency * min(height, width) / 4).astype(np.int64)
    power = np.bincount(rings.ravel(), np.square(spectrum).ravel()) / np.maximum(np.bincount(rings.ravel()), 1)
    share = np.divide(white, power, out=np.ones_like(power), where=power > white).astype(np.float32)
    share *= np.float32(max(1 - noise / max(white, ROUNDING**2), 0.0))
    offsets = scipy.fft.idctn(spectrum * share[rings], norm="ortho")
    return np.asarray(offsets * _usual(offsets), np.float32)


def _usual(fine: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.abs(fine) < _LIMITS.outlier * robust_scale(fine))


def _squared_slope(image: FloatArray) -> FloatArray:
    across, along = sobel_gradient(image)
    return across**2 + along**2

"""Light that changes: exposure that hunts, clouds, bands of lamps on the mains.

Symbols
-------
f : a frame; r : the reference, a mean of frames; both reduced and blurred, so that motion of the air hardly counts
g(y) : gain of the frame at row y of the frame, a constant and cosines; b : its offset

``f(x + d) ≈ g(y) r(x) + b`` is fitted by least squares, reweighted so that moving objects do not count; d is the shift
of the whole frame.  A frame is corrected to ``(f − b) / g``.  The gains of all frames are 1 on average, row by row, so
that the mean of the frames stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING, FloatArray, luminance
from ...core.decision import Decision
from ...core.robust import ROUNDS, bisquare_weights, robust_scale
from ...io.source import Window
from ...registration.camera.global_shift import DEAD_ZONE, ShiftReference, measure_shift, prepare_shift_reference
from ..correction import Correction
from ..survey import Survey
from .shadows import measure_shade

# Longest side of the reduced frames, pixels, chosen.
_SIDE = 96
# Blur that hides the motion of the air: pixels of the frame, and at least that many of the reduced one; both chosen.
_BLUR, _LEAST_BLUR = 4.0, 1.5
# Cosines along the rows, chosen: bands as narrow as an eighth of the frame are followed.
_COSINES = 16
# Least change by the gain of a frame, and by bands, relative to the contrast of the scene, that is corrected.  Clips
# under steady light, simulated and real, reach 0.01, and 0.03 along the rows where somebody walks through.
_LEAST_CHANGE, _LEAST_BANDS = 0.025, 0.06
# Share of these below which no model is fitted, as means over a frame include moving objects; chosen.
_CLEARLY = 0.7
# Share of the residual that a model has to explain of what a simpler one leaves, chosen.
_EXPLAINED = 0.3
# Intensity from which a pixel is saturated: that of the two highest levels of 8 bits.
_SATURATED = 0.995
# Weight of a cosine of order j against its square, relative to the information of the frame, chosen.
_SMOOTHNESS = 1e-4
# Frames of the sample in which bands are looked for, chosen.
_SOME = 24
# Rows at which gains are compared, eight to a period of the narrowest band; the percentage of frames beyond the range
# that they wander in, and the least gain, both chosen.
_NODES, _FEW, _LEAST_GAIN = 64, 5, 0.05


@dataclass(frozen=True, eq=False)
class Light:
    """Gain and offset of frames."""

    gains: dict[int, NDArray[np.float64]]  # (J,): constant and cosines of g, by the number of the frame in the file
    offsets: dict[int, float]  # b, intensity
    rows: slice  # rows of the file that the cosines span

    def steady(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Correct the rows of a frame.

        ``values`` (H, W) or (H, W, 3).
        """
        coefficients, rows = self.gains[number], window[0]
        places = (np.arange(rows.start, rows.stop) - self.rows.start + 0.5) / (self.rows.stop - self.rows.start)
        gain = (_cosines(places, len(coefficients)) @ coefficients).astype(np.float32)
        steady = values - np.float32(self.offsets[number])
        steady /= gain.reshape(-1, *(1,) * (values.ndim - 1))
        return steady


def find_light(survey: Survey) -> Correction | None:
    """Find changes of the light: of whole frames and along their rows, and then in places."""
    if len(survey.small) < 2:
        return None
    frames, numbers, small = _reduced_frames(survey), survey.clip.numbers, None
    light, on_light = _measure_light(survey, frames)
    if light is not None:
        small = np.empty_like(survey.small)
        for before, after in ((frames, frames), (survey.small, small)):
            rows, columns = (slice(0, length) for length in before.shape[1:3])
            for number, frame, lit in zip(numbers, before, after, strict=True):
                lit[...] = replace(light, rows=rows).steady(number, frame, (rows, columns))
    shade, on_shade = measure_shade(frames, numbers, survey.clip.window, _blur_of(survey))

    def apply(number: int, values: FloatArray, window: Window) -> FloatArray:
        values = values if light is None else light.steady(number, values, window)
        return values if shade is None else shade.lit(number, values, window)

    # From here on the reduced frames only serve to measure shifts of the camera, which shadows hardly change.
    return None if light is None and shade is None else Correction((*on_light, *on_shade), apply, small)


def _measure_light(survey: Survey, frames: FloatArray) -> tuple[Light | None, tuple[Decision, ...]]:
    as_a_whole, along_rows = _hardly_change(frames)
    reference = None if as_a_whole and along_rows else _reference_of(frames)
    if reference is None:
        return None, ()
    anchor = prepare_shift_reference(_at_unit_contrast(np.nan_to_num(reference)))
    # Bands are in all frames or in none, so a sample shows them.
    some = frames[:: max(len(frames) // _SOME, 1)] if as_a_whole else frames
    light = _chosen([_fit_frame(frame, reference, anchor) for frame in some])
    if light is not None and len(some) < len(frames):
        light = _chosen([_fit_frame(frame, reference, anchor) for frame in frames])
    if light is None:
        return None, ()
    gains, offsets, with_rows = light
    numbers, rows = survey.clip.numbers, survey.clip.window[0]
    record = Light(dict(zip(numbers, gains, strict=True)), dict(zip(numbers, offsets, strict=True)), rows)
    extent = np.array([coefficients[0] for coefficients in gains])
    what = "exposure of each frame, and bands along its rows," if with_rows else "exposure of each frame"
    reason = f"the gain varies from {extent.min():.2f} to {extent.max():.2f}"
    return record, (Decision("light", f"{what} evened out", reason),)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Gains of one frame without rows, with rows, and with an offset; residuals of no change and of these three.

    ``relative_level`` is the level of the reference relative to its contrast, which turns a gain into a contrast.
    """

    gain: float
    rows: NDArray[np.float64]
    affine: tuple[float, float]
    residuals: tuple[float, float, float, float]
    relative_level: float
    known: bool


def _chosen(fits: list[_Fit]) -> tuple[list[NDArray[np.float64]], list[float], bool] | None:
    """Choose the simplest model that explains how the light changes; None where it hardly changes."""
    known = [fit for fit in fits if fit.known]
    if len(known) < 2:
        return None
    rows = np.array([fit.rows for fit in known])
    level = float(np.median([fit.relative_level for fit in known]))
    bands = float(np.sqrt((rows[:, 1:].std(axis=0) ** 2).sum() / 2))
    still, plain, by_rows, affinely = np.sum([fit.residuals for fit in known], axis=0)
    if bands * level >= _LEAST_BANDS and by_rows < (1 - _EXPLAINED) * plain:
        even = iter(_evened_rows(rows))
        steady = np.eye(1, _COSINES)[0]
        return [next(even) if fit.known else steady for fit in fits], [0.0] * len(fits), True
    affine = np.array([fit.affine for fit in known])
    scalar = np.array([fit.gain for fit in known])
    if float(scalar.std()) * level < _LEAST_CHANGE or min(plain, affinely) >= (1 - _EXPLAINED) * still:
        return None
    if affinely < (1 - _EXPLAINED) * plain:
        gain, offset = affine.mean(axis=0)
        gains = [np.array([fit.affine[0] / gain if fit.known else 1.0]) for fit in fits]
        return gains, [fit.affine[1] - offset * fit.affine[0] / gain if fit.known else 0.0 for fit in fits], False
    return [np.array([fit.gain / scalar.mean() if fit.known else 1.0]) for fit in fits], [0.0] * len(fits), False


def _evened_rows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bring the gains of every row to the same middle, (T, J) to (T, J).

    Bands wander over all rows alike, and the middle of their range is better known than the mean over the frames.
    """
    basis = _cosines((np.arange(_NODES) + 0.5) / _NODES, rows.shape[1])
    gains = rows @ basis.T
    low, high = np.percentile(gains, (_FEW, 100 - _FEW), axis=0)
    gains /= np.maximum((low + high) / 2, _LEAST_GAIN)
    return np.asarray(np.linalg.lstsq(basis, np.maximum(gains, _LEAST_GAIN).T, rcond=None)[0].T, np.float64)


def _reduced_frames(survey: Survey) -> FloatArray:
    """Reduced, blurred luminance of all frames, (T, h, w)."""
    (height, width), factor = survey.clip.shape[1:3], _reduction(survey)
    size = max(1, round(width / factor)), max(1, round(height / factor))
    stack = np.empty((len(survey.small), size[1], size[0]), np.float32)
    for plane, frame in zip(stack, survey.small, strict=True):
        reduced = luminance(cv2.resize(frame, size, interpolation=cv2.INTER_AREA))
        plane[...] = cv2.GaussianBlur(reduced, (0, 0), _blur_of(survey))
    return stack


def _reduction(survey: Survey) -> float:
    return max(1.0, max(survey.clip.shape[1:3]) / min(_SIDE, max(survey.small.shape[1:3])))


def _blur_of(survey: Survey) -> float:
    """Blur of the reduced frames, in their pixels."""
    return max(_LEAST_BLUR, _BLUR / _reduction(survey))


def _hardly_change(frames: FloatArray) -> tuple[bool, bool]:
    """Whether level and contrast of the frames hardly change, and whether their rows do."""
    mean, rows, contrasts = frames.mean(axis=0), frames.mean(axis=2), frames.std(axis=(1, 2))
    level = float(np.sqrt(np.mean(mean**2))) / max(float(mean.std()), ROUNDING)
    gains = rows / np.maximum(rows.mean(axis=0), ROUNDING)
    extent = gains.mean(axis=1)
    bands = float((gains - extent[:, None]).std())
    changes = max(float(extent.std()) * level, float(contrasts.std()) / max(float(contrasts.mean()), ROUNDING))
    return changes < _CLEARLY * _LEAST_CHANGE, bands * level < _CLEARLY * _LEAST_BANDS


def _reference_of(frames: FloatArray) -> FloatArray | None:
    """Mean of frames, brought to one place and one gain; NaN where none shows anything, None without contrast."""
    first = frames[len(frames) // 2]
    if float(np.ptp(first)) <= 0:
        return None
    anchor = prepare_shift_reference(_at_unit_contrast(first))
    total, count = np.zeros(first.shape), np.zeros(first.shape)
    for frame in frames:
        placed, _ = _placed(frame, anchor)
        if placed is None:
            continue
        seen = np.isfinite(placed)
        gain = float(placed[seen].mean()) / max(float(first[seen].mean()), ROUNDING) if seen.any() else 0.0
        if gain > 0:
            total[seen] += placed[seen] / gain
            count[seen] += 1
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
    return mean if np.isfinite(mean).any() else None


def _fit_frame(frame: FloatArray, reference: FloatArray, anchor: ShiftReference) -> _Fit:
    """Fit one frame to the reference by the three models."""
    placed, shift = _placed(frame, anchor)
    height = len(reference)
    if placed is None:
        return _Fit(1.0, np.zeros(_COSINES), (1.0, 0.0), (0.0, 0.0, 0.0, 0.0), 0.0, False)
    known = np.isfinite(placed) & np.isfinite(reference)
    known &= (np.nan_to_num(placed) < _SATURATED) & (np.nan_to_num(reference) < _SATURATED)
    values, truth = np.where(known, placed, 0), np.where(known, reference, 0)
    basis = _cosines((np.arange(height) + shift[1] + 0.5) / height, _COSINES)
    _, still = _reweighted(values - truth, known)
    plain, plainly = _weighted_fit(values, truth, known, np.ones((height, 1)))
    rows, by_rows = _weighted_fit(values, truth, known, basis)
    affine, affinely = _affine_fit(values, truth, known)
    shown = truth[known]
    level = float(np.sqrt(np.mean(shown**2))) / max(float(shown.std()), ROUNDING) if shown.size else 0.0
    return _Fit(
        float(plain[0]), rows, affine, (still, plainly, by_rows, affinely), level, shown.size > 0 and plain[0] > 0
    )


def _at_unit_contrast(image: FloatArray) -> FloatArray:
    return ((image - image.mean()) / max(float(image.std()), ROUNDING)).astype(np.float32)


def _placed(frame: FloatArray, anchor: ShiftReference) -> tuple[FloatArray | None, NDArray[np.float64]]:
    """Frame on the grid of the reference, NaN beyond its border, and its shift; None where they are not alike."""
    shift = measure_shift(_at_unit_contrast(frame), anchor)
    if shift is None:
        return None, np.zeros(2)
    if np.abs(shift).max() <= DEAD_ZONE / 2:
        return frame, np.zeros(2)
    matrix = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    size = frame.shape[1::-1]
    placed = cv2.warpAffine(
        frame, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    return placed, shift


def _cosines(places: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Constant and cosines at places from 0 to 1, shape (N, count)."""
    return np.cos(np.pi * np.arange(count) * places[:, None])


def _weighted_fit(
    values: FloatArray, truth: FloatArray, known: NDArray[np.bool_], basis: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Coefficients of the gain, and the mean robust squared residual."""
    weights = known.astype(np.float64)
    coefficients, residual = np.zeros(basis.shape[1]), 0.0
    for _ in range(ROUNDS):
        power = (weights * truth * truth).sum(axis=1)
        normal = basis.T @ (power[:, None] * basis)
        normal += np.diag(_SMOOTHNESS * power.sum() * np.arange(basis.shape[1]) ** 2 + ROUNDING**2)
        coefficients = np.linalg.solve(normal, basis.T @ (weights * truth * values).sum(axis=1))
        weights, residual = _reweighted(values - truth * (basis @ coefficients)[:, None], known)
    return coefficients, residual


def _affine_fit(values: FloatArray, truth: FloatArray, known: NDArray[np.bool_]) -> tuple[tuple[float, float], float]:
    """Gain and offset, and the mean robust squared residual."""
    weights = known.astype(np.float64)
    gain, offset, residual = 1.0, 0.0, 0.0
    for _ in range(ROUNDS):
        total = max(float(weights.sum()), ROUNDING**2)
        means = float((weights * truth).sum()) / total, float((weights * values).sum()) / total
        spread = float((weights * (truth - means[0]) ** 2).sum())
        gain = float((weights * (truth - means[0]) * (values - means[1])).sum()) / max(spread, ROUNDING**2)
        offset = means[1] - gain * means[0]
        weights, residual = _reweighted(values - gain * truth - offset, known)
    return (gain, offset), residual


def _reweighted(difference: NDArray[np.float64], known: NDArray[np.bool_]) -> tuple[NDArray[np.float64], float]:
    """Tukey's weights of residuals, and their mean square under these weights."""
    weights = known * bisquare_weights(difference, robust_scale(difference[known]))
    return weights, float((weights * difference**2).sum() / max(float(weights.sum()), ROUNDING**2))

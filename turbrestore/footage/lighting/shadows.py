"""Light that changes in place: shadows that move over the scene, clouds, lamps.

Symbols
-------
f : a frame; r : the median of the frames at every place; both reduced and blurred, and at one exposure
g : gain of a frame, a smooth field; G∗ a Gaussian average

``g = G∗(w r f) / G∗(w r²)`` is the fit of ``f ≈ g r`` in a window, with weights w that leave moving objects out.
Motion of the air moves f off g r by its displacement times the gradient of r, which has both signs in a window and
hardly changes g; a shadow changes all of it.  The fields of all frames are 1 on average, in the logarithm, so that the
light of the mean stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING, FloatArray
from ...core.decision import Decision
from ...core.robust import bisquare_weights, robust_scale
from ...core.thresholds import threshold
from ...io.source import Window
from ...registration.camera.global_shift import known_shifts
from ..survey import FEWEST


@dataclass(frozen=True)
class _Thresholds:
    """What tells light that changes in place from motion, and how smooth it is."""

    # Deviation of the Gaussian average: as a share of the longer side of a frame, and in those of its blur.
    reach: float = threshold(0.045, "1", "chosen: half and double pass every test")
    reach_blurs: float = threshold(2.0, "1", "test: test_air_walkers_and_moving_cameras_are_no_light")
    # Least deviation over time of the logarithm of g, at the percentile over the frame.
    change: float = threshold(0.03, "1", "chosen: half and double pass every test")
    percentile: int = threshold(90, "%", "chosen: half of it passes every test")
    # Least share of the squared residual that g explains.
    explained: float = threshold(0.8, "1", "measured: air, walkers, snow, rain and noise reach 0.6")
    # Root mean square of the shifts, in reduced frames, up to which the camera is static.
    static: float = threshold(1.0, "pixels", "chosen: half and double pass every test")
    largest: float = threshold(3.0, "1", "chosen: half and double pass every test")
    # What is added to r: this share of its bright parts, at the percentile, so that dark ones count less.
    dark: float = threshold(0.03, "1", "chosen: half and double pass every test")
    bright: int = threshold(95, "%", "chosen: half of it passes every test")
    rounds: int = threshold(3, "fits", "test: test_air_walkers_and_moving_cameras_are_no_light")


_LIMITS = _Thresholds()


@dataclass(frozen=True, eq=False)
class Shade:
    """Gain of frames, a smooth field."""

    gains: dict[int, NDArray[np.float16]]  # (h, w): g on a reduced grid, by the number of the frame in the file
    window: Window  # rows and columns of the file that the grid spans

    def lit(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Correct the light of a frame, or of a window of it."""
        small = self.gains[number].astype(np.float32)
        axes = (
            ((np.arange(part.start, part.stop, dtype=np.float32) - whole.start + 0.5) * size)
            / (whole.stop - whole.start)
            - 0.5
            for part, whole, size in zip(window, self.window, small.shape, strict=True)
        )
        rows, columns = np.meshgrid(*axes, indexing="ij")
        gain = cv2.remap(small, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return values / (gain if values.ndim == 2 else gain[..., None])


def measure_shade(
    frames: FloatArray, numbers: Sequence[int], window: Window, blur: float
) -> tuple[Shade | None, tuple[Decision, ...]]:
    """Measure how light changes in place; None where it does not.

    ``frames`` (T, h, w), reduced, and blurred by ``blur`` pixels.
    """
    if len(frames) < FEWEST or float(np.ptp(frames[0])) <= 0:
        return None, ()
    reference = np.median(frames, axis=0).astype(np.float32)
    dark = np.float32(_LIMITS.dark * np.percentile(reference, _LIMITS.bright))
    reach = max(_LIMITS.reach * max(reference.shape), _LIMITS.reach_blurs * blur)
    fields, explained = np.empty_like(frames), np.zeros(2)
    for field, frame in zip(fields, frames, strict=True):
        field[...], residuals = _field(frame + dark, reference + dark, reach)
        explained += residuals
    logarithms = np.log(fields)
    logarithms -= logarithms.mean(axis=0)
    change = float(np.percentile(logarithms.std(axis=0), _LIMITS.percentile))
    if change < _LIMITS.change or explained[1] > (1 - _LIMITS.explained) * explained[0]:
        return None, ()
    shifts = known_shifts(frames / max(float(frames.std()), ROUNDING))[0]
    if float(np.square(shifts - shifts.mean(axis=0)).sum(axis=1).mean()) > _LIMITS.static**2:
        return None, ()
    gains = np.exp(logarithms).astype(np.float16)
    low, high = (float(value) for value in np.percentile(gains, (1, 99)))
    reason = f"in places the gain varies from {low:.2f} to {high:.2f}, as under shadows, clouds or lamps"
    decision = Decision("light", "light that changes in place evened out", reason)
    return Shade(dict(zip(numbers, gains, strict=True)), window), (decision,)


def _field(f: FloatArray, r: FloatArray, reach: float) -> tuple[FloatArray, NDArray[np.float64]]:
    """Return g of a frame, and the robust squared residuals of the reference without and with it."""
    weights, field = np.ones_like(f), np.ones_like(f)
    for _ in range(_LIMITS.rounds):
        over, under = (cv2.GaussianBlur(weights * r * part, (0, 0), reach) for part in (f, r))
        known = under > ROUNDING**2
        field = np.where(known, over / np.where(known, under, 1), 1).astype(np.float32)
        field = np.clip(field, 1 / _LIMITS.largest, _LIMITS.largest)
        residual = f - field * r
        weights = bisquare_weights(residual, robust_scale(residual)).astype(np.float32) + 1e-3
    squares = [float((weights * part**2).sum()) for part in (f - r, residual)]
    return field, np.array(squares)

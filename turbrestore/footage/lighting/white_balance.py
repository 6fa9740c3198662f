"""White balance that hunts: a gain for each channel of each frame, beside the light that all channels share.

Symbols
-------
f : a frame; r : the mean of the frames; both reduced and blurred, so that motion of the air hardly counts
G : gain of a channel of a frame, or of its luminance, from ``f ≈ G r`` by least squares, reweighted so that moving
    objects do not count

A channel is divided by its gain over that of the luminance.  These ratios are 1 on average, in the logarithm, so that
the colours of the mean stay.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING, FloatArray, luminance
from ...core.decision import Decision
from ...core.robust import ROUNDS, bisquare_weights, robust_scale
from ...core.thresholds import threshold
from ...registration.camera.global_shift import known_shifts
from ..correction import Correction
from ..placement import reduce_frames
from ..survey import Survey


@dataclass(frozen=True)
class _Thresholds:
    """What tells a white balance that hunts, and which pixels show it."""

    side: int = threshold(64, "pixels", "chosen: half and double pass every test")
    blur: float = threshold(1.5, "pixels", "chosen: half and double pass every test")  # of the reduced frames
    # Deviation over time, of the logarithm of a ratio.
    change: float = threshold(0.01, "1", "measured: below 0.004 for still scenes, 0.006 in a clip of skiers")
    dark: float = threshold(0.02, "intensity", "chosen: half and double pass every test")
    saturated: float = threshold(0.98, "intensity", "test: test_channels_are_brought_to_their_mean, from below only")


_LIMITS = _Thresholds()


def find_white_balance(survey: Survey) -> Correction | None:
    """Find a white balance that changes; grey frames have none."""
    if survey.small.ndim != 4 or len(survey.small) < 3:
        return None
    ratios = _ratios(reduce_frames(survey.small, survey.small.shape, _LIMITS.side, 1, _LIMITS.blur))
    changes = ratios.std(axis=0)
    if changes.max() < _LIMITS.change:
        return None
    factors = np.exp(ratios).astype(np.float32)
    balance = dict(zip(survey.clip.numbers, factors, strict=True))
    name = ("red", "green", "blue")[int(changes.argmax())]
    low, high = np.exp(ratios[:, changes.argmax()].min()), np.exp(ratios[:, changes.argmax()].max())
    reason = f"{name} varies from {low:.2f} to {high:.2f} of its mean against the other colours"
    decision = Decision("white balance", "colours of each frame evened out", reason)
    small = survey.small / factors[:, None, None]
    return Correction((decision,), lambda number, values, _: values / balance[number], small)


def _ratios(frames: FloatArray) -> NDArray[np.float64]:
    """Logarithms of the gains of channels over that of luminance, (T, 3), of mean 0 over time."""
    grey = np.stack([luminance(frame) for frame in frames])
    shifts = known_shifts(grey / np.maximum(grey.mean(axis=(1, 2), keepdims=True), ROUNDING) / 4)[0]
    planes = np.concatenate([frames, grey[..., None]], axis=-1)
    size = planes.shape[2], planes.shape[1]
    # Every frame at the place of the first; NaN beyond its border.
    placed = np.stack(
        [
            cv2.warpAffine(
                plane,
                np.array([[1, 0, -dx], [0, 1, -dy]]),
                size,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=(np.nan,) * 4,
            )
            for plane, (dx, dy) in zip(planes, shifts, strict=True)
        ]
    )
    usable = (placed > _LIMITS.dark) & (placed < _LIMITS.saturated)
    count = usable.sum(axis=0)
    reference = np.where(usable, placed, 0).sum(axis=0) / np.maximum(count, 1)
    usable &= count > len(frames) / 2
    gains = np.ones(planes.shape[::3])
    for number, (frame, known) in enumerate(zip(placed, usable, strict=True)):
        for channel in range(4):
            gains[number, channel] = _gain(frame[..., channel], reference[..., channel], known[..., channel])
    ratios = np.log(gains[:, :3] / gains[:, 3:])
    return ratios - ratios.mean(axis=0)


def _gain(values: FloatArray, reference: NDArray[np.float64], usable: NDArray[np.bool_]) -> float:
    f, r = values[usable].astype(np.float64), reference[usable]
    if f.size < 16:
        return 1.0
    weights: NDArray[np.floating] = np.ones(f.size)
    gain = 1.0
    for _ in range(ROUNDS):
        gain = float((weights * r * f).sum() / max(float((weights * r * r).sum()), ROUNDING**2))
        residual = f - gain * r
        weights = bisquare_weights(residual, robust_scale(residual))
    return max(gain, ROUNDING)

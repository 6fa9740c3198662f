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

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...core.decision import Decision
from ...core.robust import bisquare_weights, robust_scale
from ...registration.camera.global_shift import known_shifts
from ..placement import reduce_frames
from ..survey import Survey

# Longest side of the reduced frames, pixels, and their blur.
_SIDE, _BLUR = 64, 1.5
# Deviation over time, of the logarithm of a ratio, from which the white balance hunts.  It is below 0.004 in real clips
# of still scenes, and 0.006 in one of skiers that the camera follows.
_LEAST_CHANGE = 0.01
_DARK, _SATURATED = 0.02, 0.98
_ROUNDS = 4


def steady_white_balance(survey: Survey) -> tuple[Survey, tuple[Decision, ...]]:
    """Take a white balance that changes out of the frames; others, and grey frames, are returned as they are."""
    if survey.small.ndim != 4 or len(survey.small) < 3:
        return survey, ()
    ratios = _ratios(reduce_frames(survey.small, survey.small.shape, _SIDE, 1, _BLUR))
    changes = ratios.std(axis=0)
    if changes.max() < _LEAST_CHANGE:
        return survey, ()
    factors = np.exp(ratios).astype(np.float32)
    balance = dict(zip(survey.clip.numbers, factors, strict=True))
    name = ("red", "green", "blue")[int(changes.argmax())]
    low, high = np.exp(ratios[:, changes.argmax()].min()), np.exp(ratios[:, changes.argmax()].max())
    reason = f"{name} varies from {low:.2f} to {high:.2f} of its mean against the other colours"
    decision = Decision("white balance", "colours of each frame evened out", reason)
    small = survey.small / factors[:, None, None]
    return survey.adjusted(lambda number, values, _: values / balance[number], small), (decision,)


def _ratios(frames: FloatArray) -> NDArray[np.float64]:
    """Logarithms of the gains of channels over that of luminance, (T, 3), of mean 0 over time."""
    grey = np.stack([luminance(frame) for frame in frames])
    shifts = known_shifts(grey / np.maximum(grey.mean(axis=(1, 2), keepdims=True), 1e-6) / 4)[0]
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
    usable = (placed > _DARK) & (placed < _SATURATED)
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
    for _ in range(_ROUNDS):
        gain = float((weights * r * f).sum() / max(float((weights * r * r).sum()), 1e-12))
        residual = f - gain * r
        weights = bisquare_weights(residual, robust_scale(residual), 1e-9)
    return max(gain, 1e-3)

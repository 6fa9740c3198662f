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

from ...core.arrays import FloatArray
from ...core.decision import Decision
from ...core.robust import bisquare_weights, robust_scale
from ...io.source import Window
from ...registration.camera.global_shift import known_shifts

# Deviation of the Gaussian average: as a share of the longer side of a frame, and in those of the blur of the frames.
_REACH, _REACH_BLURS = 0.045, 2.0
# Fewest frames of which a median says anything.
_FEWEST = 8
# Least deviation over time of the logarithm of g that is corrected, its percentile over the frame, and the share of the
# squared residual that g has to explain.
# Behind moving air, with walkers, snow, rain or noise, g explains up to six tenths of it.
_LEAST_CHANGE, _MOST_OF, _EXPLAINED = 0.03, 90, 0.8
# Largest shift of a static camera, pixels of the reduced frames, root mean square.
_STATIC = 1.0
# Gains are limited to this factor; what is added to r, as a share of its bright parts: dark ones count less.
_LARGEST, _DARK, _BRIGHT = 3.0, 0.03, 95
_ROUNDS = 3


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
    if len(frames) < _FEWEST or float(np.ptp(frames[0])) <= 0:
        return None, ()
    reference = np.median(frames, axis=0).astype(np.float32)
    dark = np.float32(_DARK * np.percentile(reference, _BRIGHT))
    reach = max(_REACH * max(reference.shape), _REACH_BLURS * blur)
    fields, explained = np.empty_like(frames), np.zeros(2)
    for field, frame in zip(fields, frames, strict=True):
        field[...], residuals = _field(frame + dark, reference + dark, reach)
        explained += residuals
    logarithms = np.log(fields)
    logarithms -= logarithms.mean(axis=0)
    change = float(np.percentile(logarithms.std(axis=0), _MOST_OF))
    if change < _LEAST_CHANGE or explained[1] > (1 - _EXPLAINED) * explained[0]:
        return None, ()
    shifts = known_shifts(frames / max(float(frames.std()), 1e-6))[0]
    if float(np.square(shifts - shifts.mean(axis=0)).sum(axis=1).mean()) > _STATIC**2:
        return None, ()
    gains = np.exp(logarithms).astype(np.float16)
    low, high = (float(value) for value in np.percentile(gains, (1, 99)))
    reason = f"in places the gain varies from {low:.2f} to {high:.2f}, as under shadows, clouds or lamps"
    decision = Decision("light", "light that changes in place evened out", reason)
    return Shade(dict(zip(numbers, gains, strict=True)), window), (decision,)


def _field(f: FloatArray, r: FloatArray, reach: float) -> tuple[FloatArray, NDArray[np.float64]]:
    """Return g of a frame, and the robust squared residuals of the reference without and with it."""
    weights, field = np.ones_like(f), np.ones_like(f)
    for _ in range(_ROUNDS):
        over, under = (cv2.GaussianBlur(weights * r * part, (0, 0), reach) for part in (f, r))
        known = under > 1e-9
        field = np.where(known, over / np.where(known, under, 1), 1).astype(np.float32)
        field = np.clip(field, 1 / _LARGEST, _LARGEST)
        residual = f - field * r
        weights = bisquare_weights(residual, robust_scale(residual), 1e-6).astype(np.float32) + 1e-3
    squares = [float((weights * part**2).sum()) for part in (f - r, residual)]
    return field, np.array(squares)

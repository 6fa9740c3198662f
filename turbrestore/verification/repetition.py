"""Repetition in an image: how far apart the copies of a pattern are that optical flow can mistake for each other.

Symbols
-------
w : window of the image, whose mean and slow trend are taken out
r(d) : autocorrelation of w at the lag d, 1 at zero

A pattern that repeats with the period p has r(p) near 1, and where it moves by p / 2 or more, the nearest copy is as
near as the pattern itself.  The median of p over the windows with repetition counts, if half of those with detail have
one: a fence within a scene is held in place by what is around it.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance

# Side of the windows, pixels: three periods of the longest that is looked for, 24 pixels, chosen.
_SIDE = 72
# Autocorrelation from which a pattern repeats; it falls by a third over a lag of a third of the window.  At 0.35, a
# fence within a scene does.
_ALIKE = 0.5
# Windows with detail have at least this share of the largest variance, chosen.
_DETAIL = 0.1


def repetition(image: FloatArray) -> float:
    """Return the period of the pattern that an image (H, W[, 3]) consists of, pixels, or infinity where it has none."""
    grey = luminance(image)
    side = min(_SIDE, *grey.shape)
    grey = grey - cv2.GaussianBlur(grey, (0, 0), side / 4)
    tops, lefts = (np.linspace(0, length - side, -(-length // side)).round().astype(int) for length in grey.shape)
    windows = [grey[y : y + side, x : x + side] for y in tops for x in lefts]
    least = max(_DETAIL * float(max(window.var() for window in windows)), 1e-8)
    periods = np.array([_period(window) for window in windows if window.var() > least])
    found = periods[np.isfinite(periods)]
    return float(np.median(found)) if 2 * found.size > periods.size else np.inf


def _period(window: FloatArray) -> float:
    """Shortest lag at which the autocorrelation of a window has a peak."""
    side, most = len(window), len(window) // 3
    power = np.square(np.abs(np.fft.rfft2(window - window.mean(), (2 * side, 2 * side))))
    whole = np.fft.fftshift(np.fft.irfft2(power))[side - most : side + most + 1, side - most : side + most + 1]
    r = np.float32(whole / whole[most, most])
    peaks = (r == cv2.dilate(r, np.ones((3, 3), np.uint8))) & (r > _ALIKE)
    rows, columns = np.nonzero(peaks[1:-1, 1:-1])
    lags = np.hypot(rows + 1 - most, columns + 1 - most)
    return float(lags[lags > 2].min(initial=np.inf))

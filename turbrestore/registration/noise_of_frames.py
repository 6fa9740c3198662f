"""Noise of frames that are registered: what each has beside their mean and beside what is in proportion to the scene.

It is noise in the sense of :mod:`turbrestore.core.noise_spectrum`: that of the sensor and the codec, smooth or not, and
texture that changes from frame to frame.  Flow that matches a frame with a reference matches such noise too, unless it
is told how strong it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.noise_spectrum import NoiseSpectrum, fit_noise_spectrum
from .warp import warp

# Frames that are looked at: their windows tell the spectrum to a few percent.
_FRAMES = 8


def noise_of_frames(frames: Sequence[FloatArray], flows: Sequence[FloatArray], mean: FloatArray) -> NoiseSpectrum:
    """Spectrum of the noise of a frame, from some frames (H, W[, 3]) registered by their flows (H, W, 2) and their mean.

    ``mean`` (H, W[, 3]).
    """
    grey, count = luminance(mean), len(frames)
    picked = np.unique(np.linspace(0, count - 1, min(count, _FRAMES)).round().astype(int))
    residuals = (luminance(warp(frames[number], flows[number])) - grey for number in picked)
    # The mean contains a part of the noise of each frame.
    return fit_noise_spectrum(residuals, grey).scaled(count / max(count - 1, 1))

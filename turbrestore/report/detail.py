"""How fine the detail is that a clip tells: signal beside noise at every frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import luminance
from ..core.noise_spectrum import RINGS, window_powers
from ..results import Restoration


@dataclass(frozen=True, eq=False)
class DetailSpectrum:
    """Powers of the filtered image by ``RINGS`` of frequencies, squared intensity."""

    frequencies: NDArray[np.float64]  # (rings,): cycles per pixel
    signal: NDArray[np.float64]  # (rings,): of the scene with its blur; 0 where noise explains all
    noise: NDArray[np.float64]  # (rings,)
    limit: float  # frequency from which on noise exceeds the signal, cycles per pixel


def detail_spectrum(restoration: Restoration) -> DetailSpectrum | None:
    """Return signal and noise of the filtered image, None unless its noise was measured."""
    if restoration.noise is None or restoration.filtered is None:
        return None
    grey = np.ascontiguousarray(luminance(restoration.filtered.image)[restoration.shown])
    # The mean of every window is taken out, and with it most of the lowest ring.
    noise = restoration.noise.power[1:]
    signal = np.maximum(window_powers(grey).mean(axis=0)[1:] - noise, 0)
    lost = np.flatnonzero(signal <= noise)
    frequencies = RINGS[1:]
    return DetailSpectrum(frequencies, signal, noise, float(frequencies[lost[0]] if lost.size else frequencies[-1]))

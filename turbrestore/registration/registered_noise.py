"""Noise of registered frames and of their mean, and the halves of a clip that tell the latter.

Symbols
-------
A, B : means of the registered frames of two halves; half their difference has the noise of the mean of all frames, and
    nothing of the scene
N : spectrum of noise (:mod:`turbrestore.core.noise_spectrum`)

The noise of a frame is what it has beside the mean of all, and beside what is in proportion to the scene: that of the
sensor and the codec, smooth or not, and texture that changes from frame to frame.  Flow that matches a frame with a
reference matches such noise too, unless it is told how strong it is.

A clip is halved twice: into every other frame, and into its beginning and its end.  Alternate frames differ by what is
new in every frame.  Beginning and end differ by that too, and by what lives for several frames: texture that renews
itself, waves, or a pattern of the sensor.  What only the second pair of halves shows is no noise of the camera, and no
part of the scene either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.noise_spectrum import NoiseSpectrum, fit_noise_spectrum
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead
from .recentring import recentre
from .warp import warp

# One after the other, or stacked.
Frames = Sequence[FloatArray] | FloatArray
# Frames whose noise is looked at: their windows tell the spectrum to a few percent.
_FRAMES = 8


def noise_of_frames(frames: Frames, flows: Frames, mean: FloatArray) -> NoiseSpectrum:
    """Spectrum of the noise of a frame, by frames (H, W[, 3]) registered by their flows (H, W, 2) and their mean.

    ``mean`` (H, W[, 3]).
    """
    grey, count = luminance(mean), len(frames)
    picked = np.unique(np.linspace(0, count - 1, min(count, _FRAMES)).round().astype(int))
    residuals = (luminance(warp(frames[number], flows[number])) - grey for number in picked)
    # The mean contains a part of the noise of each frame.
    return fit_noise_spectrum(residuals, grey).scaled(count / max(count - 1, 1))


@dataclass(frozen=True, eq=False)
class Halves:
    """Means of the registered frames of two halves of a clip, in the geometry of the result."""

    # (H, W) or (H, W, 3).
    first: FloatArray
    second: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Mean of both, (H, W) or (H, W, 3)."""
        return (self.first + self.second) / np.float32(2)

    def noise(self) -> NoiseSpectrum:
        """Spectrum of the noise of the luminance of the mean."""
        first, second = luminance(self.first), luminance(self.second)
        half = np.float32(0.5)
        return fit_noise_spectrum([half * (first - second)], half * (first + second))


@dataclass(frozen=True, eq=False)
class HalvedClip:
    """The two ways in which a clip is halved."""

    alternate: Halves
    lasting: Halves  # beginning and end
    count: int  # frames

    def recentred(self, mean_flow: FloatArray) -> HalvedClip:
        """Move all halves onto the mean geometry; ``mean_flow`` (H, W, 2)."""
        pairs = ((pair.first, pair.second) for pair in (self.alternate, self.lasting))
        moved = (Halves(*(recentre(half, mean_flow) for half in pair)) for pair in pairs)
        return HalvedClip(next(moved), next(moved), self.count)


def halve(
    frames: Iterable[FloatArray], flows: Iterable[FloatArray], shape: tuple[int, ...], count: int, threads: int = 0
) -> HalvedClip:
    """Average the registered frames of each half.

    ``frames`` (H, W) or (H, W, 3) each, ``count`` of them; ``flows`` (H, W, 2) each.
    """
    sums, counts = np.zeros((2, 2, *shape), np.float32), np.zeros((2, 2), np.float32)
    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    for number, (_, registered) in enumerate(map_ahead(lambda pair: warp(*pair), pairs, threads)):
        quarter = number % 2, 2 * number // count
        sums[quarter] += registered
        counts[quarter] += 1
    alternate, lasting = (Halves(*(sums.sum(axis=axis).T / np.maximum(counts.sum(axis=axis), 1)).T) for axis in (1, 0))
    return HalvedClip(alternate, lasting, count)


def halves_memory(shape: tuple[int, ...], threads: int) -> float:
    """Bytes that :func:`halve` takes for frames of (H, W) or (H, W, 3) pixels, its result among them."""
    values = float(np.prod(shape))
    # Four sums and four halves, and registered frames of which some wait in each thread; the flow and the frame read.
    return 4 * values * (8 + 2 * (threads + 1)) + 8.0 * shape[0] * shape[1]

"""Noise of registered frames and of their mean, and the halves of a clip that tell the latter.

Symbols
-------
A, B : means of the registered frames of two halves; half their difference has the noise of the mean of all frames, and
    nothing of the scene
N : spectrum of noise (:mod:`turbrestore.core.noise_spectrum`)
ρ : correlation of the noise from one frame to the next

The noise of a frame is what it has beside the mean of all, and beside what is in proportion to the scene: that of the
sensor and the codec, smooth or not, and texture that changes from frame to frame.  Flow that matches a frame with a
reference matches such noise too, unless it is told how strong it is.

A clip is halved three times: into every other frame, into every other pair of frames, and into its beginning and its
end.  Alternate frames differ by what is new in every frame.  Beginning and end differ by that too, and by what lives
for several frames: texture that renews itself, waves, or a pattern of the sensor.  What only they show is no noise of
the camera, and no part of the scene either.

Noise reduction over time and codecs make noise that is alike from frame to frame.  The mean then has more noise than
alternate frames tell.  They see the power of the noise over time at half a cycle a frame, alternate pairs see it at a
quarter, and the mean has that at zero.  For a first-order process, with σ² the variance in a frame, these are
``σ² (1 − ρ) / (1 + ρ)``, ``σ² (1 − ρ²) / (1 + ρ²)`` and ``σ² (1 + ρ) / (1 − ρ)``.  The ratio of the first two is
``1 + k`` with ``k = 2 ρ / (1 + ρ²)``, so they tell ρ, and the mean has ``((1 + ρ) / (1 − ρ))²`` times the first.  It
cannot have more than beginning and end differ by.  These alone would not do, because registration leaves slow
differences in clips of white noise: up to ten times its power at low frequencies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.noise_spectrum import RINGS, NoiseSpectrum, fit_noise_spectrum
from ..core.robust import spread
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead
from .recentring import recentre
from .warp import warp

# One after the other, or stacked.
Frames = Sequence[FloatArray] | FloatArray
# Frames whose noise is looked at: their windows tell the spectrum to a few percent.
_FRAMES = 8
# Fewest frames that hold two periods of alternate pairs, and rings on either side that tell ρ together, chosen: with
# four, a test of known ρ fails.
_FEWEST, _AROUND = 8, 2
# ρ up to which all is taken for noise, chosen: a recursion over time that keeps three fifths of the last frame.  From
# the second on nothing is: textures that live for a tenth of a clip of 40 frames have 0.78.
_LARGEST, _TEXTURE = 0.6, 0.8


def noise_of_frames(frames: Frames, flows: Frames, image: FloatArray, is_mean: bool = True) -> NoiseSpectrum:
    """Spectrum of the noise of a frame, by frames (H, W[, 3]) registered to an image by their flows (H, W, 2).

    ``image`` (H, W[, 3]) is the mean of the frames, or one of them.
    """
    grey, count = luminance(image), len(frames)
    picked = np.unique(spread(count, _FRAMES))
    residuals = (luminance(warp(frames[number], flows[number])) - grey for number in picked)
    # The mean contains a part of the noise of each frame; one frame has as much noise as the next.
    share = count / max(count - 1, 1) if is_mean else 0.5
    return fit_noise_spectrum(residuals, grey).scaled(share)


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
    """The ways in which a clip is halved, and what they tell."""

    alternate: Halves
    lasting: Halves  # beginning and end
    count: int  # frames
    noise: NoiseSpectrum  # of the luminance of the mean of all frames
    frame_noise: float  # variance of the noise of a frame, squared intensity
    beyond: float  # variance of the mean that lasts for longer than noise does, squared intensity

    def recentred(self, mean_flow: FloatArray) -> HalvedClip:
        """Move all halves onto the mean geometry; ``mean_flow`` (H, W, 2)."""
        pairs = ((pair.first, pair.second) for pair in (self.alternate, self.lasting))
        alternate, lasting = (Halves(*(recentre(half, mean_flow) for half in pair)) for pair in pairs)
        return replace(self, alternate=alternate, lasting=lasting)


def halve(
    frames: Iterable[FloatArray], flows: Iterable[FloatArray], shape: tuple[int, ...], count: int, threads: int = 0
) -> HalvedClip:
    """Average the registered frames of each half, and measure their noise.

    ``frames`` (H, W) or (H, W, 3) each, ``count`` of them; ``flows`` (H, W, 2) each.
    """
    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    registered = (one for _, one in map_ahead(lambda pair: warp(*pair), pairs, threads))
    (alternate, in_pairs, lasting), counts = _means_of_halves(registered, shape, count)
    new, last = alternate.noise(), lasting.noise()
    gain, share = np.ones(len(RINGS)), np.ones(len(RINGS))
    if count >= _FEWEST:
        # Halves of unequal size have more noise.
        uneven = (1 / counts[:2]).sum(axis=1)
        gain, share = _gain_of_mean(new, in_pairs.noise().scaled(uneven[0] / uneven[1]), last)
    # What is alike for longer than noise counts as noise of the mean, but does not explain how the scene changes.
    explained = 1 + share * (gain - 1)
    beyond = max(last.certain.deviation**2 - new.times(explained).deviation ** 2, 0.0)
    # Of a first-order process, the variance lies in the middle between what is new and what the mean has.
    frame_noise = count * new.times(np.sqrt(explained)).deviation ** 2
    return HalvedClip(alternate, lasting, count, new.times(gain), frame_noise, beyond)


def _means_of_halves(
    registered: Iterable[FloatArray], shape: tuple[int, ...], count: int
) -> tuple[list[Halves], NDArray[np.float64]]:
    """Halves by every other frame, by every other pair, and beginning and end; and the frames of each, (3, 2)."""
    # Arrays of their own, so that the pair that is not kept is freed.
    sums, counts = [[np.zeros(shape, np.float32) for _ in range(2)] for _ in range(3)], np.zeros((3, 2))
    for number, frame in enumerate(registered):
        for way, half in enumerate((number % 2, number // 2 % 2, 2 * number // count)):
            sums[way][half] += frame
            counts[way, half] += 1
    for total, size in zip(chain(*sums), np.maximum(counts, 1).ravel(), strict=True):
        np.divide(total, np.float32(size), out=total)
    return [Halves(*way) for way in sums], counts


def _gain_of_mean(
    new: NoiseSpectrum, in_pairs: NoiseSpectrum, lasting: NoiseSpectrum
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return, by ring, how many times the power of what is new the mean has, and the share of that which is noise."""
    ratio = in_pairs.power / new.power
    weights = 1 / np.maximum(np.square(in_pairs.error / in_pairs.power) + np.square(new.error / new.power), 1e-6)
    # The lowest rings repeat the third.
    weights[:2] = 0
    window = np.ones(2 * _AROUND + 1)
    total, average = (np.convolve(values, window, "same") for values in (weights, weights * ratio))
    average /= total
    error, k = average / np.sqrt(total), np.maximum(average - 1, ROUNDING)
    # Chance of two standard errors tells no correlation, and hardly lessens one that is clear.
    k *= np.maximum(1 - np.square(2 * error / k), 0)
    largest, texture = (2 * rho / (1 + rho**2) for rho in (_LARGEST, _TEXTURE))
    share, k = np.clip((texture - k) / (texture - largest), 0, 1), np.minimum(k, largest)
    rho = k / (1 + np.sqrt(1 - k**2))
    gain = np.minimum(np.square((1 + rho) / (1 - rho)), lasting.power / new.power)
    gain[:2] = gain[2]
    return np.maximum(gain, 1), share


def halves_memory(shape: tuple[int, ...], threads: int) -> float:
    """Bytes that :func:`halve` takes for frames of (H, W) or (H, W, 3) pixels, its result among them."""
    values = float(np.prod(shape))
    # Six halves, and registered frames of which some wait in each thread; the flow and the frame read.
    return 4 * values * (6 + 2 * (threads + 1)) + 8.0 * shape[0] * shape[1]


def kept_halves_memory(shape: tuple[int, ...]) -> float:
    """Bytes of a :class:`HalvedClip` for frames of (H, W) or (H, W, 3) pixels: its four means."""
    return 16 * float(np.prod(shape))

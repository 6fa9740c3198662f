"""The spectrum of the noise: how much of it there is at every spatial frequency.

Symbols
-------
d : difference of two images of one scene, such as a registered frame less the mean of all, or half the difference of
    the means of two halves of a clip
m : the scene, as the mean of the frames shows it
N : power spectrum of the noise of d, squared intensity; that of white noise of variance n² is n² at every frequency
e : share of the power of the scene by which d differs too, because the images are not registered exactly

In a window, the expected power spectra of d and m at a frequency are ``P_d = N + e P_m``.  Windows differ in P_m, so
they tell both: N is what flat ones have, e what those with detail have beyond it.  Both follow, for every ring of
frequencies, by least squares in which a window counts by the inverse of its variance, which is proportional to
(N + e P_m)².

A camera's noise reduction, a codec, a digital zoom, demosaicing, film grain and the interpolation of the registration
all make noise that is smooth: N falls with the frequency.  Differences of neighbouring pixels do not see such noise.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray

# Side of a window, pixels, and most windows along an axis, which bounds the time for large images; both chosen.
SIDE, _MOST_WINDOWS = 32, 16
# Centres of the rings, cycles per pixel.  The last one holds the corners too.
RINGS: NDArray[np.float64] = np.arange(SIDE // 2 + 1) / SIDE
# Of several differences the lower quartile counts, because some may show what the others do not.
_QUARTILE = 0.25
# Rounds of the weighted least squares, which settle within three or four.
_ROUNDS = 6
# Least power of noise, squared intensity: a hundredth of the rounding of 16 bits.
_LEAST = (0.1 / 65535) ** 2 / 12

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NoiseSpectrum:
    """Spectrum of the noise of an image, by ``RINGS`` of frequencies."""

    power: Float64Array  # (rings,): N, squared intensity
    error: Float64Array  # (rings,): its standard error
    relative: Float64Array  # (rings,): e, 0 to 1

    def at(self, frequency: NDArray[np.floating]) -> Float64Array:
        """N at some frequencies, cycles per pixel; beyond the last ring it stays the same."""
        return np.interp(frequency, RINGS, self.power)

    @property
    def certain(self) -> NoiseSpectrum:
        """N less two standard errors: hardly anything where a scene has no flat parts."""
        return NoiseSpectrum(np.maximum(self.power - 2 * self.error, _LEAST), self.error, self.relative)

    def scaled(self, factor: float) -> NoiseSpectrum:
        """Return the spectrum of the same noise with its variance multiplied; e is a ratio, and stays."""
        return self.times(np.full_like(self.power, factor))

    def times(self, factors: Float64Array) -> NoiseSpectrum:
        """Return the spectrum with the variance of every ring multiplied by a factor of its own (rings,)."""
        return NoiseSpectrum(self.power * factors, self.error * factors, self.relative)

    @property
    def deviation(self) -> float:
        """Standard deviation of a pixel, intensity."""
        nu = np.fft.fftfreq(SIDE)
        return float(np.sqrt(self.at(np.hypot(nu[:, None], nu)).mean()))


def white_noise(deviation: float) -> NoiseSpectrum:
    """Return the spectrum of white noise of a known standard deviation."""
    nothing = np.zeros_like(RINGS)
    return NoiseSpectrum(np.full_like(RINGS, max(deviation**2, _LEAST)), nothing, nothing)


def fit_noise_spectrum(differences: Iterable[FloatArray], scene: FloatArray) -> NoiseSpectrum:
    """Fit N and e to differences, each (H, W), of images of one scene (H, W); see the docstring of the module."""
    of_scene = window_powers(scene)
    powers = [window_powers(difference) for difference in differences]
    usual = np.quantile(np.array(powers), _QUARTILE, axis=0) / _quartile_of_noise(len(powers))
    found = np.array([_fit_ring(ring, m) for ring, m in zip(usual.T, of_scene.T, strict=True)])
    # The mean of each window is taken out, and what changes as slowly as windows are wide is light.
    found[:2] = found[2]
    return NoiseSpectrum(*np.maximum(found.T, [[_LEAST], [0.0], [0.0]]))


@functools.cache
def _quartile_of_noise(count: int) -> Float64Array:
    """Lower quartile of the power of white noise in ``count`` windows, relative to its mean, by ring (rings,)."""
    if count == 1:
        return np.ones_like(RINGS)
    white = np.random.default_rng(0).standard_normal((count, 8 * SIDE, 8 * SIDE), np.float32)
    powers = np.array([window_powers(image) for image in white])
    return np.quantile(powers, _QUARTILE, axis=0).mean(axis=0) / powers.mean(axis=(0, 1))


def window_powers(image: FloatArray) -> Float64Array:
    """Power spectra of windows spread evenly over an image (H, W), by ring, (windows, rings), squared intensity."""
    side = min(SIDE, *image.shape)
    profile = np.hanning(side + 2)[1:-1].astype(np.float32)
    profile = np.outer(profile, profile)
    starts = (_starts(length, side) for length in image.shape)
    every = np.lib.stride_tricks.sliding_window_view(image, (side, side))[np.ix_(*starts)].reshape(-1, side, side)
    tapered = ((every - every.mean(axis=(1, 2), keepdims=True)) * profile).astype(np.float32, copy=False)
    # NumPy computes in single precision only where it divides by the size.
    spectra = np.fft.rfft2(tapered, norm="forward")
    power = np.square(np.abs(spectra)).reshape(len(tapered), -1) * (side**4 / np.square(profile).sum())
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    ring = np.minimum(np.rint(frequency * SIDE), SIDE // 2).astype(int).ravel()
    # All columns but the first and, of an even number, the last stand for two.
    times = np.full(frequency.shape, 2.0)
    times[:, 0] = 1
    times[:, -1] = 1 + side % 2
    sums = np.zeros((ring.size, len(RINGS)))
    sums[np.arange(ring.size), ring] = times.ravel()
    present = np.flatnonzero(sums.any(axis=0))
    means = power @ (sums / np.maximum(sums.sum(axis=0), 1))[:, present]
    # Small images have no frequencies in some rings.
    return np.array([np.interp(RINGS, RINGS[present], row) for row in means])


def _starts(length: int, side: int) -> NDArray[np.int_]:
    """First pixels of windows that overlap by half, or that lie further apart along a long axis."""
    count = min(_MOST_WINDOWS, 1 + round(2 * (length - side) / side))
    return np.linspace(0, length - side, count).round().astype(int)


def _fit_ring(difference: Float64Array, scene: Float64Array) -> tuple[float, float, float]:
    """N, its standard error and e from the powers of a ring in every window."""
    # Windows without detail, of which there are usually some, start the rounds.
    noise, relative, spread = float(np.median(difference)), 0.0, 0.0
    weights = np.ones_like(difference)
    for _ in range(_ROUNDS):
        weights = 1 / np.square(noise + relative * scene + _LEAST)
        one, by_scene, by_square = weights.sum(), (weights * scene).sum(), (weights * scene**2).sum()
        of_noise, of_both = (weights * difference).sum(), (weights * scene * difference).sum()
        determinant = one * by_square - by_scene**2
        noise, relative, spread = of_noise / one, 0.0, 1 / one
        if determinant > 1e-9 * one * by_square:
            noise, spread = (by_square * of_noise - by_scene * of_both) / determinant, by_square / determinant
            relative = (one * of_both - by_scene * of_noise) / determinant
        if noise < 0:
            noise, relative = 0.0, of_both / by_square
        elif relative < 0:
            noise, relative = of_noise / one, 0.0
    residual = np.sqrt(weights) * (difference - noise - relative * scene)
    # One or two windows fit any line, and tell no error.
    left = len(difference) - 2
    error = np.sqrt(np.square(residual).sum() / left * spread) if left > 0 else noise
    return float(noise), float(error), float(min(relative, 1.0))

"""Blur of every frame of a sequence, tile by tile, relative to the other frames: which frames are sharp, and where.

Symbols
-------
P_t, P̄ : power spectra of frame t and of the reference, squared intensity.
k : frequency, radians per pixel.
s : relative blur variance of a frame, squared pixels: ``log(P_t / P̄) = −s k²``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_frames, luminance
from ..runtime.scratch import iter_frames
from .tile_spectra import (
    CORRELATED,
    LARGEST_EXPONENT,
    LARGEST_STEP,
    NEWTON_STEPS,
    CueParams,
    Float64Array,
    TileGrid,
    TileSpectra,
    fit_weights,
    noise_floor,
)

# Prior standard deviation of the relative blur variance of a frame, squared pixels.
_PRIOR = 2.0
# Rounds that fit the frames to the reference and the reference to the frames.
_ROUNDS = 3
# Limits of the factor by which rings that fit worse than expected count less.
_SMALLEST_MISFIT, _LARGEST_MISFIT = 0.3, 100.0
# Number of spectra fitted together, all frames of some tiles; with 16 rings the fit takes 150 MB.
_FITTED = 1 << 16
# Relative error of the correction for the window.
_WINDOW_ERROR = 0.05


@dataclass(frozen=True, eq=False)
class FrameBlur:
    """Blur variance of every frame in every tile, relative to the other frames."""

    relative: FloatArray  # (T, m, n): s, squared pixels; the mean over the frames is 0
    # (T, m, n): standard deviation of ``relative``; 2 squared pixels, that of the prior, where a tile has no structure.
    deviation: FloatArray
    # (T, m, n): best estimate of s above that of the sharpest frame, at least 0: ``relative`` shrunk towards 0 as far
    # as noise explains it, minus its minimum over the frames.
    extra: FloatArray
    grid: TileGrid  # positions of the tiles


def frame_blur(frames: ArrayLike, noise: float, params: CueParams | None = None) -> FrameBlur:
    """Blur of every frame in every tile, relative to the other frames: ``log(P_t / P̄) = −s_t k²``.

    Spectra are averaged over rings.  The reference P̄ starts as the mean over the frames.  A mean of Gaussians of
    different widths is not a Gaussian, so P̄ is then refitted as the spectrum of which the frames are blurred versions.
    A shift does not change a power spectrum, so the frames need not be registered as long as the content of a tile
    stays in it.  Where other structure moves in and out, errors reach three times the deviation.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity.  Interpolation smooths noise, so for registered
        frames this is an upper bound at high frequency.
    params : CueParams, optional

    Returns
    -------
    FrameBlur

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (48, 48)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> frames = np.stack([cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414, 1.0)])
    >>> frame_blur(frames, noise=1e-4).extra.ravel().astype(float).round(1).tolist()
    [0.0, 1.0, 0.0]
    """
    params = params or CueParams()
    stack = check_frames(frames, at_least=2)
    spectra = TileSpectra.of(stack.shape[1:3], params)
    averaging, k2, counts = spectra.cells()
    fit = _Fit(spectra, k2, counts, noise_floor(noise), params)
    # (T, tiles, rings); float32 halves what stays in memory.
    power = np.stack([spectra.power(luminance(frame)) @ averaging for frame in iter_frames(stack)])
    spectrum, misfit = _common_spectrum(power, fit)
    design = fit.design(spectrum)
    parts = [_blur_of_tiles(power[:, some], spectrum[some], misfit[some], design, fit) for some in _batches(power)]
    shape = (len(stack), len(spectra.grid.rows), len(spectra.grid.columns))
    joined = (np.concatenate(of_tiles, axis=1) for of_tiles in zip(*parts, strict=True))
    relative, deviation, extra = (part.reshape(shape).astype(np.float32) for part in joined)
    return FrameBlur(relative, deviation, extra, spectra.grid)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Constants of the fits: k² of the rings, the number of independent values in each, and n."""

    spectra: TileSpectra
    k2: Float64Array
    counts: Float64Array
    floor: float
    params: CueParams

    def design(self, spectrum: Float64Array) -> Float64Array:
        """k² changed by the smear of the window, for the mean of all tiles, shape (rings,)."""
        return self.k2 * self.spectra.widening(2 * [spectrum.mean(axis=0)], self.k2)


def _batches(power: FloatArray) -> list[slice]:
    """Tiles to fit together: a fit takes 36 times the memory of their power in rings."""
    tiles = max(_FITTED // len(power), 1)
    return [slice(start, start + tiles) for start in range(0, power.shape[1], tiles)]


def _common_spectrum(power: FloatArray, fit: _Fit) -> tuple[Float64Array, Float64Array]:
    """Spectrum of which the frames are blurred versions, and misfit of each ring, from power (T, tiles, rings)."""
    reference = np.maximum(power.mean(axis=0, dtype=np.float64) - fit.floor, 0.0)
    s, misfit = np.zeros(power.shape[:2]), np.ones(power.shape[1:])
    for _ in range(_ROUNDS - 1):
        design = fit.design(reference)
        for some in _batches(power):
            known = reference[some], misfit[some]
            s[:, some], reference[some], misfit[some] = _refit(power[:, some], *known, design, s[:, some], fit)
    return reference, misfit


def _refit(
    power: FloatArray, reference: Float64Array, misfit: Float64Array, design: Float64Array, s: Float64Array, fit: _Fit
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit the frames to the reference, then the reference to the frames, in some tiles: s, reference and misfit."""
    signal = power.astype(np.float64) - fit.floor
    s, _, residual = _fit_relative(signal, reference, design, s, misfit, fit)
    # The slope of the logarithm of a spectrum, and therefore the smear by the window, depends on s itself.
    s = s + 2 * fit.spectra.smear * s**2
    s -= s.mean(axis=0)
    decay = np.exp(-np.clip(s[..., None] * design, -LARGEST_EXPONENT, LARGEST_EXPONENT))
    refitted = np.maximum((signal * decay).sum(axis=0) / (decay**2).sum(axis=0), 0.0)
    return s, refitted, np.clip(misfit * residual.mean(axis=0), _SMALLEST_MISFIT, _LARGEST_MISFIT)


def _blur_of_tiles(
    power: FloatArray, spectrum: Float64Array, misfit: Float64Array, design: Float64Array, fit: _Fit
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Values s of the frames in some tiles, their deviation, and the best estimate above the sharpest; (T, tiles)."""
    s, signal = np.zeros(power.shape[:2]), power.astype(np.float64) - fit.floor
    for _ in range(2):
        s, information, residual = _fit_relative(signal, spectrum, design, s, misfit, fit)
    s = s + 2 * fit.spectra.smear * s**2
    s -= s.mean(axis=0)
    # The deviation of s from the information in the rings and the mean squared residual of each.
    gathered = information * design**2
    total = gathered.sum(axis=-1) + 1 / _PRIOR**2
    leverage = gathered / total[..., None]
    squared = (residual / np.maximum(1 - leverage, 0.1)).mean(axis=0)
    variance = (CORRELATED * (gathered * np.maximum(squared, 1.0)).sum(axis=-1) + 1 / _PRIOR**2) / total**2
    deviation = np.hypot(np.sqrt(variance), _WINDOW_ERROR * s)
    # The posterior mean, with the variance of s over the frames beyond that of its error as that of the prior.
    spread = np.maximum((s**2 - deviation**2).mean(axis=0), 0.0)
    estimate = s * spread / np.maximum(spread + deviation**2, 1e-30)
    return s, deviation, estimate - estimate.min(axis=0)


def _fit_relative(
    power: Float64Array, reference: Float64Array, design: Float64Array, s: Float64Array, misfit: Float64Array, fit: _Fit
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit s, shape (T, tiles), of frames to a reference with much less noise; q = s · design.

    Returns s, shrunk towards 0 by the prior, the information about q, and the squared residual in units of the expected
    one, both of shape (T, tiles, rings).
    """
    for _ in range(NEWTON_STEPS // 2):
        q = np.clip(s[..., None] * design, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        grown, shrunk = power * np.exp(q / 2), reference * np.exp(-q / 2)
        weight, signal = fit_weights((grown, shrunk, q), (fit.floor, 0.0), fit.counts, 1.0, fit.params)
        weight = weight / misfit
        difference, information = shrunk - grown, weight * signal
        step = ((weight * difference) @ design - s / _PRIOR**2) / (information @ design**2 + 1 / _PRIOR**2)
        s = s + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    return s, information, difference**2 * weight / signal

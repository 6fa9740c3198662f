"""Blur of every frame of a sequence, tile by tile, relative to the other frames: which of them are lucky, and where.

Symbols
-------
P_t, P̄ : power spectra of frame t and of what the frames have in common, squared intensity.
k : frequency, radians per pixel.
s : relative blur variance of a frame, squared pixels: ``log(P_t / P̄) = −s k²``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_frames, luminance
from ..core.errors import DataError
from ..runtime.scratch import iter_frames
from .exponent_fit import LARGEST_EXPONENT, PRIOR, fit_relative
from .tile_spectra import CORRELATED, CueParams, Float64Array, TileGrid, TileSpectra, noise_floor

# Relative blur variance of frames in some tiles, its deviation, and its best estimate above the sharpest; (T, tiles).
_Judged = tuple[Float64Array, Float64Array, Float64Array]
# Rounds of frames against reference, reference from frames.
_ROUNDS = 3
# Rings that fit worse than expected count less, within these limits.
_SMALLEST_MISFIT, _LARGEST_MISFIT = 0.3, 100.0
# Spectra, of all frames in some tiles, that are fitted together; with 16 rings that takes 150 MB.
_FITTED = 1 << 16
# Share of s by which the correction for the window may be wrong.
_WINDOW_ERROR = 0.05


@dataclass(frozen=True, eq=False)
class FrameBlur:
    """Blur variance of every frame in every tile, relative to the other frames.

    Attributes
    ----------
    relative : ndarray, float32, shape (T, m, n)
        s, squared pixels; the mean over the frames is 0.
    deviation : ndarray, float32, shape (T, m, n)
        Standard deviation of ``relative``; 2 squared pixels, what is assumed beforehand, where nothing is to be seen.
    extra : ndarray, float32, shape (T, m, n)
        Best estimate of s above that of the sharpest frame, at least 0: ``relative`` drawn to 0 as far as noise
        explains it, less its minimum over the frames.
    grid : TileGrid
    """

    relative: FloatArray
    deviation: FloatArray
    extra: FloatArray
    grid: TileGrid


@dataclass(frozen=True, eq=False)
class BlurReference:
    """What the frames of a sequence have in common, so that other frames of it can be held against them.

    Attributes
    ----------
    spectrum : ndarray, float64, shape (tiles, rings)
        P̄ above the noise, squared intensity.
    misfit : ndarray, float64, shape (tiles, rings)
        Factor on the expected squared error of each ring, by which the fit weighs it less.
    size : ndarray, float64, shape (tiles, rings)
        Mean squared residual of each ring, in units of what is expected.
    offset : ndarray, float64, shape (tiles,)
        Mean of s before it is made 0, squared pixels.
    spread : ndarray, float64, shape (tiles,)
        Variance of s over the frames that noise does not explain, pixels to the fourth.
    least : ndarray, float64, shape (tiles,)
        Best estimate of s of the sharpest frame, squared pixels.
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    shape : tuple of int
        Height and width of a frame, pixels.
    params : CueParams
    """

    spectrum: Float64Array
    misfit: Float64Array
    size: Float64Array
    offset: Float64Array
    spread: Float64Array
    least: Float64Array
    noise: float
    shape: tuple[int, int]
    params: CueParams


def frame_blur(frames: ArrayLike, noise: float, params: CueParams | None = None) -> FrameBlur:
    """Blur of every frame in every tile, relative to the other frames: ``log(P_t / P̄) = −s_t k²``.

    Spectra are averaged over rings. The reference P̄ starts as the mean over the frames; as a mean of Gaussians of
    different widths is none, it is then refitted as the spectrum of which the frames are blurred versions. Motion
    does not change a spectrum, so the frames need not be registered, as long as what a tile shows stays in it; where
    structure of another kind moves in and out, errors are up to three times the deviation.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity. Interpolation smooths noise: for registered
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
    return refer_blur(frames, noise, params)[1]


def refer_blur(frames: ArrayLike, noise: float, params: CueParams | None = None) -> tuple[BlurReference, FrameBlur]:
    """Blur of every frame, as :func:`frame_blur` gives it, and the reference that other frames are held against.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    params : CueParams, optional

    Returns
    -------
    reference : BlurReference
    blur : FrameBlur

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    See :func:`blur_against`.
    """
    params = params or CueParams()
    stack = check_frames(frames, at_least=2)
    spectra = TileSpectra.of(stack.shape[1:3], params)
    averaging, k2, counts = spectra.cells()
    fit = _Fit(spectra, k2, counts, noise_floor(noise), params)
    power = _ring_power(stack, spectra, averaging)
    spectrum, misfit = _common_spectrum(power, fit)
    design = fit.design(spectrum)
    own = [_own_scores(power[:, some], spectrum[some], misfit[some], design, fit) for some in _batches(power)]
    size, offset, spread, least = (np.concatenate(parts) for parts in zip(*(scores for scores, _ in own), strict=True))
    reference = BlurReference(spectrum, misfit, size, offset, spread, least, noise, spectra.grid.shape, params)
    return reference, _frame_blur([found for _, found in own], spectra.grid)


def blur_against(frames: ArrayLike, reference: BlurReference, noise: float | None = None) -> FrameBlur:
    """Blur of frames, or of an image fused from them, relative to the frames of a reference.

    Each is judged by itself, so that frames can come one by one.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Of the same scene.
    reference : BlurReference
        From :func:`refer_blur`.
    noise : float, optional
        Standard deviation of the white noise of these frames, intensity; by default that of the reference.

    Returns
    -------
    FrameBlur
        ``relative`` to the mean of the frames of the reference, ``extra`` above the sharpest of them, at least 0.

    Raises
    ------
    DataError
        Frames of another size than those of the reference.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (48, 48)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> frames = np.stack([cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414, 1.0)])
    >>> reference, _ = refer_blur(frames, noise=1e-4)
    >>> soft = cv2.GaussianBlur(scene, (0, 0), 1.225)
    >>> blur_against(soft[None], reference).extra.ravel().astype(float).round(1).tolist()
    [0.5]
    """
    stack = check_frames(frames)
    if stack.shape[1:3] != reference.shape:
        raise DataError(f"frames: expected the size {reference.shape} of the reference, found {stack.shape[1:3]}")
    spectra = TileSpectra.of(reference.shape, reference.params)
    averaging, k2, counts = spectra.cells()
    floor = noise_floor(reference.noise if noise is None else noise)
    fit = _Fit(spectra, k2, counts, floor, reference.params)
    power, design = _ring_power(stack, spectra, averaging), fit.design(reference.spectrum)
    judged: list[_Judged] = []
    for some in _batches(power):
        s, gathered, _ = _score(power[:, some], reference.spectrum[some], reference.misfit[some], design, fit)
        s = s - reference.offset[some]
        deviation = _deviation(s, gathered, reference.size[some])
        estimate = _posterior(s, deviation, reference.spread[some])
        judged.append((s, deviation, np.maximum(estimate - reference.least[some], 0.0)))
    return _frame_blur(judged, spectra.grid)


@dataclass(frozen=True, eq=False)
class _Fit:
    """What spectra are fitted with: k² of the rings, how many independent values each holds, and n."""

    spectra: TileSpectra
    k2: Float64Array
    counts: Float64Array
    floor: float
    params: CueParams

    def design(self, spectrum: Float64Array) -> Float64Array:
        """k² as the window shows it in the mean of all tiles, shape (rings,)."""
        return self.k2 * self.spectra.widening(2 * [spectrum.mean(axis=0)], self.k2)


def _ring_power(frames: FloatArray, spectra: TileSpectra, averaging: FloatArray) -> FloatArray:
    """Power of frames in rings, shape (T, tiles, rings)."""
    tiles = len(spectra.grid.rows) * len(spectra.grid.columns)
    power = np.empty((len(frames), tiles, averaging.shape[1]), np.float32)
    for frame, found in zip(iter_frames(frames), power, strict=True):
        np.matmul(spectra.power(luminance(frame)), averaging, out=found)
    return power


def _batches(power: FloatArray) -> list[slice]:
    """Tiles that are fitted together, for a fit takes 36 times what their power in rings takes."""
    tiles = max(_FITTED // len(power), 1)
    return [slice(start, start + tiles) for start in range(0, power.shape[1], tiles)]


def _common_spectrum(power: FloatArray, fit: _Fit) -> tuple[Float64Array, Float64Array]:
    """Spectrum that the frames are blurred versions of, and misfit of each ring, from power (T, tiles, rings)."""
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
    """One round over some tiles: frames against reference, reference from frames; s, reference and misfit."""
    signal = power.astype(np.float64) - fit.floor
    s, _, residual = fit_relative(signal, reference, fit.floor, design, fit.counts, s, misfit, fit.params)
    # The slope of the logarithm of a spectrum, and with it the smear by the window, depends on s itself.
    s = s + 2 * fit.spectra.smear * s**2
    s -= s.mean(axis=0)
    decay = np.exp(-np.clip(s[..., None] * design, -LARGEST_EXPONENT, LARGEST_EXPONENT))
    refitted = np.maximum((signal * decay).sum(axis=0) / (decay**2).sum(axis=0), 0.0)
    return s, refitted, np.clip(misfit * residual.mean(axis=0), _SMALLEST_MISFIT, _LARGEST_MISFIT)


def _own_scores(
    power: FloatArray, spectrum: Float64Array, misfit: Float64Array, design: Float64Array, fit: _Fit
) -> tuple[tuple[Float64Array, Float64Array, Float64Array, Float64Array], _Judged]:
    """Judge the frames of the reference in some tiles: its size, offset, spread and least, and their blur."""
    s, gathered, residual = _score(power, spectrum, misfit, design, fit)
    size, offset = residual.mean(axis=0), s.mean(axis=0)
    s = s - offset
    deviation = _deviation(s, gathered, size)
    spread = np.maximum((s**2 - deviation**2).mean(axis=0), 0.0)
    estimate = _posterior(s, deviation, spread)
    least = estimate.min(axis=0)
    return (size, offset, spread, least), (s, deviation, estimate - least)


def _score(
    power: FloatArray, spectrum: Float64Array, misfit: Float64Array, design: Float64Array, fit: _Fit
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit s, shape (T, tiles), to a known spectrum; also information about s and squared residual of every ring."""
    s, signal = np.zeros(power.shape[:2]), power.astype(np.float64) - fit.floor
    for _ in range(2):
        s, information, residual = fit_relative(signal, spectrum, fit.floor, design, fit.counts, s, misfit, fit.params)
    gathered = information * design**2
    leverage = gathered / (gathered.sum(axis=-1, keepdims=True) + 1 / PRIOR**2)
    return s + 2 * fit.spectra.smear * s**2, gathered, residual / np.maximum(1 - leverage, 0.1)


def _deviation(s: Float64Array, gathered: Float64Array, size: Float64Array) -> Float64Array:
    """Combine what rings say of s, and the mean squared residual of each, to the standard deviation of s."""
    total = gathered.sum(axis=-1) + 1 / PRIOR**2
    variance = (CORRELATED * (gathered * np.maximum(size, 1.0)).sum(axis=-1) + 1 / PRIOR**2) / total**2
    return np.hypot(np.sqrt(variance), _WINDOW_ERROR * s)


def _posterior(s: Float64Array, deviation: Float64Array, spread: Float64Array) -> Float64Array:
    """Posterior mean of s, whose variance over the frames, ``spread``, is what noise does not explain."""
    return s * spread / np.maximum(spread + deviation**2, 1e-30)


def _frame_blur(judged: list[_Judged], grid: TileGrid) -> FrameBlur:
    """Join what is said of tiles that were fitted together."""
    shape = (-1, len(grid.rows), len(grid.columns))
    joined = (np.concatenate(parts, axis=1) for parts in zip(*judged, strict=True))
    relative, deviation, extra = (part.reshape(shape).astype(np.float32) for part in joined)
    return FrameBlur(relative, deviation, extra, grid)

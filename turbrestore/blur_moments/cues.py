"""Cues from blur: how much wider one image is blurred than another, read from spectra without knowing the scene.

A temporal mean is one long exposure of an integrative sensor (papers 1 and 2), and second moments of blur add:
``cov(blur of the mean) = cov(blur of a frame) + cov(displacement)``.  At low frequency the spectra of two images of one
scene differ by ``−log(P₁ / P₂) = kᵀ(Σ₁ − Σ₂)k``, for any scene and any displacement between them.

Symbols
-------
P₁, P₂ : power spectra of two images, tile by tile; n₁, n₂ : their noise floors, squared intensity.
k : frequency, radians per pixel.
Σ : covariance of a blur (its central second moment), squared pixels.
D : Σ₁ − Σ₂; q = kᵀDk, the exponent.

The papers observe moments of a known point or edge.  Here the scene is unknown, and the equations are those of the
logarithm of the transfer function, whose second derivatives at 0 are the second moments of the blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_frames, check_grey, luminance
from ..core.errors import DataError
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

# Directions that are distinguished in the spectrum of a tile.
_SECTORS = 6
# Tiles whose spectra are fitted together.
_BATCH = 4096
# An estimate of larger variance, pixels to the fourth, is reported as no estimate.
_NO_ESTIMATE = 100.0


@dataclass(frozen=True, eq=False)
class RelativeBlur:
    """How much wider the first of two images is blurred than the second; negative where it is sharper."""

    # Σ₁ − Σ₂ per axis if it is the same in all directions, and its standard deviation, squared pixels. If it is not,
    # directions with more structure count more, and ``matrix`` should be used.
    variance: float
    deviation: float
    # (2, 2): Σ₁ − Σ₂ with axes (x, y), and the standard deviation of each entry, squared pixels.
    matrix: Float64Array
    matrix_deviation: Float64Array
    # (m, n): the same for every tile; 0 with an infinite deviation where the tile has no structure.
    tile_variance: Float64Array
    tile_deviation: Float64Array
    # (m, n, 2, 2): the same for every tile.
    tile_matrix: Float64Array
    tile_matrix_deviation: Float64Array
    grid: TileGrid  # positions of the tiles


def relative_blur(
    first: ArrayLike, second: ArrayLike, noise: float | tuple[float, float], params: CueParams | None = None
) -> RelativeBlur:
    """Difference of the second moments of the blurs of two images of one scene.

    ``−log(P₁ / P₂) = kᵀ(Σ₁ − Σ₂)k`` is fitted by weighted least squares to windowed tiles, each tile alone and all
    together.  The fit compares ``(P₁ − n₁) e^{q/2}`` with ``(P₂ − n₂) e^{−q/2}``, so no logarithm is taken of noise and
    the estimate has no bias at low signal.  Weights follow from the noise floors, from ``params.misfit`` and, where the
    exponent q is large, from ``params.departure``, because only the low frequencies of a blur depend on its second
    moment alone.  The smear of a spectrum by the window, which makes differences look smaller (5 % for σ = 1 and 1.5 in
    tiles of 48 pixels), is corrected to first order.  The deviations are estimated from the residuals.

    Parameters
    ----------
    first, second : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float or tuple of two floats
        Standard deviation of the white noise in both images, or in each, intensity.
    params : CueParams, optional

    Returns
    -------
    RelativeBlur

    Raises
    ------
    DataError
        Shapes do not agree, or an image is smaller than 16 pixels.
    ConfigurationError
        A noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (128, 128)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> soft, softer = (cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414))
    >>> blur = relative_blur(softer, soft, noise=1e-4)
    >>> round(blur.variance, 1), np.abs(blur.matrix).round(1).tolist()
    (1.0, [[1.0, 0.0], [0.0, 1.0]])
    """
    params = params or CueParams()
    one, two = (check_grey(image, name) for image, name in ((first, "first"), (second, "second")))
    if one.shape != two.shape:
        raise DataError(f"second: expected the shape of first {one.shape}, found {two.shape}")
    noises = noise if isinstance(noise, tuple) else (noise, noise)
    spectra = TileSpectra.of(one.shape, params)
    return _compare(spectra.power(one), spectra.power(two), noises, spectra, params)


def displacement_variance(frames: ArrayLike, noise: float, params: CueParams | None = None) -> RelativeBlur:
    """Covariance of the displacement over a sequence, from the blur of its temporal mean against its frames.

    ``cov(blur of the mean) = cov(blur of a frame) + cov(displacement)``: the spectrum of the mean, P₁, is compared
    with the mean of the spectra, P₂.  The mean of T independent frames retains a share P₂/T of the power for any
    displacement, which is subtracted from P₁; the result is the variance about the mean with divisor T − 1.  Changes of
    blur from frame to frame have little effect; rotation and scaling within a tile are not measured.  The deviations
    describe the fit of the spectra, not how well T frames represent others.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    params : CueParams, optional
        By default tiles of 64 pixels and a departure of 1, because the displacements of few frames are far from
        Gaussian, and those of 2 pixels leave power at the lowest frequencies only.

    Returns
    -------
    RelativeBlur
        ``matrix`` is the covariance of (dx, dy), ``variance`` the mean of their variances.

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (128, 128)).cumsum(0).cumsum(1) % 1
    >>> scene = cv2.GaussianBlur(scene, (0, 0), 1.5)
    >>> shifts = [-2, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2]
    >>> frames = np.stack([np.roll(scene, shift, axis=1) for shift in 3 * shifts])
    >>> np.abs(displacement_variance(frames, noise=1e-4).matrix).round().tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    params = params or CueParams(tile=64, departure=1.0)
    stack = check_frames(frames, at_least=2)
    count = len(stack)
    spectra = TileSpectra.of(stack.shape[1:3], params)
    mean, power = np.zeros(stack.shape[1:3]), np.zeros(1)
    for frame in iter_frames(stack):
        grey = luminance(frame)
        mean += grey / np.float64(count)
        power = power + spectra.power(grey) / np.float64(count)
    # This also subtracts the noise of the mean, n²/T.
    coherent = (spectra.power(mean.astype(np.float32)) - power / count) / (1 - 1 / count)
    return _compare(coherent, power, (0.0, noise), spectra, params)


def _compare(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    noises: tuple[float, float],
    spectra: TileSpectra,
    params: CueParams,
) -> RelativeBlur:
    """Fit the spectra of tiles, shape (tiles, frequencies), one by one and pooled."""
    floors = (noise_floor(noises[0]), noise_floor(noises[1]))
    averaging, k2, _ = spectra.cells()
    one, two = (power.mean(axis=0, keepdims=True) for power in (first, second))
    factor = spectra.widening([(power[0] @ averaging) - n for power, n in zip((one, two), floors, strict=True)], k2)
    kx, ky = spectra.kx, spectra.ky
    spread = factor @ (averaging.T > 0)
    full = np.stack([kx**2, 2 * kx * ky, ky**2], axis=1) * spread[:, None]
    isotropic = ((kx**2 + ky**2) * spread)[:, None]
    # Edges carry no information about blur along them, so the signal is estimated in each direction separately.
    sectors = spectra.cells(_SECTORS)[0]
    shape = (len(spectra.grid.rows), len(spectra.grid.columns))
    variance, deviation = _fit_difference(one, two, floors, isotropic, averaging, len(first), params)
    matrix, matrix_deviation = _fit_difference(one, two, floors, full, sectors, len(first), params)
    tiles, tile_deviation = _fit_tiles(first, second, floors, isotropic, averaging, params)
    matrices, matrix_deviations = _fit_tiles(first, second, floors, full, sectors, params)
    return RelativeBlur(
        variance=float(variance[0, 0]),
        deviation=float(deviation[0, 0]),
        matrix=_symmetric(matrix)[0],
        matrix_deviation=_symmetric(matrix_deviation)[0],
        tile_variance=tiles.reshape(shape),
        tile_deviation=tile_deviation.reshape(shape),
        tile_matrix=_symmetric(matrices).reshape(*shape, 2, 2),
        tile_matrix_deviation=_symmetric(matrix_deviations).reshape(*shape, 2, 2),
        grid=spectra.grid,
    )


def _fit_tiles(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    floors: tuple[float, float],
    design: Float64Array,
    averaging: FloatArray,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Fit the spectrum of each tile, some thousands at a time, because fits take many times the memory of spectra."""
    batches = [slice(start, start + _BATCH) for start in range(0, len(first), _BATCH)]
    fits = [_fit_difference(first[some], second[some], floors, design, averaging, 1, params) for some in batches]
    found, deviation = (np.concatenate(parts) for parts in zip(*fits, strict=True))
    return found, deviation


def _symmetric(entries: Float64Array) -> Float64Array:
    """(…, 3) as xx, xy, yy to (…, 2, 2)."""
    return entries[..., [[0, 1], [1, 2]]]


def _fit_difference(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    floors: tuple[float, float],
    design: Float64Array,
    averaging: FloatArray,
    tiles: int,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Fit D, shape (..., p), to spectra P₁ and P₂, shape (..., f), that are means over ``tiles``; also its deviation.

    ``design``, shape (f, p), holds the squared frequencies, q = design · D.  The signal is taken to be constant within
    the cells of ``averaging``, shape (f, cells).
    """
    one, two = first.astype(np.float64) - floors[0], second.astype(np.float64) - floors[1]
    D = np.zeros((*first.shape[:-1], design.shape[1]))
    spread = (averaging.T > 0).astype(np.float64)
    cell_size = np.maximum(spread.sum(axis=1) / CORRELATED**2, 1.0)
    averaging = averaging.astype(np.float64)
    products = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
    square = (*D.shape, design.shape[1])
    for _ in range(NEWTON_STEPS):
        q = np.clip(D @ design.T, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        growth = np.exp(q / 2)
        grown, shrunk = one * growth, two / growth
        cells = (grown @ averaging, shrunk @ averaging, q @ averaging)
        weight, signal = (part @ spread for part in fit_weights(cells, floors, tiles, cell_size, params))
        information = ((weight * signal) @ products).reshape(square) + 1e-9 * np.eye(design.shape[1])
        pull = weight * (shrunk - grown)
        step = np.linalg.solve(information, (pull @ design)[..., None])[..., 0]
        D = D + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    scatter = (pull**2 @ products).reshape(square)
    inverse = np.linalg.inv(information)
    # The scatter of few values is itself uncertain, and the expected one rests on assumptions: take half of each.
    cov = CORRELATED**2 * (inverse @ scatter @ inverse + inverse) / 2
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    known = variances < _NO_ESTIMATE
    return np.where(known, D, 0.0), np.where(known, np.sqrt(variances), np.inf)

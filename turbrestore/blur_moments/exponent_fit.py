"""Weighted least squares fits of the exponent by which the spectra of two images of one scene differ.

Symbols
-------
P₁, P₂ : power spectra of two images; n₁, n₂ : their noise floors, squared intensity.
P_t, P̄ : spectrum of frame t, and the one it is held against.
D : difference of the covariances of two blurs, squared pixels; s : the same for a frame and one number per tile.
q : exponent, ``−log(P₁ / P₂) = q = kᵀDk``.

Both sides are multiplied out, ``(P₁ − n₁) e^{q/2} = (P₂ − n₂) e^{−q/2}``, so that noise does not go through the
logarithm.  In the code the two sides are ``grown`` and ``shrunk``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from .tile_spectra import CORRELATED, CueParams, Float64Array

# Newton steps, and squared pixels that each may go.
_STEPS, _LARGEST_STEP = 12, 4.0
# Exponents beyond this say "blurred away" and no more.
LARGEST_EXPONENT = 8.0
# Variance of an estimate, pixels to the fourth, from which on nothing is seen.
_NOTHING_SEEN = 100.0
# What is known of a frame before it is seen: standard deviation of its relative blur variance, squared pixels.
PRIOR = 2.0


def fit_difference(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    floors: tuple[float, float],
    design: Float64Array,
    averaging: FloatArray,
    tiles: int,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Difference of the blurs of two images from their spectra, neither known better than the other.

    Parameters
    ----------
    first, second : ndarray, shape (..., f)
        P₁ and P₂ with their noise, squared intensity.
    floors : tuple of two floats
        n₁ and n₂.
    design : ndarray, float64, shape (f, p)
        Frequencies squared, so that q = design · D.
    averaging : ndarray, float32, shape (f, cells)
        Cells over which a signal is taken to be the same, from ``TileSpectra.cells``.
    tiles : int
        Over how many tiles the spectra are means.
    params : CueParams

    Returns
    -------
    D, deviation : ndarray, float64, shape (..., p)
        Squared pixels; 0 with an infinite deviation where nothing is to be seen.

    Examples
    --------
    >>> import numpy as np
    >>> k2 = np.linspace(0.02, 2, 100)
    >>> soft, softer = np.ones((1, 100)), np.exp(-0.5 * k2)[None]
    >>> cells = np.eye(100, dtype=np.float32)
    >>> fit_difference(softer, soft, (1e-6, 1e-6), k2[:, None], cells, 1, CueParams())[0].round(3).tolist()
    [[0.5]]
    """
    one, two = first.astype(np.float64) - floors[0], second.astype(np.float64) - floors[1]
    D = np.zeros((*first.shape[:-1], design.shape[1]))
    spread = (averaging.T > 0).astype(np.float64)
    cell_size = np.maximum(spread.sum(axis=1) / CORRELATED**2, 1.0)
    for _ in range(_STEPS):
        q = np.clip(D @ design.T, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        grown, shrunk = one * np.exp(q / 2), two * np.exp(-q / 2)
        cells = (grown @ averaging, shrunk @ averaging, q @ averaging)
        weight, signal = (part @ spread for part in _weight(cells, floors, tiles, cell_size, params))
        information = np.einsum("...b,bi,bj->...ij", weight * signal, design, design)
        information += 1e-9 * np.eye(design.shape[1])
        pull = weight * (shrunk - grown)
        step = np.linalg.solve(information, (pull @ design)[..., None])[..., 0]
        D = D + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    scatter = np.einsum("...b,bi,bj->...ij", pull**2, design, design)
    inverse = np.linalg.inv(information)
    # The scatter of few values is itself uncertain, what is expected rests on assumptions: half of each.
    cov = CORRELATED**2 * (inverse @ scatter @ inverse + inverse) / 2
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    seen = variances < _NOTHING_SEEN
    return np.where(seen, D, 0.0), np.where(seen, np.sqrt(variances), np.inf)


def fit_relative(
    power: Float64Array,
    reference: Float64Array,
    floor: float,
    design: Float64Array,
    counts: Float64Array,
    s: Float64Array,
    misfit: Float64Array,
    params: CueParams,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Relative blur variance of frames from their spectra and one that is known much better than theirs.

    The signal is therefore taken from the reference alone.

    Parameters
    ----------
    power : ndarray, float64, shape (T, tiles, rings)
        P_t above the noise, squared intensity.
    reference : ndarray, float64, shape (tiles, rings)
        P̄ above the noise.
    floor : float
        n of a frame.
    design : ndarray, float64, shape (rings,)
        k² as the window shows it, q = s · design.
    counts : ndarray, float64, shape (rings,)
        How many independent values a ring holds.
    s : ndarray, float64, shape (T, tiles)
        Where to start from, squared pixels.
    misfit : ndarray, float64, shape (tiles, rings)
        Factor on the expected squared error of each ring.
    params : CueParams

    Returns
    -------
    s : ndarray, float64, shape (T, tiles)
        Squared pixels, drawn to 0 by ``PRIOR``.
    information : ndarray, float64, shape (T, tiles, rings)
        About q.
    residual : ndarray, float64, shape (T, tiles, rings)
        Squared, in units of what is expected.

    Examples
    --------
    >>> import numpy as np
    >>> k2 = np.linspace(0.02, 2, 20)
    >>> one, power = np.ones((1, 20)), np.exp([[-0.5 * k2], [0.5 * k2]])
    >>> fit_relative(power, one, 1e-6, k2, np.full(20, 50.0), np.zeros((2, 1)), one, CueParams())[0].round(2).tolist()
    [[0.5], [-0.5]]
    """
    for _ in range(_STEPS // 2):
        q = np.clip(s[..., None] * design, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        grown, shrunk = power * np.exp(q / 2), reference * np.exp(-q / 2)
        weight, signal = _weight((grown, shrunk, q), (floor, 0.0), counts, 1.0, params)
        weight = weight / misfit
        difference, information = shrunk - grown, weight * signal
        step = ((weight * difference) @ design - s / PRIOR**2) / (information @ design**2 + 1 / PRIOR**2)
        s = s + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    return s, information, difference**2 * weight / signal


def _weight(
    cells: tuple[Float64Array, Float64Array, Float64Array],
    floors: tuple[float, float],
    repeats: float | Float64Array,
    cell_size: float | Float64Array,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Weight of ``grown − shrunk`` in a fit of q, given all three, and the signal, common to both.

    The weight is the inverse variance of ``log grown − log shrunk`` over the signal. Values are means over
    ``repeats`` independent ones, and the cells over ``cell_size`` such values.
    """
    grown, shrunk, q = cells
    noise_one, noise_two = floors[0] * np.exp(q / 2), floors[1] * np.exp(-q / 2)
    # The image with less noise shows the signal better.
    share = (noise_two + 1e-30) / (noise_one + noise_two + 2e-30)
    error = np.hypot(share * noise_one, (1 - share) * noise_two) / np.sqrt(repeats * cell_size)
    # A cell of noise shows some signal by chance.
    signal = np.maximum(share * grown + (1 - share) * shrunk - 2 * error, 1e-15)
    noise = 2 * signal * (noise_one + noise_two) + noise_one**2 + noise_two**2
    variance = (params.misfit**2 * signal**2 + noise) / repeats + (params.departure * q**2 * signal) ** 2
    return signal / variance, signal

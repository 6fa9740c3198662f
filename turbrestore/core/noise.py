"""Estimation of the noise of an image, and of how it depends on the level."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import ROUNDING, FloatArray, check_grey

# Rows that are filtered at once, and pixels that tell the noise to a quarter of a percent.
_NOISE_ROWS, _NOISE_PIXELS = 16, 1 << 18
# Levels at which a curve of the noise is known at most, fewest pixels for one of them, and share of these pixels, the
# flattest, in each of two groups; all chosen.
_LEVELS, _PIXELS, _FLATTEST = 12, 200, 0.2
# Noise is that of photons if the curve has so many levels, a line leaves no more than this share of what it varies by,
# and it is so many times larger where it is bright; all chosen.
_FEWEST_LEVELS, _STRAIGHT, _PHOTONS = 5, 0.5, 4.0
# Share of the steepest slope of a sum of squares below which a slope is rounding: some thousand times that of float64.
_LEAST_GRADIENT = 1e-12


@dataclass(frozen=True, eq=False)
class NoiseCurve:
    """Variance of the noise against the level: the photon transfer curve of a recording.

    It is affine for raw frames, whose light comes in photons, and of any form after a tone curve.
    """

    levels: NDArray[np.float64]  # (K,): ascending intensities
    # (K,): squared intensity; between the levels the variance is linear, and constant beyond them.
    variances: NDArray[np.float64]

    def variance(self, image: FloatArray) -> FloatArray:
        """Return the variance of the noise at every pixel of an image, shape (H, W)."""
        return np.interp(image, self.levels, self.variances).astype(np.float32)


def fit_noise_curve(level: FloatArray, variance: FloatArray, energy: FloatArray) -> NoiseCurve:
    """Fit the variance of the noise against the level to registered frames.

    Frames that are not registered exactly vary by the squared gradient times the variance of the displacement, which is
    one number for the image, and by noise. The flattest pixels of every level tell both.
    ``level`` (H, W); ``variance`` (H, W); ``energy`` (H, W).
    """
    flat = tuple(np.asarray(part, np.float64).ravel() for part in (level, variance, energy))
    levels, _, energies = flat
    count = int(np.clip(levels.size // _PIXELS, 1, _LEVELS))
    low, high = np.percentile(levels, (1, 99))
    # Of equal width, because a dark sky would else take all of them.
    edges = np.linspace(low, max(high, low + ROUNDING), count + 1)
    numbers = np.clip(np.searchsorted(edges, levels) - 1, 0, count - 1)
    groups = []
    for number in range(count):
        chosen = np.flatnonzero(numbers == number)
        if chosen.size < min(_PIXELS, levels.size):
            continue
        size = max(int(_FLATTEST * chosen.size), 1)
        chosen = chosen[np.argpartition(energies[chosen], min(2 * size, chosen.size - 1))]
        ordered = chosen[: 2 * size][np.argsort(energies[chosen[: 2 * size]])]
        groups.append([[part[pixels].mean() for part in flat] for pixels in (ordered[:size], ordered[size:])])
    if not groups:
        return NoiseCurve(np.array([0.0]), np.array([flat[1].mean()]))
    found = np.array(groups)  # (K, 2, 3)
    known = found[:, :, 0].mean(axis=1)
    design = np.zeros((2 * len(found), len(found) + 1))
    design[np.arange(2 * len(found)), np.repeat(np.arange(len(found)), 2)] = 1
    scale = float(found[..., 2].max()) or 1.0
    design[:, -1] = found[..., 2].ravel() / scale
    variances, _ = nonnegative_least_squares(design, found[..., 1].ravel())
    return NoiseCurve(known, variances[:-1])


def photon_noise(first: FloatArray, second: FloatArray) -> NoiseCurve | None:
    """Fit the noise of the mean of two images of one scene, relative to its average, as that of photons.

    Its variance is a line that rises with the level.  None where it does not, or hardly: registration and codecs leave
    differences too, but most at the middle levels.
    ``first``, ``second`` (H, W).
    """
    half = np.float32(0.5)
    level = np.asarray(cv2.GaussianBlur(half * (first + second), (0, 0), 1.0), np.float32)
    slope = cv2.Sobel(level, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(level, cv2.CV_32F, 0, 1) ** 2
    energy = np.asarray(cv2.GaussianBlur(slope, (0, 0), 2.0), np.float32)
    found = fit_noise_curve(level, (half * (first - second)) ** 2, energy)
    if len(found.levels) < _FEWEST_LEVELS:
        return None
    above = found.levels - float(level.min())
    line, residual = nonnegative_least_squares(np.stack([np.ones_like(above), above], axis=1), found.variances)
    variances = line[0] + line[1] * above
    spread = float(np.linalg.norm(found.variances - found.variances.mean()))
    if residual > _STRAIGHT * spread or variances[-1] < _PHOTONS * max(variances[0], ROUNDING**2):
        return None
    curve = NoiseCurve(found.levels, variances)
    return NoiseCurve(found.levels, variances / float(curve.variance(level).mean()))


def nonnegative_least_squares(
    design: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Minimise ``‖A x − b‖`` over ``x ≥ 0`` by active sets (Lawson and Hanson 1974); return x and the least norm.

    SciPy has the same, but takes longer to import than a small clip to restore.
    ``design`` (m, n) is A, ``values`` (m,) is b.
    """
    x, free = np.zeros(design.shape[1]), np.zeros(design.shape[1], bool)
    gradient = design.T @ values
    tolerance = _LEAST_GRADIENT * float(np.abs(gradient).max())
    # As many turns as SciPy takes at most: rounding may let one unknown come and go.
    for _ in range(3 * len(x)):
        if not (gradient[~free] > tolerance).any():
            break
        free[np.argmax(np.where(free, -np.inf, gradient))] = True
        while True:
            found = np.zeros_like(x)
            found[free] = np.linalg.lstsq(design[:, free], values, rcond=None)[0]
            falling = free & (found <= 0)
            if not falling.any():
                break
            # Go towards it until the first unknown is zero.
            shares = np.where(falling, x, np.inf) / np.where(falling, x - found, 1)
            first = int(np.argmin(shares))
            x += shares[first] * (found - x)
            free &= x > 0
            free[first] = False
        x = found
        gradient = design.T @ (values - design @ x)
    return x, float(np.linalg.norm(design @ x - values))


def estimate_noise(image: ArrayLike) -> float:
    """Estimate the standard deviation of the noise from the median of |second differences in x and y|.

    The mask ``[1 −2 1]ᵀ[1 −2 1] / 6`` (Immerkær 1996) keeps the deviation of white noise and cancels planes; the
    median, unlike the mean, is insensitive to edges. A fused image has smoother noise than a frame, because
    registration interpolates; its low frequencies contain more noise than this estimate.  Of a large image, strips of
    rows all over it are used.
    ``image`` (H, W) or (H, W, 3).
    """
    grey = check_grey(image)
    if min(grey.shape) < 3:
        return 0.0
    mask, (height, width) = np.array([1, -2, 1], np.float32), grey.shape
    step = _NOISE_ROWS * max((height - 2) * (width - 2) // _NOISE_PIXELS, 1)
    strips = (grey[top : top + _NOISE_ROWS + 2] for top in range(0, height - 2, step))
    filtered = [cv2.sepFilter2D(strip, cv2.CV_32F, mask, mask)[1:-1, 1:-1].ravel() for strip in strips]
    sizes = np.abs(np.concatenate(filtered))
    half = sizes.size // 2
    # One pivot, where np.median takes three.
    sizes.partition(half)
    low = sizes[half] if sizes.size % 2 else sizes[:half].max()
    return float((low + sizes[half]) / 2 / (6 * 0.6745))

"""Displacement of blocks of pixels over a clip, and its statistics.

Symbols
-------
ρ : image that the frames are registered to; I_t : frame; W_t : flow to it, pixels; T : number of frames.
g : mean of the gradients of ρ and of the registered frame.  M : Σ g gᵀ over a block.
w_t : displacement of a block in frame t, pixels, less its mean over time.  u_t : w_t less its mean over the blocks.
b : side of the window over which w is the mean, pixels.
σ² : variance of the noise of a frame.  c(k), ρ(k) : autocovariance and autocorrelation at a lag of k frames.
V : variance of u per axis.  N, ν : independent frames, and degrees of freedom of V.

Method
------
A smooth flow is smaller than the motion where the image has little structure.  Therefore the displacement of a block is
solved from the registered frame, with the flow as the point of linearisation:
``w = M⁻¹ Σ g (ρ − I∘(id + W) + gᵀW)`` (Lucas and Kanade 1981).  On synthetic clips the slope of w over the true
displacement is 0.97 to 1.01.  A block counts if M makes the error from the residual small against the displacement.

* w is a mean weighted by |g|², so b follows from the second moment of these weights within the blocks: b²/12.
* The mean over time takes the variance m of the mean of T correlated values away: ``ĉ(k) = c(k) − m`` with
  ``m = (1/T) Σ_|k|<T (1 − |k|/T) c(k)``.  Both equations are solved together; c is taken to end at its first zero.
* Noise adds at most ``σ² tr M⁻¹ / 2`` to the variance of a block; this is taken out.  Where it is as large as the
  gradients it adds less, because it is in g too.
* T frames are worth ``N = T / (1 + 2 Σ (1 − k/T) ρ(k)²)`` independent ones for a variance.  The blocks of a frame are
  worth ``d = (tr S)² / tr S²`` independent values, S their covariance, whose sample value is lower by 1/d + 1/N.
  ν V / E[V] has a χ² distribution with ν = d N degrees of freedom.

The correlation time is that of the measured displacements and not of the identified dynamics: a transition matrix
fitted to few frames, with nearly as many states, has eigenvalues that repeat the frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.errors import DataError
from ..core.gradient import sobel_gradient
from ..registration.warp import warp
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead

Float64Array = NDArray[np.float64]

# Blocks along the shorter side of a frame, and the smallest side of a block, pixels; both chosen.
_BLOCKS, _SMALLEST = 8, 6
# Largest variance of the error of a block that counts, as a share of the variance of the displacement, and the fewest
# such blocks; both chosen.
_LARGEST_ERROR = 0.05
_LEAST_BLOCKS = 4
# Fewest frames whose displacement has a variance about its mean that says anything.
LEAST_FRAMES = 3
# Largest lag at which the autocovariance is used, as a share of the clip, chosen.
_LARGEST_LAG = 0.5
# Each leaves at most 3/4 of the error of m, as c reaches over half of the clip: together 0.3 %.
_SOLVING_STEPS = 20
# Fewest independent frames of a long clip, and correlation from frame to frame above which motion is slow; both chosen.
_LEAST_INDEPENDENT, _PERSISTENT = 10, 0.5


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacement of the blocks of a clip."""

    blocks: Float64Array  # (T, m, n, 2): w, pixels
    counts: NDArray[np.bool_]  # (m, n): which blocks have enough structure
    spacing: int  # distance of neighbouring blocks, pixels
    window: float  # b, pixels
    # What noise adds at most to the variance of w, mean over the blocks that count, squared pixels.
    noise_variance: float


@dataclass(frozen=True, eq=False)
class MotionStatistics:
    """Variance of displacements, and how well it is known."""

    variance: Float64Array  # (2,): along x and y over a long time, without noise, squared pixels
    freedom: float  # ν of the mean of both
    independent_frames: float  # N
    # (K,): ρ(k) for k = 0, 1, …, up to its first zero, or to the largest lag that is used.
    autocorrelation: Float64Array

    @property
    def slow(self) -> bool:
        """Whether the clip spans few correlation times, so that its mean takes away what cannot be put back."""
        persistent = len(self.autocorrelation) > 1 and self.autocorrelation[1] > _PERSISTENT
        return bool(persistent and self.independent_frames < _LEAST_INDEPENDENT)


@dataclass(frozen=True, eq=False)
class ClipMotion:
    """Displacement of the blocks of a clip, and its statistics."""

    displacement: Displacement
    statistics: MotionStatistics
    rotation: float  # as rotation_share gives it
    correlation: Float64Array  # (S,): as separation_correlation gives it


def measure_motion(
    frames: Iterable[FloatArray], flows: Iterable[FloatArray], image: FloatArray, noise: float, threads: int = 0
) -> ClipMotion | None:
    """Measure the motion of a clip; None where too few blocks have enough structure.

    ``frames`` (H, W) or (H, W, 3) each; ``flows`` (H, W, 2) each; ``image`` (H, W) or (H, W, 3).
    """
    found = block_displacement(frames, flows, image, noise, threads)
    if found.counts.sum() < _LEAST_BLOCKS:
        return None
    statistics = motion_statistics(found.blocks[:, found.counts], found.noise_variance)
    return ClipMotion(found, statistics, rotation_share(found), separation_correlation(found))


def block_displacement(
    frames: Iterable[FloatArray], flows: Iterable[FloatArray], image: FloatArray, noise: float, threads: int = 0
) -> Displacement:
    """Measure the displacement of blocks.

    ``frames`` (H, W) or (H, W, 3) each; ``flows`` (H, W, 2) each; ``image`` (H, W) or (H, W, 3).
    """
    grey = luminance(image)
    ix, iy = sobel_gradient(grey)
    side = max(min(grey.shape) // _BLOCKS, _SMALLEST)

    def solve(pair: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        frame, flow = pair
        registered = warp(luminance(frame), flow)
        gx, gy = ((one + other) / 2 for one, other in zip(sobel_gradient(registered), (ix, iy), strict=True))
        residual = grey - registered
        target = residual + gx * flow[..., 0] + gy * flow[..., 1]
        xx, xy, yy, bx, by = (
            block_means(plane, side) for plane in (gx * gx, gx * gy, gy * gy, gx * target, gy * target)
        )
        determinant = np.maximum(xx * yy - xy**2, ROUNDING**2)
        moved = np.stack([yy * bx - xy * by, xx * by - xy * bx], axis=-1) / determinant[..., None]
        return moved, block_means(residual**2, side)

    solved = [
        result for _, result in map_ahead(solve, zip(iter_frames(frames), iter_frames(flows), strict=True), threads)
    ]
    if len(solved) < LEAST_FRAMES:
        raise DataError(f"frames: expected at least {LEAST_FRAMES}, found {len(solved)}")
    w = np.array([moved for moved, _ in solved], np.float64)
    w -= w.mean(axis=0)
    xx, xy, yy = (block_means(plane, side).astype(np.float64) for plane in (ix * ix, ix * iy, iy * iy))
    smallest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    error = np.mean([square for _, square in solved], axis=0) / np.maximum(smallest * side**2, ROUNDING**2)
    counts = error < _LARGEST_ERROR * np.median(w.var(axis=0).mean(axis=-1))
    inverse_trace = (xx + yy) / np.maximum(xx * yy - xy**2, ROUNDING**2) / side**2
    added = float(noise**2 * np.mean(inverse_trace[counts]) / 2) if counts.any() else np.inf
    return Displacement(w, counts, side, _window(ix**2 + iy**2, side, counts), added)


def motion_statistics(w: Float64Array, noise_variance: float) -> MotionStatistics:
    """Variance of displacements over a long time, and its degrees of freedom.

    ``w`` (T, K, 2).
    """
    frames = len(w)
    flat = w.reshape(frames, -1)
    largest = max(int(_LARGEST_LAG * frames), 1)
    found = np.array([np.mean(flat[k:] * flat[: frames - k]) for k in range(largest)])
    share = (1 - np.arange(largest) / frames) * np.where(np.arange(largest) == 0, 1, 2)
    taken, true, end = 0.0, found, largest
    for _ in range(_SOLVING_STEPS):
        true = found + taken
        ends = np.flatnonzero(true <= 0)
        end = int(ends[0]) if ends.size else largest
        taken = float(share[:end] @ true[:end]) / frames
    correlation = true[:end] / true[0] if true[0] > 0 else np.ones(1)
    if 0 < end < largest:
        correlation = np.append(correlation, 0.0)
    independent = frames / float(1 + share[1 : len(correlation)] @ correlation[1:] ** 2)
    measured = np.mean(w**2, axis=(0, 1))
    variance = np.maximum(measured * true[0] / max(found[0], ROUNDING**2) - noise_variance, 0.01 * measured)
    return MotionStatistics(variance, independent * _independent_values(flat, independent), independent, correlation)


def rotation_share(displacement: Displacement) -> float:
    """Share of rotation in the gradient of the displacement.

    Tilt is the gradient of a phase, and has no rotation; fields whose components are independent have 0.5.
    """
    w, counts = displacement.blocks, displacement.counts
    four = counts[1:, 1:] & counts[1:, :-1] & counts[:-1, 1:] & counts[:-1, :-1]
    right, down = np.diff(w, axis=2), np.diff(w, axis=1)
    x, y = (right[:, 1:] + right[:, :-1])[:, four], (down[:, :, 1:] + down[:, :, :-1])[:, four]
    curl, divergence = np.sum((x[..., 1] - y[..., 0]) ** 2), np.sum((x[..., 0] + y[..., 1]) ** 2)
    total = float(curl + divergence)
    return float(curl) / total if total > 0 else float("nan")


def separation_correlation(displacement: Displacement) -> Float64Array:
    """Correlation of the displacements of blocks that count, 0, 1, … blocks apart along a row or a column.

    Returns (S,).
    """
    w, counts = displacement.blocks, displacement.counts
    known = np.where(counts[..., None], w, np.nan)
    variance = max(float(np.nanmean(known**2)), ROUNDING**2) if counts.any() else 1.0
    rows, columns = counts.shape
    found = []
    for k in range(min(rows, columns)):
        products = [known[:, k:] * known[:, : rows - k], known[:, :, k:] * known[:, :, : columns - k]]
        values = np.concatenate([part[np.isfinite(part)] for part in products])
        found.append(values.mean() / variance if values.size else np.nan)
    return np.array(found)


def block_means(plane: NDArray[np.floating], side: int) -> FloatArray:
    """Means over square blocks in the middle of a plane.

    ``plane`` (H, W); returns (H // side, W // side).
    """
    rows, columns = plane.shape[0] // side, plane.shape[1] // side
    top, left = (plane.shape[0] - rows * side) // 2, (plane.shape[1] - columns * side) // 2
    inside = plane[top : top + rows * side, left : left + columns * side]
    return cv2.resize(np.ascontiguousarray(inside, np.float32), (columns, rows), interpolation=cv2.INTER_AREA)


def _window(energy: FloatArray, side: int, counts: NDArray[np.bool_]) -> float:
    """Side of the square whose second moment is that of the weights within the blocks."""
    if not counts.any():
        return float(side)
    variance = 0.0
    total = np.maximum(block_means(energy, side).astype(np.float64), ROUNDING**2)
    for axis in range(2):
        # Counted from the middle, where single precision is best.
        place = (np.indices(energy.shape)[axis] - energy.shape[axis] / 2).astype(np.float32)
        first, second = (block_means(energy * place**power, side) / total for power in (1, 2))
        variance += float(np.mean((second - first**2)[counts])) / 2
    return float(np.sqrt(12 * max(variance, 1 / 12)))


def _independent_values(flat: Float64Array, independent: float) -> float:
    """d, from the covariance of the values of a frame; the smaller Gram matrix has the same traces."""
    gram = flat @ flat.T if len(flat) < flat.shape[1] else flat.T @ flat
    trace, square = float(np.trace(gram)), float(np.sum(gram**2))
    if trace <= 0:
        return 1.0
    return 1 / max(square / trace**2 - 1 / independent, 1 / flat.shape[1])

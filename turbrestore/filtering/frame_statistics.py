"""Temporal statistics of the first block of registered frames, from which Z of every frame follows.

Symbols
-------
Z₀ : variance of a registered frame about the image before sharpness is taken into account (paper 3, eq. 15)
κ : what the window of the sharpness leaves out, see :func:`turbrestore.filtering.frame_noise.local_sharpness`

All frames are warped twice: for mean and variance, and again to leave out what deviates.  Some are warped once more,
for a median, which moving objects do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.noise import fit_noise_curve
from ..core.noise_spectrum import NoiseSpectrum
from ..core.robust import MEDIAN_DEVIATION, MEDIAN_OF, MEDIAN_ROWS
from ..core.robust import spread as spread_over
from ..registration.registered_noise import noise_of_frames
from ..registration.warp import warp
from ..runtime.fourier import irfft2, rfft2
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead, sum_in_threads
from .frame_noise import (
    AGREEMENT_WINDOW,
    LEVEL_WINDOW,
    OUTLIER,
    OUTLIER_WINDOW,
    SHARPNESS_WINDOW,
    FrameStatistics,
    gradient,
    project_gradient,
    smooth,
    squared_deviation,
)

# Smallest variance, so that noise-free synthetic data keep every gain defined: (1/4096 of full scale)².
_IMAGE_NOISE_FLOOR = 6e-8
# Sharpness that differs by less than this share, chosen, does not justify averaging fewer frames.
_LEAST_SPREAD = 0.03
# Share of the mean variance by which every pixel varies at least, chosen.
_LEAST_DEVIATION = 0.1
# How many times the variance exceeds its robust estimate where an object has moved, chosen.
_HEAVY_TAIL = 4.0
# Variance of a Sobel derivative (divided by 8) of white noise of unit variance, and the pixels over which such
# derivatives correlate: the sum of their squared correlations, 2.9.
_SOBEL_NOISE, _SOBEL_AREA = 12 / 64, 3.0
# κ of pure noise: a Gaussian window g_{s/2} is four times as high in the middle as g_s, so that the window
# (g_s − κ g_{s/2}) / (1 − κ) is zero there, and the noise of a pixel does not count.  Least share of noise for which a
# window without its middle is better: clean clips, which have less, lose 0.2 dB by it.
_MIDDLE, _LEAST_SHARE = 0.25, 0.15
# Rings of the highest frequencies, chosen: where scenes have little, and noise is told best.
_HIGHEST = 4


@dataclass(frozen=True, eq=False)
class _SharpnessMoments:
    """Means over the frames of the local sharpness in the whole window and in its middle, variances and covariance."""

    whole: np.ndarray
    middle: np.ndarray
    whole_spread: np.ndarray
    middle_spread: np.ndarray
    joint: np.ndarray


def measure_frame_statistics(
    frames: Sequence[FloatArray],
    flows: Sequence[FloatArray],
    image: FloatArray,
    image_noise: float | None = None,
    threads: int = 0,
) -> FrameStatistics:
    """Temporal statistics of frames registered by their flows.

    ``frames`` (H, W) or (H, W, 3) each; ``flows`` (H, W, 2) each; ``image`` (H, W) or (H, W, 3).
    """
    template = np.stack(gradient(luminance(image)))

    def add(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[np.ndarray, ...]:
        sums = tuple(np.zeros(image.shape[:2]) for _ in range(2))
        for frame, flow in pairs:
            _add_moments(luminance(warp(frame, flow)), *sums)
        return *sums, np.array(float(len(pairs)))

    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    total, squares, number = sum_in_threads(add, pairs, threads)
    count = float(number)
    mean, variance = _mean_and_variance(total, squares, count)
    variance *= count / max(count - 1, 1)
    centre, usual, fine = _median_and_spread(frames, flows, mean.shape, int(count), threads)
    mean, variance, covered = _robust_start(mean, variance, centre, usual)

    square = template[0] ** 2 + template[1] ** 2
    energy = smooth(square, SHARPNESS_WINDOW)
    sensor_noise = fit_noise_curve(mean, np.where(covered, variance, fine), energy).variance(mean)
    mean_frame, deviation, moments = _without_outliers(frames, flows, mean, variance, template, threads)
    noise = noise_of_frames(frames, flows, mean_frame)
    coloured = _coloured(template, noise)
    sharpness, spread, explained, left_out = _leave_middle_out(moments, coloured, sensor_noise)
    # Where a scene without noise is flat, the square of the scale exceeds single precision.
    scale = _score_scale(sharpness, spread, explained)
    # Near a moving object the flow follows it, and a frame may be sharp without showing the scene.
    scale *= 1 - smooth(covered.astype(np.float32), SHARPNESS_WINDOW)
    return FrameStatistics(
        frame_noise=noise.deviation,
        image_noise=max(float(variance.mean()) if image_noise is None else image_noise, _IMAGE_NOISE_FLOOR),
        template=template,
        template_energy=float(square.sum(dtype=np.float64)),
        mean_sharpness=sharpness.astype(np.float32),
        score_scale=scale.astype(np.float32),
        score_variance=(scale**2 * spread).astype(np.float32),
        left_out=left_out,
        mean_frame=mean_frame,
        deviation=deviation,
        median=centre,
        spread=_deviation(usual, AGREEMENT_WINDOW),
    )


def _add_moments(plane: FloatArray, total: np.ndarray, squares: np.ndarray) -> None:
    cv2.accumulate(plane, total)
    cv2.accumulateSquare(plane, squares)


def _mean_and_variance(
    total: np.ndarray, squares: np.ndarray, count: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    mean = total / count
    return mean, np.maximum(squares / count - mean**2, 0.0)


def _median_and_spread(
    frames: Sequence[FloatArray], flows: Sequence[FloatArray], shape: tuple[int, ...], count: int, threads: int
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Median of some registered frames, their squared median deviation as a variance, and their variance in detail."""
    picked = set(spread_over(count, MEDIAN_OF))
    stack = np.empty((len(picked), *shape), np.float16)
    chosen = (
        pair
        for number, pair in enumerate(zip(iter_frames(frames), iter_frames(flows), strict=True))
        if number in picked
    )
    warped = map_ahead(lambda pair: luminance(warp(*pair)), chosen, threads)
    for plane, (_, registered) in zip(stack, warped, strict=True):
        plane[...] = registered
    centre, spread = np.empty(shape, np.float32), np.empty(shape, np.float32)

    def fill(top: int) -> None:
        rows = np.s_[top : top + MEDIAN_ROWS]
        # With the values of a pixel side by side, sorting them takes a fifth of the time of a median over the frames.
        values = np.ascontiguousarray(np.moveaxis(stack[:, rows], 0, -1), np.float32)
        values.sort(axis=-1)
        centre[rows] = _middle(values)
        values -= centre[rows, :, None]
        np.abs(values, out=values).sort(axis=-1)
        spread[rows] = (MEDIAN_DEVIATION * _middle(values)) ** 2

    for _ in map_ahead(fill, range(0, shape[0], MEDIAN_ROWS), threads):
        pass
    fine = np.zeros(shape)
    for plane in stack:
        difference = plane.astype(np.float32) - centre
        # Light that has changed is no noise.
        cv2.accumulateSquare(difference - smooth(difference, LEVEL_WINDOW), fine)
    return centre, spread, fine / max(len(stack) - 1, 1)


def _middle(ordered: FloatArray) -> FloatArray:
    """Median of sorted values along the last axis."""
    count = ordered.shape[-1]
    return (ordered[..., (count - 1) // 2] + ordered[..., count // 2]) / np.float32(2)


def _robust_start(
    mean: np.ndarray, variance: np.ndarray, centre: FloatArray, spread: FloatArray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and variance, or median and squared median deviation where objects have moved; mark these pixels too.

    An object that covers a pixel in a share p of the frames lies (1 − p) / p variances from the mean, and is no outlier
    if p exceeds a seventh.  The median and the median deviation hardly change up to p = 0.3.
    """
    usual = smooth(spread, OUTLIER_WINDOW) + np.float32(_IMAGE_NOISE_FLOOR)
    covered = smooth(variance.astype(np.float32), OUTLIER_WINDOW) > _HEAVY_TAIL * usual
    return np.where(covered, centre, mean), np.where(covered, spread, variance), covered


def _without_outliers(
    frames: Sequence[FloatArray],
    flows: Sequence[FloatArray],
    mean: np.ndarray,
    variance: np.ndarray,
    template: FloatArray,
    threads: int,
) -> tuple[FloatArray, FloatArray, _SharpnessMoments]:
    """Mean and variance of the registered frames, and of their sharpness, without pixels that deviate from all others.

    A moving object may be sharper than the scene, and would set the standard of sharpness.
    """
    centre, usual = mean.astype(np.float32), _deviation(variance)

    def add(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[np.ndarray, ...]:
        counts, total, squares, *moments = (np.zeros(mean.shape) for _ in range(8))
        for frame, flow in pairs:
            registered = luminance(warp(frame, flow))
            kept = (squared_deviation(registered, centre, usual) <= OUTLIER).view(np.uint8)
            cv2.accumulate(kept, counts)
            cv2.accumulate(registered, total, kept)
            cv2.accumulateSquare(registered - centre, squares, kept)
            projection = project_gradient(registered, template)
            whole, middle = (smooth(projection, width) * kept for width in (SHARPNESS_WINDOW, SHARPNESS_WINDOW / 2))
            _add_moments(whole, *moments[:2])
            _add_moments(middle, *moments[2:4])
            cv2.accumulateProduct(whole, middle, moments[4])
        return counts, total, squares, *moments

    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    counts, total, squares, *moments = sum_in_threads(add, pairs, threads)
    some = np.maximum(counts, 1)
    trimmed = np.where(counts > 0, total / some, mean)
    deviation = _deviation(np.maximum(squares / some - (trimmed - centre) ** 2, 0.0))
    whole, whole_spread = _mean_and_variance(moments[0], moments[1], some)
    middle, middle_spread = _mean_and_variance(moments[2], moments[3], some)
    joint = moments[4] / some - whole * middle
    return trimmed.astype(np.float32), deviation, _SharpnessMoments(whole, middle, whole_spread, middle_spread, joint)


def _deviation(variance: np.ndarray, window: float = OUTLIER_WINDOW) -> FloatArray:
    floor = max(_LEAST_DEVIATION * float(variance.mean()), _IMAGE_NOISE_FLOOR)
    return smooth(variance.astype(np.float32), window) + np.float32(floor)


def _coloured(template: FloatArray, noise: NoiseSpectrum) -> FloatArray:
    """Template on which white noise projects as noise of a spectrum and of the same variance does on ``template``.

    Rings in which no noise is certain have what the highest ones have: white noise is usually among it.
    """
    known = noise.certain
    known = replace(known, power=np.maximum(known.power, np.median(known.power[-_HIGHEST:])))
    frequency = np.hypot(np.fft.fftfreq(template.shape[1])[:, None], np.fft.rfftfreq(template.shape[2]))
    response = np.sqrt(known.at(frequency)) / known.deviation
    spectrum = rfft2(template) * response.astype(np.float32)
    return np.asarray(irfft2(spectrum, template.shape[1:]), np.float32)


def _leave_middle_out(
    moments: _SharpnessMoments, template: FloatArray, noise: FloatArray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Mean and variance of the local sharpness, the part of the variance that noise explains, and κ.

    κ grows with that part: without noise the middle of the window is where the sharpness of a pixel shows best.  Noise
    n of variance ``noise`` adds ``Σ g t · ∇n = −Σ n ∇·(g t)`` to the sharpness, with t the template, g the window.
    """
    window = SHARPNESS_WINDOW
    energy = smooth(template[0] ** 2 + template[1] ** 2, window)
    divergence = smooth((gradient(template[0])[0] + gradient(template[1])[1]) ** 2, window / np.sqrt(2))
    # ∫ g² and, along one axis, ∫ (∇g)² of a Gaussian of deviation s are 1 / (4π s²) and 1 / (8π s⁴).
    inside, border = noise * divergence / (4 * np.pi * window**2), noise * energy / (8 * np.pi * window**4)
    share = min(float((inside + border).sum() / max(moments.whole_spread.sum(), ROUNDING**2)), 1.0)
    if share < _LEAST_SHARE:
        # A bound, as if the gradients of the noise did not cancel: the score still contains the pixel's own noise.
        bound = noise * energy * (_SOBEL_NOISE * _SOBEL_AREA / (4 * np.pi * window**2))
        return moments.whole, moments.whole_spread, bound, 0.0
    kappa = _MIDDLE * share
    rest = (1 - kappa) ** 2
    sharpness = (moments.whole - kappa * moments.middle) / (1 - kappa)
    spread = (moments.whole_spread - 2 * kappa * moments.joint + kappa**2 * moments.middle_spread) / rest
    # The same of g_s − κ g_{s/2}, in units of those of g_s.
    explained = inside * (1 - 3.2 * kappa + 4 * kappa**2) + border * (1 - 5.12 * kappa + 16 * kappa**2)
    return sharpness, np.maximum(spread, 0.0), explained / rest, kappa


def _score_scale(sharpness: np.ndarray, spread: np.ndarray, explained: np.ndarray) -> np.ndarray:
    """Factor from a deviation of the sharpness to the best estimate of its standardised noise-free part.

    Noise explains a part of the variance ``spread``; the rest is sharpness.
    """
    deviation = np.sqrt(np.maximum(spread - explained, 0.0))
    whole = spread + (_LEAST_SPREAD * sharpness) ** 2
    return np.divide(deviation, whole, out=np.zeros_like(whole), where=whole > 0)

"""The last guard: detail of the result that the frames do not agree on gives way to the mean of the registered frames.

Symbols
-------
A, B : two halves of the clip (:mod:`turbrestore.registration.registered_noise`), deblurred linearly as the result is
b : one of four bands of detail, differences of Gaussians of 0, 1, 2, 4 and 8 pixels
r : correlation of b of A with b of B in a window, the smaller one of both ways to halve the clip; ρ = 2 r / (1 + r)
    that of their mean with the scene (Spearman and Brown), as far as the frames tell
g : share of the mean in a band of the result
n² : variance of the noise of the mean in a small window; that of photons depends on the level

What belongs to the scene is in both halves.  Noise is not, nor are waves, clouds, rain and what registration has torn;
deconvolution sharpens them all the same, and so do weights that follow sharpness.  Where ρ is low and the result has
more energy in a band than the mean of the registered frames, ``g = (1 − ρ')(E / E₀ − 1)``, with ρ' and g between 0 and
1, goes from the one to the other.  Where the halves agree, and where the result is smoother than the mean, it stays.
The halves are deblurred first, because a blur leaves nothing but noise at the highest frequencies of a band, while the
scene is still in the lower ones.

Near an edge the windows of the bands hold the edge, on which the halves agree, and a ring behind it is not noticed.
Flat parts are therefore looked at once more in small windows with sharp borders: where the mean varies by no more than
its noise in a window that ends before the edge, the scene is flat to within the noise, and what the result varies by
beyond the mean is rings or noise.  There all of the image is the mean's, even if the halves agree: deblurred alike,
they have the same rings.

What is left of the colours below the bands is that of the mean where it differs by more than two grey levels: weights
may have preferred a frame that is tinted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.decision import Decision
from ..core.gradient import sobel_gradient
from ..core.noise import NoiseCurve
from ..core.noise_spectrum import SIDE, NoiseSpectrum
from ..registration.registered_noise import Halves

# Gaussians that separate the bands, octaves; the window of a band, in these and in pixels, chosen: in tests
# a _WINDOWS of 1 leaves rings, and one of 4 changes a sharp image.
_SCALES = (1.0, 2.0, 4.0, 8.0)
_WINDOWS, _WINDOW = 2.0, 1.0
# Side of the small windows that tell flat parts, pixels: wider ones do not fit between the bars of a chart.
_FLAT = 7
# ρ below which nothing of a band is taken for the scene, and above which all of it is; both chosen.
_NONE, _ALL = 0.3, 0.8
# Energy that is nothing, squared intensity, about that of rounding to 12 bits.
_NOTHING = 1e-8
# Difference of colours, intensity, from which those of the mean begin to count, and from which they alone do: one and
# two levels of 8 bits, chosen.
_LEAST_TINT, _TINT = 1 / 255, 2 / 255
# Rows that are worked on at once, and those around that count: four deviations of each band and of the widest window.
_ROWS, _AROUND = 256, 128
# Bytes a pixel, and a pixel and channel, of these rows.
_BYTES, _CHANNEL_BYTES = 74, 50
# Share of the detail from which on the frames do not agree on the image as a whole, chosen on 65 clips, as
# benchmarks/decisions/guards.md tells.
MOSTLY = 0.5
# Least g, and the share of the image that has it, that is worth a remark, chosen.
_CLEAR, _REMARKED = 0.5, 0.15


@dataclass(frozen=True, eq=False)
class Guarded:
    """The image that is left, and what gave way."""

    image: FloatArray  # (H, W) or (H, W, 3)
    share: FloatArray  # (H, W): largest g of bands, tint and flat parts, 0 to 1
    decisions: tuple[Decision, ...]


def keep_agreed(
    result: FloatArray,
    mean: FloatArray,
    noise: NoiseSpectrum,
    halvings: Sequence[Halves],
    full_scale: tuple[float, float] = (0.0, 1.0),
    photons: NoiseCurve | None = None,
) -> Guarded:
    """Let the mean of the registered frames take the place of detail that they do not agree on.

    ``result`` and ``mean`` (H, W) or (H, W, 3); ``noise`` is that of the mean; the halves of ``halvings``, (H, W) each,
    are as sharp as the result; ``full_scale`` are black and white; ``photons`` is the noise at every level, relative to
    its average.
    """
    image, (share, flat) = np.empty_like(result), np.empty((2, *result.shape[:2]), np.float32)
    usual = _variance_within(noise)
    for top in range(0, len(result), _ROWS):
        first, above = max(top - _AROUND, 0), min(top, _AROUND)
        rows, own = slice(first, top + _ROWS + _AROUND), slice(above, above + _ROWS)
        least = _at_levels(usual, mean[rows], photons)
        parts = _agreed(result[rows], mean[rows], least, [Halves(h.first[rows], h.second[rows]) for h in halvings])
        for whole, part in zip((image, share, flat), parts, strict=True):
            whole[top : top + _ROWS] = part[own]
    np.clip(image, *full_scale, out=image)
    # Flat parts that are smoothed are no reason to doubt the registration.
    clear, share = float((share >= _CLEAR).mean()), np.maximum(share, flat)
    if clear < _REMARKED:
        return Guarded(image, share, ())
    choice = f"in {100 * clear:.0f} % of the image, the mean of the registered frames is kept without sharpening"
    reason = "the halves of the clip disagree there: noise, water, clouds, rain or registration that failed"
    return Guarded(image, share, (Decision("agreement", choice, reason),))


def disputed_detail(share: FloatArray, mean: FloatArray) -> float:
    """Return the share of the mean in the result, where a pixel counts by the detail that the mean (H, W[, 3]) has."""
    detail = np.hypot(*sobel_gradient(luminance(mean))) ** 2
    return float((share * detail).sum() / max(float(detail.sum()), ROUNDING**2))


def keep_agreed_memory(shape: tuple[int, ...]) -> float:
    """Bytes that :func:`keep_agreed` takes for an image (H, W[, 3]), its result and deblurred halves among them."""
    channels = shape[2] if len(shape) == 3 else 1
    rows = min(shape[0], _ROWS + 2 * _AROUND)
    return shape[1] * float(shape[0] * 4 * (7 + channels) + rows * (_BYTES + _CHANNEL_BYTES * channels))


def _agreed(
    result: FloatArray, mean: FloatArray, least: FloatArray, halvings: Sequence[Halves]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return some rows of the guarded image, the largest g of bands and tint, and g of flat parts."""
    left, all_of_mean, flat = result, mean, _flat_parts(mean, result, least)
    pairs = [(halves.first, halves.second) for halves in halvings]
    image, share = np.zeros_like(result), np.zeros(result.shape[:2], np.float32)
    for scale in _SCALES:
        window = partial(_smooth, scale=_WINDOWS * scale + _WINDOW)
        alike = np.ones(result.shape[:2], np.float32)
        for number, pair in enumerate(pairs):
            (first, a), (second, b) = (_split(half, scale) for half in pair)
            pairs[number] = first, second
            energy = np.sqrt(window(a * a) * window(b * b)) + np.float32(_NOTHING)
            np.minimum(alike, window(a * b) / energy, out=alike)
        (mean, usual), (left, detail) = (_split(some, scale) for some in (mean, left))
        given = _unlike(alike) * _excess(window(detail * detail), window(usual * usual))
        image += detail + (usual - detail) * (given if result.ndim == 2 else given[..., None])
        np.maximum(share, given, out=share)
    if result.ndim == 3:
        tint = (left - luminance(left)[..., None]) - (mean - luminance(mean)[..., None])
        given = np.clip((np.abs(tint).max(axis=2) - _LEAST_TINT) / (_TINT - _LEAST_TINT), 0, 1).astype(np.float32)
        left = left - tint * given[..., None]
        np.maximum(share, given, out=share)
    image = image + left
    image += (all_of_mean - image) * (flat if result.ndim == 2 else flat[..., None])
    return image, share, flat


def _at_levels(variance: float, mean: FloatArray, photons: NoiseCurve | None) -> FloatArray:
    """Variance of noise, (H, W), at the level that a mean (H, W[, 3]) has in small windows; the same for all levels."""
    if photons is None:
        return np.full(mean.shape[:2], variance, np.float32)
    return np.float32(variance) * photons.variance(cv2.blur(luminance(mean), (_FLAT, _FLAT)))


def _flat_parts(mean: FloatArray, result: FloatArray, least: FloatArray) -> FloatArray:
    """Return g of flat parts: of each pixel the largest g of the small windows that hold it, with a soft edge.

    A window is flat up to a variance of ``least``, which that of pure noise exceeds in about half of the windows, and
    not at all flat from twice that on.
    """
    side = (_FLAT, _FLAT)

    def variance(image: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(image * image, side) - np.square(cv2.blur(image, side)), np.float32)

    flat = np.clip(2 - variance(luminance(mean)) / (least + np.float32(_NOTHING)), 0, 1)
    given = flat * _excess(variance(result), variance(mean))
    return np.asarray(cv2.blur(cv2.dilate(given, np.ones(side, np.uint8)), (3, 3)), np.float32)


def _variance_within(noise: NoiseSpectrum) -> float:
    """Variance that noise has on average within a small window, about the mean of the window."""
    nu = np.fft.fftfreq(SIDE)
    box = np.sin(np.pi * _FLAT * nu[1:]) / (_FLAT * np.sin(np.pi * nu[1:]))
    box = np.append(1.0, box)
    return float((noise.at(np.hypot(nu[:, None], nu)) * (1 - np.square(np.outer(box, box)))).mean())


def _unlike(alike: FloatArray) -> FloatArray:
    """Return 1 − ρ' from the correlation of two halves."""
    alike = np.clip(alike, 0, 1)
    return np.asarray(1 - np.clip((2 * alike / (1 + alike) - _NONE) / (_ALL - _NONE), 0, 1), np.float32)


def _excess(detail: FloatArray, usual: FloatArray) -> FloatArray:
    """Return by how much the energy of the result exceeds that of the mean, 0 to 1; of colours, the largest."""
    more = detail / (np.maximum(usual, 0) + np.float32(_NOTHING)) - 1
    return np.asarray(np.clip(more if more.ndim == 2 else more.max(axis=2), 0, 1), np.float32)


def _split(image: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return an image without its finest detail, and the detail."""
    smooth = _smooth(image, scale)
    return smooth, image - smooth


def _smooth(image: FloatArray, scale: float) -> FloatArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), scale), np.float32)

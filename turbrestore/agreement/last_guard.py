"""The last guard: detail of the result that the frames do not agree on gives way to the mean of the registered frames.

Symbols
-------
A, B : means of the registered frames of two halves of the clip, of alternating quarters
b : one of four bands of detail, differences of Gaussians of 0, 1, 2, 4 and 8 pixels
r : correlation of b of A with b of B in a window; ρ = 2 r / (1 + r) that of their mean with the scene (Spearman and
    Brown), as far as the frames tell
g : share of the mean in a band of the result

What belongs to the scene is in both halves.  Noise is not, nor are waves, clouds, rain and what registration has torn;
deconvolution sharpens them all the same, and so do weights that follow sharpness.  Where ρ is low and the result has
more energy in a band than the mean of the registered frames, ``g = (1 − ρ')(E / E₀ − 1)``, with ρ' and g between 0 and
1, goes from the one to the other.  Where the halves agree, and where the result is smoother than the mean, it stays.

Near an edge the windows of the bands hold the edge, on which the halves agree, and a ring behind it is not noticed.
Flat parts are therefore looked at once more in small windows with sharp borders, each against its own mean: where the
halves share nothing in a window that ends before the edge, the scene is flat to within the noise, and what the result
varies by beyond the mean is rings or noise.  There all of the image is the mean's.

What is left of the colours below the bands is that of the mean where it differs by more than two grey levels: weights
may have preferred a frame that is tinted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..registration.warp import warp
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead

# Parts of the clip that belong to one half and the other in turn.
_PARTS = 4
# Gaussians that separate the bands; the window of a band, in these and in pixels.
_SCALES = (1.0, 2.0, 4.0, 8.0)
_WINDOWS, _WINDOW = 2.0, 1.0
# Side of the small windows that tell flat parts, pixels.
_FLAT = 7
# ρ below which nothing of a band is taken for the scene, and above which all of it is.
_NONE, _ALL = 0.3, 0.8
# Energy that is nothing, squared intensity; fewest frames that have two halves.
_NOTHING, FEWEST = 1e-8, 8
# Difference of colours, intensity, from which those of the mean begin to count, and from which they alone do.
_LEAST_TINT, _TINT = 1 / 255, 2 / 255
# Rows that are worked on at once, and those around that count: the Gaussians of all bands and of the widest window.
_ROWS, _AROUND = 256, 128
# Bytes a pixel, and a pixel and channel, of these rows.
_BYTES, _CHANNEL_BYTES = 70, 50
# Least g, and the share of the image that has it, that is worth a remark.
_CLEAR, _REMARKED = 0.5, 0.15


@dataclass(frozen=True, eq=False)
class Halves:
    """Means of the registered frames of two halves of a clip, in the geometry of the result."""

    # (H, W) or (H, W, 3).
    first: FloatArray
    second: FloatArray


@dataclass(frozen=True, eq=False)
class Guarded:
    """The image that is left, and what gave way."""

    image: FloatArray  # (H, W) or (H, W, 3)
    share: FloatArray  # (H, W): largest g of bands, tint and flat parts, 0 to 1
    decisions: tuple[Decision, ...]


def registered_halves(
    frames: Iterable[FloatArray], flows: Iterable[FloatArray], shape: tuple[int, ...], count: int, threads: int = 0
) -> Halves:
    """Average the registered frames of each half.

    ``frames`` (H, W) or (H, W, 3) each; ``flows`` (H, W, 2) each.
    """
    sums, counts = np.zeros((2, *shape), np.float32), [0, 0]
    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    for number, (_, registered) in enumerate(map_ahead(lambda pair: warp(*pair), pairs, threads)):
        half = number * _PARTS // count % 2
        sums[half] += registered
        counts[half] += 1
    return Halves(*(total / np.float32(some) for total, some in zip(sums, counts, strict=True)))


def keep_agreed(result: FloatArray, halves: Halves, full_scale: tuple[float, float] = (0.0, 1.0)) -> Guarded:
    """Let the mean of the registered frames take the place of detail that they do not agree on.

    ``result`` (H, W) or (H, W, 3); ``full_scale`` are black and white.
    """
    image, (share, flat) = np.empty_like(result), np.empty((2, *result.shape[:2]), np.float32)
    for top in range(0, len(result), _ROWS):
        first, above = max(top - _AROUND, 0), min(top, _AROUND)
        rows, own = slice(first, top + _ROWS + _AROUND), slice(above, above + _ROWS)
        parts = _agreed(result[rows], halves.first[rows], halves.second[rows])
        for whole, part in zip((image, share, flat), parts, strict=True):
            whole[top : top + _ROWS] = part[own]
    np.clip(image, *full_scale, out=image)
    # Flat parts that are smoothed are no reason to doubt the registration.
    clear, share = float((share >= _CLEAR).mean()), np.maximum(share, flat)
    if clear < _REMARKED:
        return Guarded(image, share, ())
    choice = f"detail in {100 * clear:.0f} % of the image is that of the mean of the registered frames"
    reason = "there the halves of the clip do not agree on it: noise, water, clouds, rain or registration that failed"
    return Guarded(image, share, (Decision("agreement", choice, reason),))


def halves_memory(shape: tuple[int, ...], threads: int) -> float:
    """Bytes that :func:`registered_halves` takes for frames of (H, W) or (H, W, 3) pixels, its result among them."""
    values = float(np.prod(shape))
    # Two sums, and registered frames of which some wait in each thread; the flow and the frame that are read.
    return 4 * values * (4 + 2 * (threads + 1)) + 8.0 * shape[0] * shape[1]


def keep_agreed_memory(shape: tuple[int, ...]) -> float:
    """Bytes that :func:`keep_agreed` takes for an image of (H, W) or (H, W, 3) pixels, its result among them."""
    channels = shape[2] if len(shape) == 3 else 1
    rows = min(shape[0], _ROWS + 2 * _AROUND)
    return shape[1] * float(shape[0] * 4 * (3 + channels) + rows * (_BYTES + _CHANNEL_BYTES * channels))


def _agreed(result: FloatArray, first_half: FloatArray, second_half: FloatArray) -> tuple[FloatArray, ...]:
    """Return some rows of the guarded image, the largest g of bands and tint, and g of flat parts."""
    first, second = luminance(first_half), luminance(second_half)
    mean, left = (first_half + second_half) / np.float32(2), result
    flat, all_of_mean = _flat_parts(first, second, mean, result), mean
    image, share = np.zeros_like(result), np.zeros(result.shape[:2], np.float32)
    for scale in _SCALES:
        (first, a), (second, b), (mean, usual), (left, detail) = (
            _split(some, scale) for some in (first, second, mean, left)
        )
        window = partial(_smooth, scale=_WINDOWS * scale + _WINDOW)
        moments = [window(one * other) for one, other in ((a, a), (b, b), (a, b), (usual, usual), (detail, detail))]
        given = _given(moments)
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


def _flat_parts(first: FloatArray, second: FloatArray, mean: FloatArray, result: FloatArray) -> FloatArray:
    """Return g of flat parts: of each pixel the largest g of the small windows that hold it, with a soft edge."""
    side = (_FLAT, _FLAT)

    def covariance(one: FloatArray, other: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(one * other, side) - cv2.blur(one, side) * cv2.blur(other, side), np.float32)

    pairs = (first, first), (second, second), (first, second), (mean, mean), (result, result)
    # The standard error of the correlation of noise in a window: faint texture may seem to be none in some.
    given = _given([covariance(*pair) for pair in pairs], doubt=1 / _FLAT)
    return np.asarray(cv2.blur(cv2.dilate(given, np.ones(side, np.uint8)), (3, 3)), np.float32)


def _given(moments: Sequence[FloatArray], doubt: float = 0.0) -> FloatArray:
    """Return g from ⟨AA⟩, ⟨BB⟩, ⟨AB⟩, the energies of the mean and of the result, and the error of a correlation."""
    aa, bb, ab, usual, detail = moments
    alike = doubt + np.clip(ab / np.sqrt(np.maximum(aa * bb, 0) + np.float32(_NOTHING**2)), 0, 1 - doubt)
    unlike = 1 - np.clip((2 * alike / (1 + alike) - _NONE) / (_ALL - _NONE), 0, 1)
    more = detail / (np.maximum(usual, 0) + np.float32(_NOTHING)) - 1
    more = more if more.ndim == 2 else more.max(axis=2)
    return np.asarray(unlike * np.clip(more, 0, 1), np.float32)


def _split(image: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return an image without its finest detail, and the detail."""
    smooth = _smooth(image, scale)
    return smooth, image - smooth


def _smooth(image: FloatArray, scale: float) -> FloatArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), scale), np.float32)

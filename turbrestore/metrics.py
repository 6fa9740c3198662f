"""Quality of a restoration, with and without ground truth.

A restoration determines the scene only up to the mean displacement of its video, and some methods crop, so
:func:`align` locates the result inside the truth and leaves out a border before any comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .core.arrays import FloatArray, check_flow, check_image
from .core.errors import DataError
from .runtime.scratch import iter_frames

# Border that is not compared, pixels, chosen.
BORDER = 30
# Margin that is cut off, because it may contain values from outside: the sub-pixel shift is less than three pixels, and
# interpolates over two more.  Both chosen.
_GUARD = 6
_LARGEST_SHIFT = 3.0
# The interior must contain the window of the structural similarity, 7×7 pixels.
_WINDOW = 7
_SMALLEST = 2 * BORDER + _WINDOW + 1


@dataclass(frozen=True)
class Comparison:
    """Quality of a result compared with the truth."""

    psnr: float  # peak signal-to-noise ratio after alignment, dB
    psnr_fit: float  # the same after a fit of gain and offset, dB
    ssim: float  # structural similarity after that fit
    sharpness: float  # mean gradient magnitude relative to that of the truth, after alignment
    overshoot: float  # share of pixels outside the local range of the truth, after alignment; see :func:`overshoot`


@dataclass(frozen=True)
class Appearance:
    """Quality of a result without a truth."""

    sharpness: float  # mean gradient magnitude relative to that of the reference
    overshoot: float  # share of pixels outside the local range of the reference; see :func:`overshoot`


@dataclass(frozen=True)
class FlowComparison:
    """Errors of flows compared with the true ones, pixels."""

    endpoint_error: float  # mean length of the difference
    # The same after subtraction of the mean difference over time at every pixel; NaN for a single flow.
    endpoint_error_centred: float
    true_length: float  # mean length of the true flows, for comparison


def compare(result: ArrayLike, truth: ArrayLike) -> Comparison:
    """Compare a result with the truth, both reduced to grey by the mean of the channels.

    Parameters
    ----------
    result : array_like, shape (H, W) or (H, W, 3)
        At least 68×68 pixels; may be a crop of the scene.
    truth : array_like, shape (H', W') or (H', W', 3)
        The scene.

    Returns
    -------
    Comparison

    Raises
    ------
    DataError
        An image is too small, of one colour, larger than the truth, or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> truth = np.random.default_rng(0).random((128, 128)).astype(np.float32)
    >>> round(compare(truth + 0.1, truth).psnr)
    20
    """
    from skimage.metrics import structural_similarity

    a, t = align(result, truth)
    design = np.stack([a.ravel(), np.ones(a.size, np.float32)], axis=1)
    gain, offset = np.linalg.lstsq(design, t.ravel(), rcond=None)[0]
    fitted = (gain * a + offset).astype(np.float32)
    ssim = structural_similarity(t, np.clip(fitted, 0, 1), data_range=1.0)
    return Comparison(psnr(a, t), psnr(fitted, t), float(ssim), sharpness(a, t), overshoot(a, t))


def appearance(result: ArrayLike, reference: ArrayLike) -> Appearance:
    """Compare a result with a frame, or the temporal mean, of the same pixels.

    Parameters
    ----------
    result, reference : array_like, shape (H, W) or (H, W, 3)
        Of the same size; they are not aligned.

    Returns
    -------
    Appearance

    Raises
    ------
    DataError
        Sizes differ, or the reference has no contrast.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.tile(np.linspace(0, 1, 128, dtype=np.float32), (128, 1))
    >>> appearance(ramp, ramp)
    Appearance(sharpness=1.0, overshoot=0.0)
    """
    share = overshoot(result, reference)
    return Appearance(sharpness(result, reference), share)


def compare_flows(flows: ArrayLike, truth: ArrayLike) -> FlowComparison:
    """Compare flows with the true ones.

    Parameters
    ----------
    flows, truth : array_like, shape (T, H, W, 2)
        Pixels; memory maps are read one flow at a time.

    Returns
    -------
    FlowComparison

    Raises
    ------
    DataError
        Shapes differ, or are not those of flows.

    Examples
    --------
    >>> import numpy as np
    >>> compare_flows(np.zeros((5, 2, 2, 2)), np.full((5, 2, 2, 2), (3.0, 4.0)))
    FlowComparison(endpoint_error=5.0, endpoint_error_centred=0.0, true_length=5.0)
    """
    a, t = check_flow(flows, "flows"), check_flow(truth, "truth")
    if a.shape != t.shape or a.ndim != 4:
        raise DataError(f"flows: expected shape (T, H, W, 2) as the truth {t.shape}, found {a.shape}")
    offset = np.zeros(t.shape[1:])
    for flow, true in zip(a, t, strict=True):
        offset += (flow - true) / np.float64(len(t))
    lengths = [[_length(w - true), _length(w - true - offset), _length(true)] for w, true in zip(a, t, strict=True)]
    plain, centred, true_length = np.mean(lengths, axis=0).tolist()
    return FlowComparison(plain, centred if len(t) > 1 else float("nan"), true_length)


def align(result: ArrayLike, truth: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Align a result with the truth by cross-correlation, to a fraction of a pixel, and crop both to one interior.

    ``result`` (H, W) or (H, W, 3); ``truth`` (H', W') or (H', W', 3).
    """
    from skimage.registration import phase_cross_correlation

    image, scene = comparable(_grey(result, "result"), "result"), comparable(_grey(truth, "truth"), "truth")
    if np.ptp(scene) == 0:
        raise DataError("truth: expected an image with some contrast, found one colour")
    margin = BORDER - _GUARD
    core = image[margin:-margin, margin:-margin]
    # As much must overlap as the structural similarity needs.
    reach = min(margin, min(core.shape) - 2 * _GUARD - _WINDOW)
    if core.shape[0] > scene.shape[0] + 2 * reach or core.shape[1] > scene.shape[1] + 2 * reach:
        raise DataError(f"result: expected at most the size of the truth {scene.shape}, found {image.shape}")
    match = cv2.matchTemplate(np.pad(scene, reach, mode="reflect"), core, cv2.TM_CCOEFF_NORMED)
    y, x = (int(v) - reach for v in np.unravel_index(int(match.argmax()), match.shape))
    top, left = max(y, 0), max(x, 0)
    bottom, right = min(y + core.shape[0], scene.shape[0]), min(x + core.shape[1], scene.shape[1])
    a, t = core[top - y : bottom - y, left - x : right - x], scene[top:bottom, left:right]
    shift = phase_cross_correlation(t, a, upsample_factor=20)[0]
    if np.abs(shift).max() < _LARGEST_SHIFT:
        matrix = np.array([[1, 0, shift[1]], [0, 1, shift[0]]], np.float32)
        a = cv2.warpAffine(a, matrix, a.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    inside = slice(_GUARD, -_GUARD)
    return a[inside, inside], t[inside, inside]


def part_shown(whole: FloatArray, image: FloatArray) -> FloatArray:
    """Cut the part out of an image (H', W'[, 3]) that a smaller one (H, W[, 3]) of the same scene shows."""
    height, width = image.shape[:2]
    if height > whole.shape[0] or width > whole.shape[1]:
        return whole
    match = cv2.matchTemplate(_grey(whole, "whole"), _grey(image, "image"), cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(match.argmax()), match.shape)
    return whole[y : y + height, x : x + width]


def comparable(image: FloatArray, name: str) -> FloatArray:
    """Return an image if it is large enough for :func:`compare`.

    ``image`` (H, W) or (H, W, 3).
    """
    if min(image.shape[:2]) < _SMALLEST:
        raise DataError(f"{name}: expected at least {_SMALLEST} pixels a side to be compared, found {image.shape[:2]}")
    return image


def psnr(image: ArrayLike, truth: ArrayLike) -> float:
    """Peak signal-to-noise ratio for full scale 1, without alignment."""
    a, t = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    if a.shape != t.shape:
        raise DataError(f"image: expected the shape of the truth {t.shape}, found {a.shape}")
    error = float(np.mean((a - t) ** 2))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def sharpness(image: ArrayLike, reference: ArrayLike) -> float:
    """Mean gradient magnitude relative to that of a reference, for example the temporal mean.

    ``image, reference`` (H, W) or (H, W, 3).
    """
    gradients = [_gradient(grey) for grey in map(_grey, iter_frames((image, reference)), ("image", "reference"))]
    if gradients[1] == 0:
        raise DataError("reference: expected an image with some contrast, found one colour")
    return gradients[0] / gradients[1]


def overshoot(image: ArrayLike, reference: ArrayLike, tolerance: float = 0.05) -> float:
    """Share of pixels that exceed the local range (7×7) of a reference by more than a tolerance, as ringing does.

    ``image, reference`` (H, W) or (H, W, 3).
    """
    a, r = _grey(image, "image"), _grey(reference, "reference")
    if a.shape != r.shape:
        raise DataError(f"image: expected the size of the reference {r.shape}, found {a.shape}")
    box = np.ones((7, 7), np.uint8)
    high, low = cv2.dilate(r, box) + tolerance, cv2.erode(r, box) - tolerance
    return float(np.mean((a > high) | (a < low)))


def endpoint_error(flow: ArrayLike, truth: ArrayLike) -> float:
    """Mean length of the difference of two flows.

    ``flow, truth`` (H, W, 2) or (T, H, W, 2).
    """
    a, t = check_flow(flow), check_flow(truth, "truth")
    if a.shape != t.shape:
        raise DataError(f"flow: expected the shape of the truth {t.shape}, found {a.shape}")
    return _length(a - t)


def _length(flow: np.ndarray) -> float:
    return float(np.hypot(flow[..., 0], flow[..., 1]).mean())


def _gradient(grey: FloatArray) -> float:
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return float(np.hypot(across, down, out=across).mean())


def _grey(image: ArrayLike, name: str) -> FloatArray:
    array = check_image(image, name)
    grey = array.mean(axis=-1) if array.ndim == 3 else array
    return np.ascontiguousarray(grey, np.float32)

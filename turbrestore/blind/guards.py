"""Guards: a deconvolved image is held against the image it came from before anyone sees it.

A right width restores contrast that fine detail has lost, so that the result leaves the range of the blurred image
next to it: a correct chart does so at every third pixel.  Beyond the range of a window wider than the blur it has
little to gain: the plateaus on either side of an edge are in it.  Too wide a width rings, and rings overshoot
plateaus.  The share of pixels that leave the range of a window of four widths by more than 30 % of that range tells
the two apart; see ``docs/decisions/guards.md`` for what it is on right and wrong widths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image, luminance
from ..core.errors import DataError, require_between
from ..deconvolution.deconvolve import Deconvolution
from ..runtime.scratch import drop_pages

_WINDOW_SIGMAS = 4.0
_SMALLEST_WINDOW = 8
_BEYOND = 0.3
# A range below this share of the contrast of the whole image is noise.
_LEAST_RANGE = 0.1
_FLAT_SHARE = 0.2
_DETAIL_WINDOW = 4.0


@dataclass(frozen=True)
class GuardParams:
    """What a deconvolved image must not exceed.

    Parameters
    ----------
    overshoot : float
        Largest share of pixels beyond the local range of the blurred image by 30 % of that range.
    noise_gain : float
        Largest ratio of the deviation in the flattest fifth of the image after to before.
    back_off : float
        Factor on the width of the blur when a guard objects.
    tries : int
        Widths that are tried at most; after the last nothing is removed.
    """

    overshoot: float = 0.12
    noise_gain: float = 6.0
    back_off: float = 0.8
    tries: int = 8

    def __post_init__(self) -> None:
        require_between("overshoot", self.overshoot, 0, 1)
        require_between("noise_gain", self.noise_gain, 1, 1000)
        require_between("back_off", self.back_off, 0.1, 0.99)
        require_between("tries", self.tries, 1, 100)


@dataclass(frozen=True)
class GuardReading:
    """What the guards saw on one deconvolved image.

    Attributes
    ----------
    sigma : float
        Width that was removed, pixels.
    overshoot : float
        Share of pixels beyond the local range.
    noise_gain : float
        Deviation in flat regions after over before.
    passed : bool
        Whether both are within bounds.
    """

    sigma: float
    overshoot: float
    noise_gain: float
    passed: bool


def judge(result: ArrayLike, blurred: ArrayLike, sigma: float, params: GuardParams | None = None) -> GuardReading:
    """Hold a deconvolved image against the image it was deconvolved from; of colour, luminance and every channel.

    Parameters
    ----------
    result : array_like, shape (H, W) or (H, W, 3)
        Deconvolved image.
    blurred : array_like, shape of ``result``
        What it came from.
    sigma : float
        Width of the blur that was removed, pixels.
    params : GuardParams, optional
        Bounds.

    Returns
    -------
    GuardReading

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> edge = np.repeat([[0.2] * 24 + [0.8] * 24], 48, axis=0)
    >>> judge(edge, edge, 1.0).overshoot
    0.0
    >>> rung = edge + 0.3 * (abs(np.arange(48) - 27) < 3.5)
    >>> judge(rung, edge, 1.0).passed
    False
    """
    params = params or GuardParams()
    after, before = check_image(result, "result"), check_image(blurred, "blurred")
    if after.shape != before.shape:
        raise DataError(f"result: expected the shape {before.shape} of the blurred image, found {after.shape}")
    # One pair of planes at a time: of a large image they are a good part of what memory holds.
    channels = [None, *range(3)] if after.ndim == 3 else [None]
    seen = [_figures(_plane(after, channel), _plane(before, channel), sigma) for channel in channels]
    overshoot, gain = (max(figures) for figures in zip(*seen, strict=True))
    return GuardReading(float(sigma), overshoot, gain, overshoot <= params.overshoot and gain <= params.noise_gain)


def deconvolve_guarded(
    attempt: Callable[[float], Deconvolution], blurred: ArrayLike, sigma: float, params: GuardParams | None = None
) -> tuple[Deconvolution, tuple[GuardReading, ...]]:
    """Deconvolve with a width that is lowered until no guard objects.

    Parameters
    ----------
    attempt : callable
        Deconvolves ``blurred`` for a width in pixels.
    blurred : array_like, shape (H, W) or (H, W, 3)
        Image that is deconvolved.
    sigma : float
        First width, pixels.
    params : GuardParams, optional
        Bounds.

    Returns
    -------
    result : Deconvolution
        The first that passes; without blur removed if none does.
    readings : tuple of GuardReading
        Of every width that was tried.

    Raises
    ------
    DataError
        Values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.deconvolution.deconvolve import deconvolve
    >>> image = np.random.default_rng(0).uniform(size=(32, 32)).astype(np.float32)
    >>> result, readings = deconvolve_guarded(lambda width: deconvolve(image, width), image, 0.0)
    >>> result.sigma, readings
    (0.0, ())
    """
    params = params or GuardParams()
    readings: list[GuardReading] = []
    while sigma > 0 and len(readings) < params.tries:
        result = attempt(sigma)
        readings.append(judge(result.image, blurred, sigma, params))
        if readings[-1].passed:
            return result, tuple(readings)
        sigma *= params.back_off
    return attempt(0.0), tuple(readings)


def _plane(image: FloatArray, channel: int | None) -> FloatArray:
    """Channel of an image, or luminance."""
    if channel is None:
        return luminance(image)
    plane = image[..., channel].copy()
    # All channels of a mapped image came into memory.
    drop_pages(image)
    return plane


def _figures(after: FloatArray, before: FloatArray, sigma: float) -> tuple[float, float]:
    return _overshoot(after, before, sigma), _noise_gain(after, before)


def _overshoot(after: FloatArray, before: FloatArray, sigma: float) -> float:
    radius = max(_SMALLEST_WINDOW, round(_WINDOW_SIGMAS * sigma))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    high, low = cv2.dilate(before, window), cv2.erode(before, window)
    contrast = float(np.subtract(*np.percentile(before, (99, 1))))
    margin = high - low
    np.maximum(margin, _LEAST_RANGE * contrast, out=margin)
    margin *= _BEYOND
    np.subtract(after, high, out=high)
    np.subtract(low, after, out=low)
    return float(np.mean(np.maximum(high, low, out=high) > margin))


def _noise_gain(after: FloatArray, before: FloatArray) -> float:
    energy = np.square(cv2.Sobel(before, cv2.CV_32F, 1, 0))
    energy += np.square(cv2.Sobel(before, cv2.CV_32F, 0, 1))
    energy = cv2.GaussianBlur(energy, (0, 0), _DETAIL_WINDOW)
    flat = energy <= np.quantile(energy, _FLAT_SHARE)
    del energy
    deviations = [
        float(np.std((image - cv2.GaussianBlur(image, (0, 0), _DETAIL_WINDOW))[flat])) for image in (after, before)
    ]
    return deviations[0] / max(deviations[1], 1e-4)

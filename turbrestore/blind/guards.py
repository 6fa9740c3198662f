"""Guards: bounds on ringing and on amplified noise that a deconvolved image must keep.

Symbols
-------
f : blurred image; u : deconvolved image; σ : width of the blur that was removed, pixels
W(x) : window of 4σ around pixel x, at least 8 pixels; ``range(x) = max f − min f`` over W(x)

Overshoot is the share of pixels with ``u > max f + 0.3 range`` or ``u < min f − 0.3 range``, where range is at least a
tenth of the contrast of f.  The right width restores the contrast of fine detail, so u leaves the range of the pixels
right next to it: a correctly restored chart does so at every third pixel.  But it hardly leaves the range of a window
wider than the blur, which contains the plateaus on either side of an edge.  Too large a width causes ringing, which
overshoots the plateaus.

Noise gain is the ratio, after to before, of the standard deviation of fine detail in the flattest fifth of f.

``docs/decisions/guards.md`` lists both for right and for wrong widths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image, luminance
from ..core.errors import DataError, require_between
from ..runtime.scratch import iter_parts

_WINDOW_SIGMAS = 4.0
_SMALLEST_WINDOW = 8
_BEYOND = 0.3
# A range below this share of the contrast of the whole image is taken for noise.
_LEAST_RANGE = 0.1
_FLAT_SHARE = 0.2
# Standard deviation of the Gaussian that separates fine detail, pixels.
_DETAIL_WINDOW = 4.0
_LEAST_DEVIATION = 1e-4


@dataclass(frozen=True)
class GuardParams:
    """Bounds that a deconvolved image must keep, and what is done if it does not.

    Parameters
    ----------
    overshoot : float
        Largest share of pixels beyond the local range of the blurred image by 30 % of that range.
    noise_gain : float
        Largest ratio, after to before, of the standard deviation in the flattest fifth of the image.
    back_off : float
        Factor on the width of the blur after a failed attempt.
    tries : int
        Largest number of attempts; if the last one fails, no blur is removed.
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
    """What the guards measured on one deconvolved image.

    Attributes
    ----------
    sigma : float
        Width that was removed, pixels.
    overshoot : float
        Share of pixels beyond the local range.
    noise_gain : float
        Ratio of the standard deviations in flat regions, after to before.
    passed : bool
        Whether both are within their bounds.
    """

    sigma: float
    overshoot: float
    noise_gain: float
    passed: bool


def evaluate_guards(
    result: ArrayLike, blurred: ArrayLike, sigma: float, params: GuardParams | None = None
) -> GuardReading:
    """Compare a deconvolved image with the blurred one.

    Parameters
    ----------
    result : array_like, shape (H, W) or (H, W, 3)
        Deconvolved image, u.
    blurred : array_like, shape of ``result``
        Blurred image, f.
    sigma : float
        Width of the blur that was removed, pixels.
    params : GuardParams, optional
        Bounds.

    Returns
    -------
    GuardReading
        For colour images, the largest figures of the luminance and of each channel.

    Raises
    ------
    DataError
        The shapes differ, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> edge = np.repeat([[0.2] * 24 + [0.8] * 24], 48, axis=0)
    >>> evaluate_guards(edge, edge, 1.0).overshoot
    0.0
    >>> ringing = edge + 0.3 * (abs(np.arange(48) - 27) < 3.5)
    >>> evaluate_guards(ringing, edge, 1.0).passed
    False
    """
    params = params or GuardParams()
    after, before = check_image(result, "result"), check_image(blurred, "blurred")
    if after.shape != before.shape:
        raise DataError(f"result: expected the shape {before.shape} of the blurred image, found {after.shape}")
    # One pair of planes at a time, because those of a large image take a good part of the memory.
    pairs = zip(_planes(after), _planes(before), strict=True)
    figures = [(_overshoot(*pair, sigma), _noise_gain(*pair)) for pair in pairs]
    overshoot, gain = (max(values) for values in zip(*figures, strict=True))
    return GuardReading(float(sigma), overshoot, gain, overshoot <= params.overshoot and gain <= params.noise_gain)


def _planes(image: FloatArray) -> Iterator[FloatArray]:
    """Luminance and, for a colour image, a copy of each channel."""
    yield luminance(image)
    for channel in range(3 if image.ndim == 3 else 0):
        plane, done = np.empty(image.shape[:2], np.float32), 0
        for part in iter_parts(image):
            plane[done : done + len(part)] = part[..., channel]
            done += len(part)
        yield plane


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
    return deviations[0] / max(deviations[1], _LEAST_DEVIATION)

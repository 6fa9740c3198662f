"""Fusion of a dewarped frame with its registered neighbours.

Symbols
-------
J : the frame, dewarped; J_i its neighbours, warped onto it
e : difference J_i − J, averaged in a small window and squared
t : difference that misregistration and noise explain, intensity, ``t² = m² |∇J|² + d² + (s n)²`` with n the noise:
    at edges, registration that is wrong by a fraction of a pixel and a blur that changes leave a difference
w : weight of a neighbour, ``exp(−e / 2t²)``

Where a neighbour shows something else than the frame, because an object or the background it uncovers has moved, or
the flow is wrong, e exceeds what t allows and the neighbour has no weight: the frame stays as it is, and nothing of
the neighbour is left as a ghost.  Weights are as smooth as the windows, so they are computed on the grid of the image.

The result is checked against the frame, before it is deblurred: where it is worse, the frame is changed less.

Symbols of the check
--------------------
I : the frame; E : its estimate, before it is deblurred
M : mean of the neighbours, which the camera alone has brought to where E lies
e_E, e_I : distances of E and I from M, squared and averaged in a window
s_E, s_I : energies of the gradient of E and I, averaged likewise

Turbulence displaces I about M at random, so that E, which is freed of it, lies nearer.  Where an object is held back, a
pattern slips by a period or the camera was lost, it lies further away.  Where neighbours were averaged that do not fit,
E is less sharp than I.  The share of E is ::

    1 / (1 + (e_E / κ (e_I + e))⁴) · 1 / (1 + ((s_I − s_n) / ς (s_E + s))⁴)

with e, s what does not count, and s_n the energy that the noise of I has.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..core.gradient import sobel_gradient
from .grid import enlarged, grid_of, pixel_of, reduced

# Windows, pixels, in which the difference and its square are averaged, both chosen.
_DIFFERENCE_WINDOW, _SQUARE_WINDOW = 1.5, 2.0
# d, the tolerance of flat regions, intensity; m, pixels; s, the share of the noise that the windows leave, 0.27 of
# white noise.  All chosen.
_DIFFERENCE, _MISREGISTRATION, _NOISE_SHARE = 0.02, 1.0, 0.5
# κ and ς.  With a κ of 2 still scenes lose 0.1 dB, because a long memory lies off the mean of a few frames; half or
# twice ς fails in test_check.py.
_FURTHER, _SOFTER = 4.0, 3.0
# e and s, squared intensity, chosen.
_EVEN = 1e-4
# Windows of the images and of the mean, pixels of the grid: half or twice of either fails in test_check.py.
_IMAGE_WINDOW, _CHECKED_WINDOW = 1.0, 4.0
# Energy of the gradient that white noise of unit variance has after the first window, by Sobel's derivatives.
_OF_NOISE = 0.041


def fuse(frame: FloatArray, neighbours: Iterable[FloatArray], noise: float) -> tuple[FloatArray, FloatArray]:
    """Average a frame with the neighbours that agree with it.

    ``frame`` (H, W) or (H, W, 3); returns the average, and the mean weight of the neighbours (h, w).
    """
    total, weights = frame.copy(), np.ones(frame.shape, np.float32)
    agreement, count = np.zeros(grid_of(frame.shape), np.float32), 0
    tolerance = explained_difference(frame, noise)
    for neighbour in neighbours:
        weight = agreement_weight(neighbour, frame, tolerance)
        agreement += weight
        weight = for_channels(enlarged(weight, frame.shape), frame)
        cv2.accumulateProduct(weight, neighbour, total)
        weights += weight
        count += 1
    total /= weights
    agreement += 0 if count else 1
    return total, agreement / np.float32(max(count, 1))


def for_channels(weight: FloatArray, image: FloatArray) -> FloatArray:
    """Repeat a weight (H, W) for every channel of an image."""
    return weight if image.ndim == 2 else cv2.merge([weight] * image.shape[2])


def explained_difference(frame: FloatArray, noise: float) -> FloatArray:
    """Squared difference that misregistration and noise explain.

    ``frame`` (H, W) or (H, W, 3); returns (h, w).
    """
    pixel = pixel_of(frame.shape)
    along_x, along_y = sobel_gradient(cv2.GaussianBlur(reduced(frame), (0, 0), _DIFFERENCE_WINDOW / pixel))
    square = _mean_of_channels(along_x**2 + along_y**2) / pixel**2
    steepness = cv2.GaussianBlur(square, (0, 0), _SQUARE_WINDOW / pixel)
    return np.asarray(_MISREGISTRATION**2 * steepness + _DIFFERENCE**2 + (_NOISE_SHARE * noise) ** 2, np.float32)


def agreement_weight(neighbour: FloatArray, frame: FloatArray, tolerance: FloatArray) -> FloatArray:
    """Weight of a registered image beside another.

    ``neighbour, frame`` (H, W) or (H, W, 3); ``tolerance`` (h, w); returns (h, w).
    """
    return agreement_on_grid(reduced(neighbour - frame), tolerance, pixel_of(frame.shape))


def agreement_on_grid(difference: FloatArray, tolerance: FloatArray, pixel: float) -> FloatArray:
    """Weight (h, w) of an image from its difference (h, w[, 3]) on a grid whose pixel is so many of the image wide."""
    difference = cv2.GaussianBlur(difference, (0, 0), _DIFFERENCE_WINDOW / pixel)
    np.square(difference, out=difference)
    square = cv2.GaussianBlur(_mean_of_channels(difference), (0, 0), _SQUARE_WINDOW / pixel)
    return np.asarray(np.exp(square / (-2 * tolerance)), np.float32)


def share_of_estimate(estimate: FloatArray, frame: FloatArray, mean: FloatArray, noise: float) -> FloatArray:
    """Share, 0 to 1, with which an estimate replaces a frame.

    ``estimate, frame, mean`` (h, w), luminance on the grid; returns (h, w).
    """
    ours, seen, middle = (cv2.GaussianBlur(one, (0, 0), _IMAGE_WINDOW) for one in (estimate, frame, mean))
    further, near = (_averaged((one - middle) ** 2) for one in (ours, seen))
    sharp, was_sharp = (_averaged(x**2 + y**2) for x, y in map(sobel_gradient, (ours, seen)))
    distance = further / (_FURTHER * (near + _EVEN))
    softness = (was_sharp - np.float32(_OF_NOISE * noise**2)) / (_SOFTER * (sharp + _EVEN))
    return 1 / ((1 + distance**4) * (1 + np.maximum(softness, 0) ** 4))


def _averaged(image: FloatArray) -> FloatArray:
    return cv2.GaussianBlur(image, (0, 0), _CHECKED_WINDOW)


def _mean_of_channels(image: FloatArray) -> FloatArray:
    # Ten times as fast as NumPy's mean along a short axis.
    return image if image.ndim == 2 else cv2.transform(image, np.full((1, image.shape[2]), 1 / image.shape[2]))

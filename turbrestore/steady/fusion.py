"""Fusion of a dewarped frame with its registered neighbours.

Symbols
-------
J : the frame, dewarped; J_i its neighbours, warped onto it
e : difference J_i − J, averaged in a small window and squared
t : difference that misregistration and noise explain, intensity, ``t² = m² |∇J|² + d² + (s n)²`` with n the noise:
    at edges, registration that is wrong by a fraction of a pixel and a blur that changes leave a difference
w : weight of a neighbour, ``exp(−e / 2t²)``

Where a neighbour shows something else than the frame, because an object or the background it uncovers has moved, or
the flow is wrong, e exceeds what t allows and the neighbour has no weight: the frame passes as it is, and nothing of
the neighbour is left as a ghost.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..core.gradient import sobel_gradient

# Windows, pixels, in which the difference and its square are averaged.
_DIFFERENCE_WINDOW, _SQUARE_WINDOW = 1.5, 2.0
# d, the tolerance of flat regions, intensity; m, pixels; s, the share of the noise that the windows leave.
_DIFFERENCE, _MISREGISTRATION, _NOISE_SHARE = 0.02, 1.0, 0.5


def fuse(frame: FloatArray, neighbours: Iterable[FloatArray], noise: float) -> tuple[FloatArray, FloatArray]:
    """Average a frame with the neighbours that agree with it.

    ``frame`` (H, W) or (H, W, 3); returns ``agreement`` (H, W).
    """
    total, weights, count = frame.copy(), np.ones(frame.shape[:2], np.float32), 0
    tolerance = explained_difference(frame, noise)
    for neighbour in neighbours:
        weight = agreement_weight(neighbour, frame, tolerance)
        total += weight * neighbour if frame.ndim == 2 else weight[..., None] * neighbour
        weights += weight
        count += 1
    agreement = np.asarray((weights - 1) / count if count else weights, np.float32)
    return total / (weights if frame.ndim == 2 else weights[..., None]), agreement


def explained_difference(frame: FloatArray, noise: float) -> FloatArray:
    """Squared difference that misregistration and noise explain.

    ``frame`` (H, W) or (H, W, 3); returns (H, W).
    """
    along_x, along_y = sobel_gradient(cv2.GaussianBlur(frame, (0, 0), _DIFFERENCE_WINDOW))
    square = along_x**2 + along_y**2
    steepness = cv2.GaussianBlur(square if frame.ndim == 2 else square.mean(-1), (0, 0), _SQUARE_WINDOW)
    return np.asarray(_MISREGISTRATION**2 * steepness + _DIFFERENCE**2 + (_NOISE_SHARE * noise) ** 2, np.float32)


def agreement_weight(neighbour: FloatArray, frame: FloatArray, tolerance: FloatArray) -> FloatArray:
    """Weight of a registered image beside another.

    ``neighbour, frame`` (H, W) or (H, W, 3); ``tolerance`` (H, W); returns (H, W).
    """
    difference = cv2.GaussianBlur(neighbour - frame, (0, 0), _DIFFERENCE_WINDOW)
    np.square(difference, out=difference)
    square = difference if frame.ndim == 2 else difference.mean(-1)
    return np.asarray(np.exp(cv2.GaussianBlur(square, (0, 0), _SQUARE_WINDOW) / (-2 * tolerance)), np.float32)

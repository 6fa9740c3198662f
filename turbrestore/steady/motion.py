"""What moves in a frame: objects whose path is longer than turbulence displaces.

Symbols
-------
G_i : flow from the frame to its neighbour i frames away, without the motion of the camera, pixels
v : velocity, pixels a frame: ``Σ i (G_i − G_{−i}) / 2 Σ i²``, the least squares fit over pairs of neighbours
I, I_i : the frame; a neighbour, brought onto it by the motion of the camera alone
c : what turbulence displaces at most, pixels

A point moves where ``|v| i > 2 c`` for the furthest pair, and where I_i and I_{−i} both differ from I: in flat regions
a flow is arbitrary, but the images are alike.  A point moves as well where the registered neighbours show something
else than the frame (:mod:`turbrestore.steady.fusion`), as beside an object that covers the background.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray

# Agreement of the neighbours below which a point moves; path in units of c.
_AGREEMENT, _PATH = 0.5, 2.0
# Window of the differences, pixels, and the smallest that counts, intensity.
_WINDOW, _DIFFERENCE = 2.0, 0.04


def moving_mask(
    flows: Mapping[int, FloatArray],
    image: FloatArray,
    placed: Mapping[int, FloatArray],
    agreement: FloatArray,
    largest: float,
) -> NDArray[np.bool_]:
    """Mark the points that move.

    ``flows`` (H, W, 2); ``image`` (H, W); ``placed`` (H, W); ``agreement`` (H, W); returns (H, W).
    """
    moving = agreement < _AGREEMENT
    pairs = [offset for offset in flows if offset > 0 and -offset in flows]
    if not placed:
        return moving
    velocity = np.zeros((*image.shape, 2), np.float32)
    for offset in pairs:
        velocity += offset / (2 * sum(pair**2 for pair in pairs)) * (flows[offset] - flows[-offset])
    differs = [cv2.GaussianBlur((other - image) ** 2, (0, 0), _WINDOW) > _DIFFERENCE**2 for other in placed.values()]
    path = np.hypot(velocity[..., 0], velocity[..., 1]) * max(pairs)
    return moving | ((path > _PATH * largest) & np.logical_and.reduce(differs))

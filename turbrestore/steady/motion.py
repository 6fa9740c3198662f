"""What moves in a frame: objects whose path is longer than turbulence displaces.

Symbols
-------
G_i : flow from the frame to its neighbour i frames away, without the motion of the camera, pixels
v : velocity, pixels a frame: ``Σ i G_i / Σ i²``, the least squares fit
I, I_i : the frame; a neighbour, brought onto it by the motion of the camera alone
c : what turbulence displaces at most, pixels

A point moves where ``|v| i > 2 c`` for the furthest neighbour, and where two neighbours, one on either side if there
are, both differ from I: in flat regions a flow is arbitrary, but the images are alike.  A point moves as well where the
registered neighbours show something else than the frame (:mod:`turbrestore.steady.fusion`), as beside an object that
covers the background.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray

# Agreement of the neighbours below which a point moves; longest path of turbulence, in units of c.
_AGREEMENT, _PATH = 0.5, 2.0
# Window of the differences, pixels, and the smallest that counts, intensity.
_WINDOW, _DIFFERENCE = 2.0, 0.04


def moving_mask(
    path: FloatArray, image: FloatArray, placed: Sequence[FloatArray], agreement: FloatArray, pixel: float
) -> NDArray[np.bool_]:
    """Mark the points that move, on a grid whose pixel is so many of the image wide.

    ``path`` (h, w), in units of what turbulence displaces at most; ``image`` (h, w); ``placed`` (h, w) each;
    ``agreement`` (h, w); returns (h, w).
    """
    moving = agreement < _AGREEMENT
    if not placed:
        return moving
    squares = [cv2.GaussianBlur((other - image) ** 2, (0, 0), _WINDOW / pixel) for other in placed]
    return moving | ((path > _PATH) & np.logical_and.reduce([square > _DIFFERENCE**2 for square in squares]))


def path_length(flows: Mapping[int, FloatArray]) -> FloatArray:
    """Length of the path to the furthest neighbour at constant velocity.

    ``flows`` (h, w, 2), at least one; returns (h, w).
    """
    pairs = {offset: flow for offset, flow in flows.items() if -offset in flows}
    if 3 * max(pairs, default=0) >= max(map(abs, flows)):
        # The displacement of the frame itself cancels in pairs.
        flows = pairs
    moments = [np.float32(offset) * flow for offset, flow in flows.items()]
    velocity = np.add.reduce(moments)
    furthest, squares = max(map(abs, flows)), sum(offset**2 for offset in flows)
    return np.hypot(velocity[..., 0], velocity[..., 1]) * np.float32(furthest / squares)


def witnesses(offsets: Iterable[int]) -> tuple[int, ...]:
    """Choose the neighbours that show whether something moved: the furthest, and one like it on the other side.

    Where the other side is shorter than half, it is one half as far on the same side.
    """
    offsets = sorted(offsets, key=abs)
    if len(offsets) < 2:
        return ()
    furthest = offsets[-1]
    others = sorted(offsets[:-1], key=lambda offset: abs(offset + furthest))
    if 2 * abs(others[0] + furthest) > abs(furthest):
        others = sorted(offsets[:-1], key=lambda offset: abs(2 * offset - furthest))
    return furthest, others[0]

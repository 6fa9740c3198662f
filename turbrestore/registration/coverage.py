"""How many frames show each pixel: near the border of an image, motion carries pixels out of view."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError, require_between
from ..runtime.scratch import iter_frames
from .warp import inside

Rectangle = tuple[int, int, int, int]
# Least share of the frames that show every border pixel of a cropped image; chosen: noise there is about 5 % higher.
SEEN = 0.9


def coverage(flows: ArrayLike) -> FloatArray:
    """Share (H, W) of the frames that show each pixel of the reference of their flows (T, H, W, 2)."""
    stack = check_flow(flows, "flows")
    if stack.ndim != 4 or not len(stack):
        raise DataError(f"flows: expected shape (T, H, W, 2) with at least one flow, found {stack.shape}")
    total = np.zeros(stack.shape[1:3], np.float32)
    for flow in iter_frames(stack):
        total += inside(flow)
    return total / np.float32(len(stack))


def well_seen(seen: ArrayLike, least: float = SEEN, margin: int = 0, smallest: int = 16) -> Rectangle:
    """Rectangle whose border enough frames show, by their share ``seen`` (H, W).

    The side with the worst pixel is trimmed until no pixel of the border is below ``least``; pixels inside are not
    examined. If less than the smallest size would be left, nothing is trimmed.
    """
    require_between("least", least, 0, 1)
    require_between("margin", margin, 0, 10_000, "pixels")
    share = np.asarray(seen)
    top, left, (bottom, right) = 0, 0, share.shape
    while bottom - top >= smallest and right - left >= smallest:
        view = share[top:bottom, left:right]
        sides = (view[0], view[-1], view[:, 0], view[:, -1])
        worst = min(range(4), key=lambda side: (sides[side].min(), sides[side].mean()))
        if sides[worst].min() >= least:
            break
        top, bottom, left, right = top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
    else:
        return 0, 0, share.shape[1], share.shape[0]
    spare = min(margin, max(0, (min(bottom - top, right - left) - smallest) // 2))
    return left + spare, top + spare, right - left - 2 * spare, bottom - top - 2 * spare

"""How many frames show each pixel: near the border of an image, motion carries pixels out of view."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError, require_between
from ..runtime.scratch import iter_frames
from .warp import inside

Rectangle = tuple[int, int, int, int]


def coverage(flows: ArrayLike) -> FloatArray:
    """Share of the frames that show each pixel of the reference.

    Parameters
    ----------
    flows : array_like, shape (T, H, W, 2)
        From the reference to each frame, pixels.

    Returns
    -------
    ndarray, float32, shape (H, W)
        0 to 1.

    Raises
    ------
    DataError
        Wrong shape, no flows, or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> flows = np.zeros((2, 3, 4, 2), np.float32); flows[1, ..., 0] = 2
    >>> coverage(flows)[0]
    array([1. , 1. , 0.5, 0.5], dtype=float32)
    """
    stack = check_flow(flows, "flows")
    if stack.ndim != 4 or not len(stack):
        raise DataError(f"flows: expected shape (T, H, W, 2) with at least one flow, found {stack.shape}")
    total = np.zeros(stack.shape[1:3], np.float32)
    for flow in iter_frames(stack):
        total += inside(flow)
    return total / np.float32(len(stack))


def well_seen(seen: ArrayLike, least: float = 0.9, margin: int = 0, smallest: int = 16) -> Rectangle:
    """Rectangle whose border enough frames show.

    The side with the worst pixel is trimmed until no pixel of the border is below ``least``; pixels inside are not
    examined.  If less than the smallest size would be left, nothing is trimmed.

    Parameters
    ----------
    seen : array_like, shape (H, W)
        From :func:`coverage`.
    least : float
        Share of the frames, 0 to 1.
    margin : int
        Further pixels to trim on every side.
    smallest : int
        Shortest side of the result, pixels.

    Returns
    -------
    x, y, width, height : int
        Pixels.

    Raises
    ------
    ConfigurationError
        ``least`` or ``margin`` is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> seen = np.ones((40, 60)); seen[:3] = 0.5
    >>> well_seen(seen, margin=1)
    (1, 4, 58, 35)
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

"""Inversion and composition of flows.

Symbols
-------
W : flow, pixels, ``w = id + W``; V : inverse flow, ``(id + W) ∘ (id + V) = id``.  Both sample flows bilinearly.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError
from .warp import sample_linear, strips


def invert_flow(flow: ArrayLike, iterations: int = 20, tolerance: float = 1e-3) -> FloatArray:
    """Flow of the inverse map: ``(id + W) ∘ (id + V) = id``.

    Fixed-point iteration ``V ← −W ∘ (id + V)``; it converges if the flow stretches by less than a factor of two
    (Lipschitz constant of W below 1), as atmospheric flows do.

    Parameters
    ----------
    flow : array_like, shape (H, W, 2)
        Displacements W (dx, dy) in pixels.
    iterations : int
        Largest number of fixed-point steps.
    tolerance : float
        The iteration ends when no displacement changes by more than this many pixels; a large flow is inverted some
        rows at a time.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)
        V, in pixels.

    Raises
    ------
    DataError
        Wrong shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> shift = np.full((4, 4, 2), 0.5, np.float32)
    >>> invert_flow(shift)[0, 0]
    array([-0.5, -0.5], dtype=float32)
    """
    flow = check_flow(flow)
    if flow.ndim != 3:
        raise DataError(f"flow: expected shape (H, W, 2), found {flow.shape}")
    inverse, planes = -flow, cv2.split(flow)
    for rows in strips(flow.shape):
        for _ in range(iterations):
            update = sample_linear(planes, inverse[rows], rows)
            np.negative(update, out=update)
            change = cv2.norm(update, inverse[rows], cv2.NORM_INF)
            inverse[rows] = update
            if change <= tolerance:
                break
    return inverse


def compose_flows(outer: ArrayLike, inner: ArrayLike) -> FloatArray:
    """Flow of ``(id + outer) ∘ (id + inner)``: follow ``inner`` first, then ``outer`` from where it leads.

    ``warp(warp(I, outer), inner) ≈ warp(I, compose_flows(outer, inner))``, without the second interpolation.

    Parameters
    ----------
    outer, inner : array_like, shape (H, W, 2)
        Displacements (dx, dy) in pixels.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> a, b = np.full((4, 4, 2), 0.5, np.float32), np.full((4, 4, 2), -0.2, np.float32)
    >>> compose_flows(a, b)[1, 1]
    array([0.3, 0.3], dtype=float32)
    """
    outer, inner = check_flow(outer, "outer"), check_flow(inner, "inner")
    if outer.ndim != 3 or outer.shape != inner.shape:
        raise DataError(f"inner: expected shape (H, W, 2) as outer has, found {outer.shape} and {inner.shape}")
    return inner + sample_linear(cv2.split(outer), inner)

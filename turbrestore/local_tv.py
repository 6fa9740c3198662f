"""Total variation by differences of neighbouring pixels, periodic."""

from __future__ import annotations

import numpy as np

from .arrays import FloatArray
from .primal_dual import Regulariser


def local_gradient(u: FloatArray) -> FloatArray:
    """Periodic forward differences.

    Parameters
    ----------
    u : ndarray, float32, shape (H, W)
        Image.

    Returns
    -------
    ndarray, float32, shape (2, H, W)
        Along rows' index y, and along x.

    Examples
    --------
    >>> import numpy as np
    >>> local_gradient(np.array([[1.0, 3.0]], np.float32))[1]
    array([[ 2., -2.]], dtype=float32)
    """
    return np.stack([np.roll(u, -1, axis=0) - u, np.roll(u, -1, axis=1) - u])


def local_divergence(v: FloatArray) -> FloatArray:
    """Negative adjoint of :func:`local_gradient`.

    Parameters
    ----------
    v : ndarray, float32, shape (2, H, W)
        Vector field.

    Returns
    -------
    ndarray, float32, shape (H, W)

    Examples
    --------
    >>> import numpy as np
    >>> local_divergence(np.array([[[0.0, 0.0]], [[2.0, 0.0]]], np.float32))
    array([[ 2., -2.]], dtype=float32)
    """
    return v[0] - np.roll(v[0], 1, axis=0) + v[1] - np.roll(v[1], 1, axis=1)


LOCAL_TV = Regulariser(
    gradient=local_gradient,
    adjoint=lambda p: -local_divergence(p),
    project=lambda p: p / np.maximum(np.sqrt(np.square(p).sum(axis=0)), 1),
    value=lambda u: float(np.sqrt(np.square(local_gradient(u)).sum(axis=0)).sum(dtype=np.float64)),
    norm_squared=8.0,
)

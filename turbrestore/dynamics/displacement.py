"""Correct the size of the motion in a flow model by the displacement variance that blur shows."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import DataError
from .flow_model import FlowDynamics

# Standard error of the variance of measured flows as an estimate of the variance of the motion, and standard error of a
# displacement variance beside its own deviation, as shares of each.
_FLOW_ERROR, _CUE_ERROR = 0.3, 0.15
# With a larger variance of the motion, squared pixels, structure leaves the tiles in which a displacement variance is
# measured.
_LARGEST_VARIANCE = 20.0
# Standard deviation of the square of a Hann window of 64 pixels, in which a displacement variance is measured; pixels.
_TILE_WINDOW = 9.0
# Variance of flows below which nothing moves, squared pixels.
_LEAST_VARIANCE = 1e-12
# A model without motion could not follow any frame.
_LEAST_FACTOR = 0.05


def with_displacement(dynamics: FlowDynamics, variance: ArrayLike, deviation: ArrayLike) -> FlowDynamics:
    """Correct the size of the motion by a displacement variance that was measured without the flows.

    Measured flows contain noise beside motion, and flow methods smooth some of the motion away: their variance,
    averaged over the window of a tile, is assumed to be that of the motion within 30 %.  The displacement variance is
    assumed to be right within its deviation and 15 %.  Large motion moves structure out of the tiles (of 34 squared
    pixels a third to a half was missing, of 5 to 13 up to 30 %), so the square of the larger variance over 20 squared
    pixels is added to its error.

    The mean of both, weighted by inverse variance, divided by the variance of the flows is ``motion_factor``.  Q and
    the stationary covariance of the state are scaled by its mean, which assumes that noise and motion have the same
    directions.  The filter takes at most this share of the flow outside the subspace of C to be motion.

    Parameters
    ----------
    dynamics : FlowDynamics
    variance : float or array_like, shape (H, W)
        Variance of the displacement per axis, squared pixels, as of
        :func:`turbrestore.blur_moments.cues.displacement_variance`.
    deviation : float or array_like, shape (H, W)
        Its standard deviation, squared pixels; infinite where it is unknown.

    Returns
    -------
    FlowDynamics
        With a new ``motion_factor``, at least 0.05, and Q scaled by the change of its mean.

    Raises
    ------
    DataError
        Shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> flows = np.zeros((6, 2, 2, 2), np.float32); flows[::2], flows[1::2] = 1, -1
    >>> dynamics = identify(flows)
    >>> with_displacement(dynamics, variance=0.6, deviation=0.0).motion_factor.round(2)[0]
    array([0.55, 0.55], dtype=float32)
    >>> with_displacement(dynamics, variance=0.6, deviation=np.inf).motion_factor[0]
    array([1., 1.], dtype=float32)
    """
    cue, error = np.asarray(variance, np.float64), np.asarray(deviation, np.float64)
    for name, given in (("variance", cue), ("deviation", error)):
        if given.shape not in ((), dynamics.shape):
            raise DataError(f"{name}: expected one number or shape {dynamics.shape}, found {given.shape}")
    measured = np.maximum(cv2.GaussianBlur(dynamics.flow_variance, (0, 0), _TILE_WINDOW), _LEAST_VARIANCE)
    missing = np.maximum(measured, cue) ** 2 / _LARGEST_VARIANCE
    own, other = (_FLOW_ERROR * measured) ** -2, 1 / (error**2 + (_CUE_ERROR * cue) ** 2 + missing**2)
    motion = (own * measured + other * cue) / (own + other)
    factor = np.maximum(motion / measured, _LEAST_FACTOR).astype(np.float32)
    change = float(factor.mean() / dynamics.motion_factor.mean())
    return replace(dynamics, Q=dynamics.Q * change, motion_factor=factor)

"""The size of the motion in a flow model, drawn towards what blur says of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import DataError
from .flow_model import FlowDynamics

# Standard deviation of the variance of measured flows about that of the motion, and error of a displacement variance
# besides its deviation, as shares of each.
_FLOW_ERROR, _CUE_ERROR = 0.3, 0.15
# What moves by more than this in variance, squared pixels, leaves the tiles that a displacement variance is seen in.
_LARGEST_VARIANCE = 20.0
# Standard deviation of the square of a Hann window of 64 pixels, through which a displacement variance is seen; pixels.
_TILE_WINDOW = 9.0
# Variance of flows below which nothing moves, squared pixels.
_LEAST_VARIANCE = 1e-12
# A model without motion would never follow a frame.
_LEAST_FACTOR = 0.05


def with_displacement(dynamics: FlowDynamics, variance: ArrayLike, deviation: ArrayLike) -> FlowDynamics:
    """Draw the size of the motion towards a displacement variance that was found without the flows.

    Measured flows hold noise besides motion, and smooth some of the motion away: their variance, seen through the
    window of a tile, is taken to be that of the motion within 30 %.  The displacement variance is taken to be right
    within its deviation and 15 %; and as structure leaves the tiles that large motion is seen in (of 34 squared pixels
    a third to a half was missing, of 5 to 13 up to 30 %), the square of the larger variance over 20 squared pixels adds
    to its error.

    The mean of both, weighted by inverse variance, over the variance of the flows is ``motion_factor``.  Q and the
    stationary covariance of the state change by its mean: noise and motion are thought to share the directions of the
    flow alike.  A filter takes at most this share of what C leaves out to be motion.

    Parameters
    ----------
    dynamics : FlowDynamics
    variance : float or array_like, shape (H, W)
        Variance of the displacement per axis, squared pixels, as of
        :func:`turbrestore.blur_moments.cues.displacement_variance`.
    deviation : float or array_like, shape (H, W)
        Its standard deviation, squared pixels; infinite where nothing is known.

    Returns
    -------
    FlowDynamics
        With another ``motion_factor``, at least 0.05, and Q scaled by the change of its mean.

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
    lost = np.maximum(measured, cue) ** 2 / _LARGEST_VARIANCE
    own, other = (_FLOW_ERROR * measured) ** -2, 1 / (error**2 + (_CUE_ERROR * cue) ** 2 + lost**2)
    motion = (own * measured + other * cue) / (own + other)
    factor = np.maximum(motion / measured, _LEAST_FACTOR).astype(np.float32)
    change = float(factor.mean() / dynamics.motion_factor.mean())
    return replace(dynamics, Q=dynamics.Q * change, motion_factor=factor)

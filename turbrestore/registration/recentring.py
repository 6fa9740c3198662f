"""The mean geometry of all frames: an image is moved onto it after the last frame.

Symbols
-------
q : image; W_k : flow from q to frame I_k, pixels; W̄ : mean of W_k over the frames that count
V : inverse flow, ``(id + V) = (id + W̄)^{-1}``

The centroid of the training frames is not that of all frames: where turbulence is correlated in time, half of a clip
has a mean flow of its own.  Flows from one image to all frames tell how far it lies from their mean geometry: exactly
by W̄ (paper 3, eq. 12), so ``q ∘ (id + V)`` lies there, and the flows from it, ``W_k ∘ (id + V) + V``, average to zero.

Measured flows have a bias, up to 2 px where the image is much sharper than the frames, and their mean over the training
frames, whose centroid has been found, shows it.  So the filter takes W̄ as the difference of the means over all frames
and over the training frames: a clip that has trained as a whole is left where it is.

The mean geometry is itself known only as well as the motion of finitely many frames averages out; see
:func:`turbrestore.dynamics.flow_model.mean_flow_error`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow, check_image
from ..core.errors import DataError
from .camera.global_shift import DEAD_ZONE
from .flow_algebra import invert_flow
from .warp import warp


def recentring_flow(mean_flow: ArrayLike) -> FloatArray:
    """Flow V (H, W, 2) that moves an image onto the mean geometry: the inverse of W̄.

    A shift of the whole image by more than two pixels is the camera's; it is left, because it bends nothing, and
    following it would move a part of the image out of the frame.
    """
    flow = check_flow(mean_flow, "mean_flow")
    if flow.ndim != 3:
        raise DataError(f"mean_flow: expected shape (H, W, 2), found {flow.shape}")
    shift = np.median(flow.reshape(-1, 2), axis=0)
    return invert_flow(flow - shift if np.hypot(*shift) > DEAD_ZONE else flow)


def recentre(image: ArrayLike, mean_flow: ArrayLike) -> FloatArray:
    """Move an image onto the mean geometry of its frames: ``q ∘ (id + W̄)^{-1}`` (Micheli et al., eq. 12).

    :meth:`turbrestore.Filtered.recentred` does the same with the filtered image and its variance.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        q, such as the centroid.
    mean_flow : array_like, shape (H, W, 2)
        W̄, pixels, such as ``Filtered.mean_flow``.

    Returns
    -------
    ndarray, float32, of the shape of the image

    Raises
    ------
    DataError
        Wrong shapes, or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.tile(np.linspace(0, 1, 11, dtype=np.float32), (8, 1))
    >>> round(float(recentre(ramp, np.full((8, 11, 2), [1.0, 0.0]))[4, 5]), 3)
    0.4
    """
    V = recentring_flow(mean_flow)
    # Interpolation by no shift would change the last bits.
    return warp(image, V) if V.any() else check_image(image)

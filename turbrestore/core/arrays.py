"""Checks and conversions of images, stacks of frames and flows.

=========  ==================================  =======  ================================================
name       shape                               dtype    unit
=========  ==================================  =======  ================================================
image      (H, W) or (H, W, C)                 float32  intensity, 0 black to 1 full scale
frames     (T, H, W) or (T, H, W, C)           float32  intensity, 0 black to 1 full scale
flow       (H, W, 2)                           float32  pixels, last axis (dx, dy)
flows      (T, H, W, 2)                        float32  pixels, last axis (dx, dy)
=========  ==================================  =======  ================================================

One sign rule holds everywhere: ``reference(x, y) ≈ frame(x + dx, y + dy)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError

FloatArray = NDArray[np.float32]

CHANNELS = (3,)
# Numbers in each part of a large array that is processed in parts.
_PART = 1 << 22
# Weights of RGB by Rec. 601, as OpenCV and most cameras use them.
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)


def check_image(image: ArrayLike, name: str = "image") -> FloatArray:
    """Return ``image`` as a finite float32 array of shape (H, W) or (H, W, 3).

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Floating point intensities (0 to 1), or unsigned integers, which are divided by the largest value of
        their type.
    name : str
        Name of the array in error messages.

    Returns
    -------
    ndarray, float32
        The image itself when it already has the right type, a copy otherwise.

    Raises
    ------
    DataError
        Wrong number of axes or channels, empty, not numeric, NaN or infinite values.

    Examples
    --------
    >>> import numpy as np
    >>> check_image(np.array([[0, 255]], np.uint8))
    array([[0., 1.]], dtype=float32)
    """
    array = _as_float(image, name)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in CHANNELS):
        raise DataError(f"{name}: expected shape (H, W) or (H, W, 3), found {array.shape}")
    return _finite(array, name)


def check_frames(frames: ArrayLike, name: str = "frames", at_least: int = 1) -> FloatArray:
    """Return ``frames`` as a finite float32 array of shape (T, H, W) or (T, H, W, 3).

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Floating point intensities (0 to 1), or unsigned integers, which are divided by the largest value of
        their type.
    name : str
        Name of the array in error messages.
    at_least : int
        Smallest number of frames that the caller can work with.

    Returns
    -------
    ndarray, float32
        The array itself when it already has the right type, a copy otherwise.

    Raises
    ------
    DataError
        Too few frames, wrong number of axes or channels, not numeric, NaN or infinite values.

    Examples
    --------
    >>> import numpy as np
    >>> check_frames(np.zeros((4, 2, 3))).shape
    (4, 2, 3)
    """
    array = _as_float(frames, name)
    if array.ndim not in (3, 4) or (array.ndim == 4 and array.shape[3] not in CHANNELS):
        raise DataError(f"{name}: expected shape (T, H, W) or (T, H, W, 3), found {array.shape}")
    if len(array) < at_least:
        raise DataError(f"{name}: expected at least {at_least} frames, found {len(array)}")
    return _finite(array, name)


def check_flow(flow: ArrayLike, name: str = "flow") -> FloatArray:
    """Return ``flow`` as a finite float32 array of shape (H, W, 2) or (T, H, W, 2).

    Parameters
    ----------
    flow : array_like, shape (H, W, 2) or (T, H, W, 2)
        Displacements in pixels, last axis (dx, dy).
    name : str
        Name of the array in error messages.

    Returns
    -------
    ndarray, float32
        The flow itself when it already has the right type, a copy otherwise.

    Raises
    ------
    DataError
        Wrong shape, empty, not numeric, NaN or infinite values.

    Examples
    --------
    >>> import numpy as np
    >>> check_flow(np.zeros((2, 3, 2))).dtype
    dtype('float32')
    """
    values = np.asarray(flow)
    if values.dtype.kind not in "fiu":
        raise DataError(f"{name}: expected real numbers, found {values.dtype}")
    array = values.astype(np.float32, copy=False)
    if array.ndim not in (3, 4) or array.shape[-1] != 2:
        raise DataError(f"{name}: expected shape (H, W, 2) or (T, H, W, 2), found {array.shape}")
    return _finite(array, name)


def luminance(image: FloatArray) -> FloatArray:
    """Luminance of an image or of frames, by the weights of Rec. 601.

    Parameters
    ----------
    image : ndarray, float32, shape (..., H, W) or (..., H, W, 3)
        Arrays with two axes, or whose last axis is not 3, are grey already.

    Returns
    -------
    ndarray, float32, shape (..., H, W)

    Examples
    --------
    >>> import numpy as np
    >>> luminance(np.ones((2, 2, 3), np.float32))
    array([[1., 1.],
           [1., 1.]], dtype=float32)
    """
    if image.ndim < 3 or image.shape[-1] not in CHANNELS:
        return image
    grey, done = np.empty(image.shape[:-1], np.result_type(image, _LUMA)), 0
    # In parts, without a temporary of the size of the image.
    for part in _parts(image):
        np.matmul(part, _LUMA, out=grey[done : done + len(part)])
        done += len(part)
    return grey


def from_unit(image: FloatArray, bit_depth: int) -> NDArray[np.unsignedinteger]:
    """Quantise intensities in [0, 1] to unsigned integers of ``bit_depth`` bits.

    Parameters
    ----------
    image : ndarray, float32
        Values outside [0, 1] are clipped.
    bit_depth : int
        1 to 16; up to 8 gives uint8, above gives uint16.

    Returns
    -------
    ndarray, uint8 or uint16

    Examples
    --------
    >>> import numpy as np
    >>> from_unit(np.array([0.0, 0.5, 1.2], np.float32), 8)
    array([  0, 128, 255], dtype=uint8)
    """
    top = 2**bit_depth - 1
    dtype = np.uint8 if bit_depth <= 8 else np.uint16
    levels, done = np.empty(image.shape, dtype), 0
    # In parts, because they are computed in double precision.
    for part in _parts(image):
        levels[done : done + len(part)] = np.rint(np.clip(part, 0.0, 1.0) * np.float64(top))
        done += len(part)
    return levels


def _parts(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Consecutive views along the first axis, each of a few million numbers at most."""
    step = max(1, len(array) * _PART // max(array.size, 1))
    return (array[start : start + step] for start in range(0, len(array), step))


def _as_float(values: ArrayLike, name: str) -> FloatArray:
    array = np.asarray(values)
    if np.issubdtype(array.dtype, np.unsignedinteger):
        return (array / np.float32(np.iinfo(array.dtype).max)).astype(np.float32)
    if not np.issubdtype(array.dtype, np.floating):
        raise DataError(f"{name}: expected floating point or unsigned integer values, found {array.dtype}")
    return array.astype(np.float32, copy=False)


def _finite(array: FloatArray, name: str) -> FloatArray:
    if array.size == 0:
        raise DataError(f"{name}: expected at least one pixel, found shape {array.shape}")
    # In parts, without a temporary of the array's size.
    if not all(np.isfinite(part).all() for part in _parts(array)):
        bad = int(array.size - np.count_nonzero(np.isfinite(array)))
        raise DataError(f"{name}: expected finite values, found {bad} NaN or infinite ones")
    return array

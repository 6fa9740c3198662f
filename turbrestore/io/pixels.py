"""From the pixel values of files to intensities in [0, 1], by one rule for all formats.

Integers are divided by the value that means white in their file; floating point values have to lie in [0, 1]
already, because nothing says what else they mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import DataError, require

PixelArray = NDArray[Any]

# 67 million, twice an 8K frame; a frame of this size takes 800 MB as RGB in float32.
MAX_PIXELS = 2**26
# Rounding and resampling overshoot a little; values further out mean that another scale was used.
FLOAT_MARGIN = 0.01


def to_unit(pixels: PixelArray, full_scale: float, name: str) -> FloatArray:
    """Turn the pixel values of a file into intensities in [0, 1].

    Parameters
    ----------
    pixels : ndarray
        Unsigned integers, or floating point values in [0, 1]. Floating point values up to 0.01 outside are
        clipped: rounding and resampling leave such values, while another scale (0 to 255, 0 to 4095) goes far
        beyond.
    full_scale : float
        The integer that means 1; ignored for floating point values.
    name : str
        How error messages call the array.

    Returns
    -------
    ndarray, float32, shape of ``pixels``
        A new array.

    Raises
    ------
    DataError
        NaN, infinite or out of range.

    Examples
    --------
    >>> import numpy as np
    >>> to_unit(np.array([0, 1023], np.uint16), 1023, "frame 0")
    array([0., 1.], dtype=float32)
    >>> to_unit(np.array([0.0, 4095.0]), 1, "frame 0")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.DataError: frame 0: expected values in 0 to 1, found 0 to 4095; divide them by full scale
    """
    pixels = np.asarray(pixels)
    if np.issubdtype(pixels.dtype, np.unsignedinteger):
        if full_scale < np.iinfo(pixels.dtype).max and pixels.max() > full_scale:
            raise DataError(f"{name}: expected values up to {full_scale:.0f}, found {pixels.max()}")
        return np.divide(pixels, np.float32(full_scale), dtype=np.float32)
    with np.errstate(over="ignore"):
        values = np.array(pixels, dtype=np.float32)
    lowest, highest = float(values.min()), float(values.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        bad = int(values.size - np.count_nonzero(np.isfinite(values)))
        raise DataError(f"{name}: expected finite values, found {bad} NaN or infinite ones")
    if lowest < -FLOAT_MARGIN or highest > 1 + FLOAT_MARGIN:
        raise DataError(
            f"{name}: expected values in 0 to 1, found {lowest:.6g} to {highest:.6g}; divide them by full scale"
        )
    return np.clip(values, 0, 1, out=values)


def full_scale_of(dtype: np.dtype[Any], name: str) -> int:
    """Value that means intensity 1 in an array of this type.

    Parameters
    ----------
    dtype : dtype
        Of the array.
    name : str
        How error messages call the array.

    Returns
    -------
    int
        The largest value of an unsigned integer type, 1 for floating point.

    Raises
    ------
    DataError
        Signed integers, booleans and other types: nothing says where their white lies.

    Examples
    --------
    >>> import numpy as np
    >>> full_scale_of(np.dtype(np.uint8), "a.tif")
    255
    """
    if np.issubdtype(dtype, np.unsignedinteger):
        return int(np.iinfo(dtype).max)
    if np.issubdtype(dtype, np.floating):
        return 1
    raise DataError(f"{name}: expected unsigned integers or floating point in 0 to 1, found {dtype}; convert the data")


def depth_of(dtype: np.dtype[Any]) -> int:
    """Bit depth of an array: its unsigned integers' bits, at most 32; 32 for floating point.

    Parameters
    ----------
    dtype : dtype
        Of the array.

    Returns
    -------
    int

    Examples
    --------
    >>> import numpy as np
    >>> depth_of(np.dtype(np.uint16)), depth_of(np.dtype(np.float64))
    (16, 32)
    """
    return min(8 * dtype.itemsize, 32) if np.issubdtype(dtype, np.unsignedinteger) else 32


def check_depth(bit_depth: int) -> int:
    """Return ``bit_depth`` if an output can have it.

    Parameters
    ----------
    bit_depth : int
        Bits per channel.

    Returns
    -------
    int

    Raises
    ------
    ConfigurationError
        Neither 1 to 16 nor 32.

    Examples
    --------
    >>> check_depth(12)
    12
    """
    known = not isinstance(bit_depth, bool) and bit_depth in {*range(1, 17), 32}
    require(known, f"bit_depth: expected 1 to 16, or 32 for floating point, found {bit_depth}")
    return bit_depth

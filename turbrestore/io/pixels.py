"""Conversion of the pixel values of files to intensities in [0, 1], by one rule for all formats.

Integers are divided by the value that means white in their file. Floating point values must lie in [0, 1] already,
because nothing in the file says what else they mean.

The mosaic of a Bayer sensor shows one colour a pixel. Its planes are the mosaics of every second row and column, whose
neighbours have one colour.
"""

from __future__ import annotations

from numbers import Integral
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, check_scale, not_finite
from ..core.errors import DataError, require
from ..core.remarks import Doubt

PixelArray = NDArray[Any]

# 67 million pixels are two 8K frames; a frame of this size takes 800 MB as float32 RGB.
MAX_PIXELS = 2**26
# Least side of a frame whose pixels tell what they are, as that of the smallest frames that are restored.
LEAST_SIDE = 16
# Rounding and resampling overshoot a little; values further outside indicate another scale; chosen.
FLOAT_MARGIN = 0.01
# Patterns of a Bayer sensor, by the colours of its first pixels.
BAYER_CODES = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
}
BAYER_REMARK = Doubt("pixels alternate as in a Bayer mosaic: --bayer rggb (or grbg, gbrg, bggr) gives colours")
# Number of the tag of EXIF and TIFF that :func:`upright` takes.
ORIENTATION_TAG = 274
# Neighbours in a mosaic differ by this factor, chosen, more than the next pixels of their colour; in an image, less.
_ALTERNATING = 1.3


def to_unit(pixels: PixelArray, full_scale: float, name: str, remedy: str = "") -> FloatArray:
    """Convert the pixel values of a file to a new array of float32 intensities in [0, 1].

    Unsigned integers are divided by ``full_scale``. Floating point values up to 0.01 outside [0, 1] are clipped:
    rounding and resampling produce such values, while another scale (0 to 255, 0 to 4095) goes far beyond. ``name`` is
    the array in messages; ``remedy`` says what to do about values that are not finite.
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
        raise not_finite(values, name, remedy)
    check_scale(lowest, highest, name, FLOAT_MARGIN)
    return np.clip(values, 0, 1, out=values)


def unrepaired(pixels: PixelArray) -> PixelArray:
    """Repair nothing: where there is a repair, a kept run depends on the remarks of a source."""
    return pixels


def full_scale_of(dtype: np.dtype[Any], name: str) -> int:
    """Value that means intensity 1: the maximum of an unsigned integer type, 1 for floating point.

    Other types raise DataError, because their white is not defined; ``name`` is the array in the message.
    """
    if np.issubdtype(dtype, np.unsignedinteger):
        return int(np.iinfo(dtype).max)
    if np.issubdtype(dtype, np.floating):
        return 1
    raise DataError(f"{name}: expected unsigned integers or floating point in 0 to 1, found {dtype}; convert the data")


def depth_of(dtype: np.dtype[Any]) -> int:
    """Bit depth of an array: the bits of integers, at most 32; 32 for floating point."""
    return min(8 * dtype.itemsize, 32) if np.issubdtype(dtype, np.integer) else 32


def check_depth(bit_depth: int) -> int:
    """Return ``bit_depth``, or raise ConfigurationError unless it is 1 to 16 or 32."""
    known = not isinstance(bit_depth, bool) and bit_depth in {*range(1, 17), 32}
    require(known, f"bit_depth: expected 1 to 16, or 32 for floating point, found {bit_depth}")
    return bit_depth


def at_levels(pixels: PixelArray, levels: tuple[float, float] | None) -> PixelArray:
    """Give intensities in floating point the numbers that 0 and 1 mean; integers stay."""
    if levels is None or pixels.dtype.kind != "f":
        return pixels
    return levels[0] + pixels * np.float32(levels[1] - levels[0])


def at_full_range(pixels: PixelArray, white: int) -> PixelArray:
    """Spread unsigned integers, of which none is above ``white``, over the range of their type."""
    full = np.iinfo(pixels.dtype).max
    if not 0 < white < full:
        return pixels
    return np.rint(np.minimum(pixels, white) * (full / white)).astype(pixels.dtype)


def without_alpha(pixels: PixelArray) -> tuple[PixelArray, tuple[str, ...]]:
    """Drop the last channel of two or four; return the pixels, and a warning where there was one."""
    if pixels.ndim == 2 or pixels.shape[2] not in (2, 4):
        return pixels, ()
    colours = pixels[..., 0] if pixels.shape[2] == 2 else pixels[..., :3]
    return np.ascontiguousarray(colours), ("alpha channel ignored",)


def upright(pixels: PixelArray, orientation: object) -> PixelArray:
    """Turn and mirror an image as its EXIF or TIFF orientation tag, 1 to 8, demands; other values do nothing."""
    if not isinstance(orientation, Integral) or orientation not in range(2, 9):
        return pixels
    place = int(orientation) - 1
    if place >= 4:
        pixels = np.swapaxes(pixels, 0, 1)
    horizontal, vertical = [(1, 1), (-1, 1), (-1, -1), (1, -1)][place % 4]
    return np.ascontiguousarray(pixels[::vertical, ::horizontal])


def demosaic(pixels: PixelArray, pattern: str) -> PixelArray:
    """Turn a mosaic (H, W) into RGB (H, W, 3) of its type by bilinear interpolation.

    OpenCV's edge-aware interpolation gains a little on sharp frames without noise, and loses as much or more on noisy
    ones, which is what turbulent footage is made of.
    """
    if pixels.dtype.itemsize > 2:
        return _demosaic_wide(pixels, pattern)
    return cv2.cvtColor(pixels.astype(pixels.dtype.newbyteorder("=")), BAYER_CODES[pattern])


def _demosaic_wide(pixels: PixelArray, pattern: str) -> PixelArray:
    """Do the same for types that OpenCV does not take: means of the pixels of a colour, weighted by their distance."""
    values, colours = pixels.astype(np.float64), []
    for colour in "rgb":
        own = np.zeros(values.shape)
        for place in range(4):
            own[place // 2 :: 2, place % 2 :: 2] = pattern[place] == colour
        # Every second pixel is green, so the nearest green ones share a side.
        corner = 0 if colour == "g" else 0.25
        near = np.array([[corner, 0.5, corner], [0.5, 1, 0.5], [corner, 0.5, corner]])
        total, weight = (cv2.filter2D(part, -1, near, borderType=cv2.BORDER_CONSTANT) for part in (own * values, own))
        # A frame of one row lacks a colour.
        colours.append(total / np.maximum(weight, ROUNDING))
    image = np.stack(colours, axis=-1)
    return (np.rint(image) if pixels.dtype.kind in "iu" else image).astype(pixels.dtype.newbyteorder("="))


def looks_like_bayer(pixels: PixelArray) -> bool:
    """Whether pixels alternate along rows and columns, as the colours of a mosaic do."""
    values = pixels.astype(np.float32)
    if values.ndim != 2 or min(values.shape) < LEAST_SIDE:
        return False
    for turned in (values, values.T):
        next_one = float(np.abs(turned[:, 1:] - turned[:, :-1]).mean())
        next_of_colour = float(np.abs(turned[:, 2:] - turned[:, :-2]).mean())
        if next_one <= _ALTERNATING * next_of_colour:
            return False
    return True


def doubted_pattern(mosaic: PixelArray, pattern: str) -> tuple[Doubt, ...]:
    """Doubt a pattern whose greens, the two planes of one colour, are clearly less alike than the other two planes."""
    planes = planes_of(mosaic).astype(np.float32)
    size = planes.shape[1] // LEAST_SIDE, planes.shape[0] // LEAST_SIDE
    if min(size) < 2:
        return ()
    # Means of blocks have little noise, and little of the detail that is between the planes.
    blocks = cv2.resize(planes, size, interpolation=cv2.INTER_AREA)
    blocks = blocks[np.isfinite(blocks).all(axis=-1)]
    if not len(blocks):
        return ()
    outer, inner = (float(np.median(np.abs(blocks[:, m] - blocks[:, n]))) for m, n in ((0, 3), (1, 2)))
    greens, others = (outer, inner) if pattern[0] == "g" else (inner, outer)
    # The greens of a sensor differ by less than a twentieth of the light.
    if greens <= 2 * others + float(np.median(np.abs(blocks))) / 20:
        return ()
    first, second = (name for name in BAYER_CODES if (name[0] == "g") != (pattern[0] == "g"))
    return (Doubt(f"the greens of the Bayer pattern {pattern} are unlike: try --bayer {first} or --bayer {second}"),)


def planes_of(mosaic: PixelArray) -> PixelArray:
    """Split a mosaic (H, W) into its planes (H // 2, W // 2, 4); a last odd row or column is left out."""
    height, width = mosaic.shape[0] // 2 * 2, mosaic.shape[1] // 2 * 2
    parts = [mosaic[row:height:2, column:width:2] for row in (0, 1) for column in (0, 1)]
    return np.stack(parts, axis=-1)


def mosaic_places(places: PixelArray) -> PixelArray:
    """Turn rows, columns and numbers of planes, (N, 3), into rows and columns of the mosaic, (N, 2)."""
    return np.stack([2 * places[:, 0] + places[:, 2] // 2, 2 * places[:, 1] + places[:, 2] % 2], axis=-1)


def plane_places(places: PixelArray) -> PixelArray:
    """Turn rows and columns of the mosaic, (N, 2), into rows, columns and numbers of planes, (N, 3)."""
    return np.stack([places[:, 0] // 2, places[:, 1] // 2, 2 * (places[:, 0] % 2) + places[:, 1] % 2], axis=-1)


def with_planes(mosaic: PixelArray, planes: PixelArray) -> PixelArray:
    """Return a copy of a mosaic whose planes are replaced."""
    replaced = mosaic.copy()
    height, width = 2 * planes.shape[0], 2 * planes.shape[1]
    for number in range(4):
        replaced[number // 2 : height : 2, number % 2 : width : 2] = planes[..., number]
    return replaced

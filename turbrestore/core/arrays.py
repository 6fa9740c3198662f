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

import os
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError
from .remarks import counted

FloatArray = NDArray[np.float32]
Frame = TypeVar("Frame")

CHANNELS = (3,)
# Rounding error of float32 at full scale: intensities that differ by less are the same.
ROUNDING = float(np.finfo(np.float32).eps)
# Numbers in each part of a large array that is processed in parts: 16 MiB of float32.
PART = 1 << 22
# Weights of RGB by Rec. 601, as OpenCV and most cameras use them.
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)


def check_image(image: ArrayLike, name: str = "image") -> FloatArray:
    """Return ``image`` as a finite float32 array of shape (H, W) or (H, W, 3).

    ``image`` (H, W) or (H, W, 3).
    """
    array = _as_float(image, name)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in CHANNELS):
        raise DataError(f"{name}: expected shape (H, W) or (H, W, 3), found {array.shape}")
    return _finite(array, name)


def check_unit_image(image: ArrayLike, name: str = "image") -> FloatArray:
    """Return what :func:`check_image` does; an image on another scale than 0 to 1 is refused."""
    return _on_unit_scale(check_image(image, name), name)


def check_unit_frames(frames: ArrayLike, at_least: int = 1) -> FloatArray:
    """Return what :func:`check_frames` does; frames on another scale than 0 to 1 are refused."""
    return _on_unit_scale(check_frames(frames, at_least), "frames")


def check_scale(lowest: float, highest: float, name: str, margin: float) -> None:
    """Refuse intensities from ``lowest`` to ``highest`` that lie more than ``margin`` outside [0, 1]."""
    if lowest < -margin or highest > 1 + margin:
        raise DataError(
            f"{name}: expected values in 0 to 1, found {lowest:.6g} to {highest:.6g}; divide them by full scale"
        )


def check_grey(image: ArrayLike, name: str = "image") -> FloatArray:
    """Return the luminance of ``image``, (H, W) or (H, W, 3), as a finite float32 array of shape (H, W)."""
    return luminance(check_image(image, name))


def check_frames(frames: ArrayLike, at_least: int = 1) -> FloatArray:
    """Return ``frames`` as a finite float32 array of shape (T, H, W) or (T, H, W, 3).

    ``frames`` (T, H, W) or (T, H, W, 3).
    """
    array = _as_float(frames, "frames", "turbrestore.open_frames")
    if array.ndim not in (3, 4) or (array.ndim == 4 and array.shape[3] not in CHANNELS):
        remedy = "; write frame[None] for a single frame" if array.ndim == 2 else ""
        raise DataError(f"frames: expected shape (T, H, W) or (T, H, W, 3), found {array.shape}{remedy}")
    if len(array) < at_least:
        raise DataError(f"frames: expected at least {counted(at_least, 'frame')}, found {len(array)}")
    return _finite(array, "frames", "; clean_source(source, check_content(source)) fills them")


def check_flow(flow: ArrayLike, name: str = "flow") -> FloatArray:
    """Return ``flow`` as a finite float32 array of shape (H, W, 2) or (T, H, W, 2).

    ``flow`` (H, W, 2) or (T, H, W, 2).
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

    ``image`` (..., H, W) or (..., H, W, 3); returns (..., H, W).
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
    """Quantise intensities in [0, 1] to unsigned integers of ``bit_depth`` bits."""
    top = 2**bit_depth - 1
    dtype = np.uint8 if bit_depth <= 8 else np.uint16
    levels, done = np.empty(image.shape, dtype), 0
    # In parts, because they are computed in double precision.
    for part in _parts(image):
        levels[done : done + len(part)] = np.rint(np.clip(part, 0.0, 1.0) * np.float64(top))
        done += len(part)
    return levels


def from_unit_to_type(image: FloatArray, bit_depth: int) -> NDArray[Any]:
    """Convert intensities to the type of a file: uint8 up to 8 bits, uint16 up to 16, clipped float32 for 32."""
    if bit_depth != 32:
        return from_unit(image, 8 if bit_depth <= 8 else 16)
    return np.clip(image, 0, 1, dtype=np.float32)


def _parts(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Consecutive views along the first axis, each of a few million numbers at most."""
    step = max(1, len(array) * PART // max(array.size, 1))
    return (array[start : start + step] for start in range(0, len(array), step))


def as_array(values: Any, name: str, reader: str) -> NDArray[Any]:
    """Return an array; raise DataError for a path, which ``reader`` reads, for arrays of two shapes and other objects.

    What holds an array is refused too, because several of its arrays may be meant.
    """
    if isinstance(values, str | os.PathLike):
        raise DataError(f"{name}: expected numbers, found the path {os.fspath(values)}; open it with {reader}")
    try:
        array = np.asanyarray(values)
    except ValueError:
        shapes = dict.fromkeys(str(getattr(part, "shape", type(part).__name__)) for part in values)
        raise DataError(f"{name}: expected one shape, found {' beside '.join(shapes)}; crop them to one size") from None
    if array.dtype == object:
        found = f"{name}: expected numbers, found {type(values).__name__}"
        held = next((f"; use its .{part}" for part in ("read()", "image") if hasattr(values, part.rstrip("()"))), "")
        raise DataError(found + held)
    return array


def check_stream(frames: Iterable[Frame]) -> Iterable[Frame]:
    """Return what gives frames one after the other; raise DataError for a path, and for what gives none."""
    if isinstance(frames, str | os.PathLike):
        found = f"the path {os.fspath(frames)}; open it with turbrestore.open_frames"
        raise DataError(f"frames: expected arrays (H, W) or (H, W, 3), found {found}")
    if not (hasattr(frames, "__iter__") or hasattr(frames, "__getitem__")):
        raise DataError(f"frames: expected arrays (H, W) or (H, W, 3), found {type(frames).__name__}")
    return frames


def _on_unit_scale(array: FloatArray, name: str) -> FloatArray:
    # Splines overshoot: registered frames, the centroid and the filtered image exceed the range of the frames by up to
    # 0.7 of it (the Lebesgue constant of cubic splines, 1.55, squared).  Other scales (0 to 255, 0 to 4095) go further.
    check_scale(float(array.min()), float(array.max()), name, margin=1.0)
    return array


def _as_float(values: ArrayLike, name: str, reader: str = "turbrestore.read_image") -> FloatArray:
    array = np.asarray(as_array(values, name, reader))
    if np.issubdtype(array.dtype, np.unsignedinteger):
        return (array / np.float32(np.iinfo(array.dtype).max)).astype(np.float32)
    if not np.issubdtype(array.dtype, np.floating):
        raise DataError(f"{name}: expected floating point or unsigned integer values, found {array.dtype}")
    return array.astype(np.float32, copy=False)


def not_finite(values: NDArray[Any], name: str, remedy: str = "") -> DataError:
    """Count the values that are not finite."""
    bad = int(values.size - np.count_nonzero(np.isfinite(values)))
    return DataError(f"{name}: expected finite values, found {counted(bad, 'NaN or infinite value')}{remedy}")


def _finite(array: FloatArray, name: str, remedy: str = "") -> FloatArray:
    if array.size == 0:
        raise DataError(f"{name}: expected at least one pixel, found shape {array.shape}")
    # In parts, without a temporary of the array's size.
    if not all(np.isfinite(part).all() for part in _parts(array)):
        raise not_finite(array, name, remedy)
    return array

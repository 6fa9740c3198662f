"""Backward warp of images by flows.

Symbols
-------
W : flow, ``w = id + W``.  ``warp(I, W) = I ∘ w`` (paper 3, eqs. 6 and 15).

Sampling is by interpolating cubic B-splines, or bilinear; outside the image the nearest pixel is repeated.  The usual
cubic convolution (OpenCV's has a = −0.75) does not reproduce a ramp and so moves edges by up to 0.04 px; the spline
reproduces cubics.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow, check_image
from ..core.errors import ConfigurationError, DataError
from ..runtime.device import CPU, find_device, memory_of
from ..runtime.image_stacks import load, load_image, sample_spline, spline_planes, store_image, warp_stack

INTERPOLATIONS = ("linear", "cubic")
# Pixels of a strip.  A dozen arrays of a smaller one would stay in the cache of a core, but with two threads, taking
# the interpreter lock for every operation on them costs more than the cache saves.
_STRIP = 1 << 16


def warp(image: ArrayLike, flow: ArrayLike, interpolation: str = "cubic", device: str = CPU) -> FloatArray:
    """Backward warp of an image (H, W[, 3]) by a flow (H, W, 2): ``result(x, y) = image(x + dx, y + dy)``.

    With ``flow = estimate_flow(reference, frame)`` the result lies on the reference (``I ∘ w``; paper 3, eq. 15).
    """
    image, flow = check_image(image), check_flow(flow)
    if interpolation not in INTERPOLATIONS:
        raise ConfigurationError(f"interpolation: expected one of {', '.join(INTERPOLATIONS)}, found {interpolation!r}")
    if flow.ndim != 3 or image.shape[:2] != flow.shape[:2]:
        raise DataError(f"flow: expected shape {(*image.shape[:2], 2)}, found {flow.shape}")
    if interpolation == "linear":
        # OpenCV 5 is exact for one and three channels; for the two of a flow it still rounds positions to 1/32 px.
        return sample_linear(cv2.split(image) if image.shape[2:] == (2,) else (image,), flow)
    found = find_device(device)
    if found == CPU:
        return sample_splines(spline_planes(image), flow)
    with memory_of(found):
        return store_image(warp_stack(load_image(image, found), load(flow, found)))


def sample_splines(planes: FloatArray, flow: FloatArray) -> FloatArray:
    """Sample splines (C, H + 3, W + 3) where a flow (H, W, 2) leads, as :func:`warp` does."""
    result = np.empty((*flow.shape[:2], len(planes)), np.float32)
    sample_spline(planes, np.ascontiguousarray(flow), np.moveaxis(result, -1, 0))
    return result[..., 0] if len(planes) == 1 else result


def inside(flow: ArrayLike) -> FloatArray:
    """Mask (H, W) of the pixels that a warp by a flow (H, W, 2) does not sample from the repeated border."""
    flow = check_flow(flow)
    if flow.ndim != 3:
        raise DataError(f"flow: expected shape (H, W, 2), found {flow.shape}")
    seen = np.ones(flow.shape[:2], np.float32)
    # Only samples within reach of a border can lie beyond it.
    reach = math.ceil(cv2.norm(flow, cv2.NORM_INF))
    _fade(seen.T, flow[..., 0].T, reach)
    _fade(seen, flow[..., 1], reach)
    return seen


def sample_linear(planes: Sequence[FloatArray], flow: FloatArray, rows: slice = slice(None)) -> FloatArray:
    """Sample planes (H, W[, 3]) bilinearly where the flow (h, W, 2) of some rows leads."""
    x, y = (axis[rows] for axis in _pixel_grid(*planes[0].shape[:2]))
    position = x + flow[..., 0], y + flow[..., 1]
    sampled = [cv2.remap(plane, *position, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes]
    return cv2.merge(sampled) if len(planes) > 1 else sampled[0]


def strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Split the rows of an image into pieces whose intermediate results stay in the cache."""
    rows = max(_STRIP // shape[1], 1)
    return (slice(start, min(start + rows, shape[0])) for start in range(0, shape[0], rows))


def _fade(seen: FloatArray, flow: FloatArray, reach: int) -> None:
    """Multiply ``seen`` by the mask of samples along the first axis; no sample moves by more than ``reach``."""
    length = len(flow)
    position = np.arange(length, dtype=np.float32)[:, None]
    before = min(reach, length)
    for part in (slice(0, before), slice(max(length - reach, before), length)):
        sample = position[part] + flow[part]
        seen[part] *= np.clip(1 - np.maximum(-sample, sample - (length - 1)), 0, 1)


@functools.lru_cache(maxsize=4)
def _pixel_grid(height: int, width: int) -> tuple[FloatArray, FloatArray]:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x.flags.writeable = y.flags.writeable = False
    return x, y

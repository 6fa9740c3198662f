"""The grid that displacements live on: every second pixel of a large image, because those of turbulence are smooth.

Displacements are pixels of the image wherever they are sampled.  Pixel centres of image and grid are those of a
reduction by area: pixel x of the grid lies at ``(x + ½) W / w − ½`` of the image.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..registration.flow_algebra import invert_flow
from ..registration.warp import sample_linear

# Smallest side of an image whose grid is coarser than itself, chosen.
_HALVED = 128


def grid_of(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the shape of the grid of an image."""
    height, width = shape[:2]
    return (height, width) if min(height, width) < _HALVED else (height // 2, width // 2)


def reduced(image: FloatArray) -> FloatArray:
    """Reduce an image (H, W) or (H, W, 3) to its grid, (h, w) or (h, w, 3)."""
    height, width = grid_of(image.shape)
    return image if height == len(image) else cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def enlarged(field: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Interpolate a field (h, w) or (h, w, 2) from the grid of an image of this shape."""
    return field if field.shape[:2] == shape[:2] else cv2.resize(field, (shape[1], shape[0]))


def pixel_of(shape: tuple[int, ...]) -> float:
    """Return the width of a pixel of the grid of an image of this shape, pixels of the image."""
    return shape[1] / grid_of(shape)[1]


def follow(field: FloatArray, flow: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Sample a field (h, w) or (h, w, 2) where a flow (h, w, 2) on the grid of an image of this shape leads."""
    planes = (field,) if field.ndim == 2 else cv2.split(field)
    return sample_linear(planes, flow / _pixel(flow, shape))


def inverted(flow: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Flow (h, w, 2) of the inverse map, on the grid of an image of this shape."""
    size = _pixel(flow, shape)
    # Every step leaves a share of the error as large as the flow stretches by: a third of 8 pixels ends at 0.03.
    return size * invert_flow(flow / size, iterations=5)


def _pixel(flow: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Width and height of a pixel of a grid over an image of this shape."""
    return np.divide(shape[1::-1], flow.shape[1::-1]).astype(np.float32)

"""Stacks of images: arrays on the CPU, or tensors of torch on a device; equations are written once for both.

A stack has the shape (..., H, W), float32.  Arithmetic is spelled alike in NumPy and torch: ``xp = namespace(stack)``,
``xp.sqrt(stack)``.  The operations here are not, and look at the stack: on the CPU they are OpenCV's and one compiled
loop, on a device those of torch and kornia.  Both agree to rounding.  Pixel centres lie at whole numbers.  Images are
continued by reflection about their outermost pixels; the median repeats those.

On a device a repeated run gives the same bytes, in full single precision: nothing is scattered.

Images are sampled by cubic B-splines: the cubic convolution that the libraries offer does not reproduce a ramp, and
biases flows by up to 0.04 px.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from .device import CPU
from .jit import jit
from .threads import WhileInside

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Pole of the cubic B-spline prefilter; its impulse response is cut off where it falls below 1e-7.
_POLE = np.sqrt(3.0) - 2.0
PREFILTER = (-6 * _POLE / (1 - _POLE**2) * _POLE ** np.abs(np.arange(-12, 13))).astype(np.float32)
# Coefficients that a spline needs before the image and beyond it.
_BEFORE, _BEYOND = 1, 2

# ndarray or torch tensor.
Stack = Any
Shape = tuple[int, ...]
Record = TypeVar("Record", bound="DataclassInstance")


def namespace(stack: Stack) -> Any:
    """Return the library that a stack belongs to, ``numpy`` or ``torch``."""
    return np if isinstance(stack, np.ndarray) else sys.modules["torch"]


def load(array: NDArray[Any], device: Any) -> Stack:
    """Bring an array to a device, given by its name or as the ``device`` of a stack; ``"cpu"`` is NumPy."""
    if isinstance(device, str) and device == CPU:
        return array
    import torch

    # torch shares no memory that cannot be written.
    return torch.from_numpy(np.require(array, requirements=["C", "W"])).to(device)


def load_record(record: Record, device: Any) -> Record:
    """Return a dataclass with its arrays on a device."""
    values = {item.name: getattr(record, item.name) for item in fields(record)}
    return replace(
        record, **{name: load(value, device) for name, value in values.items() if isinstance(value, np.ndarray)}
    )


def store(stack: Stack) -> NDArray[Any]:
    """Return a stack as an array; from a GPU into memory that the system does not move, which is many times faster."""
    if isinstance(stack, np.ndarray):
        return stack
    if stack.device.type != "cuda":
        return np.asarray(stack.cpu().numpy())
    import torch

    pinned = torch.empty(stack.shape, dtype=stack.dtype, pin_memory=True)
    return np.asarray(pinned.copy_(stack).numpy())


def load_image(image: NDArray[np.floating], device: Any) -> Stack:
    """Bring an image (H, W) or (H, W, C) to a device with its channels first, (C, H, W)."""
    return load(image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0), device)


def store_image(channels: Stack) -> FloatArray:
    """Return channels (C, H, W) as an image (H, W) or (H, W, C); the reverse of :func:`load_image`."""
    planes = store(channels)
    return planes[0] if len(planes) == 1 else np.ascontiguousarray(np.moveaxis(planes, 0, -1))


def correlate(stack: Stack, kernel_x: FloatArray, kernel_y: FloatArray) -> Stack:
    """Correlate along both axes with kernels of odd length."""
    if isinstance(stack, np.ndarray):

        def filtered(plane: FloatArray, out: FloatArray) -> None:
            cv2.sepFilter2D(plane, -1, kernel_x, kernel_y, dst=out, borderType=cv2.BORDER_REFLECT_101)

        return _each(filtered, stack, stack.shape[-2:])
    from kornia.filters import filter2d_separable

    half = len(kernel_y) // 2, len(kernel_x) // 2
    planes = _reflect(_planes_of(stack), half, half)
    along, across = (_kernel_on(str(stack.device), kernel.tobytes()) for kernel in (kernel_x, kernel_y))
    with full_precision():
        return filter2d_separable(planes, along, across, padding="valid").reshape(stack.shape)


def resize(stack: Stack, size: Shape) -> Stack:
    """Interpolate linearly to a grid (H, W)."""
    if isinstance(stack, np.ndarray):
        return _each(lambda plane, out: cv2.resize(plane, size[::-1], dst=out), stack, size)
    from torch.nn.functional import interpolate

    planes = interpolate(_planes_of(stack), size=size, mode="bilinear", align_corners=False)
    return planes.reshape(*stack.shape[:-2], *size)


def median(stack: Stack, side: int) -> Stack:
    """Median of windows of 3×3 or 5×5 pixels."""
    if isinstance(stack, np.ndarray):
        return _each(lambda plane, out: cv2.medianBlur(plane, side, dst=out), stack, stack.shape[-2:])
    from kornia.filters import median_blur

    with full_precision():
        return median_blur(_planes_of(stack), side, border_type="replicate").reshape(stack.shape)


def sample(coefficients: Stack, flow: Stack) -> Stack:
    """Evaluate the cubic B-splines with these coefficients (B, H, W) where each pixel leads by its flow (B, 2, H, W).

    Positions outside the image are moved to its border.
    """
    if not isinstance(coefficients, np.ndarray):
        return _sample_gathered(coefficients, flow)
    result = np.empty(coefficients.shape, np.float32)
    for number, displacement in enumerate(np.moveaxis(flow, 1, -1)):
        planes = bordered(coefficients[number])[None]
        sample_spline(planes, np.ascontiguousarray(displacement), result[number : number + 1])
    return result


def spline_coefficients(stack: Stack) -> Stack:
    """Coefficients of the cubic B-spline through the pixels."""
    return correlate(stack, PREFILTER, PREFILTER)


def bordered(coefficients: FloatArray) -> FloatArray:
    """Continue the coefficients of a plane (H, W) by what samples at its border need, (H + 3, W + 3)."""
    return cv2.copyMakeBorder(coefficients, _BEFORE, _BEYOND, _BEFORE, _BEYOND, cv2.BORDER_REFLECT_101)


def spline_planes(image: FloatArray) -> FloatArray:
    """Coefficients (C, H + 3, W + 3) of splines through an image (H, W[, 3]) that is sampled several times."""
    planes = (image,) if image.ndim == 2 else cv2.split(image)
    return np.stack([bordered(spline_coefficients(plane)) for plane in planes])


def warp_stack(stack: Stack, flow: Stack) -> Stack:
    """Warp a stack (B, H, W) backward by a flow (H, W, 2): :func:`turbrestore.registration.warp.warp` on any device."""
    xp = namespace(stack)
    planes = xp.moveaxis(flow, -1, 0)
    return sample(spline_coefficients(stack), xp.broadcast_to(planes, (len(stack), *planes.shape)))


@jit
def sample_spline(coefficients: FloatArray, flow: FloatArray, result: FloatArray) -> None:
    """Sum 4×4 B-spline coefficients of every plane at each position that a flow leads to.

    ``coefficients`` (C, H + 3, W + 3); ``flow`` (H, W, 2); ``result`` (C, H, W).
    """
    zero, one, sixth = np.float32(0), np.float32(1), np.float32(1 / 6)
    three, four, six = np.float32(3), np.float32(4), np.float32(6)
    bottom, right = np.float32(result.shape[1] - 1), np.float32(result.shape[2] - 1)
    for row in range(result.shape[1]):
        for column in range(result.shape[2]):
            x = min(max(np.float32(column) + flow[row, column, 0], zero), right)
            y = min(max(np.float32(row) + flow[row, column, 1], zero), bottom)
            # An unsigned index cannot count from the end, which would be checked at every access.
            j, i = np.uint32(x), np.uint32(y)
            t, u = x - np.float32(j), y - np.float32(i)
            left, upper = (one - t) * (one - t) * (one - t) * sixth, (one - u) * (one - u) * (one - u) * sixth
            centre, middle = (four - (six - three * t) * t * t) * sixth, (four - (six - three * u) * u * u) * sixth
            far, lower = t * t * t * sixth, u * u * u * sixth
            beside, below = one - left - centre - far, one - upper - middle - lower
            for plane in range(coefficients.shape[0]):
                field = coefficients[plane]
                rows = field[i], field[i + 1], field[i + 2], field[i + 3]
                a = rows[0][j] * left + rows[0][j + 1] * centre + rows[0][j + 2] * beside + rows[0][j + 3] * far
                b = rows[1][j] * left + rows[1][j + 1] * centre + rows[1][j + 2] * beside + rows[1][j + 3] * far
                c = rows[2][j] * left + rows[2][j + 1] * centre + rows[2][j + 2] * beside + rows[2][j + 3] * far
                d = rows[3][j] * left + rows[3][j + 1] * centre + rows[3][j + 2] * beside + rows[3][j + 3] * far
                result[plane, row, column] = a * upper + b * middle + c * below + d * lower


def _sample_gathered(coefficients: Stack, flow: Stack) -> Stack:
    """Sixteen gathers; torch's grid_sample rounds positions to 1e-7 of the width, which is 2e-4 px of 1920."""
    xp, (count, height, width) = namespace(flow), coefficients.shape
    y, x = (xp.arange(length, dtype=xp.float32, device=flow.device) for length in (height, width))
    x, y = (x + flow[:, 0]).clip(0, width - 1), (y[:, None] + flow[:, 1]).clip(0, height - 1)
    left, top = x.floor(), y.floor()
    columns, rows = _spline_weights(x - left), _spline_weights(y - top)
    around = _reflect(coefficients, (_BEFORE, _BEFORE), (_BEYOND, _BEYOND)).reshape(-1)
    longer = width + _BEFORE + _BEYOND
    first = xp.arange(count, device=x.device, dtype=xp.int32) * ((height + _BEFORE + _BEYOND) * longer)
    index = (first[:, None, None] + top.int() * longer + left.int()).reshape(-1)
    result = xp.zeros_like(x)
    for row, row_weight in enumerate(rows):
        line = xp.zeros_like(x)
        for column, column_weight in enumerate(columns):
            step = row * longer + column
            taken = around.narrow(0, step, around.numel() - step).index_select(0, index)
            line.addcmul_(taken.reshape(x.shape), column_weight)
        result.addcmul_(line, row_weight)
    return result


def _spline_weights(t: Stack) -> tuple[Stack, Stack, Stack, Stack]:
    """Weights of the cubic B-spline for the pixels at −1, 0, 1 and 2, t beyond 0."""
    rest = 1 - t
    first, second, last = rest * rest * rest / 6, 2 / 3 - t * t * (1 - t / 2), t * t * t / 6
    return first, second, 1 - first - second - last, last


def _each(function: Callable[[FloatArray, FloatArray], object], stack: FloatArray, size: Shape) -> FloatArray:
    """Fill planes (H, W) of a given size by a function of each plane of a stack."""
    result = np.empty((*stack.shape[:-2], *size), np.float32)
    for plane, out in zip(stack.reshape(-1, *stack.shape[-2:]), result.reshape(-1, *size), strict=True):
        function(plane, out)
    return result


def _planes_of(stack: Stack) -> Stack:
    return stack.reshape(-1, 1, *stack.shape[-2:])


def _reflect(stack: Stack, before: Shape, beyond: Shape) -> Stack:
    """Continue images by so many rows and columns; unlike torch's padding, by more than there are too."""
    for axis, *sides in zip((-2, -1), before, beyond, strict=True):
        stack = stack.index_select(axis, _reflected_order(str(stack.device), stack.shape[axis], *sides))
    return stack


# A copy to a GPU waits until it has worked off what it was given before, so small arrays are copied once.
@functools.lru_cache(maxsize=64)
def _kernel_on(device: str, values: bytes) -> Stack:
    """Kernel of a filter on a device, shape (1, n)."""
    import torch

    return torch.from_numpy(np.frombuffer(values, np.float32).copy())[None].to(device)


@functools.lru_cache(maxsize=256)
def _reflected_order(device: str, length: int, before: int, beyond: int) -> Stack:
    import torch

    return torch.from_numpy(np.pad(np.arange(length), (before, beyond), mode="reflect")).to(device)


@functools.cache
def full_precision() -> WhileInside:
    """Keep the convolutions of cuDNN, which kornia's filters and median use, in single precision and reproducible.

    A GPU otherwise rounds their factors to ten bits.
    """

    def settings() -> AbstractContextManager[None]:
        from torch.backends import cudnn

        return cudnn.flags(enabled=cudnn.enabled, deterministic=True, allow_tf32=False)

    return WhileInside(settings)

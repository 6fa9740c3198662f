"""The few operations on stacks of images that an iterative solver needs, in NumPy with OpenCV and in torch.

A stack has the shape (..., H, W), float32.  Arithmetic is spelled alike in both libraries
(``arrays.add(a, b, out=c)``), so that a solver is written once; filtering, resizing, sampling and the median are not,
and are here.  Both agree to rounding.  Pixel centres lie at whole numbers.  Images are continued by reflection about
their outermost pixels; the median repeats those.

Sampling is by cubic B-splines, as in :mod:`turbrestore.registration.warp`: the cubic convolution that both libraries
have does not reproduce a ramp, and biases flows by up to 0.04 px.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..core.arrays import FloatArray

# Pole of the cubic B-spline prefilter; its impulse response below is cut off where it falls under 1e-7.
_POLE = np.sqrt(3.0) - 2.0
PREFILTER = (-6 * _POLE / (1 - _POLE**2) * _POLE ** np.abs(np.arange(-12, 13))).astype(np.float32)

# ndarray or torch tensor, float32.
Stack = Any
Shape = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class StackOps:
    """One library's operations.

    Attributes
    ----------
    arrays : module
        ``numpy`` or ``torch``, for arithmetic.
    load, store : callable
        From a NumPy array to a stack, and back.
    zeros : callable
        ``zeros(shape)`` is a stack of zeros.
    filter : callable
        ``filter(stack, kernel_x, kernel_y)`` correlates along both axes with kernels of odd length.
    resize : callable
        ``resize(stack, (H, W))`` interpolates linearly.
    sample : callable
        ``sample(coefficients, x, y)`` sums 4×4 B-spline coefficients (B, H, W) about positions x and y (B, H, W); those
        outside are moved to the border.
    median : callable
        ``median(stack, side)`` of windows of 3×3 or 5×5 pixels.
    """

    arrays: Any
    load: Callable[[FloatArray], Stack]
    store: Callable[[Stack], FloatArray]
    zeros: Callable[[Shape], Stack]
    filter: Callable[[Stack, FloatArray, FloatArray], Stack]
    resize: Callable[[Stack, Shape], Stack]
    sample: Callable[[Stack, Stack, Stack], Stack]
    median: Callable[[Stack, int], Stack]


def numpy_ops() -> StackOps:
    """Operations of NumPy and OpenCV.

    Returns
    -------
    StackOps

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.tile(np.arange(8, dtype=np.float32), (1, 8, 1))
    >>> numpy_ops().resize(ramp, (4, 4))[0, 0]
    array([0.5, 2.5, 4.5, 6.5], dtype=float32)
    """

    def each(function: Callable[[FloatArray, FloatArray], object], stack: FloatArray, size: Shape) -> FloatArray:
        result = np.empty((*stack.shape[:-2], *size), np.float32)
        for plane, out in zip(stack.reshape(-1, *stack.shape[-2:]), result.reshape(-1, *size), strict=True):
            function(plane, out)
        return result

    def filtered(stack: FloatArray, kernel_x: FloatArray, kernel_y: FloatArray) -> FloatArray:
        def correlate(plane: FloatArray, out: FloatArray) -> None:
            cv2.sepFilter2D(plane, -1, kernel_x, kernel_y, dst=out, borderType=cv2.BORDER_REFLECT_101)

        return each(correlate, stack, stack.shape[-2:])

    return StackOps(
        arrays=np,
        load=lambda array: array,
        store=lambda stack: stack,
        zeros=lambda shape: np.zeros(shape, np.float32),
        filter=filtered,
        resize=lambda stack, size: each(lambda plane, out: cv2.resize(plane, size[::-1], dst=out), stack, size),
        sample=_sample_blended,
        median=lambda stack, side: each(
            lambda plane, out: cv2.medianBlur(plane, side, dst=out), stack, stack.shape[-2:]
        ),
    )


def torch_ops(device: str) -> StackOps:
    """Operations of torch, made of additions, comparisons and gathers alone.

    Each sums in one fixed order, so that results repeat from run to run on a GPU too, and in full single precision;
    convolutions of cuDNN, which may round to ten bits, and scattering are avoided.

    Parameters
    ----------
    device : str
        What torch calls it, such as ``"cuda"``; ``"cpu"`` is torch on the processor.  It has to be there.

    Returns
    -------
    StackOps

    Examples
    --------
    >>> import numpy as np
    >>> ops = torch_ops("cpu")
    >>> ramp = np.tile(np.arange(8, dtype=np.float32), (1, 8, 1))
    >>> ops.store(ops.resize(ops.load(ramp), (4, 4)))[0, 0]
    array([0.5, 2.5, 4.5, 6.5], dtype=float32)
    """
    import torch
    from torch.nn import functional

    def resized(stack: Stack, size: Shape) -> Stack:
        planes = stack.reshape(-1, 1, *stack.shape[-2:])
        planes = functional.interpolate(planes, size=size, mode="bilinear", align_corners=False)
        return planes.reshape(*stack.shape[:-2], *size)

    def median(stack: Stack, side: int) -> Stack:
        height, width = stack.shape[-2:]
        # Padding by repetition takes stacks of four axes at most.
        planes = functional.pad(stack.reshape(-1, 1, height, width), (side // 2,) * 4, mode="replicate")
        shifts = ((y, x) for y in range(side) for x in range(side))
        windows = [planes[..., y : y + height, x : x + width] for y, x in shifts]
        return _median_of(windows, torch).reshape(stack.shape)

    return StackOps(
        arrays=torch,
        # torch shares no memory that cannot be written.
        load=lambda array: torch.from_numpy(np.require(array, requirements=["C", "W"])).to(device),
        store=lambda stack: stack.cpu().numpy(),
        zeros=lambda shape: torch.zeros(shape, device=device),
        filter=lambda stack, kernel_x, kernel_y: _correlate(
            _correlate(stack, kernel_x, -1, torch), kernel_y, -2, torch
        ),
        resize=resized,
        sample=lambda coefficients, x, y: _sample_gathered(coefficients, x, y, torch),
        median=median,
    )


def _correlate(stack: Stack, kernel: FloatArray, axis: int, torch: Any) -> Stack:
    """Sum of shifted copies; the same to the bit as a convolution, which is three times slower on a processor."""
    half, length = len(kernel) // 2, stack.shape[axis]
    if half == 0:
        return stack * float(kernel[0])
    reflected = torch.from_numpy(np.pad(np.arange(length), half, mode="reflect")).to(stack.device)
    longer = stack.index_select(axis, reflected)
    result = longer.narrow(axis, 0, length) * float(kernel[0])
    for shift, weight in enumerate(kernel.tolist()):
        if shift and weight:
            result.add_(longer.narrow(axis, shift, length), alpha=weight)
    return result


def _sample_gathered(coefficients: Stack, x: Stack, y: Stack, torch: Any) -> Stack:
    """Sixteen gathers; torch's grid_sample rounds positions to 1e-7 of the width, which is 2e-4 px of 1920."""
    count, height, width = coefficients.shape
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    left, top = x.floor(), y.floor()
    columns, rows = _spline_weights(x - left), _spline_weights(y - top)
    # One coefficient more on the near side and two on the far side, so that no index has to be reflected.
    across, down = (
        torch.from_numpy(np.pad(np.arange(length), (1, 2), mode="reflect")).to(coefficients.device)
        for length in (width, height)
    )
    around = coefficients.index_select(2, across).index_select(1, down).reshape(-1)
    first = torch.arange(count, device=x.device, dtype=torch.int32) * ((height + 3) * (width + 3))
    index = (first[:, None, None] + top.int() * (width + 3) + left.int()).reshape(-1)
    result = torch.zeros_like(x)
    for row, of_row in enumerate(rows):
        line = torch.zeros_like(x)
        for column, of_column in enumerate(columns):
            step = row * (width + 3) + column
            taken = around.narrow(0, step, around.numel() - step).index_select(0, index)
            line.addcmul_(taken.reshape(x.shape), of_column)
        result.addcmul_(line, of_row)
    return result


def _spline_weights(t: Stack) -> tuple[Stack, Stack, Stack, Stack]:
    """Weights of the cubic B-spline for the pixels at −1, 0, 1 and 2, t beyond 0."""
    rest = 1 - t
    first, second, last = rest * rest * rest / 6, 2 / 3 - t * t * (1 - t / 2), t * t * t / 6
    return first, second, 1 - first - second - last, last


def _median_of(planes: list[Stack], arrays: Any) -> Stack:
    """Median of an odd number of planes by minima and maxima.

    Of any ``n // 2 + 2`` values neither the smallest nor the largest is the median of all n: they are dropped, the next
    one joins, and again, until one is left.
    """
    kept, rest = planes[: len(planes) // 2 + 2], planes[len(planes) // 2 + 2 :]

    def order(low: int, high: int) -> None:
        a, b = kept[low], kept[high]
        kept[low], kept[high] = arrays.minimum(a, b), arrays.maximum(a, b)

    while len(kept) > 1:
        last = len(kept) - 1
        for i in range(len(kept) // 2):
            order(i, last - i)
        for i in range(1, (last + 2) // 2):
            order(0, i)
        for i in range((last + 1) // 2, last):
            order(i, last)
        kept = kept[1:last] + rest[:1]
        rest = rest[1:]
    return kept[0]


def spline_coefficients(stack: Stack, ops: StackOps) -> Stack:
    """Coefficients of the cubic B-spline through the pixels.

    Parameters
    ----------
    stack : stack, shape (..., H, W)
    ops : StackOps

    Returns
    -------
    stack, shape (..., H, W)

    Examples
    --------
    >>> import numpy as np
    >>> flat = np.full((1, 16, 16), 0.5, np.float32)
    >>> bool(np.allclose(spline_coefficients(flat, numpy_ops()), 0.5))
    True
    """
    return ops.filter(stack, PREFILTER, PREFILTER)


def warp_stack(stack: Stack, flow: Stack, ops: StackOps) -> Stack:
    """Backward warp by cubic B-splines, as :func:`turbrestore.registration.warp.warp`.

    Parameters
    ----------
    stack : stack, shape (B, H, W)
        Channels of one image.
    flow : stack, shape (H, W, 2)
        Displacements (dx, dy), pixels.
    ops : StackOps

    Returns
    -------
    stack, shape (B, H, W)

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.tile(np.arange(16, dtype=np.float32), (1, 16, 1))
    >>> warp_stack(ramp, np.full((16, 16, 2), 0.25, np.float32), numpy_ops())[0, 0, 6:10].round(3)
    array([6.25, 7.25, 8.25, 9.25], dtype=float32)
    """
    y, x = (ops.load(axis) for axis in np.mgrid[: stack.shape[-2], : stack.shape[-1]].astype(np.float32))
    x, y = (ops.arrays.broadcast_to(axis, stack.shape) for axis in (x + flow[..., 0], y + flow[..., 1]))
    return ops.sample(spline_coefficients(stack, ops), x, y)


def _sample_blended(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Sum of 4×4 B-spline coefficients as a blend of four bilinear samples (Sigg and Hadwiger 2005)."""

    def bilinear(map_x: FloatArray, map_y: FloatArray) -> FloatArray:
        result = np.empty(x.shape, np.float32)
        for plane, u, v, out in zip(coefficients, map_x, map_y, result, strict=True):
            cv2.remap(plane, u, v, cv2.INTER_LINEAR, dst=out, borderMode=cv2.BORDER_REFLECT_101)
        return result

    height, width = coefficients.shape[-2:]
    left, right, to_right = _spline_pair(x, width)
    upper, lower, to_lower = _spline_pair(y, height)
    top, bottom = (
        a + to_right * (bilinear(right, row) - a) for row, a in ((row, bilinear(left, row)) for row in (upper, lower))
    )
    return top + to_lower * (bottom - top)


def _spline_pair(position: FloatArray, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two positions and a blend whose bilinear samples weigh four neighbours as the cubic B-spline does."""
    position = np.clip(position, 0, length - 1)
    whole = np.floor(position)
    t = position - whole
    rest = 1 - t
    before = rest * rest * rest / 6 + (2 / 3 - t * t * (1 - t / 2))
    after = 1 - before
    return whole - 1 + (before - rest * rest * rest / 6) / before, whole + 1 + t * t * t / (6 * after), after

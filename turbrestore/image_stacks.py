"""The few operations on stacks of images that an iterative solver needs, in NumPy with OpenCV and in torch.

A stack has the shape (..., H, W), float32.  Arithmetic is spelled alike in both libraries
(``arrays.add(a, b, out=c)``), so that a solver is written once; filtering, resizing, sampling and the median are not,
and are here.  Both agree to rounding.  Pixel centres lie at whole numbers.  Images are continued by reflection about
their outermost pixels; the median repeats those.

Sampling is by cubic B-splines, as in :mod:`turbrestore.warp`: the cubic convolution that both libraries have does not
reproduce a ramp, and biases flows by up to 0.04 px.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .arrays import FloatArray
from .errors import ConfigurationError

# Pole of the cubic B-spline prefilter; its impulse response below is cut off where it falls under 1e-7.
_POLE = np.sqrt(3.0) - 2.0
_PREFILTER = (-6 * _POLE / (1 - _POLE**2) * _POLE ** np.abs(np.arange(-12, 13))).astype(np.float32)

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
    bilinear : callable
        ``bilinear(stack, x, y)`` is the stack (B, H, W) at positions x and y (B, H, W).
    median : callable
        ``median(stack, side)`` of windows of 3×3 or 5×5 pixels.
    """

    arrays: Any
    load: Callable[[FloatArray], Stack]
    store: Callable[[Stack], FloatArray]
    zeros: Callable[[Shape], Stack]
    filter: Callable[[Stack, FloatArray, FloatArray], Stack]
    resize: Callable[[Stack, Shape], Stack]
    bilinear: Callable[[Stack, Stack, Stack], Stack]
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

    def bilinear(stack: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        result = np.empty(x.shape, np.float32)
        for plane, u, v, out in zip(stack, x, y, result, strict=True):
            cv2.remap(plane, u, v, cv2.INTER_LINEAR, dst=out, borderMode=cv2.BORDER_REFLECT_101)
        return result

    return StackOps(
        arrays=np,
        load=lambda array: array,
        store=lambda stack: stack,
        zeros=lambda shape: np.zeros(shape, np.float32),
        filter=filtered,
        resize=lambda stack, size: each(lambda plane, out: cv2.resize(plane, size[::-1], dst=out), stack, size),
        bilinear=bilinear,
        median=lambda stack, side: each(
            lambda plane, out: cv2.medianBlur(plane, side, dst=out), stack, stack.shape[-2:]
        ),
    )


def torch_ops(device: str) -> StackOps:
    """Operations of torch.

    Parameters
    ----------
    device : str
        ``"cpu"``, ``"cuda"`` or any other name that torch gives a device.

    Returns
    -------
    StackOps

    Raises
    ------
    ConfigurationError
        torch is not installed, or has no such device.

    Examples
    --------
    >>> import numpy as np
    >>> ops = torch_ops("cpu")
    >>> ramp = np.tile(np.arange(8, dtype=np.float32), (1, 8, 1))
    >>> ops.store(ops.resize(ops.load(ramp), (4, 4)))[0, 0]
    array([0.5, 2.5, 4.5, 6.5], dtype=float32)
    """
    try:
        import torch
        from torch.nn import functional
    except ImportError as error:
        raise ConfigurationError("backend: torch is not installed, install turbrestore[torch]") from error
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigurationError(f"device: torch sees no CUDA here, found {device!r}; use 'cpu'")

    def filtered(stack: Stack, kernel_x: FloatArray, kernel_y: FloatArray) -> Stack:
        planes = stack.reshape(-1, 1, *stack.shape[-2:])
        x, y = (torch.from_numpy(kernel).to(device) for kernel in (kernel_x, kernel_y))
        half_x, half_y = len(x) // 2, len(y) // 2
        planes = functional.pad(planes, (half_x, half_x, half_y, half_y), mode="reflect")
        planes = functional.conv2d(functional.conv2d(planes, x.reshape(1, 1, 1, -1)), y.reshape(1, 1, -1, 1))
        return planes.reshape(stack.shape)

    def resized(stack: Stack, size: Shape) -> Stack:
        planes = stack.reshape(-1, 1, *stack.shape[-2:])
        planes = functional.interpolate(planes, size=size, mode="bilinear", align_corners=False)
        return planes.reshape(*stack.shape[:-2], *size)

    def bilinear(stack: Stack, x: Stack, y: Stack) -> Stack:
        height, width = stack.shape[-2:]
        grid = torch.stack([x * (2 / (width - 1)) - 1, y * (2 / (height - 1)) - 1], dim=-1)
        planes = stack[:, None]
        return functional.grid_sample(planes, grid, mode="bilinear", padding_mode="reflection", align_corners=True)[
            :, 0
        ]

    def median(stack: Stack, side: int) -> Stack:
        planes = stack.reshape(-1, 1, *stack.shape[-2:])
        half = side // 2
        planes = functional.pad(planes, (half,) * 4, mode="replicate").unfold(2, side, 1).unfold(3, side, 1)
        return planes.flatten(-2).median(dim=-1).values.reshape(stack.shape)

    return StackOps(
        arrays=torch,
        load=lambda array: torch.from_numpy(np.ascontiguousarray(array)).to(device),
        store=lambda stack: stack.cpu().numpy(),
        zeros=lambda shape: torch.zeros(shape, device=device),
        filter=filtered,
        resize=resized,
        bilinear=bilinear,
        median=median,
    )


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
    return ops.filter(stack, _PREFILTER, _PREFILTER)


def sample_spline(coefficients: Stack, x: Stack, y: Stack, ops: StackOps) -> Stack:
    """Sum of 4×4 B-spline coefficients as a blend of four bilinear samples (Sigg and Hadwiger 2005).

    Parameters
    ----------
    coefficients : stack, shape (B, H, W)
    x, y : stack, shape (B, H, W)
        Positions; those outside are moved to the border.
    ops : StackOps

    Returns
    -------
    stack, shape (B, H, W)

    Examples
    --------
    >>> import numpy as np
    >>> ops, image = numpy_ops(), np.random.default_rng(0).random((1, 16, 16)).astype(np.float32)
    >>> y, x = np.mgrid[:16, :16].astype(np.float32)
    >>> bool(np.allclose(sample_spline(spline_coefficients(image, ops), x[None], y[None], ops), image, atol=1e-5))
    True
    """
    height, width = coefficients.shape[-2:]
    left, right, to_right = _spline_pair(x, width, ops.arrays)
    upper, lower, to_lower = _spline_pair(y, height, ops.arrays)
    top, bottom = (
        a + to_right * (ops.bilinear(coefficients, right, row) - a)
        for row, a in ((row, ops.bilinear(coefficients, left, row)) for row in (upper, lower))
    )
    return top + to_lower * (bottom - top)


def _spline_pair(position: Stack, length: int, arrays: Any) -> tuple[Stack, Stack, Stack]:
    """Two positions and a blend whose bilinear samples weigh four neighbours as the cubic B-spline does."""
    position = arrays.clip(position, 0, length - 1)
    whole = arrays.floor(position)
    t = position - whole
    rest = 1 - t
    before = rest * rest * rest / 6 + (2 / 3 - t * t * (1 - t / 2))
    after = 1 - before
    return whole - 1 + (before - rest * rest * rest / 6) / before, whole + 1 + t * t * t / (6 * after), after

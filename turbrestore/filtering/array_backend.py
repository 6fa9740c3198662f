"""Where frames are registered and fused: with NumPy and OpenCV on the CPU, or with torch on a device.

The formulas of the filter are written once for both.  What differs is here: how arrays come to the device and back, and
how a frame is warped by the estimated flow, ``I ∘ ŵ`` (paper 3, eq. 15).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..registration.warp import inside, warp
from ..runtime.device import CPU, find_device, memory_of
from ..runtime.image_stacks import Stack, StackOps, numpy_ops, torch_ops, warp_stack
from .frame_noise import FrameStatistics
from .kalman import PixelGaussian, PixelStacks

# Registered channels (C, H, W), their luminance (H, W), and where the warp samples the frame (H, W), 1 to 0.
Warped = tuple[Stack, Stack, Stack]


@dataclass(frozen=True, eq=False)
class ArrayBackend:
    """Arrays of one library on one device."""

    device: str  # ``"cpu"`` is NumPy and OpenCV; any other is the name of a device of torch
    ops: StackOps  # operations on its arrays
    warp: Callable[[FloatArray, Stack], Warped]  # from a frame (a NumPy array) and a flow to the registered frame

    @property
    def is_cpu(self) -> bool:
        """Whether the arrays are NumPy's, whose operations run side by side in threads."""
        return self.device == CPU

    def memory(self) -> AbstractContextManager[None]:
        """Context in which a lack of memory on the device is a ConfigurationError."""
        return memory_of(self.device)

    def load(self, array: NDArray[np.floating]) -> Stack:
        """Bring an array to the device, float32."""
        with self.memory():
            return self.ops.load(np.asarray(array, np.float32))

    def load_pixels(self, pixels: PixelGaussian) -> PixelStacks:
        """Bring ρ̂ and Σ to the device."""
        return PixelStacks(self.load(_channels_first(pixels.mean)), self.load(pixels.variance))

    def store_pixels(self, pixels: PixelStacks) -> PixelGaussian:
        """Bring ρ̂ and Σ back to NumPy arrays."""
        return PixelGaussian(self.store_image(pixels), self.ops.store(pixels.variance))

    def store_image(self, pixels: PixelStacks) -> FloatArray:
        """Bring ρ̂ back to a NumPy array."""
        mean = self.ops.store(pixels.mean)
        return mean[0] if len(mean) == 1 else np.ascontiguousarray(np.moveaxis(mean, 0, -1))

    def load_statistics(self, statistics: FrameStatistics) -> FrameStatistics:
        """Bring the maps that Z follows from to the device."""
        names = ("mean_sharpness", "score_scale", "score_variance", "mean_frame", "deviation", "median", "spread")
        maps = {name: self.load(getattr(statistics, name)) for name in names}
        along, across = statistics.template
        return replace(statistics, template=(self.load(along), self.load(across)), **maps)


def array_backend(device: str) -> ArrayBackend:
    """Return the backend of a device."""
    found = find_device(device)
    if found == CPU:
        return ArrayBackend(found, numpy_ops(), _warp_on_cpu)
    ops = torch_ops(found)
    return ArrayBackend(found, ops, lambda frame, flow: _warp_in_torch(frame, flow, ops))


def _warp_on_cpu(frame: FloatArray, flow: FloatArray) -> Warped:
    registered = warp(frame, flow)
    return _channels_first(registered), luminance(registered), inside(flow)


def _warp_in_torch(frame: FloatArray, flow: Stack, ops: StackOps) -> Warped:
    registered = warp_stack(ops.load(_channels_first(frame)), flow, ops)
    # The luminance of the three unit colours is the weight of each channel.
    weights = luminance(np.eye(3, dtype=np.float32)[None])[0].tolist() if len(registered) == 3 else [1.0]
    grey = sum(weight * channel for weight, channel in zip(weights, registered, strict=True))
    height, width = flow.shape[:2]
    x, y = (ops.arrays.arange(length, dtype=flow.dtype, device=flow.device) for length in (width, height))
    seen = _within(x + flow[..., 0], width) * _within(y[:, None] + flow[..., 1], height)
    return registered, grey, seen


def _within(position: Stack, length: int) -> Stack:
    """1 where a position lies between the first and the last pixel, falling to 0 one pixel beyond."""
    return (1 - (-position).maximum(position - (length - 1))).clamp(0, 1)


def _channels_first(image: NDArray[np.floating]) -> NDArray[np.floating]:
    return image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)

"""Where frames are registered and fused: with NumPy and OpenCV on the CPU, or with torch on a device.

The formulas of the filter are written once for both.  How arrays come to the device and back is here; how a frame is
warped there is in :mod:`.frame_noise`.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..runtime.device import CPU, find_device, memory_of
from ..runtime.image_stacks import Stack, StackOps, numpy_ops, torch_ops
from .frame_noise import FrameStatistics, channels_first
from .kalman import PixelGaussian, PixelStacks


@dataclass(frozen=True, eq=False)
class ArrayBackend:
    """Arrays of one library on one device."""

    device: str  # ``"cpu"`` is NumPy and OpenCV; any other is the name of a device of torch
    ops: StackOps  # operations on its arrays

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
        return PixelStacks(self.load(channels_first(pixels.mean)), self.load(pixels.variance))

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
    return ArrayBackend(found, numpy_ops() if found == CPU else torch_ops(found))

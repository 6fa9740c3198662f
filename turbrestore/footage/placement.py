"""Where frames lie in the scene while the camera moves, to whole pixels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import global_shifts

# Longest side of the reduced frames whose shifts are measured.
_SIDE = 192


@dataclass(frozen=True)
class Placement:
    """Shifts of frames, and the part of the scene that they show together."""

    shifts: dict[int, tuple[int, int]]  # (dx, dy) of each frame by its number in the file, pixels
    size: tuple[int, int]  # (H, W) of a frame

    @classmethod
    def still(cls, source: FrameSource) -> Placement:
        """Place all frames alike."""
        return cls(dict.fromkeys(source.numbers, (0, 0)), (source.shape[1], source.shape[2]))

    @property
    def shape(self) -> tuple[int, int]:
        """(H', W') of the part of the scene that the frames show together."""
        (left, right), (top, bottom) = (self._range(axis) for axis in (0, 1))
        return self.size[0] + bottom - top, self.size[1] + right - left

    def place(self, number: int) -> Window:
        """Return the rows and columns of the scene that a frame shows."""
        dx, dy = self.shifts[number]
        top, left = self._range(1)[1] - dy, self._range(0)[1] - dx
        return slice(top, top + self.size[0]), slice(left, left + self.size[1])

    def _range(self, axis: int) -> tuple[int, int]:
        values = [shift[axis] for shift in self.shifts.values()]
        return min(values), max(values)


def reduced(frames: Iterable[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Reduce and smooth T frames of (H, W) pixels, ``shape`` beginning with (T, H, W), to measure their shifts."""
    count, height, width = shape[:3]
    factor = max(1.0, max(height, width) / _SIDE)
    size = max(16, round(width / factor)), max(16, round(height / factor))
    small = np.empty((count, size[1], size[0]), np.float32)
    for plane, frame in zip(small, frames, strict=True):
        plane[...] = cv2.GaussianBlur(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    return small


def shifts_of_reduced(small: FloatArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Shifts (dx, dy) of frames that :func:`reduced` has reduced, in pixels of the frames, shape (T, 2)."""
    return global_shifts(small) * (shape[2] / small.shape[2], shape[1] / small.shape[1])


def measured_shifts(frames: Iterable[FloatArray], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Shifts (dx, dy) of T frames of (H, W) pixels, ``shape`` beginning with (T, H, W), in pixels, shape (T, 2)."""
    return shifts_of_reduced(reduced(frames, shape), shape)


def placed(source: FrameSource, shifts: NDArray[np.float64]) -> Placement:
    """Place the frames of a source by shifts of shape (T, 2)."""
    whole = ((int(dx), int(dy)) for dx, dy in np.rint(shifts))
    return Placement(dict(zip(source.numbers, whole, strict=True)), (source.shape[1], source.shape[2]))

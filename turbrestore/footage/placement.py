"""Where frames and windows lie: in the scene that the frames show together, in each other, and at reduced size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..io.source import Window
from .survey import reduced_shape

# Root mean square of the shifts of frames from which the camera moves, pixels: the air alone moves frames by less;
# chosen.
_MOVING = 3.0


def camera_moves(shifts: NDArray[np.float64]) -> bool:
    """Tell from the shifts of frames, (T, 2) in pixels, whether the camera moves."""
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))) >= _MOVING


@dataclass(frozen=True)
class Placement:
    """Shifts of frames, and the part of the scene that they show together."""

    shifts: dict[int, tuple[int, int]]  # (dx, dy) of each frame by its number in the file, pixels
    size: tuple[int, int]  # (H, W) of a frame

    @classmethod
    def by(cls, shifts: NDArray[np.float64], numbers: Sequence[int], size: tuple[int, int]) -> Placement:
        """Place frames by shifts (T, 2), rounded to whole pixels."""
        whole = ((int(dx), int(dy)) for dx, dy in np.rint(shifts))
        return cls(dict(zip(numbers, whole, strict=True)), size)

    @property
    def shape(self) -> tuple[int, int]:
        """(H', W') of the part of the scene that the frames show together."""
        (left, top), (right, bottom) = self._range
        return self.size[0] + bottom - top, self.size[1] + right - left

    def place(self, number: int) -> Window:
        """Return the rows and columns of the scene that a frame shows."""
        return self.of_shift(*self.shifts[number])

    def of_shift(self, dx: int, dy: int) -> Window:
        """Return the rows and columns of the scene that a frame of this shift shows."""
        right, bottom = self._range[1]
        top, left = bottom - dy, right - dx
        return slice(top, top + self.size[0]), slice(left, left + self.size[1])

    @cached_property
    def _range(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Least and greatest (dx, dy)."""
        across, down = zip(*self.shifts.values(), strict=True)
        return (min(across), min(down)), (max(across), max(down))


def relative_window(whole: Window, window: Window) -> Window:
    """Return the rows and columns of a window, counted from where another begins."""
    rows, columns = (
        slice(part.start - own.start, part.stop - own.start) for own, part in zip(whole, window, strict=True)
    )
    return rows, columns


def reduce_frames(
    frames: Iterable[FloatArray], shape: tuple[int, ...], side: int, shortest: int, blur: float
) -> FloatArray:
    """Reduce frames to a longest side and, if they are smaller, to a shortest, and blur them.

    ``shape`` (T, H, W) or (T, H, W, 3); returns (T, h, w) or (T, h, w, 3).
    """
    small = np.empty(reduced_shape(shape, side, shortest), np.float32)
    size = (small.shape[2], small.shape[1])
    for plane, frame in zip(small, frames, strict=True):
        plane[...] = cv2.GaussianBlur(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), (0, 0), blur)
    return small

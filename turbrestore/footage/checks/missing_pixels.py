"""Pixels without a value: holes that are filled from around, and borders that no frame shows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...io.pixels import PixelArray
from ...io.source import FrameSource
from .black_borders import black_border

# Share of a frame that may be missing and is filled from around, and from which it shows too little; both chosen.
FEW_MISSING, MOST_MISSING = 0.01, 0.5
# Factor between the windows from which what no frame shows is continued, chosen.
_WIDER = 3.0
# Number of rings of values that are filled from the edge of a hole inwards, chosen.
_WIDEST_HOLE = 32


def fill_holes(pixels: PixelArray) -> PixelArray:
    """Fill what is not finite, ring by ring, with the mean of the known values among the eight neighbours."""
    missing = ~np.isfinite(pixels)
    if not missing.any():
        return pixels
    with np.errstate(over="ignore"):
        values = np.where(missing, 0, pixels).astype(np.float32)
    for _ in range(_WIDEST_HOLE):
        known = (~missing).astype(np.float32)
        weight = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(values, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        ring = missing & (weight > 0.5)
        values[ring] = total[ring] / weight[ring]
        missing &= ~ring
        if not missing.any():
            break
    values[missing] = np.nan
    return values


@dataclass(frozen=True, eq=False)
class Backdrop:
    """What frames show behind the pixels that others lack."""

    # (H, W) or (H, W, 3): mean over the frames that have a value; where none has one, that of the pixels around.
    values: FloatArray
    unseen: NDArray[np.bool_]  # (H, W): pixels that no frame has
    black: NDArray[np.bool_]  # of the shape of the values: where all frames have a border; the scene may be black there
    black_borders: bool  # whether frames lack what is black along their borders, too

    def behind(self, pixels: PixelArray) -> PixelArray:
        """Fill a few missing pixels from around, and many of them, or black borders, from other frames."""
        if np.count_nonzero(~np.isfinite(pixels)) <= FEW_MISSING * pixels.size:
            pixels = fill_holes(pixels)
        missing = ~np.isfinite(pixels) | (_missing(pixels, self.black_borders) & ~self.black)
        if not missing.any():
            return pixels
        if np.issubdtype(pixels.dtype, np.floating):
            return np.where(missing, self.values, pixels).astype(np.float32)
        return np.where(missing, np.rint(self.values), pixels).astype(pixels.dtype)


def mean_backdrop(frames: Iterable[PixelArray], shape: tuple[int, ...], black_borders: bool) -> Backdrop:
    """Average what frames show, and continue it smoothly to where none has a value.

    ``frames`` (H, W) or (H, W, 3) each, as ``shape`` says; missing pixels are NaN, infinite or, with ``black_borders``,
    black.
    """
    total, count, valued = np.zeros(shape), np.zeros(shape, np.int32), np.zeros(shape, bool)
    for pixels in frames:
        known = ~_missing(pixels, black_borders)
        np.add(total, pixels, out=total, where=known)
        count += known
        valued |= np.isfinite(pixels)
    mean = (total / np.maximum(count, 1)).astype(np.float32)
    unseen = np.asarray(~valued if valued.ndim == 2 else ~valued.all(axis=2))
    return Backdrop(continued(mean, valued), unseen, valued & (count == 0), black_borders)


def _missing(pixels: PixelArray, black_borders: bool) -> NDArray[np.bool_]:
    """Mark what a frame lacks; of the shape of the frame."""
    missing = ~np.isfinite(pixels)
    return np.asarray((missing.T | black_border(pixels).T).T) if black_borders else missing


def continued(values: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """Continue values into what is not known, by averages in wider and wider windows of what is.

    ``values`` (H, W) or (H, W, 3); ``known`` of the same shape, or (H, W).
    """
    filled, missing, reach = values.copy(), ~known, 1.0
    weight = known.astype(np.float32)
    while missing.any() and reach < 4 * max(known.shape):
        around = cv2.GaussianBlur(weight, (0, 0), reach, borderType=cv2.BORDER_CONSTANT)
        total = cv2.GaussianBlur((values.T * weight.T).T, (0, 0), reach, borderType=cv2.BORDER_CONSTANT)
        near = missing & (around > 0.05)
        filled[near] = (total[near].T / around[near]).T
        missing &= ~near
        reach *= _WIDER
    return filled


def backdrop_of_file(backdrop: Backdrop, source: FrameSource) -> Backdrop:
    """Bring a backdrop of the selected rows and columns to the size of the frames in the file."""
    values, black = np.zeros(source.file_shape[1:], np.float32), np.zeros(source.file_shape[1:], bool)
    unseen = np.zeros(source.file_shape[1:3], bool)
    values[source.window], black[source.window] = backdrop.values, backdrop.black
    unseen[source.window] = backdrop.unseen
    return replace(backdrop, values=values, unseen=unseen, black=black)

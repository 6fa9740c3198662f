"""Counts: numbers of files that do not say which of them are black and white.

Black is 0, or the lowest number of all frames if that is negative; white is the highest.  A number is lone where no
neighbour comes near it: a hot pixel, a cosmic ray, a damaged byte.  Lone numbers, and those of a few frames alone, do
not widen the range to more than twice what the others span; they are clipped instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..core.errors import DataError
from ..runtime.scratch import iter_frames
from .limits import Limits
from .pixels import FLOAT_MARGIN, PixelArray, depth_of, full_scale_of
from .source import FrameSource

# Percentage of the frames at either end whose extremes do not count, chosen.
_FEW = 10
NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
# Unsigned numbers of four bytes and more fill their type if one of them reaches this share of it, and
# hence uses its highest byte.
_FILLED = 1 / 256


@dataclass(frozen=True)
class CountRange:
    """Numbers that mean black and white, and the lowest and highest number of all frames."""

    black: float
    white: float
    lowest: float
    highest: float

    @property
    def levels(self) -> tuple[float, float] | None:
        """Black and white; None where they are 0 and 1 as in other files."""
        return None if (self.black, self.white) == (0, 1) else (self.black, self.white)

    @property
    def remark(self) -> str:
        """Say how the numbers are read."""
        text = (
            f"values {self.lowest:g} to {self.highest:g} are scaled: {self.black:g} is black, {self.white:g} is white"
        )
        clipped = self.lowest < self.black or self.highest > self.white
        return text + (", and the few values beyond, which are isolated, are clipped" if clipped else "")

    def unit(self, values: PixelArray) -> FloatArray:
        """Bring numbers to intensities; NaN and infinite ones stay."""
        scaled = (values.astype(np.float64) - self.black) / (self.white - self.black)
        clipped = np.clip(scaled, 0, 1, where=np.isfinite(scaled), out=scaled)
        return clipped.astype(np.float32)


def holds_counts(dtype: np.dtype[Any]) -> bool:
    """Whether the numbers of a type may be counts: signed ones, floating point, and unsigned ones of four bytes."""
    return dtype.kind in "if" or (dtype.kind == "u" and dtype.itemsize >= 4)


def source_of_numbers(
    path: Path,
    form: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    pixels: Callable[[Sequence[int]], Iterator[PixelArray]],
    notes: tuple[str, ...],
    limits: Limits,
) -> FrameSource:
    """Describe a video of numbers of a type; where they may be counts, every frame is read once to find their range.

    Other types than numbers, and sizes beyond the limits, raise DataError.
    """
    source = FrameSource(
        name=path.name,
        format=form,
        file_shape=shape,
        full_scale=1 if dtype.kind == "i" else full_scale_of(dtype, str(path)),
        bit_depth=depth_of(dtype),
        pixels=pixels,
        path=path,
        warnings=notes,
    )
    limits.check_size(shape[2], shape[1], str(path))
    limits.check_count(shape[0], str(path))
    if not holds_counts(dtype):
        return source

    def whole() -> Iterator[PixelArray]:
        # What follows a damaged frame is scaled by the range of what comes before.
        with suppress(DataError):
            yield from pixels(range(shape[0]))

    found = range_of_counts(whole(), path.name)
    if found is None:
        return source
    return dataclasses.replace(
        source,
        full_scale=1,
        bit_depth=32,
        pixels=lambda chosen: (found.unit(frame) for frame in iter_frames(pixels(chosen))),
        warnings=(*notes, found.remark),
        levels=found.levels,
    )


def range_of_counts(frames: Iterable[PixelArray], name: str, kind: str | None = None) -> CountRange | None:
    """Find the range of the numbers of all frames; None where they are intensities already.

    ``kind`` is that of the type in the file, by default that of the frames: integers are no intensities.
    """
    ends: list[tuple[float, float, float, float]] = []
    dtype: np.dtype[Any] = np.dtype(np.float32)
    for frame in iter_frames(iter(frames)):
        dtype = frame.dtype
        ends.append(_ends(frame))
    lowest, low, high, highest = np.array(ends).T if ends else np.full((4, 1), np.nan)
    if not ends or np.nanmax(highest) == -np.inf:
        raise DataError(f"{name}: expected finite values, found only NaN or infinite ones")
    seen = np.isfinite(highest)
    bottom, top = float(lowest[seen].min()), float(highest[seen].max())
    kind = kind or dtype.kind
    if kind == "f" and bottom >= -FLOAT_MARGIN and top <= 1 + FLOAT_MARGIN:
        return None
    if kind == "u" and dtype.kind == "u" and top >= _FILLED * np.iinfo(dtype).max:
        return None
    usual = min(0.0, float(np.percentile(low[seen], _FEW, method="lower")))
    bright = float(np.percentile(high[seen], 100 - _FEW, method="higher"))
    if kind == "f" and usual >= -FLOAT_MARGIN and bright <= 1 + FLOAT_MARGIN:
        return CountRange(0.0, 1.0, bottom, top)
    span = bright - usual
    black = min(bottom, 0.0) if bottom >= usual - span or span <= 0 else usual
    white = top if top <= bright + span or span <= 0 else bright
    # Numbers that are all zero stay black.
    return CountRange(black, white if white > black else black + 1, bottom, top)


def _ends(frame: PixelArray) -> tuple[float, float, float, float]:
    """Lowest number, lowest and highest that have a neighbour as low or as high, and highest number."""
    bottom, top = float(frame.min()), float(frame.max())
    if frame.dtype.kind == "f" and bottom >= -FLOAT_MARGIN and top <= 1 + FLOAT_MARGIN:
        # Intensities need no closer look.
        return bottom, bottom, top, top
    values = np.asarray(frame, np.float64)
    known = np.isfinite(values)
    up, down = np.where(known, values, -np.inf), np.where(known, values, np.inf)
    highest, lowest = float(up.max()), float(down.min())
    if min(values.shape[:2]) < 3:
        return lowest, lowest, highest, highest
    high = float(np.minimum(up, cv2.dilate(up, NEIGHBOURS)).max())
    low = float(np.maximum(down, cv2.erode(down, NEIGHBOURS)).min())
    return lowest, low, high, highest

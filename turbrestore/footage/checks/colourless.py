"""Videos whose three channels are equal: infrared and monochrome cameras, recorded in a format of colours.

One channel is read, which takes a third of the memory and less time, and results have one channel too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from ...io.pixels import PixelArray, unrepaired
from ...io.source import FrameSource


def may_be_grey(source: FrameSource) -> bool:
    """Whether frames have three channels that nothing gives colours after they are read."""
    return len(source.shape) == 4 and source.bayer is None and source.adjust is None


def is_grey(pixels: PixelArray) -> bool:
    """Whether the channels of a frame (H, W, 3) are equal."""
    first = pixels[..., 0]
    return all(np.array_equal(first, pixels[..., channel]) for channel in (1, 2))


def read_as_grey(source: FrameSource) -> FrameSource:
    """Take the first channel of every frame, after it is repaired."""
    height, width = source.file_shape[1:3]
    whole = dataclasses.replace(source, window=(slice(0, height), slice(0, width)))

    def pixels(chosen: Sequence[int]) -> Iterator[PixelArray]:
        for frame in dataclasses.replace(whole, numbers=tuple(chosen)).native():
            yield frame[..., 0].copy()

    repair = source.repair and unrepaired
    return dataclasses.replace(source, file_shape=source.file_shape[:3], pixels=pixels, repair=repair)

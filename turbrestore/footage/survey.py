"""The survey of a clip: one pass over its frames, from which all questions about the clip are answered.

A survey keeps every frame in a reduced size, and some frames, spread over the clip, as they are in the file.  What is
looked for, such as bars beside the picture or a lamp that flickers, is a function from a survey to a correction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.noise import estimate_noise
from ..core.robust import spread
from ..io.pixels import PixelArray
from ..io.source import FrameSource
from ..registration.camera.global_shift import LONGEST_SIDE
from ..registration.flow import MIN_SIDE
from ..runtime.scratch import drop_pages, iter_frames, new_stack
from ..runtime.steps import Progress, step_counter
from .correction import Correction

# Most frames that are kept whole, for their cost, and fewest, chosen, which tell what stays from what moves; those
# beyond take at most so many bytes.
_MOST, FEWEST, _WHOLE_BYTES = 48, 9, 4e8
# About how many numbers all reduced frames are, which take 32 MB.
_NUMBERS = 8e6


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments over time of some frames of a clip, from which static overlays and patterns are found."""

    mean: FloatArray  # (H, W) or (H, W, 3)
    variance: FloatArray  # (H, W): of the luminance
    change: FloatArray  # (H, W): half of the mean squared difference from one frame to the next
    noise: float  # standard deviation of the noise of a frame, median over the frames
    count: int


@dataclass(frozen=True, eq=False)
class Survey:
    """All frames of a clip at reduced size, and some of them whole; iterating yields the whole ones, corrected."""

    clip: FrameSource  # corrected by what has been found
    numbers: tuple[int, ...]  # of the whole frames, in the file
    pixels: tuple[PixelArray, ...]  # (H, W) or (H, W, 3) each: the whole frames before they are adjusted
    small: FloatArray  # (T, h, w) or (T, h, w, 3): all frames, corrected

    def __iter__(self) -> Iterator[FloatArray]:
        return map(self.clip.intensities, self.numbers, iter_frames(self.pixels))

    @cached_property
    def moments(self) -> Moments:
        """Moments of the whole frames."""
        return _measure_moments(self)

    def corrected(self, correction: Correction) -> Survey:
        """Correct the frames."""
        if correction.apply is None:
            return self
        small = self.small if correction.small is None else correction.small
        return dataclasses.replace(self, clip=self.clip.adjusted(correction.apply), small=small)


def take_survey(clip: FrameSource, scratch: Path | None = None, progress: Progress | None = None) -> Survey:
    """Read the frames of a clip once; whole ones are kept in memory or, if there is a folder, in a scratch file."""
    told = step_counter(progress, "read", len(clip))
    small = np.empty(_small_shape(clip.shape), np.float32)
    size, places, stack = (small.shape[2], small.shape[1]), list[int](), np.empty(0)
    for index, (number, pixels) in enumerate(zip(clip.numbers, clip.native(), strict=True)):
        values = clip.intensities(number, pixels)
        small[index] = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        told(values)
        if not places:
            dtype = pixels.dtype if pixels.dtype.kind == "u" else np.dtype(np.float32)
            places = spread(len(clip), _whole_frames(clip.shape, dtype.itemsize))
            stack = new_stack((len(places), *clip.shape[1:]), scratch, dtype.newbyteorder("="))
        if index in places:
            # Floating point is in [0, 1] in the file as well.
            stack[places.index(index)] = pixels
            drop_pages(stack)
    return Survey(clip, tuple(clip.numbers[place] for place in places), tuple(stack), small)


def _measure_moments(survey: Survey) -> Moments:
    shape = survey.clip.shape[1:]
    sums, noise = np.zeros((3, *shape[:2])), list[float]()
    total = sums[0] if len(shape) == 2 else np.zeros(shape)
    before: FloatArray | None = None
    for frame in survey:
        grey = luminance(frame)
        if before is not None:
            cv2.accumulateSquare(grey - before, sums[2])
        before = grey
        cv2.accumulate(grey, sums[0])
        cv2.accumulateSquare(grey, sums[1])
        if len(shape) == 3:
            cv2.accumulate(frame, total)
        noise.append(estimate_noise(grey))
    count = len(survey.numbers)
    # Without temporary arrays: the search for overlays takes most memory here.
    mean = np.divide(total, count, out=np.empty(shape, np.float32), casting="same_kind")
    sums /= np.reshape([count, count, 2 * max(count - 1, 1)], (3, 1, 1))
    sums[1] -= np.square(sums[0], out=sums[0])
    variance, change = np.maximum(sums[1:], 0, out=sums[1:]).astype(np.float32)
    return Moments(mean, variance, change, float(np.median(noise)), count)


def survey_memory(shape: tuple[int, ...], in_scratch: bool) -> float:
    """Bytes that a survey takes of frames of shape (T, H, W) or (T, H, W, 3): whole and reduced ones."""
    whole = float(np.prod(shape[1:])) * 4 * (2 if in_scratch else _whole_frames(shape, 4))
    # One more while they are corrected, and what the light is measured from.
    return whole + 12 * float(np.prod(_small_shape(shape)))


def survey_scratch_bytes(shape: tuple[int, ...]) -> float:
    """Bytes of the scratch file of a survey."""
    return float(np.prod(shape[1:])) * 4 * _whole_frames(shape, 4)


def _whole_frames(shape: tuple[int, ...], itemsize: int) -> int:
    most = int(_WHOLE_BYTES / (itemsize * np.prod(shape[1:], dtype=float)))
    return min(shape[0], max(FEWEST, min(_MOST, most)))


def _small_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """(T, h, w) or (T, h, w, 3) of the reduced frames: smaller ones where there are many."""
    # Shifts are measured on them, and flow needs the shortest side.
    side = min(float(LONGEST_SIDE), (_NUMBERS * max(shape[1:3]) ** 2 / np.prod(shape, dtype=float)) ** 0.5)
    return reduced_shape(shape, side, MIN_SIDE)


def reduced_shape(shape: tuple[int, ...], side: float, shortest: int) -> tuple[int, ...]:
    """(T, h, w) or (T, h, w, 3) of frames that are reduced to a longest side, with no side below ``shortest``."""
    factor = max(1.0, max(shape[1:3]) / side)
    return (shape[0], *(max(shortest, round(length / factor)) for length in shape[1:3]), *shape[3:])

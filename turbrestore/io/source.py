"""A video as the stages see it: frames on demand, as often as wanted, one at a time in memory.

A reader of one format (``container``, ``ser``, ``tiff``, …) hands over a function that yields the native pixels of
given frames, and what it knows from the headers. Range, crop, scaling to [0, 1] and the checks are done here, once
for all formats.
"""

from __future__ import annotations

import dataclasses
import operator
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import CHANNELS, FloatArray
from ..core.errors import ConfigurationError, DataError, require
from ..runtime.scratch import drop_pages
from .images import IMAGE_SUFFIXES
from .pixels import PixelArray, depth_of, full_scale_of, to_unit

FrameRange = tuple[int | None, int | None] | tuple[int | None, int | None, int | None]
Roi = tuple[int, int, int, int]
# Frames that a message names before it only counts them.
_NAMED = 5


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Frames of a video, decoded while iterating; every iteration starts anew.

    Attributes
    ----------
    name : str
        How messages call the video.
    format : str
        Container or codec and pixel format, such as ``ffv1/gray16le``.
    file_shape : tuple of int
        (T, H, W) or (T, H, W, 3) of the whole file.
    full_scale : int
        Native value that means intensity 1.
    bit_depth : int
        Bits per channel of the file; 32 for floating point.
    pixels : callable
        Given ascending frame numbers of the file, yields their native pixels in that order.
    path : Path or None
        The file or folder; None for an array.
    fps : float or None
        Frames per second, after the selection.
    timestamps : ndarray, float64, shape (T,), or None
        Seconds since the first frame of the file, after the selection.
    warnings : tuple of str
        What was left out or looks odd.
    damaged : tuple of int
        Numbers, in the file, of frames that are known to be damaged.
    repair : callable or None
        Applied to the native pixels of every frame of the file before anything looks at them.
    numbers : range or tuple of int
        Numbers, in the file, of the frames selected, ascending; by default all.
    window : tuple of slice
        Rows and columns selected; by default all.

    Examples
    --------
    >>> import numpy as np
    >>> source = FrameSource.from_array(np.zeros((5, 4, 6), np.uint8))
    >>> source.shape, source.bit_depth
    ((5, 4, 6), 8)
    >>> part = source.select(frames=(1, None, 2), roi=(0, 1, 3, 2))
    >>> len(part), [frame.shape for frame in part]
    (2, [(2, 3), (2, 3)])
    """

    name: str
    format: str
    file_shape: tuple[int, ...]
    full_scale: int
    bit_depth: int
    pixels: Callable[[Sequence[int]], Iterator[PixelArray]] = field(repr=False)
    path: Path | None = None
    fps: float | None = None
    timestamps: NDArray[np.float64] | None = field(default=None, repr=False)
    warnings: tuple[str, ...] = ()
    damaged: tuple[int, ...] = ()
    repair: Callable[[PixelArray], PixelArray] | None = field(default=None, repr=False)
    numbers: range | tuple[int, ...] = range(0)
    window: tuple[slice, slice] = (slice(0), slice(0))

    def __post_init__(self) -> None:
        shape = self.file_shape
        if len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] not in CHANNELS):
            raise DataError(f"{self.name}: expected frames of shape (T, H, W) or (T, H, W, 3), found {shape}")
        if shape[0] < 1:
            raise DataError(f"{self.name}: expected at least one frame, found none")
        if min(shape[1:3]) < 1:
            raise DataError(f"{self.name}: expected frames of at least one pixel, found {shape[2]}×{shape[1]}")
        if not self.numbers:
            object.__setattr__(self, "numbers", range(shape[0]))
            object.__setattr__(self, "window", (slice(0, shape[1]), slice(0, shape[2])))

    @property
    def shape(self) -> tuple[int, ...]:
        """(T, H, W) or (T, H, W, 3) of the frames selected."""
        rows, columns = self.window
        return (len(self.numbers), rows.stop - rows.start, columns.stop - columns.start, *self.file_shape[3:])

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[FloatArray]:
        return self._frames(self.numbers)

    def read(self, start: int = 0, stop: int | None = None) -> FloatArray:
        """Frames ``start`` to ``stop`` (exclusive) as one array.

        Parameters
        ----------
        start, stop : int
            As in a slice, counted in the selection.

        Returns
        -------
        ndarray, float32, shape (T, H, W) or (T, H, W, 3)

        Raises
        ------
        DataError
            Frames are damaged or missing.
        ConfigurationError
            No frame lies in the range.

        Examples
        --------
        >>> import numpy as np
        >>> FrameSource.from_array(np.zeros((5, 4, 6))).read(1, 3).shape
        (2, 4, 6)
        """
        chosen = self.numbers[start:stop]
        require(len(chosen) > 0, f"{self.name}: no frame in {start} to {stop}; there are {len(self)}")
        stack = np.empty((len(chosen), *self.shape[1:]), np.float32)
        for index, frame in enumerate(self._frames(chosen)):
            stack[index] = frame
        return stack

    def native(self) -> Iterator[PixelArray]:
        """Frames of the selection as the file has them: cropped, but neither scaled nor checked.

        Yields
        ------
        ndarray, shape (H, W) or (H, W, 3)
            In the type of the file.

        Raises
        ------
        DataError
            Frames are damaged or missing.

        Examples
        --------
        >>> import numpy as np
        >>> [int(frame[0, 0]) for frame in FrameSource.from_array(np.full((2, 1, 1), 7, np.uint8)).native()]
        [7, 7]
        """
        for _, pixels in self._native(self.numbers):
            yield pixels

    def without(self, numbers: Collection[int], warning: str) -> FrameSource:
        """Leave frames out.

        Parameters
        ----------
        numbers : collection of int
            Numbers, in the file, of the frames to leave out; those that are not selected do not count.
        warning : str
            Added to the warnings where a frame is left out.

        Returns
        -------
        FrameSource

        Raises
        ------
        DataError
            No frame remains.

        Examples
        --------
        >>> import numpy as np
        >>> source = FrameSource.from_array(np.zeros((4, 1, 1))).without({1}, "frame 1 left out")
        >>> source.numbers, source.warnings
        ((0, 2, 3), ('frame 1 left out',))
        """
        places = [place for place, number in enumerate(self.numbers) if number not in numbers]
        if len(places) == len(self):
            return self
        if not places:
            raise DataError(f"{self.name}: expected at least one frame that can be used, found none")
        return dataclasses.replace(
            self,
            numbers=tuple(self.numbers[place] for place in places),
            timestamps=None if self.timestamps is None else self.timestamps[places],
            warnings=(*self.warnings, warning),
        )

    def select(self, frames: FrameRange | None = None, roi: Roi | None = None) -> FrameSource:
        """Part of the frames, cropped.

        Parameters
        ----------
        frames : tuple, optional
            (start, stop) or (start, stop, step), as in a slice; None stands for the end of the video. Nothing
            counts from the end, and nothing may lie outside.
        roi : tuple of int, optional
            (x, y, width, height) in pixels.

        Returns
        -------
        FrameSource

        Raises
        ------
        ConfigurationError
            Not a range or a rectangle, or outside the video.

        Examples
        --------
        >>> import numpy as np
        >>> FrameSource.from_array(np.zeros((5, 4, 6))).select(frames=(3, 9))
        Traceback (most recent call last):
        ...
        turbrestore.core.errors.ConfigurationError: frames: expected 0 <= start < stop <= 5, found (3, 9)
        """
        wanted = check_frame_range(frames)
        count = len(self)
        start = wanted.start or 0
        stop = count if wanted.stop is None else wanted.stop
        require(0 <= start < stop <= count, f"frames: expected 0 <= start < stop <= {count}, found {frames}")
        chosen = slice(start, stop, wanted.step)
        return dataclasses.replace(
            self,
            numbers=self.numbers[chosen],
            window=self._window(roi),
            fps=None if self.fps is None else self.fps / (wanted.step or 1),
            timestamps=None if self.timestamps is None else self.timestamps[chosen],
        )

    @staticmethod
    def from_array(array: ArrayLike, name: str = "array", fps: float | None = None) -> FrameSource:
        """Frames that lie in memory, or in a memory-mapped file.

        Parameters
        ----------
        array : array_like, shape (T, H, W) or (T, H, W, 3)
            Unsigned integers, scaled by the range of their type, or floating point in [0, 1].
        name : str
            How messages call the video.
        fps : float, optional
            Frames per second.

        Returns
        -------
        FrameSource

        Raises
        ------
        DataError
            Wrong shape or type.

        Examples
        --------
        >>> import numpy as np
        >>> FrameSource.from_array(np.full((2, 1, 1), 255, np.uint8)).read()
        array([[[1.]],
        <BLANKLINE>
               [[1.]]], dtype=float32)
        """
        values = np.asanyarray(array)
        return FrameSource(
            name=name,
            format=f"array/{values.dtype}",
            file_shape=values.shape,
            full_scale=full_scale_of(values.dtype, name),
            bit_depth=depth_of(values.dtype),
            pixels=lambda chosen: (values[number] for number in chosen),
            fps=fps,
        )

    def _window(self, roi: Roi | None) -> tuple[slice, slice]:
        if roi is None:
            return self.window
        height, width = self.shape[1:3]
        try:
            x, y, w, h = (operator.index(value) for value in roi)
        except (TypeError, ValueError):
            raise ConfigurationError(f"roi: expected four integers x, y, width, height, found {roi}") from None
        require(
            0 <= x < x + w <= width and 0 <= y < y + h <= height,
            f"roi: expected x, y, width, height inside {width}×{height} pixels, found {x}, {y}, {w}, {h}",
        )
        top, left = self.window[0].start + y, self.window[1].start + x
        return slice(top, top + h), slice(left, left + w)

    def _frames(self, chosen: range | tuple[int, ...]) -> Iterator[FloatArray]:
        for number, pixels in self._native(chosen):
            yield to_unit(pixels, self.full_scale, f"{self.name}: frame {number}")

    def _native(self, chosen: range | tuple[int, ...]) -> Iterator[tuple[int, PixelArray]]:
        done = 0
        for number, pixels in zip(chosen, self.pixels(chosen), strict=False):
            if pixels.shape != self.file_shape[1:]:
                expected, found = size_text(self.file_shape[1:]), size_text(pixels.shape)
                raise DataError(f"{self.name}: frame {number}: expected {expected} as the first frame, found {found}")
            yield number, (pixels if self.repair is None else self.repair(pixels))[self.window]
            # A mapped video would be in memory as a whole at the end.
            drop_pages(pixels)
            done += 1
        if done < len(chosen):
            raise DataError(
                f"{self.name}: expected {len(chosen)} frames, found {done}; the file is damaged or cut short"
            )


def check_frame_range(frames: FrameRange | None) -> slice:
    """Return (start, stop[, step]) as a slice of non-negative integers.

    Parameters
    ----------
    frames : tuple, optional
        See :meth:`FrameSource.select`.

    Returns
    -------
    slice

    Raises
    ------
    ConfigurationError
        Not two or three non-negative integers or None, or a step below 1.

    Examples
    --------
    >>> check_frame_range((10, None, 2))
    slice(10, None, 2)
    """
    wrong = ConfigurationError(
        f"frames: expected (start, stop) or (start, stop, step) of integers from 0 or None, found {frames}"
    )
    if frames is None:
        return slice(None)
    try:
        values = [None if value is None else operator.index(value) for value in frames]
    except TypeError:
        raise wrong from None
    if len(values) not in (2, 3) or any(value is not None and value < 0 for value in values):
        raise wrong
    require(len(values) == 2 or values[2] != 0, f"frames: expected a step of at least 1, found {frames}")
    return slice(*values)


def frame_files(folder: Path) -> list[Path]:
    """Images of a folder that are the frames of a video: no hidden files, no folders, no links that lead nowhere.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    list of Path
        In the order of their names, with the digits counting as numbers.

    Raises
    ------
    OSError
        The folder cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("a10.png", "a9.png", ".a1.png", "notes.txt"):
    ...         Path(folder, name).touch()
    ...     [path.name for path in frame_files(Path(folder))]
    ['a9.png', 'a10.png']
    """

    def natural(file: Path) -> tuple[list[tuple[int, str]], str]:
        parts = re.findall(r"\d+|\D+", file.name)
        return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts], file.name

    named = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.name[0] != ".")
    return sorted((path for path in named if path.is_file()), key=natural)


def size_text(shape: tuple[int, ...]) -> str:
    """Size and kind of a frame in words.

    Parameters
    ----------
    shape : tuple of int
        (H, W) or (H, W, C).

    Returns
    -------
    str

    Examples
    --------
    >>> size_text((480, 640, 3))
    '640×480 RGB'
    """
    kind = "grey" if len(shape) == 2 else "RGB" if shape[2] == 3 else f"{shape[2]} channels"
    return f"{shape[1]}×{shape[0]} {kind}"


def cut_short_text(intact: int) -> str:
    """Say what is wrong with, and what to do about, a video of which only the first ``intact`` frames are there.

    Parameters
    ----------
    intact : int
        Frames that can be read.

    Returns
    -------
    str

    Examples
    --------
    >>> cut_short_text(59)
    'cut short after 59 whole frames; copy the file again or select frames up to 59'
    >>> cut_short_text(0)
    'cut short before the end of the first frame; copy the file again'
    """
    if intact < 1:
        return "cut short before the end of the first frame; copy the file again"
    return f"cut short after {intact} whole frames; copy the file again or select frames up to {intact}"


def skipped_end_text(intact: int) -> str:
    """Say that only the whole frames of a video that is cut short are used.

    Parameters
    ----------
    intact : int
        Frames that can be read.

    Returns
    -------
    str

    Examples
    --------
    >>> skipped_end_text(59)
    'cut short; only its first 59 frames are used'
    """
    return f"cut short; only its first {intact} frames are used"


def numbers_text(numbers: Collection[int]) -> str:
    """Name frames: how many, and the first few.

    Parameters
    ----------
    numbers : collection of int
        Ascending.

    Returns
    -------
    str

    Examples
    --------
    >>> numbers_text([4])
    'frame 4'
    >>> numbers_text(range(10, 30))
    'frames 10, 11, 12, 13, 14 and 15 more'
    """
    first = f"frame{'s' * (len(numbers) > 1)} {', '.join(str(number) for number in islice(numbers, _NAMED))}"
    return f"{first} and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else first

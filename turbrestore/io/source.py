"""A video as the stages use it: frames are decoded on demand, one at a time, as often as wanted.

The reader of a format (``container``, ``ser``, ``tiff`` and others) provides a function that yields the native pixels
of given frames, and what the headers say. Range, crop, scaling to [0, 1] and checks are done here for all formats.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import CHANNELS, FloatArray, as_array
from ..core.errors import ConfigurationError, DataError, require
from ..core.remarks import Doubt, counted
from ..runtime.scratch import iter_frames
from .axes import frames_are_last
from .output import size_text
from .pixels import PixelArray, demosaic, depth_of, full_scale_of, to_unit

FrameRange = tuple[int | None, int | None] | tuple[int | None, int | None, int | None]
Roi = tuple[int, int, int, int]
Window = tuple[slice, slice]
# Selection that the constructor resolves to all frames, or to all rows and columns; None, but typed as either.
_ALL: Any = None
# Number of frames that a message lists before it only counts the others, chosen.
_NAMED = 5


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Frames of a video that are decoded while iterating; every iteration starts from the first frame.

    Attributes
    ----------
    name, format : str
        Name of the video in messages; container or codec and pixel format, such as ``ffv1/gray16le``.
    file_shape : tuple of int
        (T, H, W) or (T, H, W, 3) of the whole file.
    full_scale, bit_depth : int
        Native value that means intensity 1; bits per channel of the file, 32 for floating point.
    pixels : callable
        Takes ascending frame numbers of the file, and yields the native pixels of these frames.
    path : Path or None
        File or folder; None for an array.
    fps : float or None
        Frames per second, after the selection.
    timestamps : ndarray, float64, shape (T,), or None
        Seconds since the first frame of the file, after the selection.
    warnings : tuple of str
        What was left out, or is unusual; those that a person has to check are of the type
        ``turbrestore.core.remarks.Doubt``.
    damaged : tuple of int
        Numbers, in the file, of frames that are known to be damaged.
    levels : tuple of float or None
        Numbers of the file that were scaled to 0 and 1; None where its type says what is black and white.
    colour : tuple of int or None
        Primaries and transfer characteristic of the colours of a video, as ITU-T H.273 numbers them.
    unseen : ndarray, bool, shape (H, W), or None
        Pixels of the file that no frame shows and that are filled from around, such as the border of a round stop.
    header : tuple of str
        Cards of the header of a FITS file, 80 characters each.
    repair : callable or None
        Applied to the native pixels of every frame first.
    bayer : str or None
        Colours of the first pixels, such as ``rggb``, where native pixels are the mosaic of a Bayer sensor.
    adjust : callable or None
        Takes the number of a frame in the file, its intensities, and the rows and columns of the file that they are;
        returns the intensities that are used instead, which may lie outside [0, 1].
    numbers, window : range or tuple of int, tuple of slice
        Ascending numbers, in the file, of the selected frames; selected rows and columns. By default all.

    Examples
    --------
    >>> import numpy as np
    >>> source = FrameSource.from_array(np.zeros((5, 4, 6), np.uint8))
    >>> part = source.select(frames=(1, None, 2), roi=(0, 1, 3, 2))
    >>> source.shape, len(part), [frame.shape for frame in part]
    ((5, 4, 6), 2, [(2, 3), (2, 3)])
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
    levels: tuple[float, float] | None = None
    colour: tuple[int, int] | None = None
    unseen: NDArray[np.bool_] | None = field(default=None, repr=False)
    header: tuple[str, ...] = field(default=(), repr=False)
    repair: Callable[[PixelArray], PixelArray] | None = field(default=None, repr=False)
    bayer: str | None = None
    adjust: Callable[[int, FloatArray, Window], FloatArray] | None = field(default=None, repr=False)
    numbers: range | tuple[int, ...] = _ALL
    window: Window = _ALL

    def __post_init__(self) -> None:
        shape = self.file_shape
        if len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] not in CHANNELS):
            raise DataError(f"{self.name}: expected frames of shape (T, H, W) or (T, H, W, 3), found {shape}")
        if shape[0] < 1:
            raise DataError(f"{self.name}: expected at least one frame, found none")
        if min(shape[1:3]) < 1:
            raise DataError(f"{self.name}: expected frames of at least one pixel, found {shape[2]}×{shape[1]}")
        if self.numbers is _ALL:
            object.__setattr__(self, "numbers", range(shape[0]))
        if self.window is _ALL:
            object.__setattr__(self, "window", (slice(0, shape[1]), slice(0, shape[2])))
        if not self.numbers:
            raise DataError(f"{self.name}: expected at least one selected frame, found none")

    @property
    def shape(self) -> tuple[int, ...]:
        """(T, H, W) or (T, H, W, 3) of the selected frames."""
        rows, columns = self.window
        return (len(self.numbers), rows.stop - rows.start, columns.stop - columns.start, *self.file_shape[3:])

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[FloatArray]:
        return self._frames(self.numbers)

    def read(self, start: int = 0, stop: int | None = None) -> FloatArray:
        """Read frames ``start`` to ``stop`` (exclusive), counted in the selection, as one float32 array.

        Raises
        ------
        DataError
            Frames are damaged or missing.
        ConfigurationError
            The range is empty.

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
        """Iterate over the selected frames in the type of the file: cropped, but neither scaled nor checked.

        Examples
        --------
        >>> import numpy as np
        >>> [int(frame[0, 0]) for frame in FrameSource.from_array(np.full((2, 1, 1), 7, np.uint8)).native()]
        [7, 7]
        """
        for _, pixels in self._native(self.numbers):
            yield pixels

    def intensities(self, number: int, pixels: PixelArray) -> FloatArray:
        """Scale and adjust what :meth:`native` yields for the frame with this number in the file.

        Examples
        --------
        >>> import numpy as np
        >>> float(FrameSource.from_array(np.zeros((1, 1, 1), np.uint8)).intensities(0, np.uint8([[255]]))[0, 0])
        1.0
        """
        remedy = "; clean_source(source, check_content(source)) fills them"
        values = to_unit(pixels, self.full_scale, f"{self.name}: frame {number}", remedy)
        return values if self.adjust is None else self.adjust(number, values, self.window)

    def mosaics(self) -> Iterator[PixelArray | None]:
        """Iterate over whole frames as the sensor saw them, before they are repaired and developed; None for others.

        Examples
        --------
        >>> import numpy as np
        >>> list(FrameSource.from_array(np.full((2, 1, 1), 7, np.uint8)).mosaics())
        [None, None]
        """
        if self.bayer is None:
            yield from (None for _ in self.numbers)
        else:
            yield from self.pixels(self.numbers)

    def without(self, numbers: Collection[int], warning: str) -> FrameSource:
        """Leave out the frames with these numbers in the file; where any is selected, ``warning`` is added.

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

    def adjusted(self, adjust: Callable[[int, FloatArray, Window], FloatArray]) -> FrameSource:
        """Adjust the intensities of frames, after what adjusts them already.

        Examples
        --------
        >>> source = FrameSource.from_array(np.full((1, 1, 1), 0.5)).adjusted(lambda _, values, window: values / 2)
        >>> float(source.adjusted(lambda _, values, window: values + 1).read()[0, 0, 0])
        1.25
        """
        before = self.adjust
        if before is None:
            return dataclasses.replace(self, adjust=adjust)
        return dataclasses.replace(
            self, adjust=lambda number, values, window: adjust(number, before(number, values, window), window)
        )

    def select(self, frames: FrameRange | None = None, roi: Roi | None = None) -> FrameSource:
        """Select a range of frames and a rectangle.

        Parameters
        ----------
        frames : tuple, optional
            (start, stop) or (start, stop, step), as in a slice, but without negative numbers and within the video; None
            as the stop is the end of the video.
        roi : tuple of int, optional
            (x, y, width, height) in pixels.

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
        turbrestore.core.errors.ConfigurationError: frames: expected a range within 0:5, found 3:9
        """
        wanted = to_slice(frames)
        count = len(self)
        start = wanted.start or 0
        stop = count if wanted.stop is None else wanted.stop
        require(0 <= start < stop <= count, f"frames: expected a range within 0:{count}, found {start}:{stop}")
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
        """Use an array in memory, a memory-mapped file, or an array that is computed or read on demand, as a video.

        Arrays of Dask, xarray, Zarr and HDF5 are read frame by frame, while iterating; chunks of one frame are best.  A
        warning says where an array in memory looks like (H, W, T).

        Parameters
        ----------
        array : array_like, shape (T, H, W) or (T, H, W, 3)
            Unsigned integers, scaled by the range of their type, or floating point in [0, 1]; others raise DataError.
        name : str
            Name of the video in messages.
        fps : float, optional
            Frames per second.

        Examples
        --------
        >>> import numpy as np
        >>> FrameSource.from_array(np.full((2, 1, 1), 255, np.uint8)).read().ravel()
        array([1., 1.], dtype=float32)
        """
        # What has a type of NumPy is indexed, and converted frame by frame.
        known = isinstance(getattr(array, "dtype", None), np.dtype)
        values: Any = array if known else as_array(array, name, "turbrestore.open_frames")
        dtype = np.dtype(values.dtype)
        doubt = Doubt("the last of its axes looks like time: np.moveaxis(frames, -1, 0) makes it the first")
        return FrameSource(
            name=name,
            format=f"array/{dtype}",
            file_shape=tuple(values.shape),
            full_scale=full_scale_of(dtype, name),
            bit_depth=depth_of(dtype),
            pixels=lambda chosen: (np.asanyarray(values[number]) for number in chosen),
            fps=fps,
            warnings=(doubt,) if isinstance(values, np.ndarray) and frames_are_last(values, certain=True) else (),
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
            yield self.intensities(number, pixels)

    def _native(self, chosen: range | tuple[int, ...]) -> Iterator[tuple[int, PixelArray]]:
        done = 0
        # Without iter_frames a memory-mapped video would be in memory as a whole at the end.
        for number, native in zip(chosen, iter_frames(self.pixels(chosen)), strict=False):
            repaired = native if self.repair is None else self.repair(native)
            pixels = repaired if self.bayer is None else demosaic(repaired, self.bayer)
            if pixels.shape != self.file_shape[1:]:
                expected, found = size_text(self.file_shape[1:]), size_text(pixels.shape)
                raise DataError(f"{self.name}: frame {number}: expected {expected} as the first frame, found {found}")
            yield number, pixels[self.window]
            done += 1
        if done < len(chosen):
            raise DataError(
                f"{self.name}: expected {counted(len(chosen), 'frame')}, found {done}; the file is damaged or cut short"
            )


def to_slice(frames: FrameRange | None) -> slice:
    """Return (start, stop[, step]) as a slice; raise ConfigurationError unless they are integers from 0 or None."""
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


def check_cut_short(
    path: Path, intact: int, stop: int | None, skip_damaged: bool, problem: str = "cut short"
) -> tuple[str, ...]:
    """Raise DataError for a video of which only the first ``intact`` frames are there, or return a warning.

    The other frames may be missing if ``skip_damaged`` is true, or if frames from ``stop`` on are not needed.
    """
    found = f"{problem} after {counted(intact, 'whole frame')}"
    if skip_damaged and intact:
        return (Doubt(f"{found}; the others are missing"),)
    if stop is not None and stop <= intact:
        return ()
    if intact < 1:
        raise DataError(f"{path}: {problem} before the end of the first frame; copy the file again")
    remedy = f"copy the file again or select frames up to {intact}"
    if problem == "damaged":
        remedy = f"copy the file again, select frames up to {intact} or allow damaged ones to be skipped"
    raise DataError(f"{path}: {found}; {remedy}")


def numbers_text(numbers: Collection[int]) -> str:
    """List the first few of ascending frame numbers, and count the others."""
    first = f"frame{'s' * (len(numbers) > 1)} {', '.join(str(number) for number in islice(numbers, _NAMED))}"
    return f"{first} and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else first

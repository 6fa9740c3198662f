"""Frames in an uncompressed file that are mapped when they are asked for, so that another process can be handed them.

An array that is mapped into memory travels to another process as all its bytes; what is here travels as the name of the
file and the place in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .limits import format_errors, input_errors


@dataclass(frozen=True)
class MappedFrames:
    """Where the frames of a video lie in a file; called with numbers of frames, it yields them.

    Attributes
    ----------
    path : Path
        Absolute.
    start : int
        Place of the first number, bytes.
    shape, strides : tuple of int
        Of all frames; strides in bytes.
    dtype : dtype

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(folder + "/a.npy", np.arange(12).reshape(2, 3, 2))
    ...     frames = MappedFrames.of(np.moveaxis(np.load(folder + "/a.npy", mmap_mode="r"), 2, 0))
    ...     frames.shape, [frame.tolist() for frame in frames([1])]
    ((2, 2, 3), [[[1, 3, 5], [7, 9, 11]]])
    """

    path: Path
    start: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: np.dtype[Any]

    @staticmethod
    def of(array: NDArray[Any]) -> MappedFrames:
        """Return the frames along the first axis of a mapped file, or of a view of one."""
        whole = array
        while isinstance(whole.base, np.memmap):
            whole = whole.base
        assert isinstance(whole, np.memmap)
        start = whole.offset + array.__array_interface__["data"][0] - whole.__array_interface__["data"][0]
        return MappedFrames(Path(str(whole.filename)), start, array.shape, array.strides, array.dtype)

    def __call__(self, chosen: Sequence[int]) -> Iterator[NDArray[Any]]:
        """Map one frame after the other.

        Raises
        ------
        InputNotFoundError, StorageError
            The file has gone, or cannot be read.
        DataError
            The file has become shorter.
        """
        shape, strides = self.shape[1:], self.strides[1:]
        last = sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
        for number in chosen:
            place = self.start + number * self.strides[0]
            with input_errors(self.path), format_errors(self.path, "the file has changed"):
                piece = np.memmap(self.path, np.uint8, "r", place, (last + self.dtype.itemsize,))
            yield np.ndarray(shape, self.dtype, piece, strides=strides)

"""Stacks that are too large for memory: they lie in a scratch file and are read frame by frame.

The file is deleted as soon as it is open, so that nothing is left behind however the process ends; its space is free
again when the last array that maps it goes.  Mapped pages count as memory of the process: the functions here that hand
out frames drop the pages of each frame after its use, and the system keeps in its cache what it has room for.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import PART
from ..core.errors import StorageError
from .memory_size import size_text

Item = TypeVar("Item")
# A private map would lose what has been written to the pages that are dropped.
_SHARED = ("r", "r+", "w+")
# Left free beside the file, as others write to the disk as well; bytes, chosen.
_SPARE = 1 << 26


def new_stack(shape: tuple[int, ...], folder: Path | None = None, dtype: Any = np.float32) -> NDArray[Any]:
    """Return an array to be filled, in memory or in a file; an array in a file is full of zeros."""
    size = np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64))
    if folder is None or size == 0:
        return np.empty(shape, dtype)
    try:
        # A page that is mapped beyond the end of a full disk kills the process, so the space is checked now.
        free = shutil.disk_usage(folder).free
        if free < size + _SPARE:
            raise StorageError(
                f"{folder}: expected {size_text(size)} free for what memory does not hold, found "
                f"{size_text(free)}; name another scratch folder"
                f"{' by TMPDIR' if folder == Path(tempfile.gettempdir()) else ''}, or a higher memory limit"
            )
        with tempfile.TemporaryFile(dir=folder, prefix="turbrestore-") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            return np.memmap(file, dtype, "r+", shape=shape)
    except OSError as error:
        raise StorageError(f"{folder}: cannot hold a file of {size_text(size)} ({error.strerror})") from error


def fill_stack(
    shape: tuple[int, ...], items: Iterator[NDArray[np.float32]], folder: Path | None = None
) -> NDArray[np.float32]:
    """Return an array (T, ...) with the next items (...) of an iterator, in memory or in a file."""
    stack = new_stack(shape, folder)
    for index in range(len(stack)):
        # In a loop over the items, one would stay in memory while the next is made.
        stack[index] = next(items)
        drop_pages(stack)
    return stack


def to_scratch(array: NDArray[np.float32], folder: Path | None = None) -> NDArray[np.float32]:
    """Move an array to a file, if there is a folder for it and the array is in none."""
    if folder is None or _is_mapped(array):
        return array
    stack = new_stack(array.shape, folder)
    stack[...] = array
    drop_pages(stack)
    return stack


def drop_pages(array: object) -> None:
    """Hand back the memory of the pages of a mapped file; they are read again when they are needed."""
    mode = None
    while isinstance(array, np.ndarray):
        mode = array.mode if isinstance(array, np.memmap) else mode
        array = array.base
    if isinstance(array, mmap.mmap) and mode in _SHARED and hasattr(mmap, "MADV_DONTNEED"):
        # The pages of a map that is locked in memory cannot be dropped, and need not be.
        with contextlib.suppress(OSError):
            array.madvise(mmap.MADV_DONTNEED)


def _is_mapped(array: object) -> bool:
    while isinstance(array, np.ndarray):
        array = array.base
    return isinstance(array, mmap.mmap)


def iter_frames(items: Iterable[Item]) -> Iterator[Item]:
    """Yield one item after the other, and hand back the memory of each that is part of a mapped file."""
    for item in items:
        try:
            yield item
        finally:
            # Also where the consumer stops early.
            drop_pages(item)


def fill_frames(stack: NDArray[Any], items: Iterable[NDArray[Any]]) -> Iterator[int]:
    """Write items into a stack one after the other, and hand back the memory of each if the stack is a mapped file.

    ``stack`` (T, ...); ``items`` (...) each.
    """
    for written, item in enumerate(items, 1):
        stack[written - 1] = item
        drop_pages(stack)
        yield written


def iter_parts(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield consecutive pieces of an array, each small, and hand back their memory if it is a mapped file."""
    step = max(1, len(array) * PART // max(array.size, 1))
    yield from iter_frames(array[start : start + step] for start in range(0, len(array), step))


def iter_slices(length: int, step: int, *arrays: object) -> Iterator[slice]:
    """Yield slices of ``step`` rows, and hand back the memory of mapped arrays after the work on each."""
    for start in range(0, length, step):
        try:
            yield slice(start, min(start + step, length))
        finally:
            for array in arrays:
                drop_pages(array)


def mean_of(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of a stack (T, ...) over its first axis, as ``stack.mean(axis=0)`` gives it, bit for bit."""
    total = np.zeros(stack.shape[1:], np.float32)
    for part in iter_frames(stack):
        total += part
    return np.divide(total, np.float32(len(stack)), out=total)


def variance_of(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Variance of a stack (T, ...) over its first axis."""
    variance = np.zeros(stack.shape[1:], np.float32)
    rows = np.atleast_1d(variance)
    step = max(1, len(rows) * PART // max(rows.size, 1))
    for start in range(0, len(rows), step):
        strip = rows[start : start + step]
        some = stack.reshape(-1, 1) if stack.ndim == 1 else stack[:, start : start + step]
        mean = mean_of(some)
        for part in iter_frames(some):
            strip += np.square(part - mean)
        strip /= np.float32(len(stack))
    return variance

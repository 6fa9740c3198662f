"""Stacks that are too large for memory: kept in a file without a name, and walked frame by frame.

The file is deleted as soon as it is open, so that nothing is left behind however the process ends; its space is free
again when the last array that shows it goes.  What is mapped counts as memory of the process while its pages are
there: they are handed back after every frame, and the system keeps in its cache what it has room for.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import platform
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.errors import StorageError

Item = TypeVar("Item")
# Pages of a private map would lose what has been written to them.
_SHARED = ("r", "r+", "w+")
# Left free beside the file: others write to the disk as well.
_SPARE = 1 << 26
# Numbers that a piece of a large array has.
_PART = 1 << 22
# M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD of mallopt; bytes from which an array is large, and of the largest
# kept; of the last setting what it is by default, and more than the heap of a thread has.
_MMAP_THRESHOLD, _TRIM_THRESHOLD, _TOP_PAD, _LARGE, _LARGEST = -3, -1, -2, 1 << 20, 32 << 20
_LITTLE_PAD, _LARGE_PAD = 128 << 10, 128 << 20


def new_stack(shape: tuple[int, ...], folder: Path | None = None) -> NDArray[np.float32]:
    """Return an array to be filled, in memory or in a file; one in a file is full of zeros.

    Parameters
    ----------
    shape : tuple of int
    folder : Path, optional
        Where the file lies; without it the array is in memory.

    Returns
    -------
    ndarray, float32
        A :class:`numpy.memmap` where it is in a file.

    Raises
    ------
    StorageError
        The folder has no room for it, or cannot be written to.

    Examples
    --------
    >>> stack = new_stack((3, 4, 4), Path(tempfile.gettempdir()))
    >>> stack[1] = 1
    >>> float(stack.sum())
    16.0
    """
    size = 4 * int(np.prod(shape, dtype=np.int64))
    if folder is None or size == 0:
        return np.empty(shape, np.float32)
    try:
        # Past the end of a full disk a mapped page kills the process: better to hear of it now.
        free = shutil.disk_usage(folder).free
        if free < size + _SPARE:
            raise StorageError(
                f"{folder}: expected {size / 1e9:.1f} GB free for what memory does not hold, found "
                f"{free / 1e9:.1f} GB; {_another(folder)}, or a higher memory limit"
            )
        with tempfile.TemporaryFile(dir=folder, prefix="turbrestore-") as file:
            _reserve(file, size)
            return np.memmap(file, np.float32, "r+", shape=shape)
    except OSError as error:
        raise StorageError(f"{folder}: cannot hold a file of {size / 1e9:.1f} GB ({error.strerror})") from error


def to_scratch(array: NDArray[np.float32], folder: Path | None = None) -> NDArray[np.float32]:
    """Move an array to a file, if there is a folder for it and the array is in none.

    Parameters
    ----------
    array : ndarray, float32
    folder : Path, optional
        Where the file lies; without it nothing happens.

    Returns
    -------
    ndarray, float32
        A :class:`numpy.memmap` where it is in a file.

    Raises
    ------
    StorageError
        The folder has no room for it, or cannot be written to.

    Examples
    --------
    >>> to_scratch(np.ones((2, 3), np.float32)).sum()
    np.float32(6.0)
    """
    if folder is None or _is_mapped(array):
        return array
    stack = new_stack(array.shape, folder)
    stack[...] = array
    drop_pages(stack)
    return stack


def drop_pages(array: object) -> None:
    """Hand back the memory that the pages of a mapped file take; they are read again when they are needed.

    Parameters
    ----------
    array : object
        An array of a mapped file, or a part of one; nothing happens to anything else.

    Examples
    --------
    >>> stack = new_stack((2, 4, 4), Path(tempfile.gettempdir()))
    >>> stack[:] = 2
    >>> drop_pages(stack[1])
    >>> float(stack[1, 0, 0])
    2.0
    """
    mode = None
    while isinstance(array, np.ndarray):
        mode = array.mode if isinstance(array, np.memmap) else mode
        array = array.base
    if isinstance(array, mmap.mmap) and mode in _SHARED and hasattr(mmap, "MADV_DONTNEED"):
        # A map that is locked in memory cannot be handed back, and need not be.
        with contextlib.suppress(OSError):
            array.madvise(mmap.MADV_DONTNEED)


def _is_mapped(array: object) -> bool:
    while isinstance(array, np.ndarray):
        array = array.base
    return isinstance(array, mmap.mmap)


def iter_frames(items: Iterable[Item]) -> Iterator[Item]:
    """Yield one item after the other, and hand back the memory of each that is part of a mapped file.

    Parameters
    ----------
    items : iterable
        A stack of frames or flows, or a list of them.

    Yields
    ------
    object

    Examples
    --------
    >>> [float(frame.mean()) for frame in iter_frames(np.ones((2, 3, 3), np.float32))]
    [1.0, 1.0]
    """
    for item in items:
        try:
            yield item
        finally:
            # Also where whoever walks has seen enough.
            drop_pages(item)


def iter_parts(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield consecutive pieces of an array, each small, and hand back their memory if it is a mapped file.

    Parameters
    ----------
    array : ndarray
        Split along its first axis.

    Yields
    ------
    ndarray
        Views.

    Examples
    --------
    >>> [part.shape for part in iter_parts(np.zeros((3, 1000, 1000)))]
    [(3, 1000, 1000)]
    """
    step = max(1, len(array) * _PART // max(array.size, 1))
    yield from iter_frames(array[start : start + step] for start in range(0, len(array), step))


def iter_slices(length: int, step: int, *arrays: object) -> Iterator[slice]:
    """Yield slices of ``step`` rows, and hand back the memory of mapped arrays after the work on each.

    Parameters
    ----------
    length, step : int
        Rows in all, and rows of a slice; the last may be shorter.
    arrays : object
        What is read or written meanwhile; nothing happens to arrays in memory.

    Yields
    ------
    slice

    Examples
    --------
    >>> list(iter_slices(5, 2))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    for start in range(0, length, step):
        try:
            yield slice(start, min(start + step, length))
        finally:
            for array in arrays:
                drop_pages(array)


def mean_of(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over the first axis, as ``stack.mean(axis=0)`` gives it, bit for bit.

    Parameters
    ----------
    stack : ndarray, float32, shape (T, ...)
        At least one frame or flow; in memory, or mapped.

    Returns
    -------
    ndarray, float32, shape (...)

    Examples
    --------
    >>> mean_of(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32))
    array([2., 3.], dtype=float32)
    """
    total = np.zeros(stack.shape[1:], np.float32)
    for part in iter_frames(stack):
        total += part
    return np.divide(total, np.float32(len(stack)), out=total)


def variance_of(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Variance over the first axis.

    Parameters
    ----------
    stack : ndarray, float32, shape (T, ...)
        At least one frame or flow; in memory, or mapped.

    Returns
    -------
    ndarray, float32, shape (...)

    Examples
    --------
    >>> variance_of(np.array([[1.0, 2.0], [3.0, 6.0]], np.float32))
    array([1., 4.], dtype=float32)
    """
    variance = np.zeros(stack.shape[1:], np.float32)
    rows = np.atleast_1d(variance)
    step = max(1, len(rows) * _PART // max(rows.size, 1))
    for start in range(0, len(rows), step):
        strip = rows[start : start + step]
        some = stack.reshape(-1, 1) if stack.ndim == 1 else stack[:, start : start + step]
        mean = mean_of(some)
        for part in iter_frames(some):
            strip += np.square(part - mean)
        strip /= np.float32(len(stack))
    return variance


@contextlib.contextmanager
def returning_freed(wanted: bool = True) -> Iterator[None]:
    """Have large arrays given back to the system as soon as they are freed, meanwhile.

    The allocator of glibc otherwise raises the size from which it does so with every large array that is freed, and
    what lies between those that are in use stays with the process: a third of the peak at 1920×1080.  Afterwards small
    ones have been given back too, and it keeps arrays up to the size that it would have come to by itself.  The setting
    is that of the process: where two work at the same time, it is that of the one that came or left last, which costs
    one of them time or memory.

    Parameters
    ----------
    wanted : bool
        Whether to do so, or nothing.

    Examples
    --------
    >>> with returning_freed():
    ...     float(np.ones(2).sum())
    2.0
    """
    with _adjusted(wanted, (_MMAP_THRESHOLD, _LARGE), (_TRIM_THRESHOLD, 2 * _LARGE)):
        yield


@contextlib.contextmanager
def keeping_freed(wanted: bool = True) -> Iterator[None]:
    """Have the process keep what is freed, meanwhile.

    The allocator of glibc gives the heap of a thread back to the system as soon as nothing is in it any more, which at
    1920×1080 is several times a frame: to fill new pages with zeros takes a ninth of the time of flow and filter there.
    It keeps a heap that has less room than M_TOP_PAD, so more than all heaps have keeps them all.  Afterwards all but
    the last heap of each thread, 64 MB at most, has been given back.  The setting is that of the process, and ends that
    of :func:`returning_freed` around it.

    Parameters
    ----------
    wanted : bool
        Whether to do so, or nothing.

    Examples
    --------
    >>> with keeping_freed():
    ...     float(np.ones(2).sum())
    2.0
    """
    with _adjusted(wanted, (_MMAP_THRESHOLD, _LARGEST), (_TRIM_THRESHOLD, -1), (_TOP_PAD, _LARGE_PAD)):
        yield


@contextlib.contextmanager
def _adjusted(wanted: bool, *settings: tuple[int, int]) -> Iterator[None]:
    if not wanted or platform.libc_ver()[0] != "glibc":
        yield
        return
    library = ctypes.CDLL(None)
    try:
        for setting in settings:
            library.mallopt(*setting)
        yield
    finally:
        # Any of these ends the adjustment by itself for good, so they are set to where it ends.
        library.mallopt(_MMAP_THRESHOLD, _LARGEST)
        library.mallopt(_TRIM_THRESHOLD, 2 * _LARGEST)
        library.mallopt(_TOP_PAD, _LITTLE_PAD)
        # Of small arrays, and of all threads.
        library.malloc_trim(0)


def _another(folder: Path) -> str:
    temporary = folder == Path(tempfile.gettempdir())
    return f"name another {'folder by TMPDIR' if temporary else '--keep folder'}"


def _reserve(file: IO[bytes], size: int) -> None:
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
    else:
        file.truncate(size)

"""Arrays from ``.npy`` and ``.npz`` files: headers are held against the size of the file first, nothing is unpickled.

NumPy believes a header and asks for the memory that it names; an archive of a few kilobytes inflates to gigabytes.  The
archives that this package writes are not compressed, so a compressed one is refused, and no more memory is asked for
than the file is large.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DataError, TurbrestoreError
from ..runtime.scratch import iter_parts, new_stack
from .files import check_input, first_line, input_errors
from .limits import DEFAULT_LIMITS, Limits

# Arrays of more bytes may be put in a file.
_LARGE = 1 << 22
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def map_npy(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Map the array of a ``.npy`` file into memory, to be read on demand.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    ndarray
        Read-only.

    Raises
    ------
    InputNotFoundError, StorageError
        No such file, or it cannot be read.
    DataError
        Not a ``.npy`` file, shorter than its header says, or not of numbers.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(folder + "/a.npy", np.arange(6).reshape(2, 3))
    ...     map_npy(folder + "/a.npy")[1].tolist()
    [3, 4, 5]
    """
    path = Path(path)
    size = check_input(path).st_size
    try:
        with input_errors(path), path.open("rb") as file:
            shape, is_fortran, dtype = _header(file)
            offset = file.tell()
            needed = math.prod(shape) * dtype.itemsize
            if not 0 < needed <= size - offset:
                raise ValueError(f"its header asks for {needed} bytes, {size - offset} are there")
            return np.memmap(path, dtype, "r", offset, shape, "F" if is_fortran else "C")
    except TurbrestoreError:
        raise
    except Exception as error:  # NumPy documents no closed list of exceptions for damaged headers
        raise DataError(f"{path}: not a whole .npy array of numbers ({first_line(error)})") from error


def read_npz(
    path: str | os.PathLike[str],
    limits: Limits = DEFAULT_LIMITS,
    scratch: Path | None = None,
    large: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Read all arrays of an uncompressed ``.npz`` file.

    Parameters
    ----------
    path : path-like
        The file, as :func:`numpy.savez` writes it.
    limits : Limits
        Most bytes that are read.
    scratch : Path, optional
        Folder of a file for large arrays; by default they are in memory.
    large : int, optional
        Bytes from which an array is large; by default 4 MiB.

    Returns
    -------
    dict of str to ndarray
        By their names, without the suffix ``.npy``.

    Raises
    ------
    InputNotFoundError, StorageError
        No such file, or it cannot be read.
    DataError
        Not an archive of arrays, damaged, compressed, or too large.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(folder + "/a.npz", x=np.arange(3))
    ...     read_npz(folder + "/a.npz")
    {'x': array([0, 1, 2])}
    """
    path = Path(path)
    size = check_input(path).st_size
    limits.check_bytes(size, str(path))
    try:
        with input_errors(path), path.open("rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            names = [member.filename.removesuffix(".npy") for member in members]
            if len(set(names)) < len(names):
                raise ValueError("one name stands twice in it")
            # Members are not compressed; they hold more than the file only where they lie within each other.
            if sum(member.file_size for member in members) > size:
                raise ValueError(f"its members hold more than its {size} bytes")
            least = _LARGE if large is None else large
            return {name: _member(archive, member, scratch, least) for name, member in zip(names, members, strict=True)}
    except TurbrestoreError:
        raise
    except Exception as error:  # neither NumPy nor zipfile documents a closed list of exceptions for damaged files
        raise DataError(f"{path}: not a whole archive of arrays ({first_line(error)})") from error


def write_npz(stream: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as :func:`numpy.savez` does, those of a mapped file without taking them into memory.

    Parameters
    ----------
    stream : binary file
    arrays : mapping of str to ndarray

    Examples
    --------
    >>> import io
    >>> stream = io.BytesIO()
    >>> write_npz(stream, {"x": np.arange(3)})
    >>> _ = stream.seek(0)
    >>> np.load(stream)["x"]
    array([0, 1, 2])
    """
    with zipfile.ZipFile(stream, "w", allowZip64=True) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if isinstance(array, np.memmap) and array.ndim:
                    header = np.lib.format.header_data_from_array_1_0(array)
                    np.lib.format.write_array_header_1_0(member, header)
                    for part in iter_parts(array.T if header["fortran_order"] else array):
                        member.write(np.ascontiguousarray(part).data)
                else:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, scratch: Path | None, large: int) -> NDArray[Any]:
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{member.filename} is compressed; expected it as numpy.savez writes it")
    with archive.open(member) as stream:
        shape, is_fortran, dtype = _header(stream)
        if scratch is not None and member.file_size > large and dtype == np.float32:
            stack = _stack_of(stream, shape[::-1] if is_fortran else shape, member, scratch)
            return stack.T if is_fortran else stack
        # Reading to the end lets zipfile compare the checksum.
        data = stream.read()
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"{member.filename} has {len(data)} bytes, which do not fill shape {shape}")
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order="F" if is_fortran else "C")


def _stack_of(stream: IO[bytes], shape: tuple[int, ...], member: zipfile.ZipInfo, scratch: Path) -> NDArray[np.float32]:
    """Copy a stack to a file of its own, one part after the other."""
    if not 0 < 4 * math.prod(shape) <= member.file_size:
        raise ValueError(f"{member.filename} has {member.file_size} bytes, which do not fill shape {shape}")
    stack = new_stack(shape, scratch)
    for part in iter_parts(stack):
        part[...] = np.frombuffer(stream.read(part.nbytes), np.float32).reshape(part.shape)
    if stream.read(1):
        raise ValueError(f"{member.filename} has more bytes than shape {shape}")
    return stack


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in the order of Fortran, and type; the stream is at the data then."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format is not supported")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read")
    if any(length < 0 for length in shape):
        raise ValueError(f"its shape is {shape}")
    return shape, is_fortran, dtype

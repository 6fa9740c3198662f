"""Arrays in ``.npy`` and ``.npz`` files, and videos in ``.npy`` files; nothing is unpickled.

NumPy allocates the memory that a header asks for, and a compressed archive of a few kilobytes can hold gigabytes.
Headers are therefore compared with the size of the file first, and compressed archives, which this package never
writes, are refused, so no more memory is allocated than the file is large.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import CHANNELS, FloatArray, from_unit_to_type
from ..core.errors import DataError, require
from ..core.remarks import Doubt
from ..runtime.scratch import iter_parts, new_stack
from .axes import SAMPLES, frames_are_last
from .counts import source_of_numbers
from .limits import DEFAULT_LIMITS, Limits, check_input, format_errors, input_errors
from .output import atomic_output, frames_of_one_size
from .source import FrameSource

# Arrays of more bytes may be read to a scratch file.
_LARGE = 1 << 22
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def map_npy(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Map the array of a ``.npy`` file into memory, read-only; it is read on demand."""
    path = Path(path)
    size = check_input(path).st_size
    with input_errors(path), format_errors(path, "not a whole .npy array of numbers"), path.open("rb") as file:
        shape, is_fortran, dtype = _header(file)
        offset = file.tell()
        needed = math.prod(shape) * dtype.itemsize
        if not 0 < needed <= size - offset:
            raise ValueError(f"its header asks for {needed} bytes, {size - offset} are there")
        return np.memmap(path, dtype, "r", offset, shape, "F" if is_fortran else "C")


def read_npz(
    path: str | os.PathLike[str], limits: Limits = DEFAULT_LIMITS, scratch: Path | None = None
) -> dict[str, NDArray[Any]]:
    """Read all arrays of an uncompressed ``.npz`` file, as :func:`numpy.savez` writes it.

    Where ``scratch`` is a folder, arrays of float32 of more than 4 MiB go to scratch files there.
    """
    path = Path(path)
    size = check_input(path).st_size
    limits.check_bytes(size, str(path))
    errors = input_errors(path), format_errors(path, "not a whole archive of arrays")
    with errors[0], errors[1], path.open("rb") as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        names = [member.filename.removesuffix(".npy") for member in members]
        if len(set(names)) < len(names):
            raise ValueError("two members have the same name")
        # Uncompressed members hold more than the file only if they overlap.
        if sum(member.file_size for member in members) > size:
            raise ValueError(f"its members hold more than its {size} bytes")
        return {name: _member(archive, member, scratch) for name, member in zip(names, members, strict=True)}


def write_npz(stream: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as :func:`numpy.savez` does, but memory-mapped arrays part by part."""
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


@dataclass(frozen=True)
class MappedFrames:
    """Where the frames of a video lie in a file; called with numbers of frames, it yields them.

    A mapped array travels to another process as all its bytes; this travels as the name of the file and a place in it.
    """

    path: Path  # absolute
    start: int  # place of the first number, bytes
    # Of all frames; strides in bytes.
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
        """Map one frame after the other."""
        shape, strides = self.shape[1:], self.strides[1:]
        last = sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
        for number in chosen:
            place = self.start + number * self.strides[0]
            with input_errors(self.path), format_errors(self.path, "the file has changed"):
                piece = np.memmap(self.path, np.uint8, "r", place, (last + self.dtype.itemsize,))
            yield np.ndarray(shape, self.dtype, piece, strides=strides)


def open_npy(path: Path, limits: Limits = DEFAULT_LIMITS, axes: str | None = None) -> FrameSource:
    """Open an array of shape (T, H, W) or (T, H, W, 3) as a video; the errors are those of :func:`map_npy`.

    Other orders of the axes are those that ``axes`` names, such as ``hwt``.  Without it they are told by the shape, and
    (H, W, T) by the content: the frames of a video resemble each other more than its rows do.  A warning says how such
    an array was read.
    """
    whole = map_npy(path)
    array, order = _frames_first(path, whole) if axes is None else (_named_order(path, whole, axes), "")
    usual = "--axes thw" if whole.ndim == 3 else "--axes thwc"
    notes = (Doubt(f"its axes are taken for {order}, {_size(array)}; {usual} reads {_size(whole)}"),) if order else ()
    return source_of_numbers(
        path, f"npy/{array.dtype}", array.shape, array.dtype, MappedFrames.of(array), notes, limits
    )


def _size(array: NDArray[Any]) -> str:
    return f"{array.shape[0]} frames of {array.shape[2]}×{array.shape[1]}"


def _named_order(path: Path, array: NDArray[Any], axes: str) -> NDArray[Any]:
    """Bring the axes, which are named by letters, into the order (T, H, W) or (T, H, W, 3)."""
    names = axes.lower()
    require(
        sorted(names) in (sorted("thw"), sorted("thwc")), f"--axes: expected thw, hwt, thwc or tchw, found {axes!r}"
    )
    require(
        len(names) == array.ndim, f"--axes: expected {array.ndim} letters for the shape {array.shape}, found {axes!r}"
    )
    ordered = np.transpose(array, [names.index(name) for name in "thwc" if name in names])
    return ordered[..., 0] if ordered.ndim == 4 and ordered.shape[3] == 1 else ordered


def _frames_first(path: Path, array: NDArray[Any]) -> tuple[NDArray[Any], str]:
    """Bring the axes into the order (T, H, W) or (T, H, W, 3); say what they were taken for where that was another."""
    shape = array.shape
    if array.ndim == 4 and shape[3] not in CHANNELS:
        if shape[1] in CHANNELS:
            return np.moveaxis(array, 1, 3), "(T, 3, H, W)"
        if shape[2] in CHANNELS:
            return np.moveaxis(array, (3, 0, 1, 2), (0, 1, 2, 3)), "(H, W, 3, T)"
        for axis, order in ((3, "(T, H, W, 1)"), (1, "(T, 1, H, W)")):
            if shape[axis] == 1:
                return np.squeeze(array, axis), order
    if array.ndim == 3 and shape[2] in CHANNELS and min(shape[:2]) > SAMPLES:
        raise DataError(f"{path}: expected frames of shape (T, H, W), found {shape}, which is that of one colour image")
    if frames_are_last(array):
        return np.moveaxis(array, 2, 0), "(H, W, T)"
    return array, ""


def write_npy(path: Path, frames: Iterable[FloatArray], bit_depth: int = 32, overwrite: bool = False) -> None:
    """Write frames, one at a time, as one array of uint8, uint16 or float32."""
    count = 0
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        for frame in frames_of_one_size(frames, path):
            pixels = from_unit_to_type(frame, bit_depth)
            if count == 0:
                _write_header(file, (0, *pixels.shape), pixels.dtype)
            file.write(pixels.tobytes())
            count += 1
        # NumPy pads the header so that the number of frames fits in afterwards.
        file.seek(0)
        _write_header(file, (count, *pixels.shape), pixels.dtype)


def _write_header(file: IO[bytes], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    description = np.lib.format.dtype_to_descr(dtype)
    np.lib.format.write_array_header_1_0(file, {"descr": description, "fortran_order": False, "shape": shape})


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, scratch: Path | None) -> NDArray[Any]:
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{member.filename} is compressed; expected it as numpy.savez writes it")
    # zipfile compares the checksum at the end of the member.
    with archive.open(member) as stream:
        shape, is_fortran, dtype = _header(stream)
        size = member.file_size - stream.tell()
        if math.prod(shape) * dtype.itemsize != size:
            raise ValueError(f"{member.filename} has {size} bytes, which do not fit shape {shape}")
        if scratch is None or size <= _LARGE or dtype != np.float32:
            return np.frombuffer(bytearray(stream.read()), dtype).reshape(shape, order="F" if is_fortran else "C")
        stack = new_stack(shape[::-1] if is_fortran else shape, scratch)
        for part in iter_parts(stack):
            part[...] = np.frombuffer(stream.read(part.nbytes), np.float32).reshape(part.shape)
        return stack.T if is_fortran else stack


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read shape, whether the order is that of Fortran, and type; the stream is at the data afterwards."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format is not supported")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read")
    if any(length < 0 for length in shape):
        raise ValueError(f"its shape is {shape}")
    return shape, is_fortran, dtype

"""Videos in and out: one function opens any supported input, one writes any supported output.

=====================================  =================================  =====================================
input                                  module                             output
=====================================  =================================  =====================================
.mkv .mp4 .m4v .mov .webm .avi .gif    :mod:`turbrestore.io.container`       .mkv (FFV1, lossless), .mp4 (H.264)
.ser                                   :mod:`turbrestore.io.ser`             .ser
.tif .tiff (a stack)                   :mod:`turbrestore.io.tiff`            .tif .tiff
.npy, shape (T, H, W) or (T, H, W, 3)  here                               .npy
a folder of images                     here, :mod:`turbrestore.io.images`
=====================================  =================================  =====================================
"""

from __future__ import annotations

import dataclasses
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..core.arrays import FloatArray, check_image, from_unit
from ..core.errors import DataError, require
from .container import CONTAINER_SUFFIXES, open_container
from .encoding import write_mkv, write_mp4
from .files import check_input, input_errors
from .images import IMAGE_SUFFIXES, atomic_output, check_output, read_pixels
from .limits import DEFAULT_LIMITS, Limits
from .npy import map_npy
from .pixels import PixelArray, check_depth, depth_of, full_scale_of, to_unit
from .ser import open_ser, write_ser
from .source import (
    FrameRange,
    FrameSource,
    Roi,
    check_frame_range,
    frame_files,
    numbers_text,
    size_text,
)
from .tiff import open_tiff, write_tiff

TIFF_SUFFIXES = (".tif", ".tiff")
VIDEO_SUFFIXES = (*CONTAINER_SUFFIXES, ".ser", *TIFF_SUFFIXES, ".npy")
VIDEO_OUTPUT_SUFFIXES = (".mkv", ".mp4", ".ser", *TIFF_SUFFIXES, ".npy")

__all__ = ["VIDEO_OUTPUT_SUFFIXES", "VIDEO_SUFFIXES", "FrameSource", "open_frames", "write_video"]


def open_frames(
    path: str | os.PathLike[str],
    *,
    frames: FrameRange | None = None,
    roi: Roi | None = None,
    limits: Limits = DEFAULT_LIMITS,
    skip_damaged: bool = False,
) -> FrameSource:
    """Open a video: read its headers, check that it is whole, decode its first frame.

    Parameters
    ----------
    path : path-like
        A video file, a TIFF stack, a .npy array or a folder of images. The files of a folder are taken in natural
        order (frame2 before frame10); files that are no images are passed over.
    frames : tuple, optional
        (start, stop) or (start, stop, step), as in a slice; None stands for the end of the video. Damage outside
        of the range is no error.
    roi : tuple of int, optional
        (x, y, width, height) in pixels.
    limits : Limits
        Largest video that is read.
    skip_damaged : bool
        Leave out, with a warning, what would be refused: the missing end of a file that is cut short, and frames whose
        checksum fails and that no others depend on.

    Returns
    -------
    FrameSource
        Decodes while iterating; nothing but one frame at a time is in memory. NaN and infinite values are refused
        there, unless :func:`turbrestore.clean_source` has filled them.

    Raises
    ------
    InputNotFoundError
        No such file or folder.
    DataError
        Not a video, damaged, cut short, empty, too large, or values that are no intensities.
    ConfigurationError
        Range or rectangle outside the video.
    StorageError
        The file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_video(folder + "/a.mkv", np.zeros((9, 4, 6), np.float32), fps=30)
    ...     source = open_frames(folder + "/a.mkv", frames=(2, 8), roi=(0, 0, 3, 2))
    ...     source.shape, len([frame for frame in source])
    ((6, 2, 3), 6)
    """
    path = Path(path)
    wanted = check_frame_range(frames)
    is_folder = stat.S_ISDIR(check_input(path).st_mode)
    suffix = path.suffix.lower()
    if is_folder:
        source = _open_folder(path, limits)
    elif suffix in CONTAINER_SUFFIXES:
        source = open_container(path, frames, limits, skip_damaged)
    elif suffix == ".ser":
        source = open_ser(path, wanted.stop, limits, skip_damaged)
    elif suffix in TIFF_SUFFIXES:
        source = open_tiff(path, limits)
    elif suffix == ".npy":
        source = _open_npy(path, limits)
    elif suffix in IMAGE_SUFFIXES:
        raise DataError(f"{path}: a single image; name the folder that holds the frames")
    else:
        names = ", ".join(VIDEO_SUFFIXES)
        raise DataError(f"{path}: expected a folder of images or one of {names}, found {suffix or 'no suffix'}")
    source = source.select(frames, roi)
    source = source.without(source.damaged, f"checksum fails: {numbers_text(source.damaged)} left out")
    _check_first(source)
    return source


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    fps: float,
    bit_depth: int = 8,
    overwrite: bool = False,
) -> None:
    """Write frames as a video, in the format that the suffix names.

    Parameters
    ----------
    path : path-like
        ``.mkv`` is FFV1 without loss and ``.mp4`` H.264 of 8 bits, for viewing; ``.ser``, ``.tif`` and ``.npy`` are
        not compressed.
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Intensities, all of one size; values outside [0, 1] are clipped. Taken one at a time.
    fps : float
        Frames per second; TIFF and .npy do not keep it.
    bit_depth : int
        1 to 16, or 32 for floating point, which only TIFF and .npy have; the others write 16 bits then. TIFF and
        .npy write 9 to 15 bits as 16, scaled to the full range.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Unsupported suffix, bit depth or frame rate.
    DataError
        No frames, frames of two sizes, or values that are not finite.
    OutputError, StorageError
        The file cannot be created or completed; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_video(folder + "/a.npy", np.zeros((2, 4, 6), np.float32), fps=30, bit_depth=32)
    ...     open_frames(folder + "/a.npy").format
    'npy/float32'
    """
    check_output(path, overwrite=overwrite, suffixes=VIDEO_OUTPUT_SUFFIXES)
    check_depth(bit_depth)
    require(0 < fps < np.inf, f"fps: expected a positive number of frames per second, found {fps}")
    suffix = Path(path).suffix.lower()
    checked = (check_image(frame, f"frame {number}") for number, frame in enumerate(frames))
    if suffix == ".mkv":
        write_mkv(path, checked, fps, bit_depth, overwrite)
    elif suffix == ".mp4":
        write_mp4(path, checked, fps, overwrite)
    elif suffix == ".ser":
        write_ser(path, checked, bit_depth, fps, overwrite)
    elif suffix == ".npy":
        _write_npy(path, checked, bit_depth, overwrite)
    else:
        write_tiff(path, checked, bit_depth, overwrite)


def _check_first(source: FrameSource) -> None:
    """Refuse now what the first frame tells of all: a wrong size or scale."""
    (pixels,) = source.select((0, 1)).native()
    if np.issubdtype(pixels.dtype, np.floating):
        pixels = np.where(np.isfinite(pixels), pixels, 0)
    to_unit(pixels, source.full_scale, f"{source.name}: frame {source.numbers[0]}")


def _open_folder(folder: Path, limits: Limits) -> FrameSource:
    with input_errors(folder):
        files = frame_files(folder)
    if not files:
        raise DataError(f"{folder}: expected images ({', '.join(IMAGE_SUFFIXES)}), found none in the folder")
    limits.check_count(len(files), str(folder))
    first, notes = read_pixels(files[0], limits)
    return FrameSource(
        name=folder.name,
        format=f"images/{files[0].suffix.lower()[1:]}",
        file_shape=(len(files), *first.shape),
        full_scale=full_scale_of(first.dtype, str(files[0])),
        bit_depth=depth_of(first.dtype),
        pixels=lambda chosen: _images(files, chosen, first.dtype, first.shape, limits),
        path=folder,
        warnings=notes,
    )


def _images(
    files: list[Path], chosen: Sequence[int], dtype: np.dtype, shape: tuple[int, ...], limits: Limits
) -> Iterator[PixelArray]:
    for number in chosen:
        pixels, _ = read_pixels(files[number], limits)
        if pixels.dtype != dtype or pixels.shape != shape:
            expected, found = f"{size_text(shape)} {dtype}", f"{size_text(pixels.shape)} {pixels.dtype}"
            raise DataError(f"{files[number]}: expected {expected} as the first image, found {found}")
        yield pixels


def _open_npy(path: Path, limits: Limits) -> FrameSource:
    array = map_npy(path)
    source = FrameSource.from_array(array, path.name)
    limits.check_size(source.shape[2], source.shape[1], str(path))
    limits.check_count(len(source), str(path))
    return dataclasses.replace(source, format=f"npy/{array.dtype}", path=path)


def _write_npy(path: str | os.PathLike[str], frames: Iterable[FloatArray], bit_depth: int, overwrite: bool) -> None:
    depth = 8 if bit_depth <= 8 else 16
    shape, count, dtype = None, 0, np.dtype(np.float32)
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        for frame in frames:
            pixels: PixelArray = np.clip(frame, 0, 1) if bit_depth == 32 else from_unit(frame, depth)
            if shape is None:
                shape, dtype = pixels.shape, pixels.dtype
                _npy_header(file, (0, *shape), dtype)
            if pixels.shape != shape:
                expected, found = size_text(shape), size_text(pixels.shape)
                raise DataError(f"{path}: frame {count}: expected {expected}, found {found}")
            file.write(pixels.tobytes())
            count += 1
        if shape is None:
            raise DataError(f"{path}: expected at least one frame, found none")
        # NumPy pads the header so that the number of frames fits in afterwards.
        file.seek(0)
        _npy_header(file, (count, *shape), dtype)


def _npy_header(file: BinaryIO, shape: tuple[int, ...], dtype: np.dtype) -> None:
    description = np.lib.format.dtype_to_descr(dtype)
    np.lib.format.write_array_header_1_0(file, {"descr": description, "fortran_order": False, "shape": shape})

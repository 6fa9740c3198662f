"""TIFF stacks: one page a frame, read page by page.

Every page is checked before it is decoded (:mod:`turbrestore.io.tiff_pages`).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import FloatArray, from_unit
from ..core.errors import DataError
from .files import input_errors
from .images import atomic_output
from .limits import DEFAULT_LIMITS, Limits
from .pixels import PixelArray, check_depth, depth_of, full_scale_of
from .source import FrameSource
from .tiff_pages import check_page, check_parts, count_pages, tiff_errors

if TYPE_CHECKING:
    import tifffile

_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2


def open_tiff(path: str | os.PathLike[str], limits: Limits = DEFAULT_LIMITS) -> FrameSource:
    """Open a TIFF stack, grey or RGB, of 8 or 16 bits or floating point.

    Parameters
    ----------
    path : path-like
        TIFF, BigTIFF or ImageJ stack. Packed bits and compressions other than deflate need the package
        ``imagecodecs``.
    limits : Limits
        Largest stack that is read.

    Returns
    -------
    FrameSource

    Raises
    ------
    InputNotFoundError, StorageError
        No such file, or it cannot be read.
    DataError
        Not a TIFF file, damaged, cut short, or of a kind that is not supported.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_tiff(folder + "/a.tif", [np.full((2, 3), 0.25, np.float32)] * 4, bit_depth=32)
    ...     source = open_tiff(folder + "/a.tif")
    ...     source.shape, source.format, float(source.read().max())
    ((4, 2, 3), 'tiff/float32', 0.25)
    """
    import tifffile

    path = Path(path)
    with input_errors(path), path.open("rb") as file:
        pages = count_pages(path, file, limits)
    with input_errors(path), tiff_errors(path), tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        check_page(path, page, limits)
        packed = _packed_stack(path, tiff) if pages == 1 else None
        if packed is not None:
            return packed
        channels, notes = _channels(path, page)
        dtype = np.dtype(page.dtype)
        integer = np.issubdtype(dtype, np.unsignedinteger)
        return FrameSource(
            name=path.name,
            format=f"tiff/{dtype}",
            file_shape=(pages, page.imagelength, page.imagewidth, *channels),
            full_scale=2**page.bitspersample - 1 if integer else full_scale_of(dtype, str(path)),
            bit_depth=min(page.bitspersample, 32) if integer else depth_of(dtype),
            pixels=lambda chosen: _frames(path, chosen, limits),
            path=path,
            warnings=notes,
        )


def write_tiff(
    path: str | os.PathLike[str], frames: Iterable[FloatArray], bit_depth: int = 16, overwrite: bool = False
) -> None:
    """Write frames as a TIFF stack, uncompressed, one page a frame.

    Parameters
    ----------
    path : path-like
        The file to be written.
    frames : iterable of ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities; values outside [0, 1] are clipped.
    bit_depth : int
        1 to 8 gives 8 bits, 9 to 16 gives 16 bits (scaled to the full range of the file), 32 floating point.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Unsupported bit depth.
    DataError
        No frames, or frames of two sizes.
    OutputError, StorageError
        The file cannot be created or completed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_tiff(folder + "/a.tif", [np.zeros((2, 3), np.float32)] * 4, bit_depth=12)
    ...     open_tiff(folder + "/a.tif").format
    'tiff/uint16'
    """
    import tifffile

    depth = check_depth(bit_depth)
    shape = None
    with atomic_output(path, overwrite) as temporary, tifffile.TiffWriter(temporary, bigtiff=True) as tiff:
        for number, frame in enumerate(frames):
            if shape is not None and frame.shape != shape:
                raise DataError(f"{path}: frame {number}: expected shape {shape}, found {frame.shape}")
            shape = frame.shape
            pixels: PixelArray = np.clip(frame, 0, 1) if depth == 32 else from_unit(frame, 8 if depth <= 8 else 16)
            # Without metadata and contiguity each page is complete and stands alone, so any reader sees a stack.
            tiff.write(pixels, photometric="minisblack" if frame.ndim == 2 else "rgb", contiguous=False, metadata=None)
        if shape is None:
            raise DataError(f"{path}: expected at least one frame, found none")


def _frames(path: Path, chosen: Sequence[int], limits: Limits) -> Iterator[PixelArray]:
    import tifffile

    with input_errors(path), tiff_errors(path), tifffile.TiffFile(path) as tiff:
        for number in chosen:
            page = tiff.pages[number].aspage()
            check_page(path, page, limits)
            channels, _ = _channels(path, page)
            check_parts(path, page)
            pixels = page.asarray()
            if pixels.ndim == 3:
                # Planes stored one after the other come as (C, H, W).
                pixels = np.moveaxis(pixels, 0, -1) if page.axes.startswith("S") else pixels
                pixels = pixels[..., :3] if channels else pixels[..., 0]
            yield np.iinfo(pixels.dtype).max - pixels if page.photometric == _WHITE_IS_ZERO else pixels


def _channels(path: Path, page: tifffile.TiffPage) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Trailing axes of a page without alpha, and what was left out."""
    colours = page.samplesperpixel - len(page.extrasamples)
    integer = np.issubdtype(page.dtype, np.unsignedinteger)
    kinds = (_BLACK_IS_ZERO, _WHITE_IS_ZERO) if integer and page.bitspersample % 8 == 0 else (_BLACK_IS_ZERO,)
    grey = colours == 1 and page.photometric in kinds
    if page.imagedepth != 1 or not (grey or (colours == 3 and page.photometric == _RGB)):
        kind = f"{getattr(page.photometric, 'name', page.photometric)} with {page.samplesperpixel} channels"
        raise DataError(f"{path}: expected grey or RGB pages, found {kind}; convert the file")
    return (() if grey else (3,)), (("alpha channel ignored",) if page.extrasamples else ())


def _packed_stack(path: Path, tiff: tifffile.TiffFile) -> FrameSource | None:
    """Frames that follow each other behind a single page, as ImageJ writes stacks of 4 GB and more."""
    series, page = tiff.series[0], tiff.pages.first
    if series.dataoffset is None or series.size <= page.imagewidth * page.imagelength * page.samplesperpixel:
        return None
    dtype = series.dtype.newbyteorder(tiff.byteorder)
    source = FrameSource.from_array(np.memmap(path, dtype, "r", series.dataoffset, series.shape), path.name)
    return dataclasses.replace(source, format=f"tiff/{series.dtype}", path=path)

"""TIFF images and stacks of one page a frame, read by tifffile page by page and decompressed by imagecodecs.

tifffile ends a stack where the link to the next page is broken and fills up strips and tiles that are missing; what it
leaves out is looked for here.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, from_unit_to_type
from ...core.errors import DataError
from ...core.remarks import counted
from ..counts import source_of_numbers
from ..limits import DEFAULT_LIMITS, Limits, format_errors, input_errors
from ..npy import MappedFrames
from ..output import atomic_output, frames_of_one_size
from ..pixels import ORIENTATION_TAG, PixelArray, check_depth, upright
from ..source import FrameSource

if TYPE_CHECKING:
    import tifffile

TIFF_SUFFIXES = (".tif", ".tiff")
_UNCOMPRESSED = 1
# Compressions whose decoders are told how much a part may hold: none, fax, LZW, deflate, PackBits, LZMA, Zstandard.
_BOUNDED = (_UNCOMPRESSED, 2, 3, 4, 5, 8, 32946, 50013, 32773, 34925, 34926, 50000)
# Those whose parts are images with sizes of their own: JPEG, JPEG 2000, PNG and WebP.
_IMAGES = (6, 7, 33007, 34892, 33003, 33004, 33005, 34712, 34933, 34927, 50001)
# JPEG of which OpenCV reads what is neither grey nor RGB.
_JPEG = (6, 7)
_JPEG_END = b"\xff\xd9"
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2
_NOT_TIFF = "not a TIFF file, or damaged"
# Most values per pixel, chosen.
_MOST_SAMPLES = 16
# Orientations that :func:`upright` changes, and the first of those in which width and height are exchanged.
_ORIENTATIONS, _FIRST_ON_SIDE = range(2, 9), 5
# The description of an OME file may name other files, which are not opened.
_ALONE: dict[str, Any] = {"_multifile": False}


def open_tiff(path: Path, limits: Limits = DEFAULT_LIMITS) -> FrameSource:
    """Open a TIFF, BigTIFF or ImageJ stack, grey or RGB, with 8 or 16 bits, floating point or counts.

    Where OME or ImageJ name the axes, there may be one of time or depth, and one of three channels, which become RGB;
    other files are read page by page. The errors are those of :func:`turbrestore.io.video.open_frames`.
    """
    import tifffile

    with input_errors(path), format_errors(path, _NOT_TIFF), tifffile.TiffFile(path, **_ALONE) as tiff:
        count, whole = _list_pages(path, tiff, limits)
        page = tiff.pages[whole[0]].aspage()
        _check_page(path, page, limits)
        packed = _packed_stack(path, tiff) if count == 1 else None
        if packed is not None:
            form = f"tiff/{packed.dtype.newbyteorder('=')}"
            return source_of_numbers(path, form, packed.shape, packed.dtype, MappedFrames.of(packed), (), limits)
        channels, planes = _channels(page), _plane_pages(path, tiff, count, whole)
        if channels is None:
            kind = (
                f"{getattr(page.photometric, 'name', page.photometric)} with {counted(page.samplesperpixel, 'channel')}"
            )
            raise DataError(f"{path}: expected grey or RGB pages, found {kind}; convert the file")
        dtype, bits, notes = np.dtype(page.dtype), page.bitspersample, _notes(page)
        orientation = page.tags.valueof(ORIENTATION_TAG)
        height, width = page.imagelength, page.imagewidth
        if orientation in _ORIENTATIONS:
            notes += ("turned upright as its orientation tag demands",)
            height, width = (width, height) if orientation >= _FIRST_ON_SIDE else (height, width)
        if count > len(whole):
            reduced = count - len(whole)
            notes += (f"{counted(reduced, 'page')} of reduced size left out",)
        source = source_of_numbers(
            path,
            f"tiff/{dtype}",
            (len(planes), height, width, *((3,) if len(planes[0]) == 3 else channels)),
            dtype,
            lambda chosen: (
                upright(pixels, orientation)
                for pixels in _frames(path, [(number, planes[number]) for number in chosen], limits)
            ),
            notes,
            limits,
        )
        # Numbers of 12 bits, say, come in 16; wider ones are counts.
        narrow = dtype.kind == "u" and bits < 8 * dtype.itemsize <= 16
        return replace(source, full_scale=2**bits - 1, bit_depth=bits) if narrow else source


def read_tiff(path: Path, data: bytes, limits: Limits) -> tuple[PixelArray | None, tuple[str, ...]]:
    """Read a TIFF file of one image whose content is ``data``: upright pixels in its type, and warnings.

    The pixels are None for a file that OpenCV has to decode, such as one with a palette, one bit, or colours in JPEG.
    """
    import tifffile

    with format_errors(path, _NOT_TIFF), tifffile.TiffFile(io.BytesIO(data)) as tiff:
        _, whole = _list_pages(path, tiff, limits)
        if len(whole) != 1:
            raise DataError(f"{path}: expected one image, found {len(whole)} pages; read it as a video")
        page = tiff.pages[whole[0]].aspage()
        _check_page(path, page, limits)
        known = _channels(page) is not None and page.bitspersample in (8, 16, 32, 64)
        if known or page.compression not in _JPEG:
            # Decode as a check: OpenCV would fill missing pixels.
            pixels = _page_pixels(str(path), page, limits)
        return (upright(pixels, page.tags.valueof(ORIENTATION_TAG)), _notes(page)) if known else (None, ())


def write_tiff(path: Path, frames: Iterable[FloatArray], bit_depth: int = 16, overwrite: bool = False) -> None:
    """Write frames as an uncompressed TIFF stack of 8 bits, 16 bits or floating point, one page a frame."""
    import tifffile

    depth = check_depth(bit_depth)
    with atomic_output(path, overwrite) as temporary, tifffile.TiffWriter(temporary, bigtiff=True) as tiff:
        for frame in frames_of_one_size(frames, path):
            pixels = from_unit_to_type(frame, depth)
            # Without metadata and contiguity every page is complete in itself, so any reader finds a stack.
            tiff.write(pixels, photometric="minisblack" if frame.ndim == 2 else "rgb", contiguous=False, metadata=None)


def _list_pages(path: Path, tiff: tifffile.TiffFile, limits: Limits) -> tuple[int, list[int]]:
    """Return the number of pages, and the numbers of those that are no reduced image of another one."""
    seen: set[int] = set()
    whole = []
    tiff.pages.useframes = False
    for number, page in enumerate(tiff.pages):
        if page.offset in seen:
            raise DataError(f"{path}: damaged; its pages form a circle")
        seen.add(page.offset)
        limits.check_count(len(seen), str(path))
        if not page.aspage().is_reduced:
            whole.append(number)
    # tifffile ignores a link that leads to no page.
    tiff.filehandle.seek(tiff.pages.next_page_offset or 0)
    if tiff.filehandle.read(tiff.tiff.offsetsize) != bytes(tiff.tiff.offsetsize):
        raise DataError(f"{path}: cut short after {counted(len(seen), 'whole page')}; copy the file again")
    return len(seen), whole or list(range(len(seen)))


def _check_page(path: Path, page: tifffile.TiffPage, limits: Limits) -> None:
    """Refuse a page whose tags state too many pixels, too many values per pixel, or values of an unknown type."""
    limits.check_size(page.imagewidth, page.imagelength, str(path))
    if page.is_tiled:
        limits.check_size(page.tilewidth, page.tilelength, f"{path}: a tile")
    if page.samplesperpixel > _MOST_SAMPLES:
        raise DataError(f"{path}: expected up to {_MOST_SAMPLES} values per pixel, found {page.samplesperpixel}")
    if page.dtype is None:
        found = f"{page.bitspersample} bits of SampleFormat {int(page.sampleformat)}"
        raise DataError(f"{path}: expected integers or floating-point numbers, found {found}; convert the file")


def _channels(page: tifffile.TiffPage) -> tuple[int, ...] | None:
    """Axes after height and width, without alpha; None unless the page is grey or RGB."""
    whole_bytes = isinstance(page.bitspersample, int) and page.bitspersample % 8 == 0
    is_invertible = whole_bytes and np.issubdtype(page.dtype, np.unsignedinteger)
    greys = (_BLACK_IS_ZERO, _WHITE_IS_ZERO) if is_invertible else (_BLACK_IS_ZERO,)
    if page.imagedepth == 1 and page.samplesperpixel - len(page.extrasamples) == 1 and page.photometric in greys:
        return ()
    # Some writers do not mark the fourth channel as alpha.
    return (3,) if page.imagedepth == 1 and page.samplesperpixel >= 3 and page.photometric == _RGB else None


def _notes(page: tifffile.TiffPage) -> tuple[str, ...]:
    return ("alpha channel ignored",) if page.samplesperpixel not in (1, 3) else ()


def _plane_pages(path: Path, tiff: tifffile.TiffFile, count: int, whole: list[int]) -> list[tuple[int, ...]]:
    """Pages of every frame: one, or those of red, green and blue of an ImageJ or OME stack of channels."""
    alone: list[tuple[int, ...]] = [(number,) for number in whole]
    if not (tiff.is_imagej or tiff.is_ome) or len(whole) != count or count == 1:
        return alone
    series = tiff.series[0]
    axes = [(name, n) for name, n in zip(series.axes, series.shape, strict=True) if name not in "YXS" and n > 1]
    lengths = [length for _, length in axes]
    # What does not speak of the pages of this file says nothing about their order.
    if math.prod(lengths) != count:
        return alone
    # Some programs call any single axis one of channels.
    channels = [length for name, length in axes if name == "C" and len(axes) > 1]
    if len(axes) - len(channels) > 1 or channels not in ([], [3]) or (channels and "S" in series.axes):
        text = ", ".join(f"{name} of {length}" for name, length in axes)
        raise DataError(f"{path}: expected one axis of time or depth and 1 or 3 channels, found {text}; extract one")
    listed = [page.index for page in series.pages if page is not None]
    numbers = np.reshape(listed if len(listed) == count else range(count), lengths)
    if channels:
        numbers = np.moveaxis(numbers, [name for name, _ in axes].index("C"), -1)
    return [tuple(frame) for frame in numbers.reshape(-1, 3 if channels else 1).tolist()]


def _packed_stack(path: Path, tiff: tifffile.TiffFile) -> NDArray[Any] | None:
    """Map frames that follow each other behind a single page, as ImageJ writes stacks of 4 GB and more."""
    series, page = tiff.series[0], tiff.pages.first
    if series.dataoffset is None or series.size <= page.imagewidth * page.imagelength * page.samplesperpixel:
        return None
    array = np.memmap(path, series.dtype.newbyteorder(tiff.byteorder), "r", series.dataoffset, series.shape)
    return np.moveaxis(array, 1, -1) if series.axes in ("TCYX", "ZCYX") and series.shape[1] == 3 else array


def _frames(path: Path, chosen: Iterable[tuple[int, Sequence[int]]], limits: Limits) -> Iterator[PixelArray]:
    """Read frames, of which the number and the numbers of the pages are given."""
    import tifffile

    with input_errors(path), format_errors(path, _NOT_TIFF), tifffile.TiffFile(path, **_ALONE) as tiff:
        for frame, pages in chosen:
            planes = []
            for number in pages:
                page = tiff.pages[number].aspage()
                _check_page(path, page, limits)
                if _channels(page) is None:
                    raise DataError(f"{path}: page {number}: expected grey or RGB; convert the file")
                planes.append(_page_pixels(f"{path}: frame {frame}", page, limits))
            yield planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def _page_pixels(name: str, page: tifffile.TiffPage, limits: Limits) -> PixelArray:
    """Pixels of a page, grey or RGB, with white as the highest value; ``name`` is the file, or a frame of it."""
    if page.compression not in (*_BOUNDED, *_IMAGES):
        compression = getattr(page.compression, "name", page.compression)
        problem = f"expected a compression such as deflate, LZW or JPEG, found {compression}"
        raise DataError(f"{name}: {problem}; convert the file to one of these")
    parts = _parts(name, page)
    problem = "pixels are damaged" if page.compression == _UNCOMPRESSED else "compressed pixels are damaged"
    with format_errors(name, problem, "copy the file again"):
        if page.compression in _IMAGES:
            _check_images(name, page, parts, limits)
        # Its threads would be beside those of the caller.
        pixels = page.asarray(maxworkers=1)
    if pixels.ndim == 3:
        # Planes that are stored one after the other come as (C, H, W).
        pixels = np.moveaxis(pixels, 0, -1) if page.axes.startswith("S") else pixels
        pixels = pixels[..., :3] if _channels(page) else pixels[..., 0]
    return np.iinfo(pixels.dtype).max - pixels if page.photometric == _WHITE_IS_ZERO else pixels


def _parts(name: str, page: tifffile.TiffPage) -> list[tuple[int, int]]:
    """Offset and size of every strip or tile of a page; tifffile would make those up that have no bytes in the file."""
    expected, end = math.prod(page.chunked), page.parent.filehandle.size
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))[:expected]
    missing = expected - sum(0 < offset < end and size > 0 for offset, size in parts)
    if missing:
        problem = f"expected pixels in all strips and tiles, found none in {missing} of {expected}"
        raise DataError(f"{name}: {problem}; copy the file again")
    return parts


def _check_images(name: str, page: tifffile.TiffPage, parts: Sequence[tuple[int, int]], limits: Limits) -> None:
    """Refuse parts that are images of more pixels than are read, or JPEG images that are cut short."""
    import PIL.Image

    for offset, size in parts:
        page.parent.filehandle.seek(offset)
        data = io.BytesIO(page.parent.filehandle.read(size))
        # The decoder would make up the pixels that are missing.
        if page.compression in _JPEG and not data.getvalue().rstrip(b"\0").endswith(_JPEG_END):
            raise DataError(f"{name}: compressed pixels are damaged (cut short); copy the file again")
        with warnings.catch_warnings():
            # Pillow warns of sizes that the limits may allow.
            warnings.simplefilter("ignore")
            with PIL.Image.open(data, formats=("JPEG", "JPEG2000", "PNG", "WEBP")) as image:
                limits.check_size(*image.size, f"{name}: a part")

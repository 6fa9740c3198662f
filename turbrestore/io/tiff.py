"""TIFF images and stacks of one page a frame, read by tifffile page by page.

tifffile returns fewer pages where the link to the next one is broken, fills up missing strips and tiles, and may
decompress far more than a page holds. This module therefore follows the links and undoes common compressions itself.
"""

from __future__ import annotations

import io
import lzma
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, from_unit_to_type
from ..core.errors import DataError
from ..runtime.jit import jit
from .limits import DEFAULT_LIMITS, Limits, first_line, format_errors, input_errors
from .npy import MappedFrames
from .output import atomic_output, frames_of_one_size
from .pixels import PixelArray, check_depth, depth_of, upright
from .source import FrameSource
from .values.counts import from_counts, holds_counts, scale_of_numbers

if TYPE_CHECKING:
    import tifffile

TIFF_SUFFIXES = (".tif", ".tiff")
_NONE, _LZW, _PACKBITS, _LZMA = 1, 5, 32773, 34925
# Compressions that are undone here: LZW, two codes of deflate, PackBits and LZMA.
_DECOMPRESSED = (_LZW, 8, 32946, _PACKBITS, _LZMA)
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2
_NOT_TIFF = "not a TIFF file, or damaged"
_MOST_SAMPLES = 16
# The description of an OME file may name other files, which are not opened.
_ALONE: dict[str, Any] = {"_multifile": False}
_ORIENTATION, _SUBFILE = 274, 254
# Type of a tag: a number of 32 bits.
_LONG = 4
# LZW codes that start a new table and that end the data, and the size of the largest table.
_CLEAR, _END, _TABLE = 256, 257, 4096


def open_tiff(path: Path, limits: Limits = DEFAULT_LIMITS) -> FrameSource:
    """Open a TIFF, BigTIFF or ImageJ stack, grey or RGB, with 8 or 16 bits, floating point or counts.

    Where OME or ImageJ name the axes, there may be one of time or depth, and one of three channels, which become RGB;
    other files are read page by page. Packed bits, and compressions other than deflate, LZMA, LZW and PackBits, need
    the package ``imagecodecs``. The errors are those of :func:`turbrestore.io.video.open_frames`.
    """
    import tifffile

    with input_errors(path), path.open("rb") as file:
        pages = list_pages(path, file, limits)
    with input_errors(path), format_errors(path, _NOT_TIFF), tifffile.TiffFile(path, **_ALONE) as tiff:
        page = tiff.pages[pages.whole[0]].aspage()
        _check_page(path, page, limits)
        packed = _packed_stack(path, tiff) if pages.count == 1 else None
        if packed is not None:
            return packed
        channels, planes = _channels(page), _plane_pages(path, tiff, pages)
        if channels is None:
            kind = f"{getattr(page.photometric, 'name', page.photometric)} with {page.samplesperpixel} channels"
            raise DataError(f"{path}: expected grey or RGB pages, found {kind}; convert the file")
        dtype = np.dtype(page.dtype)
        integer = np.issubdtype(dtype, np.unsignedinteger)
        source = FrameSource(
            name=path.name,
            format=f"tiff/{dtype}",
            file_shape=(len(planes), page.imagelength, page.imagewidth, *((3,) if len(planes[0]) == 3 else channels)),
            full_scale=2**page.bitspersample - 1 if integer else scale_of_numbers(dtype, str(path)),
            bit_depth=min(page.bitspersample, 32) if integer else depth_of(dtype),
            pixels=lambda chosen: _frames(path, [planes[number] for number in chosen], limits),
            path=path,
            warnings=(*_notes(page), *pages.remarks()),
        )
        return from_counts(source) if holds_counts(dtype) else source


def read_tiff(path: Path, data: bytes, limits: Limits) -> tuple[PixelArray | None, tuple[str, ...]]:
    """Read a TIFF file of one image whose content is ``data``: upright pixels in its type, and warnings.

    The pixels are None for a file that OpenCV has to decode, such as one with a palette, one bit, JPEG or fax
    compression.
    """
    import tifffile

    pages = list_pages(path, io.BytesIO(data), limits)
    if len(pages.whole) != 1:
        raise DataError(f"{path}: expected one image, found {len(pages.whole)} pages; read it as a video")
    with format_errors(path, _NOT_TIFF), tifffile.TiffFile(io.BytesIO(data)) as tiff:
        page = tiff.pages[pages.whole[0]].aspage()
        _check_page(path, page, limits)
        if _is_decodable(page):
            return upright(_page_pixels(path, page), page.tags.valueof(_ORIENTATION)), _notes(page)
        if page.compression in _DECOMPRESSED and isinstance(page.bitspersample, int):
            # OpenCV prints that pixels are missing, and fills them up.
            row = (page.imagewidth * page.samplesperpixel * page.bitspersample + 7) // 8
            if sum(map(len, _parts(path, page))) < row * page.imagelength:
                raise DataError(f"{path}: compressed pixels are damaged (cut short); copy the file again")
        return None, ()


def write_tiff(path: Path, frames: Iterable[FloatArray], bit_depth: int = 16, overwrite: bool = False) -> None:
    """Write frames as an uncompressed TIFF stack of 8 bits, 16 bits or floating point, one page a frame."""
    import tifffile

    depth = check_depth(bit_depth)
    with atomic_output(path, overwrite) as temporary, tifffile.TiffWriter(temporary, bigtiff=True) as tiff:
        for frame in frames_of_one_size(frames, path):
            pixels = from_unit_to_type(frame, depth)
            # Without metadata and contiguity every page is complete in itself, so any reader finds a stack.
            tiff.write(pixels, photometric="minisblack" if frame.ndim == 2 else "rgb", contiguous=False, metadata=None)


@dataclass(frozen=True)
class Pages:
    """Number of pages, and the numbers of those that are no reduced image of another one."""

    count: int
    whole: tuple[int, ...]

    def remarks(self) -> tuple[str, ...]:
        """Say how many pages are left out."""
        reduced = self.count - len(self.whole)
        return (f"{reduced} page{'s' * (reduced > 1)} of reduced size left out",) if reduced else ()


def list_pages(path: Path, file: BinaryIO, limits: Limits) -> Pages:
    r"""List the pages of a TIFF file by following the links from page to page; raise DataError for broken links."""
    head = file.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
    version = struct.unpack(f"{order}H", head[2:4])[0] if len(head) == 16 else None
    if not order or version not in (42, 43):
        raise DataError(f"{path}: not a TIFF file")
    count_format, entry_size, link_format = ("H", 12, "I") if version == 42 else ("Q", 20, "Q")
    link_size = struct.calcsize(link_format)
    offset = struct.unpack(order + link_format, head[4:8] if version == 42 else head[8:16])[0]
    size = file.seek(0, io.SEEK_END)
    seen: set[int] = set()
    whole: list[int] = []
    while offset:
        if offset in seen:
            raise DataError(f"{path}: damaged; its pages form a circle")
        seen.add(offset)
        limits.check_count(len(seen), str(path))
        try:
            # The system refuses to seek to offsets beyond its range; at the end of the file nothing is read.
            file.seek(min(offset, size))
            (entries,) = struct.unpack(order + count_format, file.read(struct.calcsize(count_format)))
            start = file.tell()
            whole += [] if _is_reduced(file.read(entry_size if entries else 0), order, link_size) else [len(seen) - 1]
            file.seek(min(start + entries * entry_size, size))
            (offset,) = struct.unpack(order + link_format, file.read(link_size))
        except struct.error:
            raise DataError(f"{path}: cut short after {len(seen) - 1} whole pages; copy the file again") from None
    if not seen:
        raise DataError(f"{path}: expected at least one page, found none")
    return Pages(len(seen), tuple(whole) or tuple(range(len(seen))))


def _is_reduced(entry: bytes, order: str, link_size: int) -> bool:
    """Whether the first tag of a page, which are sorted, says that it is a reduced version of another page."""
    if len(entry) < 4 + 2 * link_size or struct.unpack(f"{order}HH", entry[:4]) != (_SUBFILE, _LONG):
        return False
    return bool(struct.unpack(f"{order}I", entry[4 + link_size : 8 + link_size])[0] & 1)


def _check_page(path: Path, page: tifffile.TiffPage, limits: Limits) -> None:
    """Refuse a page whose tags state too many pixels or too many values per pixel."""
    limits.check_size(page.imagewidth, page.imagelength, str(path))
    if page.is_tiled:
        limits.check_size(page.tilewidth, page.tilelength, f"{path}: a tile")
    if page.samplesperpixel > _MOST_SAMPLES:
        raise DataError(f"{path}: expected up to {_MOST_SAMPLES} values per pixel, found {page.samplesperpixel}")


def _channels(page: tifffile.TiffPage) -> tuple[int, ...] | None:
    """Axes after height and width, without alpha; None unless the page is grey or RGB."""
    whole_bytes = isinstance(page.bitspersample, int) and page.bitspersample % 8 == 0
    greys = (_BLACK_IS_ZERO, _WHITE_IS_ZERO) if np.issubdtype(page.dtype, np.unsignedinteger) and whole_bytes else (1,)
    if page.imagedepth == 1 and page.samplesperpixel - len(page.extrasamples) == 1 and page.photometric in greys:
        return ()
    # Some writers do not mark the fourth channel as alpha.
    return (3,) if page.imagedepth == 1 and page.samplesperpixel >= 3 and page.photometric == _RGB else None


def _notes(page: tifffile.TiffPage) -> tuple[str, ...]:
    return ("alpha channel ignored",) if page.samplesperpixel not in (1, 3) else ()


def _plane_pages(path: Path, tiff: tifffile.TiffFile, pages: Pages) -> list[tuple[int, ...]]:
    """Pages of every frame: one, or those of red, green and blue of an ImageJ or OME stack of channels."""
    alone: list[tuple[int, ...]] = [(number,) for number in pages.whole]
    if not (tiff.is_imagej or tiff.is_ome) or len(pages.whole) != pages.count or pages.count == 1:
        return alone
    series = tiff.series[0]
    axes = [(name, n) for name, n in zip(series.axes, series.shape, strict=True) if name not in "YXS" and n > 1]
    lengths = [length for _, length in axes]
    # What does not speak of the pages of this file says nothing about their order.
    if math.prod(lengths) != pages.count:
        return alone
    # Some programs call any single axis one of channels.
    channels = [length for name, length in axes if name == "C" and len(axes) > 1]
    if len(axes) - len(channels) > 1 or channels not in ([], [3]) or (channels and "S" in series.axes):
        text = ", ".join(f"{name} of {length}" for name, length in axes)
        raise DataError(f"{path}: expected one axis of time or depth and 1 or 3 channels, found {text}; extract one")
    listed = [page.index for page in series.pages if page is not None]
    numbers = np.reshape(listed if len(listed) == pages.count else range(pages.count), lengths)
    if channels:
        numbers = np.moveaxis(numbers, [name for name, _ in axes].index("C"), -1)
    return [tuple(frame) for frame in numbers.reshape(-1, 3 if channels else 1).tolist()]


def _packed_stack(path: Path, tiff: tifffile.TiffFile) -> FrameSource | None:
    """Open frames that follow each other behind a single page, as ImageJ writes stacks of 4 GB and more."""
    series, page = tiff.series[0], tiff.pages.first
    if series.dataoffset is None or series.size <= page.imagewidth * page.imagelength * page.samplesperpixel:
        return None
    dtype = series.dtype.newbyteorder(tiff.byteorder)
    array = np.memmap(path, dtype, "r", series.dataoffset, series.shape)
    if series.axes in ("TCYX", "ZCYX") and series.shape[1] == 3:
        array = np.moveaxis(array, 1, -1)
    source = FrameSource(
        name=path.name,
        format=f"tiff/{series.dtype}",
        file_shape=array.shape,
        full_scale=scale_of_numbers(array.dtype, str(path)),
        bit_depth=depth_of(array.dtype),
        pixels=MappedFrames.of(array),
        path=path,
    )
    return from_counts(source) if holds_counts(array.dtype) else source


def _is_decodable(page: tifffile.TiffPage) -> bool:
    """Whether :func:`_page_pixels` decodes the page of a still image."""
    from tifffile import TIFF

    known = page.compression in _DECOMPRESSED or page.compression in TIFF.DECOMPRESSORS
    bits = page.bitspersample in (8, 16, 32, 64)
    return _channels(page) is not None and bits and known and page.predictor in (1, *TIFF.UNPREDICTORS)


def _frames(path: Path, chosen: Sequence[tuple[int, ...]], limits: Limits) -> Iterator[PixelArray]:
    import tifffile

    with input_errors(path), format_errors(path, _NOT_TIFF), tifffile.TiffFile(path, **_ALONE) as tiff:
        for numbers in chosen:
            planes = []
            for number in numbers:
                page = tiff.pages[number].aspage()
                _check_page(path, page, limits)
                if _channels(page) is None:
                    raise DataError(f"{path}: page {number}: expected grey or RGB; convert the file")
                planes.append(_page_pixels(path, page))
            yield planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def _page_pixels(path: Path, page: tifffile.TiffPage) -> PixelArray:
    """Pixels of a page, grey or RGB, with white as the highest value."""
    if page.compression in _DECOMPRESSED:
        parts = list(_parts(path, page))
        # tifffile decodes the parts as it does those of an uncompressed page.
        page.compression = _NONE
        pixels = np.zeros(page.shaped, page.dtype)
        for index, part in enumerate(parts):
            decoded: Any = page.decode(part, index)
            segment, (plane, depth, top, left, _), shape = decoded
            rows, columns = slice(top, top + shape[1]), slice(left, left + shape[2])
            pixels[plane, depth : depth + shape[0], rows, columns] = segment[
                : page.imagedepth - depth, : page.imagelength - top, : page.imagewidth - left
            ]
        pixels = pixels.reshape(page.shape)
    else:
        pixels = page.asarray()
    if pixels.ndim == 3:
        # Planes that are stored one after the other come as (C, H, W).
        pixels = np.moveaxis(pixels, 0, -1) if page.axes.startswith("S") else pixels
        pixels = pixels[..., :3] if _channels(page) else pixels[..., 0]
    return np.iinfo(pixels.dtype).max - pixels if page.photometric == _WHITE_IS_ZERO else pixels


def _parts(path: Path, page: tifffile.TiffPage) -> Iterator[bytes]:
    """Decompress the strips or tiles of a page; each holds no more than its share of the pixels."""
    file = page.parent.filehandle
    most = math.prod(page.chunks) * np.dtype(page.dtype).itemsize
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    # tifffile returns fewer parts where a tag lacks them.
    if len(parts) < math.prod(page.chunked):
        raise DataError(f"{path}: expected {math.prod(page.chunked)} parts, found {len(parts)}; the file is damaged")
    for offset, size in parts:
        file.seek(offset)
        data = file.read(size)
        if page.compression == _LZW:
            part = _unlzw(path, data, most)
        elif page.compression == _PACKBITS:
            part = _unpack_bits(data, most)
        else:
            part = _inflate(path, data, most, page.compression)
        if len(part) > most:
            raise DataError(f"{path}: compressed pixels are damaged, or hold more than the {most} bytes of the page")
        yield part


def _unpack_bits(data: bytes, most: int) -> bytes:
    found, place = bytearray(), 0
    while place < len(data) and len(found) <= most:
        head = data[place]
        if head < 128:
            found += data[place + 1 : place + 2 + head]
            place += 2 + head
        else:
            # 128 has no meaning.
            found += data[place + 1 : place + 2] * (257 - head) if head > 128 else b""
            place += 2 if head > 128 else 1
    return bytes(found)


def _inflate(path: Path, data: bytes, most: int, compression: int) -> bytes:
    inflate: Any = lzma.LZMADecompressor() if compression == _LZMA else zlib.decompressobj()
    try:
        # Room for one byte more than allowed shows whether there is more, and lets the checksum be compared.
        found = inflate.decompress(data, most + 1)
    except (zlib.error, lzma.LZMAError) as error:
        raise DataError(f"{path}: compressed pixels are damaged ({first_line(error)}); copy the file again") from error
    if len(found) <= most and not inflate.eof:
        raise DataError(f"{path}: compressed pixels are damaged (cut short); copy the file again")
    return found


def _unlzw(path: Path, data: bytes, most: int) -> bytes:
    pixels, state = np.empty(most, np.uint8), np.zeros(2, np.int64)
    if data[:1] == b"\0" and data[1:2] and data[1] & 1:
        raise DataError(f"{path}: LZW as it was before TIFF 6 is not supported; convert the file")
    _decode_lzw(np.frombuffer(data, np.uint8), pixels, state)
    if state[1]:
        raise DataError(f"{path}: compressed pixels are damaged (unknown LZW code); copy the file again")
    return pixels[: state[0]].tobytes()


@jit
def _decode_lzw(packed: NDArray[np.uint8], pixels: NDArray[np.uint8], state: NDArray[np.int64]) -> None:
    """Decode LZW codes into ``pixels``; ``state`` becomes the count of bytes, and 1 where a code is unknown."""
    # The string of every table entry has been written before, so its place and length are enough.
    places, lengths = np.zeros(_TABLE, np.int64), np.ones(_TABLE, np.int64)
    width, bits, held, entries, last, found = 9, 0, 0, _END + 1, 0, 0
    for byte in packed:
        held = ((held << 8) | int(byte)) & 0xFFFFFF
        bits += 8
        if bits < width:
            continue
        bits -= width
        code = (held >> bits) & ((1 << width) - 1)
        if code == _END or found == pixels.size:
            break
        if code == _CLEAR:
            width, entries, last = 9, _END + 1, 0
            continue
        if last and entries < _TABLE:
            places[entries], lengths[entries] = found - last, last + 1
            entries += 1
        if code >= entries:
            state[1] = 1
            break
        last = min(lengths[code], pixels.size - found) if code > _END else 1
        for index in range(last):
            pixels[found + index] = pixels[places[code] + index] if code > _END else code
        found += last
        if entries >= (1 << width) - 1 and width < 12:
            width += 1
    state[0] = found

"""Pages of TIFF files: what is checked before they are decoded, in stacks and in still images.

The chain of pages is followed here before tifffile sees the file: tifffile ends at a broken link with a line in the
log and gives fewer pages.  Strips and tiles that hold less than their page are found here too: decoders fill them up.
"""

from __future__ import annotations

import io
import lzma
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ..core.errors import DataError, TurbrestoreError
from .files import first_line
from .limits import Limits

if TYPE_CHECKING:
    import tifffile

_NONE, _LZW, _DEFLATE, _PACKBITS, _LZMA = 1, 5, (8, 32946), 32773, 34925
_YCBCR, _SEPARATE = 6, 2
_MOST_SAMPLES = 16
# How much is read, and how much is inflated, at a time.
_PIECE, _CHUNK = 2**16, 2**20
# LZW: bits of the codes that follow a clear code, and where each begins; no table is longer.
_CLEAR, _END = 256, 257
_BITS = np.repeat([9, 10, 11, 12], [254, 512, 1024, 2306])
_STARTS = np.cumsum(_BITS) - _BITS


@contextmanager
def tiff_errors(path: Path) -> Iterator[None]:
    """Turn what tifffile raises into :class:`turbrestore.core.errors.DataError`.

    Parameters
    ----------
    path : Path
        The file that is read.

    Raises
    ------
    DataError
        For whatever but an error of the system or of this package.

    Examples
    --------
    >>> with tiff_errors(Path("a.tif")):
    ...     {}["tag"]
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.DataError: a.tif: not a TIFF file, or damaged (KeyError)
    """
    try:
        yield
    except (TurbrestoreError, OSError):
        raise
    except Exception as error:  # tifffile documents no closed list of exceptions for damaged files
        raise DataError(f"{path}: not a TIFF file, or damaged ({first_line(error)})") from error


def count_pages(path: Path, file: BinaryIO, limits: Limits) -> int:
    r"""Follow the chain of pages to its end.

    Parameters
    ----------
    path : Path
        For messages.
    file : binary file
        At its beginning.
    limits : Limits
        Most pages.

    Returns
    -------
    int

    Raises
    ------
    DataError
        Not a TIFF file, cut short, or too many pages.

    Examples
    --------
    >>> count_pages(Path("a.tif"), io.BytesIO(b"II*\0\x08\0\0\0" + bytes(14)), Limits())
    1
    """
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
    while offset:
        if offset in seen:
            raise DataError(f"{path}: damaged; its pages form a circle")
        seen.add(offset)
        limits.check_count(len(seen), str(path))
        try:
            # Beyond the end nothing is read, and a larger offset than the system knows is none at all.
            file.seek(min(offset, size))
            (entries,) = struct.unpack(order + count_format, file.read(struct.calcsize(count_format)))
            file.seek(min(file.tell() + entries * entry_size, size))
            (offset,) = struct.unpack(order + link_format, file.read(link_size))
        except struct.error:
            raise DataError(f"{path}: cut short after {len(seen) - 1} whole pages; copy the file again") from None
    if not seen:
        raise DataError(f"{path}: expected at least one page, found none")
    return len(seen)


def check_page(path: Path, page: tifffile.TiffPage, limits: Limits) -> None:
    """Refuse a page by its tags: too many pixels in the page or in one of its tiles, or too many values a pixel.

    Parameters
    ----------
    path : Path
        For messages.
    page : tifffile.TiffPage
    limits : Limits
        Largest page and tile.

    Raises
    ------
    DataError
        Too large.
    """
    limits.check_size(page.imagewidth, page.imagelength, str(path))
    if page.is_tiled:
        limits.check_size(page.tilewidth, page.tilelength, f"{path}: a tile")
    if page.samplesperpixel > _MOST_SAMPLES:
        raise DataError(f"{path}: expected up to {_MOST_SAMPLES} values a pixel, found {page.samplesperpixel}")


def check_parts(path: Path, page: tifffile.TiffPage) -> None:
    """Refuse strips and tiles that do not hold what the page says, or whose checksum fails.

    Pixels that are not compressed are counted, those of deflate and LZMA while they inflate, and those of PackBits and
    LZW by their codes.  Deflate and LZMA have checksums.

    Parameters
    ----------
    path : Path
        For messages.
    page : tifffile.TiffPage
        Of an open file.

    Raises
    ------
    DataError
        Damaged, or cut short.
    """
    file, kind = page.parent.filehandle, page.compression
    if kind not in (_NONE, _LZW, *_DEFLATE, _PACKBITS, _LZMA):
        return
    least, most = _least_bytes(page), math.prod(page.chunks) * np.dtype(page.dtype).itemsize
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    if kind == _NONE:
        there = sum(max(min(size, file.size - offset), 0) for offset, size in parts)
        _check_count(path, there, sum(least))
        return
    # tifffile gives fewer parts where a tag lacks them.
    _check_count(path, len(parts), len(least), "parts")
    for (offset, size), needed in zip(parts, least, strict=False):
        file.seek(offset)
        # What takes twice its own size is not read on.
        data = file.read(min(size, 2 * most + 1024))
        if kind == _LZW:
            found = min(_lzw_size(path, data, needed), needed)
        elif kind == _PACKBITS:
            found = _unpacked_size(data, most)
        else:
            found = _inflated_size(path, data, most, kind)
        if found > most:
            raise DataError(f"{path}: damaged; compressed pixels hold more than the {most} bytes that the page has")
        _check_count(path, found, needed)


def _check_count(path: Path, found: int, needed: int, of: str = "bytes of pixels") -> None:
    if found < needed:
        raise DataError(f"{path}: expected {needed} {of}, found {found}; the file is damaged")


def _least_bytes(page: tifffile.TiffPage) -> list[int]:
    """Bytes that each strip or tile holds at least; 0 where chroma is coarser or bits differ by channel."""
    count = math.prod(page.chunked)
    bits, height = page.bitspersample, page.imagelength
    if page.photometric == _YCBCR or not isinstance(bits, int) or page.imagedepth != 1:
        return [0] * count
    values = 1 if page.planarconfig == _SEPARATE else page.samplesperpixel
    if page.is_tiled:
        return [page.tilelength * ((page.tilewidth * values * bits + 7) // 8)] * count
    rows = max(min(page.rowsperstrip, height), 1)
    strips = -(-height // rows)
    row_bytes = (page.imagewidth * values * bits + 7) // 8
    return [row_bytes * min(rows, height - number % strips * rows) for number in range(count)]


def _inflated_size(path: Path, data: bytes, most: int, kind: int) -> int:
    """Bytes that compressed pixels inflate to, at most one chunk more than ``most``."""
    try:
        found, whole = _lzma_size(data, most) if kind == _LZMA else _zlib_size(data, most)
    except (zlib.error, lzma.LZMAError) as error:
        raise DataError(f"{path}: compressed pixels are damaged ({first_line(error)}); copy the file again") from error
    if not whole and found <= most:
        raise DataError(f"{path}: compressed pixels are damaged (cut short); copy the file again")
    return found


def _zlib_size(data: bytes, most: int) -> tuple[int, bool]:
    inflate, found = zlib.decompressobj(), 0
    for start in range(0, len(data), _PIECE):
        packed = data[start : start + _PIECE]
        while packed and found <= most:
            found += len(inflate.decompress(packed, _CHUNK))
            packed = inflate.unconsumed_tail
    if found <= most:
        # No more than the last chunk had no room for.
        found += len(inflate.flush())
    return found, inflate.eof


def _lzma_size(data: bytes, most: int) -> tuple[int, bool]:
    inflate, found = lzma.LZMADecompressor(), 0
    while found <= most and not inflate.eof:
        found += len(inflate.decompress(data, _CHUNK))
        if inflate.needs_input:
            break
        data = b""
    return found, inflate.eof


def _unpacked_size(data: bytes, most: int) -> int:
    place, found = 0, 0
    while place < len(data) and found <= most:
        head = data[place]
        if head < 128:
            found += min(head + 1, len(data) - place - 1)
            place += head + 2
        else:
            # 128 stands for nothing.
            found += 257 - head if head > 128 and place + 1 < len(data) else 0
            place += 2 if head > 128 else 1
    return found


def _lzw_size(path: Path, data: bytes, enough: int) -> int:
    """Bytes that LZW codes stand for, counted up to ``enough``."""
    if data[:1] == b"\0" and data[1:2] and data[1] & 1:
        # The first byte is that of a clear code in the other order of bits, which went out of use before TIFF 6.
        return enough
    padded = np.frombuffer(data + bytes(3), np.uint8).astype(np.uint32)
    bit, found, tables = 0, 0, 0
    while found < enough:
        tables += 1
        places = bit + _STARTS
        places = places[places + _BITS <= 8 * len(data)]
        first, bits = places >> 3, _BITS[: len(places)]
        words = (padded[first] << 16) | (padded[first + 1] << 8) | padded[first + 2]
        codes = (words >> (24 - (places & 7) - bits).astype(np.uint32)) & ((1 << bits) - 1).astype(np.uint32)
        ends = np.flatnonzero((codes == _CLEAR) | (codes == _END))
        count = int(ends[0]) if ends.size else len(codes)
        found += _table_size(path, codes[:count].tolist())
        # A table that is begun anew all the time is no encoder's; to follow it would take long.
        if not ends.size or codes[count] == _END or tables > 64 + len(data) // 256:
            break
        bit = int(places[count] + bits[count])
    return found


def _table_size(path: Path, codes: list[int]) -> int:
    """Bytes that the codes between two clear codes stand for; every code adds an entry, one longer than the last."""
    lengths, found, last = [1] * 256 + [0, 0], 0, 0
    for code in codes:
        if last:
            lengths.append(last + 1)
        if code >= len(lengths):
            raise DataError(f"{path}: compressed pixels are damaged (unknown LZW code); copy the file again")
        last = lengths[code]
        found += last
    return found

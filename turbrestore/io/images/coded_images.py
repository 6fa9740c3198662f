"""Still images of newer codecs and of film: AVIF, HEIC, JPEG 2000 and JPEG XL, DPX and EXR.

imagecodecs decodes AVIF, JPEG 2000 and JPEG XL, pillow-heif HEIC, and FFmpeg DPX and EXR.  Each gives values of as many
bits as the file has; here they are spread over the range of their type.  The size in the header is checked first.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DataError, TurbrestoreError
from ...core.extras import missing_package
from ..containers.pixel_formats import convert, native_format
from ..limits import Limits, first_line
from ..pixels import PixelArray, at_full_range

CODED_SUFFIXES = (".heic", ".heif", ".hif", ".avif", ".jp2", ".j2k", ".jpx", ".jpf", ".jxl", ".dpx", ".exr")
_JXL_CODESTREAM = b"\xff\x0a"
_EXR_TILES, _EXR_DEEP, _EXR_PARTS = 0x200, 0x800, 0x1000
# Width over height, by the code in the header of JPEG XL.
_JXL_RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))


def decode_coded(path: Path, kind: str, data: bytes, limits: Limits) -> PixelArray:
    """Decode the file whose content is ``data`` and whose format has the suffix ``kind``: upright, all channels."""
    with _damage(path):
        if kind in (".heic", ".heif", ".hif"):
            return _heic(path, data, limits)
        if kind == ".avif":
            return _avif(path, data, limits)
        if kind == ".jxl":
            return _jpeg_xl(path, data, limits)
        if kind in (".dpx", ".exr"):
            return _film(path, kind, data, limits)
        return _jpeg_2000(path, data, limits)


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except (TurbrestoreError, MemoryError):
        raise
    except Exception as error:  # each of the decoders has errors of its own
        raise DataError(f"{path}: cannot be decoded as an image, or damaged ({first_line(error)})") from error


def _heic(path: Path, data: bytes, limits: Limits) -> PixelArray:
    try:
        import pillow_heif
    except ImportError as error:
        raise missing_package(str(path), "pillow-heif", "heic") from error
    image = pillow_heif.open_heif(BytesIO(data), convert_hdr_to_8bit=False)
    width, height = image.size
    limits.check_size(width, height, str(path))
    # The decoder keeps the memory of what it hands out.
    pixels = np.array(image)
    if pixels.dtype == np.uint8:
        return pixels
    # The bits of the file are the upper ones.
    bits = image.info["bit_depth"]
    return at_full_range(pixels >> (16 - bits), 2**bits - 1)


def _avif(path: Path, data: bytes, limits: Limits) -> PixelArray:
    import imagecodecs

    # The boxes before the pixels.
    head = data[: data.find(b"mdat")]
    for found in re.findall(rb"(?s)ispe.{4}(.{8})", head):
        width, height = struct.unpack(">II", found)
        limits.check_size(width, height, str(path))
    (flags,) = re.findall(rb"(?s)av1C..(.)", head)[:1]
    # The bits "high_bitdepth" and "twelve_bit".
    bits = 8 + 2 * (flags[0] >> 6 & 1) * (1 + (flags[0] >> 5 & 1))
    pixels = imagecodecs.avif_decode(data)
    turns, mirrors = re.findall(rb"(?s)\0\0\0\x09irot(.)", head), re.findall(rb"(?s)\0\0\0\x09imir(.)", head)
    if turns:
        pixels = np.rot90(pixels, turns[0][0] & 3)
    if mirrors:
        pixels = np.flip(pixels, mirrors[0][0] & 1)
    return at_full_range(np.ascontiguousarray(pixels), 2**bits - 1)


def _jpeg_2000(path: Path, data: bytes, limits: Limits) -> PixelArray:
    import imagecodecs

    found = re.search(rb"(?s)\xff\x4f\xff\x51.{4}(.{16}).{16}..(.)", data)
    if found is None:
        raise DataError(f"{path}: not a JPEG 2000 image, or damaged (it has no header)")
    right, bottom, left, top = struct.unpack(">4I", found[1])
    limits.check_size(right - left, bottom - top, str(path))
    pixels = imagecodecs.jpeg2k_decode(data)
    bits = (found[2][0] & 127) + 1
    return at_full_range(pixels, 2**bits - 1) if pixels.dtype.kind == "u" else pixels


def _jpeg_xl(path: Path, data: bytes, limits: Limits) -> PixelArray:
    import imagecodecs

    codestream = data if data.startswith(_JXL_CODESTREAM) else _boxed_codestream(data)
    width, height, bits = _jpeg_xl_header(path, codestream)
    limits.check_size(width, height, str(path))
    pixels = imagecodecs.jpegxl_decode(data)
    return at_full_range(pixels, 2**bits - 1) if pixels.dtype.kind == "u" else pixels


def _boxed_codestream(data: bytes) -> bytes:
    """Content of the box with the codestream, or with its first part, behind the number of that part."""
    found = re.search(rb"(?s)jxlc|jxlp.{4}", data)
    return data[found.end() :] if found else b""


def _jpeg_xl_header(path: Path, codestream: bytes) -> tuple[int, int, int]:
    """Width, height, and bits of a value (ISO/IEC 18181-1, annex D); bits are read from the lowest on."""
    if not codestream.startswith(_JXL_CODESTREAM):
        raise DataError(f"{path}: not a JPEG XL image, or damaged (it has no header)")
    left = int.from_bytes(codestream[2:66], "little")

    def take(count: int) -> int:
        nonlocal left
        value, left = left & ((1 << count) - 1), left >> count
        return value

    def length(is_small: int) -> int:
        return 8 * (take(5) + 1) if is_small else take((9, 13, 18, 30)[take(2)]) + 1

    def size() -> tuple[int, int]:
        is_small = take(1)
        height, ratio = length(is_small), take(3)
        above, below = _JXL_RATIOS[ratio - 1]
        return (height * above // below if ratio else length(is_small)), height

    width, height = size()
    if take(1):
        return width, height, 8
    if take(1):
        # The orientation, which the decoder undoes.
        take(3)
        if take(1):
            size()
        if take(1) or take(1):
            raise DataError(f"{path}: JPEG XL with a preview or an animation is not read; save it as a plain image")
    if take(1):
        # Floating point, of which no value is the largest.
        return width, height, 32
    kind = take(2)
    return width, height, (8, 10, 12)[kind] if kind < 3 else take(6) + 1


def _film(path: Path, kind: str, data: bytes, limits: Limits) -> PixelArray:
    import av

    for width, height in _film_sizes(kind, data):
        limits.check_size(width, height, str(path))
    if kind == ".exr":
        _check_exr_chunks(path, data)
    decoder: Any = av.CodecContext.create(kind[1:], "r")
    frames = [*decoder.decode(av.Packet(data)), *decoder.decode(None)]
    if not frames or frames[0].is_corrupt:
        raise DataError(f"{path}: cannot be decoded as an image; the file is damaged or of an unsupported kind")
    if "f32" in frames[0].format.name:
        return np.asarray(frames[0].to_ndarray())
    layout = native_format(path, frames[0].format)
    return at_full_range(convert(frames[0], layout.target).to_ndarray(), layout.full_scale)


def _film_sizes(kind: str, data: bytes) -> list[tuple[int, int]]:
    """Width and height in a DPX header, or of both windows in that of an EXR file."""
    if kind == ".dpx":
        order = ">" if data.startswith(b"SDPX") else "<"
        width, height = struct.unpack_from(f"{order}2I", data, 772)
        return [(width, height)]
    windows = re.findall(rb"(?s)(?:data|display)Window\0box2i\0.{4}(.{16})", data)
    corners = [struct.unpack("<4i", window) for window in windows]
    return [(right - left + 1, bottom - top + 1) for left, top, right, bottom in corners]


def _check_exr_chunks(path: Path, data: bytes) -> None:
    """Refuse a file that ends before its pixels do, which FFmpeg would fill up."""
    flags = int.from_bytes(data[4:8], "little")
    if flags & (_EXR_DEEP | _EXR_PARTS):
        raise DataError(f"{path}: expected an EXR image of one flat part, found several or a deep one; save one part")
    place = 8
    # Attributes: name, type, size and value; an empty name ends them.
    while data[place] != 0:
        place = data.index(b"\0", data.index(b"\0", place) + 1) + 1
        place += 4 + int.from_bytes(data[place : place + 4], "little")
    # A table of the places of all chunks, and the chunks: coordinates, size and pixels.
    table, before_size = place + 1, 16 if flags & _EXR_TILES else 4
    place = int.from_bytes(data[table : table + 8], "little")
    for _ in range((min(place, len(data)) - table) // 8):
        place += before_size + 4 + int.from_bytes(data[place + before_size : place + before_size + 4], "little")
    if place > len(data):
        raise DataError(f"{path}: cut short; {place} bytes expected, {len(data)} found; copy the file again")

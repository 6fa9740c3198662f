"""Damage that decoders do not report: files that are cut short, and FFV1 slices whose checksum fails.

A truncated Matroska file decodes without complaint to fewer frames. The outermost element of every container states its
own size, which is compared with the size of the file.

FFV1 can store a checksum for each slice (CRC-32, polynomial 0x04C11DB7, most significant bit first, start 0; RFC 9043,
sections 4.3 and 4.9), and the decoder only logs a mismatch. zlib computes the same CRC-32 in the opposite bit order, so
it is applied to bit-reversed bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_REVERSED_BITS = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_EBML_HEADER, _MATROSKA_SEGMENT = b"\x1aE\xdf\xa3", b"\x18S\x80g"
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"moof", b"mfra", b"wide", b"free", b"skip", b"pnot", b"styp", b"sidx")
# Some writers include the RIFF header in a size that should exclude it, and pad the end; chosen.
_RIFF_SLACK = 16


def is_cut_short(path: Path) -> bool:
    """Whether a Matroska, WebM, MP4, MOV, AVI or GIF file ends before its outermost structure does.

    Other formats, and live recordings that state no size, are never reported.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if head.startswith(_EBML_HEADER):
            return _end(file, size, _matroska_length) > size
        if head.startswith(b"RIFF"):
            return _end(file, size, _riff_length) > size + _RIFF_SLACK
        if head[4:8] in _MP4_BOXES:
            return _end(file, size, _mp4_length) > size
        if head.startswith(b"GIF8"):
            file.seek(max(0, size - 256))
            return not file.read().rstrip(b"\0").endswith(b";")
    return False


def ffv1_slices_intact(packet: bytes) -> bool | None:
    """Whether all slices of an FFV1 frame (version 3) pass their checksums; None where there are no checksums."""
    end, intact = len(packet), True
    while end > 0:
        # Every slice ends with its size without this footer (3 bytes), an error status (1) and the checksum (4).
        start = end - 8 - int.from_bytes(packet[max(0, end - 8) : max(0, end - 5)], "big")
        if end < 8 or start < 0:
            return None
        # The CRC of data and checksum together is 0; zlib inverts it before and after.
        intact = intact and zlib.crc32(packet[start:end].translate(_REVERSED_BITS), 0xFFFFFFFF) == 0xFFFFFFFF
        end = start
    return intact


def _end(file: BinaryIO, size: int, length_of: Callable[[bytes, int], int]) -> int:
    """Where the last of the outermost elements ends; ``length_of`` is 0 for what other programs have appended."""
    position = 0
    while position < size:
        file.seek(position)
        length = length_of(file.read(16), size - position)
        if length == 0:
            break
        position += length
    return position


def _matroska_length(head: bytes, left: int) -> int:
    width = 9 - head[4].bit_length() if len(head) > 4 else 9
    field = head[4 : 4 + width]
    if not head.startswith((_EBML_HEADER, _MATROSKA_SEGMENT)) or width > 8 or len(field) < width:
        return 0
    unknown = (1 << 7 * width) - 1
    content = int.from_bytes(field, "big") & unknown
    # A live recording does not know its size.
    return 0 if content == unknown else 4 + width + content


def _riff_length(head: bytes, left: int) -> int:
    length = int.from_bytes(head[4:8], "little")
    return 8 + length + length % 2 if head.startswith(b"RIFF") and length else 0


def _mp4_length(head: bytes, left: int) -> int:
    length = int.from_bytes(head[:4], "big")
    if head[4:8] not in _MP4_BOXES and length > left:
        return 0
    if length == 1:
        length = int.from_bytes(head[8:], "big")
    # A box of length 0 goes to the end of the file.
    return length if length >= 8 else 0


def ends_early(times: NDArray[np.float64] | None, last: float, duration: float) -> bool:
    """Whether another frame should follow the one at ``last`` seconds, judged by the longest interval."""
    if times is None or len(times) < 2:
        return False
    return last < duration - 1.5 * float(np.diff(times).max())


def varies_in_time(times: NDArray[np.float64], tick: float) -> bool:
    """Whether frame intervals differ by more than the rounding to the clock of the file, ``tick`` seconds."""
    if len(times) < 3:
        return False
    intervals = np.diff(times)
    return bool(np.ptp(intervals) > max(2.5 * tick, 0.05 * float(np.median(intervals))))

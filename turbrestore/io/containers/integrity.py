"""Damage that decoders do not report: files that are cut short, and FFV1 slices whose checksum fails.

A truncated Matroska file decodes without complaint to fewer frames. The outermost element of every container states its
own size, which is compared with the size of the file.

FFV1 can store a checksum for each slice (CRC-32, polynomial 0x04C11DB7, most significant bit first, start 0; RFC 9043,
sections 4.3 and 4.9), and the decoder only logs a mismatch. zlib computes the same CRC-32 in the opposite bit order, so
it is applied to bit-reversed bytes.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_REVERSED_BITS = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_EBML_HEADER, _MATROSKA_SEGMENT = b"\x1aE\xdf\xa3", b"\x18S\x80g"
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"moof", b"mfra", b"wide", b"free", b"skip", b"pnot", b"styp", b"sidx")
# Some writers include the RIFF header in a size that should exclude it.
_RIFF_SLACK = 16


def is_cut_short(path: Path) -> bool:
    """Whether a Matroska, WebM, MP4, MOV, AVI or GIF file ends before its outermost structure does.

    Other formats, and live recordings that state no size, are never reported.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if head.startswith(_EBML_HEADER):
            return _matroska_end(file, size) > size
        if head.startswith(b"RIFF"):
            return _riff_end(file, size) > size + _RIFF_SLACK
        if head[4:8] in _MP4_BOXES:
            return _mp4_end(file, size) > size
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


def _matroska_end(file: BinaryIO, size: int) -> int:
    position = 0
    while position < size:
        file.seek(position)
        head = file.read(12)
        # Other programs may append data after the Matroska structure.
        if not head.startswith((_EBML_HEADER, _MATROSKA_SEGMENT)) or len(head) < 5:
            break
        length = 9 - head[4].bit_length()
        field = head[4 : 4 + length]
        if length > 8 or len(field) < length:
            break
        content = int.from_bytes(field, "big") & ((1 << 7 * length) - 1)
        if content == (1 << 7 * length) - 1:
            break  # all ones: a live recording of unknown size
        position += 4 + length + content
    return position


def _riff_end(file: BinaryIO, size: int) -> int:
    position = 0
    while position + 8 <= size:
        file.seek(position)
        tag, length = file.read(4), int.from_bytes(file.read(4), "little")
        if tag != b"RIFF" or length == 0:
            break
        position += 8 + length + length % 2
    return position


def _mp4_end(file: BinaryIO, size: int) -> int:
    position = 0
    while position + 8 <= size:
        file.seek(position)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if head[4:8] not in _MP4_BOXES and position + length > size:
            break  # appended by other programs
        if length == 1:
            length = int.from_bytes(head[8:], "big")
        if length < 8:
            break  # 0: to the end of the file
        position += length
    return position


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

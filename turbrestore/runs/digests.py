"""Checksums of files and of what a video holds."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np

from ..io.folders import frame_files
from ..io.limits import input_errors
from ..io.source import FrameSource

# Larger files are sampled, to save time: so many bytes, in so many pieces; all chosen.
_WHOLE, _PIECE, _PIECES = 4 << 30, 1 << 16, 1024


def content_digest(source: FrameSource) -> str:
    """Checksum of what a video holds, wherever it lies and whatever its time stamps say."""
    found = hashlib.blake2b(digest_size=16)
    if source.path is None:
        for frame in source.pixels(source.numbers):
            found.update(np.ascontiguousarray(frame).tobytes())
        return found.hexdigest()
    with input_errors(source.path):
        if not source.path.is_dir():
            return file_digest(source.path)
        for path in sorted(frame_files(source.path)):
            # Names are bytes on most systems, and need not be text.
            found.update(os.fsencode(path.name) + f"\0{file_digest(path)}\n".encode())
    return found.hexdigest()


def file_digest(path: Path) -> str:
    """Checksum of a file; of a very large one, of its size, time stamp and pieces."""
    found = hashlib.blake2b(digest_size=16)
    with path.open("rb") as stream:
        status = os.fstat(stream.fileno())
        if status.st_size <= _WHOLE:
            hashlib.file_digest(stream, lambda: found)
            return found.hexdigest()
        found.update(f"{status.st_size} {status.st_mtime_ns}".encode())
        for start in np.linspace(0, status.st_size - _PIECE, _PIECES).astype(np.int64):
            stream.seek(int(start))
            found.update(stream.read(_PIECE))
    return found.hexdigest()

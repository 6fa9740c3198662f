"""What is checked before an input is read: its kind and size, and how the errors of reading it are reported."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import DataError, InputNotFoundError, StorageError, TurbrestoreError, require
from .pixels import MAX_PIXELS

_NOT_FILES = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
# Where the first bytes of a file have a mark, and the suffix of the format that has it.
_SIGNATURES = (
    (0, b"\x89PNG\r\n", ".png"),
    (0, b"\xff\xd8\xff", ".jpg"),
    (0, b"II*\0", ".tif"),
    (0, b"MM\0*", ".tif"),
    (0, b"II+\0", ".tif"),
    (0, b"MM\0+", ".tif"),
    (0, b"\x93NUMPY", ".npy"),
    (0, b"LUCAM-RECORDER", ".ser"),
    (0, b"SIMPLE  =", ".fits"),
    (0, b"GIF8", ".gif"),
    (0, b"\x1aE\xdf\xa3", ".mkv"),
    (8, b"WEBP", ".webp"),
    (8, b"AVI ", ".avi"),
    (0, b"v/1\x01", ".exr"),
    (0, b"SDPX", ".dpx"),
    (0, b"XPDS", ".dpx"),
    (4, b"JXL ", ".jxl"),
    (4, b"jP  ", ".jp2"),
    (0, b"\xff\x4f\xff\x51", ".j2k"),
)


@dataclass(frozen=True)
class Limits:
    """Largest input that is read; headers are checked against it before anything is decoded.

    Parameters
    ----------
    max_pixels : int
        Pixels of a frame or image.
    max_frames : int
        Frames of a video.
    max_bytes : int
        Bytes of files that are loaded as a whole: still images, animations, flows and stage files.

    Raises
    ------
    ConfigurationError
        A limit is not a whole number of at least 1.

    Examples
    --------
    >>> Limits(max_pixels=100).check_size(20, 6, "a.png")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.DataError: a.png: expected up to 100 pixels, found 20×6; raise max-pixels if that is right
    """

    max_pixels: int = MAX_PIXELS
    max_frames: int = 1_000_000
    max_bytes: int = 2**31

    def __post_init__(self) -> None:
        for name in ("max_pixels", "max_frames", "max_bytes"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            require(whole and value >= 1, f"{name}: expected a whole number from 1, found {value}")

    def check_size(self, width: int, height: int, name: str) -> None:
        """Raise DataError where the frame size in a header is empty or too large; ``name`` is the file."""
        if width < 1 or height < 1:
            raise DataError(
                f"{name}: expected a width and height in pixels, found {width}×{height}; the file is damaged"
            )
        if width * height > self.max_pixels:
            raise DataError(
                f"{name}: expected up to {self.max_pixels} pixels, found {width}×{height}; "
                "raise max-pixels if that is right"
            )

    def check_count(self, frames: int, name: str) -> None:
        """Raise DataError where a header states, or a reader has counted, too many frames."""
        if frames > self.max_frames:
            raise DataError(f"{name}: expected up to {self.max_frames} frames, found {frames} or more; cut the video")

    def check_bytes(self, size: int, name: str) -> None:
        """Raise DataError where a file is too large to be loaded as a whole."""
        if size > self.max_bytes:
            raise DataError(f"{name}: expected up to {self.max_bytes} bytes to load at once, found {size}")


DEFAULT_LIMITS = Limits()


@contextmanager
def input_errors(path: Path) -> Iterator[None]:
    """Turn system errors while reading ``path`` into InputNotFoundError or StorageError."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputNotFoundError(f"{path}: no such file or folder") from error
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror or error})") from error


@contextmanager
def format_errors(name: Path | str, problem: str, remedy: str = "") -> Iterator[None]:
    """Turn the exceptions of a library about the content of a file into DataError; system errors are left alone.

    The message names the file, or a frame of it, and says what the problem is and, after the words of the library,
    what to do.
    """
    try:
        yield
    except (TurbrestoreError, OSError):
        raise
    except Exception as error:  # NumPy, zipfile and tifffile document no closed list of exceptions for damaged files
        raise DataError(f"{name}: {problem} ({first_line(error)}){remedy and f'; {remedy}'}") from error


def check_input(path: Path) -> os.stat_result:
    """Return the status of a file or folder, and raise DataError for a pipe, a socket or a device.

    A pipe would wait for a writer, and a device may have no end. A symbolic link is followed; a path that does not
    exist or cannot be accessed raises InputNotFoundError or StorageError.
    """
    with input_errors(path):
        status = path.stat()
    kind = _NOT_FILES.get(stat.S_IFMT(status.st_mode))
    if kind is not None:
        raise DataError(f"{path}: expected a file, found {kind}; copy its content to a file")
    return status


def content_suffix(head: bytes) -> str | None:
    """Suffix of the format that the first bytes of a file tell; None where they tell none."""
    if head[4:8] == b"ftyp":
        # The brand of the file, and those that it is compatible with.
        brands = head[8 : min(64, int.from_bytes(head[:4], "big"))]
        still = brands[:4] in (b"mif1", b"avif", b"heic", b"heix", b"heim", b"heis")
        return (".avif" if b"avif" in brands else ".heic") if still else ".mp4"
    return next((suffix for start, mark, suffix in _SIGNATURES if head.startswith(mark, start)), None)


def first_line(error: BaseException) -> str:
    """First line of an error's message, because messages of turbrestore have one line."""
    # The message of a LookupError is only the key.
    lines = [] if isinstance(error, LookupError) else str(error).splitlines()
    return (lines or [type(error).__name__])[0]

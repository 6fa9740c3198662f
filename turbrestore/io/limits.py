"""How large an input may be; headers are checked against it before anything is decoded."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.errors import DataError, require
from .pixels import MAX_PIXELS


@dataclass(frozen=True)
class Limits:
    """Largest input that is read.

    Parameters
    ----------
    max_pixels : int
        Pixels a frame or image.
    max_frames : int
        Frames of a video.
    max_bytes : int
        Bytes of what is loaded whole: files of still images, flows and artifacts.

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
        """Refuse a frame size that is empty or too large.

        Parameters
        ----------
        width, height : int
            As the header has them, pixels.
        name : str
            How error messages call the file.

        Raises
        ------
        DataError
            No pixel, or too many.
        """
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
        """Refuse more frames than the limit.

        Parameters
        ----------
        frames : int
            As the header has them, or counted so far.
        name : str
            How error messages call the file.

        Raises
        ------
        DataError
            Too many.
        """
        if frames > self.max_frames:
            raise DataError(f"{name}: expected up to {self.max_frames} frames, found {frames} or more; cut the video")

    def check_bytes(self, size: int, name: str) -> None:
        """Refuse to load more bytes than the limit.

        Parameters
        ----------
        size : int
            Bytes.
        name : str
            How error messages call the file.

        Raises
        ------
        DataError
            Too many.
        """
        if size > self.max_bytes:
            raise DataError(f"{name}: expected up to {self.max_bytes} bytes to load at once, found {size}")


DEFAULT_LIMITS = Limits()

"""Writing video files through PyAV: FFV1 in Matroska without loss, H.264 in MP4 for viewing."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, cast

from ..core.arrays import FloatArray, from_unit
from ..core.errors import DataError, StorageError, require
from .container import convert
from .images import atomic_output
from .pixels import check_depth
from .source import size_text

if TYPE_CHECKING:
    import av

# The same frames give the same bytes: without this, Matroska numbers its segment and tracks at random.
_WRITE_OPTIONS = {"fflags": "+bitexact"}
_GREY_DEPTHS = {8: "gray", 10: "gray10le", 12: "gray12le", 14: "gray14le", 16: "gray16le"}
_RGB_DEPTHS = {8: "bgr0", 10: "gbrp10le", 12: "gbrp12le", 14: "gbrp14le", 16: "gbrp16le"}


@dataclass(frozen=True)
class _Recipe:
    """How to encode a video; ``settings`` gives the pixel format and the codec's options for a frame's shape."""

    container: str
    codec: str
    settings: Callable[[tuple[int, ...]], tuple[str, dict[str, str]]]


def write_mkv(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    fps: float,
    bit_depth: int = 8,
    overwrite: bool = False,
) -> None:
    """Write frames without loss: FFV1 version 3 with checksums, in Matroska; the same frames give the same bytes.

    Parameters
    ----------
    path : path-like
        The file to be written.
    frames : iterable of ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities; values outside [0, 1] are clipped.
    fps : float
        Frames per second, at most 1000: Matroska counts milliseconds.
    bit_depth : int
        1 to 16, written as the next of 8, 10, 12, 14, 16 and scaled to its full range; 32 is written as 16.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Unsupported bit depth or frame rate.
    DataError
        No frames, or frames of two sizes.
    OutputError, StorageError
        The file cannot be created or completed.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from turbrestore.io.container import open_container
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mkv(folder + "/a.mkv", [np.full((1, 2), 0.2, np.float32)], fps=25)
    ...     open_container(folder + "/a.mkv").read()
    array([[[0.2, 0.2]]], dtype=float32)
    """
    depth = min(step for step in _GREY_DEPTHS if step >= min(check_depth(bit_depth), 16))

    def settings(shape: tuple[int, ...]) -> tuple[str, dict[str, str]]:
        # Keyframes only: a frame is decoded without its neighbours, and damage stays in one frame. A fixed number of
        # slices gives the same file on every machine; four need two rows and two columns.
        slices = "4" if min(shape[:2]) > 1 else "1"
        kind = (_GREY_DEPTHS if len(shape) == 2 else _RGB_DEPTHS)[depth]
        return kind, {"level": "3", "slicecrc": "1", "g": "1", "slices": slices}

    _encode(path, frames, _check_rate(fps, 1000), depth, _Recipe("matroska", "ffv1", settings), overwrite)


def write_mp4(path: str | os.PathLike[str], frames: Iterable[FloatArray], fps: float, overwrite: bool = False) -> None:
    """Write frames for viewing: H.264 of 8 bits in MP4, with loss.

    Parameters
    ----------
    path : path-like
        The file to be written.
    frames : iterable of ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities; values outside [0, 1] are clipped. Grey becomes RGB.
    fps : float
        Frames per second.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Unsupported frame rate, or this FFmpeg has no H.264 encoder.
    DataError
        No frames, or frames of two sizes.
    OutputError, StorageError
        The file cannot be created or completed.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from turbrestore.io.container import open_container
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mp4(folder + "/a.mp4", [np.zeros((4, 6), np.float32)] * 3, fps=25)
    ...     open_container(folder + "/a.mp4").shape
    (3, 4, 6, 3)
    """
    import av

    require("libx264" in av.codecs_available, f"{path}: no H.264 encoder is available; write .mkv")

    def settings(shape: tuple[int, ...]) -> tuple[str, dict[str, str]]:
        # Halved colour resolution, which every player knows, needs even sizes.
        return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p", {"crf": "14"}

    _encode(path, frames, _check_rate(fps, 10000), 8, _Recipe("mp4", "libx264", settings), overwrite)


def _encode(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    rate: Fraction,
    depth: int,
    recipe: _Recipe,
    overwrite: bool,
) -> None:
    import av

    with atomic_output(path, overwrite) as temporary, _encoding(path):
        iterator = iter(frames)
        first = next(iterator, None)
        if first is None:
            raise DataError(f"{path}: expected at least one frame, found none")
        name = f"file:{temporary}"
        with av.open(name, "w", format=recipe.container, container_options=dict(_WRITE_OPTIONS)) as output:
            pixel_format, options = recipe.settings(first.shape)
            stream = cast("av.VideoStream", output.add_stream(recipe.codec, rate=rate, options=options))
            stream.height, stream.width = first.shape[:2]
            stream.pix_fmt = pixel_format
            for number, frame in enumerate(itertools.chain([first], iterator)):
                if frame.shape != first.shape:
                    expected, found = size_text(first.shape), size_text(frame.shape)
                    raise DataError(f"{path}: frame {number}: expected {expected}, found {found}")
                picture = convert(_picture(frame, depth), pixel_format)
                picture.pts, picture.time_base = number, 1 / rate
                output.mux(stream.encode(picture))
            output.mux(stream.encode(None))


def _picture(frame: FloatArray, depth: int) -> av.VideoFrame:
    import av

    kind = _GREY_DEPTHS[depth] if frame.ndim == 2 else "rgb24" if depth == 8 else _RGB_DEPTHS[depth]
    return av.VideoFrame.from_ndarray(from_unit(frame, depth), format=kind)


def _check_rate(fps: float, limit: int) -> Fraction:
    require(0 < fps <= limit, f"fps: expected more than 0 and at most {limit} frames per second, found {fps}")
    # Keeps 30000/1001 and its like exact.
    return Fraction(fps).limit_denominator(1001)


@contextmanager
def _encoding(path: str | os.PathLike[str]) -> Iterator[None]:
    import av

    try:
        yield
    except av.error.FFmpegError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror}); nothing was saved") from error

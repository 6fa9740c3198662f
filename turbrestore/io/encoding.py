"""Writing of video files through PyAV: lossless FFV1 in Matroska, H.264 in MP4 for viewing."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, cast

from ..core.arrays import FloatArray, from_unit
from ..core.errors import StorageError, require
from .container import convert
from .output import atomic_output, frames_of_one_size
from .pixels import check_depth

if TYPE_CHECKING:
    import av

# Without this option Matroska numbers its segment and tracks at random; with it the same frames give the same bytes.
_WRITE_OPTIONS = {"fflags": "+bitexact"}
_GREY_DEPTHS = {8: "gray", 10: "gray10le", 12: "gray12le", 14: "gray14le", 16: "gray16le"}
_RGB_DEPTHS = {8: "bgr0", 10: "gbrp10le", 12: "gbrp12le", 14: "gbrp14le", 16: "gbrp16le"}


@dataclass(frozen=True)
class _Format:
    """How to encode a video; ``settings`` returns pixel format and codec options for the shape of a frame."""

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
    """Write frames losslessly: FFV1 version 3 with checksums, in Matroska; the same frames give the same bytes.

    Parameters
    ----------
    path : path-like
        The file that is written.
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
        # With keyframes only, every frame is decoded without its neighbours and damage stays in one frame. A fixed
        # number of slices gives the same file on every machine; four slices need two rows and two columns.
        slices = "4" if min(shape[:2]) > 1 else "1"
        kind = (_GREY_DEPTHS if len(shape) == 2 else _RGB_DEPTHS)[depth]
        return kind, {"level": "3", "slicecrc": "1", "g": "1", "slices": slices}

    _encode(path, frames, _check_rate(fps, 1000), depth, _Format("matroska", "ffv1", settings), overwrite)


def write_mp4(path: str | os.PathLike[str], frames: Iterable[FloatArray], fps: float, overwrite: bool = False) -> None:
    """Write frames for viewing: lossy H.264 of 8 bits in MP4.

    Parameters
    ----------
    path : path-like
        The file that is written.
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
        # Every player supports halved colour resolution, which needs even sizes.
        return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p", {"crf": "14"}

    _encode(path, frames, _check_rate(fps, 10000), 8, _Format("mp4", "libx264", settings), overwrite)


def _encode(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    rate: Fraction,
    depth: int,
    video_format: _Format,
    overwrite: bool,
) -> None:
    import av

    with atomic_output(path, overwrite) as temporary, _encoding(path):
        iterator = frames_of_one_size(frames, path)
        first = next(iterator)
        name = f"file:{temporary}"
        with av.open(name, "w", format=video_format.container, container_options=dict(_WRITE_OPTIONS)) as output:
            pixel_format, options = video_format.settings(first.shape)
            stream = cast("av.VideoStream", output.add_stream(video_format.codec, rate=rate, options=options))
            stream.height, stream.width = first.shape[:2]
            stream.pix_fmt = pixel_format
            for number, frame in enumerate(itertools.chain([first], iterator)):
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
    # Rates such as 30000/1001 stay exact.
    return Fraction(fps).limit_denominator(1001)


@contextmanager
def _encoding(path: str | os.PathLike[str]) -> Iterator[None]:
    import av

    try:
        yield
    except av.error.FFmpegError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror}); nothing was saved") from error

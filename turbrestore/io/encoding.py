"""Writing of video files through PyAV: lossless FFV1 in Matroska, H.264 in MP4 for viewing."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
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
# Matroska counts milliseconds.
_MOST_FRAMES_PER_SECOND = {".mkv": 1000, ".mp4": 10000}


def write_container(
    path: Path, frames: Iterable[FloatArray], fps: float, bit_depth: int = 8, overwrite: bool = False
) -> None:
    """Write frames as ``.mkv`` (lossless FFV1 version 3 with checksums) or ``.mp4`` (lossy H.264, RGB of 8 bits).

    In a ``.mkv`` file the depth is the next of 8, 10, 12, 14 and 16 bits, and values fill its range; 32 is written as
    16 bits. The same frames give the same bytes.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from turbrestore.io.container import open_container
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_container(Path(folder, "a.mkv"), [np.full((1, 2), 0.2, np.float32)], fps=25)
    ...     open_container(Path(folder, "a.mkv")).read()
    array([[[0.2, 0.2]]], dtype=float32)
    """
    import av

    suffix = path.suffix.lower()
    limit = _MOST_FRAMES_PER_SECOND[suffix]
    require(0 < fps <= limit, f"fps: expected more than 0 and at most {limit} frames per second, found {fps}")
    # Rates such as 30000/1001 stay exact.
    rate = Fraction(fps).limit_denominator(1001)
    depth = min(step for step in _GREY_DEPTHS if step >= min(check_depth(bit_depth), 16)) if suffix == ".mkv" else 8
    require(suffix == ".mkv" or "libx264" in av.codecs_available, f"{path}: no H.264 encoder here; write .mkv")
    with atomic_output(path, overwrite) as temporary, _encoding(path):
        iterator = frames_of_one_size(frames, path)
        first = next(iterator)
        container, codec, pixel_format, options = (_ffv1 if suffix == ".mkv" else _h264)(first.shape, depth)
        with av.open(f"file:{temporary}", "w", format=container, container_options=dict(_WRITE_OPTIONS)) as output:
            stream = cast("av.VideoStream", output.add_stream(codec, rate=rate, options=options))
            stream.height, stream.width = first.shape[:2]
            stream.pix_fmt = pixel_format
            for number, frame in enumerate(itertools.chain([first], iterator)):
                picture = convert(_picture(frame, depth), pixel_format)
                picture.pts, picture.time_base = number, 1 / rate
                output.mux(stream.encode(picture))
            output.mux(stream.encode(None))


def _ffv1(shape: tuple[int, ...], depth: int) -> tuple[str, str, str, dict[str, str]]:
    # With keyframes only, every frame is decoded without its neighbours and damage stays in one frame. A fixed number
    # of slices gives the same file on every machine; four slices need two rows and two columns.
    options = {"level": "3", "slicecrc": "1", "g": "1", "slices": "4" if min(shape[:2]) > 1 else "1"}
    return "matroska", "ffv1", (_GREY_DEPTHS if len(shape) == 2 else _RGB_DEPTHS)[depth], options


def _h264(shape: tuple[int, ...], _: int) -> tuple[str, str, str, dict[str, str]]:
    # Every player supports halved colour resolution, which needs even sizes.
    return "mp4", "libx264", "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p", {"crf": "14"}


def _picture(frame: FloatArray, depth: int) -> av.VideoFrame:
    import av

    kind = _GREY_DEPTHS[depth] if frame.ndim == 2 else "rgb24" if depth == 8 else _RGB_DEPTHS[depth]
    return av.VideoFrame.from_ndarray(from_unit(frame, depth), format=kind)


@contextmanager
def _encoding(path: Path) -> Iterator[None]:
    import av

    try:
        yield
    except av.error.FFmpegError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror}); nothing was saved") from error

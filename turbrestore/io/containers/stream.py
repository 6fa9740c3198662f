"""Frames that come one by one, and only once: pipes, cameras and other iterators.

Neither their number is known nor can they be looked through beforehand, so what needs all frames of a video, such as
the search for damaged frames, is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, BinaryIO, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ...core.arrays import FloatArray, from_unit
from ...core.errors import DataError, StorageError
from ..limits import DEFAULT_LIMITS, Limits
from ..output import frames_of_one_size, size_text
from ..pixels import PixelArray, full_scale_of, to_unit
from .decoding import OPEN_OPTIONS
from .pixel_formats import convert, native_format


@runtime_checkable
class Capture(Protocol):
    """Source of frames such as ``cv2.VideoCapture``: ``read()`` returns whether there is a frame, and its pixels."""

    def read(self) -> tuple[bool, Any]:
        """Return the next frame, in OpenCV's order of channels, blue, green, red."""


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Frames that can be iterated over once."""

    name: str  # for messages
    shape: tuple[int, ...]  # (H, W) or (H, W, 3) of a frame
    bit_depth: int  # bits per channel of the source
    fps: float | None  # frames per second
    frames: Iterator[FloatArray] = field(repr=False)  # intensities in [0, 1]


def open_pipe(file: BinaryIO, name: str = "standard input", limits: Limits = DEFAULT_LIMITS) -> FrameStream:
    """Read video from a pipe: Matroska, YUV4MPEG2, NUT or MPEG-TS."""
    import av

    try:
        # The container stays open as long as its frames are read.
        container = av.open(file, "r", container_options=dict(OPEN_OPTIONS))
        if not container.streams.video:
            raise DataError(f"{name}: expected a video stream, found none")
        stream = container.streams.video[0]
        limits.check_size(stream.width, stream.height, name)
        decoded = container.decode(stream)
        first = next(decoded, None)
    except (av.error.FFmpegError, EOFError) as error:
        reason = getattr(error, "strerror", None) or "it is empty"
        raise DataError(f"{name}: expected video such as Matroska or YUV4MPEG2, cannot read it ({reason})") from error
    if first is None:
        raise DataError(f"{name}: expected at least one frame, found none")
    layout = native_format(name, first.format)
    rate = stream.average_rate or stream.guessed_rate

    def frames() -> Iterator[FloatArray]:
        try:
            for number, frame in enumerate(chain([first], decoded)):
                pixels: PixelArray = convert(frame, layout.target).to_ndarray()
                yield to_unit(pixels, layout.full_scale, f"{name}: frame {number}")
        except av.error.FFmpegError as error:
            raise DataError(f"{name}: a frame cannot be decoded ({error.strerror})") from error

    shape = (first.height, first.width, *layout.channels)
    return FrameStream(name, shape, layout.bit_depth, float(rate) if rate else None, frames())


def open_camera(name: str, limits: Limits = DEFAULT_LIMITS) -> FrameStream:
    """Read from a camera that OpenCV opens, such as ``/dev/video0``; its frames are never older than the newest two."""
    import cv2

    camera = cv2.VideoCapture(name)
    # What is not fetched in time is dropped, instead of waiting in a queue.
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    there, first = camera.read()
    if not there or first is None:
        camera.release()
        raise DataError(f"{name}: expected a camera that OpenCV opens, found none; is it used by another program?")
    limits.check_size(first.shape[1], first.shape[0], name)
    fps = camera.get(cv2.CAP_PROP_FPS)

    def frames() -> Iterator[FloatArray]:
        try:
            yield from live_frames(camera)
        finally:
            camera.release()

    return FrameStream(name, first.shape, 8, fps if fps > 0 else None, frames())


def read_raw(file: BinaryIO, shape: tuple[int, ...], name: str = "standard input") -> Iterator[FloatArray]:
    """Read frames of 8 bits without a container, ``gray`` or ``rgb24`` in FFmpeg's words."""
    size = int(np.prod(shape))
    number = 0
    while data := file.read(size):
        if len(data) < size:
            raise DataError(f"{name}: frame {number}: expected {size} bytes, {size_text(shape)}, found {len(data)}")
        yield to_unit(np.frombuffer(data, np.uint8).reshape(shape), 255, f"{name}: frame {number}")
        number += 1
    if number == 0:
        raise DataError(f"{name}: expected at least one frame, found no data")


def write_raw(file: BinaryIO, frames: Iterable[FloatArray], name: str = "standard output") -> None:
    r"""Write frames of 8 bits without a container; see :func:`read_raw`.

    ``frames`` (H, W) or (H, W, 3) each.
    """
    for frame in frames_of_one_size(frames, name):
        data = from_unit(frame, 8).tobytes()
        try:
            file.write(data)
            file.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            raise StorageError(f"{name}: cannot be written to ({error.strerror or error})") from error


def live_frames(source: Capture | Iterable[ArrayLike]) -> Iterator[FloatArray]:
    """Frames of a camera, or of any iterator of images, as the functions of this package take them.

    Parameters
    ----------
    source : object with ``read()``, or iterable of array_like, shape (H, W) or (H, W, 3)
        ``cv2.VideoCapture`` or alike, whose colours are in the order blue, green, red; or images of unsigned integers,
        scaled by the range of their type, or floating point in [0, 1].

    Yields
    ------
    ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities in [0, 1].

    Raises
    ------
    DataError
        Values out of range, or not finite.

    Examples
    --------
    >>> [float(frame[0, 0]) for frame in live_frames(np.full((2, 1, 1), 51, np.uint8))]
    [0.20000000298023224, 0.20000000298023224]
    """
    images = _captured(source) if isinstance(source, Capture) else source
    for number, image in enumerate(images):
        pixels = np.asanyarray(image)
        yield to_unit(pixels, full_scale_of(pixels.dtype, f"frame {number}"), f"frame {number}")


def _captured(capture: Capture) -> Iterator[PixelArray]:
    while True:
        there, pixels = capture.read()
        if not there:
            return
        yield pixels if pixels.ndim == 2 else pixels[..., ::-1]

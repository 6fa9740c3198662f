"""Writing of video through PyAV: lossless FFV1 in Matroska, H.264 or HEVC for viewing, with the audio of another file.

A player needs the audio near the frames it belongs to, so its packets are copied, without decoding them, between the
frames, up to the time of each.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, from_unit
from ...core.errors import DataError, StorageError, require, require_between
from ..output import atomic_output, frames_of_one_size
from ..pixels import check_depth
from .pixel_formats import FULL_RANGE, RGB, VIDEO_RANGE, convert
from .transfer_curves import BT709, BT2020, CURVES, UNKNOWN

if TYPE_CHECKING:
    import av
    from av.container import OutputContainer

# Without this option Matroska numbers its segment and tracks at random; with it the same packets give the same bytes.
_WRITE_OPTIONS = {"fflags": "+bitexact"}
_GREY_DEPTHS = {8: "gray", 10: "gray10le", 12: "gray12le", 14: "gray14le", 16: "gray16le"}
_RGB_DEPTHS = {8: "bgr0", 10: "gbrp10le", 12: "gbrp12le", 14: "gbrp14le", 16: "gbrp16le"}
# Matroska counts milliseconds; the bound of MP4 was chosen.
_MOST_FRAMES_PER_SECOND = {".mkv": 1000, ".mp4": 10000}
_ENCODERS = {"h264": "libx264", "hevc": "libx265", "ffv1": "ffv1"}
# Constant rate factors where none is given, chosen.
_QUALITY = {"h264": 14, "hevc": 18}
# x265 refuses smaller frames, and damages its memory when it does.
_SMALLEST_HEVC = 16
# x265 needs some frames to compute decoding times of reordered ones, by default up to four in a row; without them it
# takes what its memory holds.
_REORDERED_HEVC = 4
# Ticks a second of frames at irregular times, as in MPEG, and what counts as irregular, in usual intervals, chosen.
_TICKS, _IRREGULAR = 90000, 0.1


@dataclass(frozen=True)
class Encoding:
    """How a video file is compressed."""

    # By default FFV1 for .mkv and H.264 for .mp4; H.264 for .mkv too if ``crf`` is given.
    codec: Literal["h264", "hevc", "ffv1"] | None = None
    # Constant rate factor of H.264 and HEVC, 0 to 51: smaller is better and larger. By default 14 and 18.
    crf: int | None = None

    def __post_init__(self) -> None:
        known = self.codec is None or self.codec in _ENCODERS
        require(known, f"codec: expected one of {', '.join(_ENCODERS)}, found {self.codec!r}")
        if self.crf is not None:
            require_between("crf", self.crf, 0, 51)
            require(self.codec != "ffv1", "crf: has no effect on FFV1, which is lossless; leave it out")

    def codec_of(self, suffix: str) -> str:
        """Codec of a file with this suffix."""
        return self.codec or ("ffv1" if suffix == ".mkv" and self.crf is None else "h264")


BY_SUFFIX = Encoding()


@dataclass(frozen=True, eq=False)
class Soundtrack:
    """File whose audio is copied, and the times of its frames."""

    path: Path
    times: NDArray[np.float64]  # (T,): times of the frames that are written, seconds since the first frame of the file


def write_container(
    path: Path,
    frames: Iterable[FloatArray],
    fps: float,
    bit_depth: int = 8,
    overwrite: bool = False,
    encoding: Encoding = BY_SUFFIX,
    sound: Soundtrack | None = None,
    colour: tuple[int, int] | None = None,
) -> None:
    """Write frames as ``.mkv`` (by default lossless FFV1 version 3 with checksums) or ``.mp4`` (lossy).

    The depth of FFV1 is the next of 8, 10, 12, 14 and 16 bits, that of HEVC 8 or 10 bits, that of H.264 8 bits, which
    every player shows; values fill the range; 32 is written as the largest of them. The same frames give the same
    bytes in FFV1; x264 and x265 may code them differently from one run to the next. The file says how its colours are
    coded: by the matrix of BT.709, or of BT.2020 for HDR, with the primaries and transfer of ``colour``, numbers of
    ITU-T H.273, or those of BT.709.
    """
    import av

    suffix = path.suffix.lower()
    codec = encoding.codec_of(suffix)
    limit = _MOST_FRAMES_PER_SECOND[suffix]
    require(0 < fps <= limit, f"fps: expected more than 0 and at most {limit} frames per second, found {fps}")
    require(suffix == ".mkv" or codec != "ffv1", f"{path}: FFV1 needs Matroska; write .mkv")
    require(_ENCODERS[codec] in av.codecs_available, f"{path}: no {codec} encoder here; write .mkv without a codec")
    with atomic_output(path, overwrite) as temporary, _encoding(path):
        iterator = frames_of_one_size(frames, path)
        # The file is opened once there is a frame.
        ready = itertools.chain([next(iterator)], iterator)
        container = "matroska" if suffix == ".mkv" else "mp4"
        with av.open(f"file:{temporary}", "w", format=container, container_options=dict(_WRITE_OPTIONS)) as output:
            _encode(output, ready, fps, check_depth(bit_depth), codec, encoding.crf, sound, colour)


def write_pipe(file: BinaryIO, frames: Iterable[FloatArray], fps: float, bit_depth: int = 8) -> None:
    r"""Write frames to a pipe as FFV1 in Matroska, each as soon as it is there.

    ``frames`` (H, W) or (H, W, 3) each.
    """
    import av

    sink = _Sink(file)
    with _encoding(Path("standard output"), sink):
        iterator = frames_of_one_size(frames, "standard output")
        ready = itertools.chain([next(iterator)], iterator)
        options = {**_WRITE_OPTIONS, "flush_packets": "1", "cluster_time_limit": "1"}
        with av.open(sink, "w", format="matroska", container_options=options) as output:
            _encode(output, ready, fps, check_depth(bit_depth), "ffv1", None, None, None)


def _encode(
    output: OutputContainer,
    frames: Iterator[FloatArray],
    fps: float,
    bit_depth: int,
    codec: str,
    crf: int | None,
    sound: Soundtrack | None,
    colour: tuple[int, int] | None,
) -> None:
    import av

    first = next(frames)
    # Rates such as 30000/1001 stay exact.
    rate = Fraction(fps).limit_denominator(1001)
    if codec == "hevc" and min(first.shape[:2]) < _SMALLEST_HEVC:
        expected, found = f"{_SMALLEST_HEVC}×{_SMALLEST_HEVC}", f"{first.shape[1]}×{first.shape[0]}"
        raise DataError(f"HEVC: expected frames of at least {expected} pixels, found {found}; choose another codec")
    depth, pixel_format, options = _layout(first.shape, bit_depth, codec, crf)
    native = _GREY_DEPTHS[depth] if first.ndim == 2 else "rgb24" if depth == 8 else _RGB_DEPTHS[depth]
    ahead = [first]
    if codec == "hevc":
        ahead += itertools.islice(frames, _REORDERED_HEVC)
        if len(ahead) <= _REORDERED_HEVC:
            options["x265-params"] += ":bframes=0"
    stream = cast("av.VideoStream", output.add_stream(_ENCODERS[codec], rate=rate, options=options))
    stream.height, stream.width = first.shape[:2]
    stream.pix_fmt = pixel_format
    if codec == "hevc":
        # Players of Apple know HEVC by this tag only.
        stream.codec_context.codec_tag = "hvc1"
    tags = _tag(stream, colour, is_rgb=codec == "ffv1")
    ticks, tick = _ticks(sound, rate)
    if tick != 1 / rate:
        stream.codec_context.time_base = tick
    with _copier(output, sound) as copy_until:
        for number, frame in enumerate(itertools.chain(ahead, frames)):
            whole = av.VideoFrame.from_ndarray(from_unit(frame, depth), format=native)
            picture = convert(whole, pixel_format, *tags)
            picture.pts, picture.time_base = number if ticks is None else ticks[number], tick
            output.mux(stream.encode(picture))
            copy_until(float(picture.pts * tick))
        output.mux(stream.encode(None))


def _layout(shape: tuple[int, ...], bit_depth: int, codec: str, crf: int | None) -> tuple[int, str, dict[str, str]]:
    """Depth, pixel format and options of a codec."""
    if codec == "ffv1":
        depth = min(step for step in _GREY_DEPTHS if step >= min(bit_depth, 16))
        # With keyframes only, every frame is decoded without its neighbours and damage stays in one frame. A fixed
        # number of slices gives the same file on every machine; four slices need two rows and two columns.
        options = {"level": "3", "slicecrc": "1", "g": "1", "slices": "4" if min(shape[:2]) > 1 else "1"}
        return depth, (_GREY_DEPTHS if len(shape) == 2 else _RGB_DEPTHS)[depth], options
    depth = 10 if codec == "hevc" and bit_depth > 8 else 8
    # Every player supports halved colour resolution, which needs even sizes.
    pixel_format = "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"
    options = {"crf": str(_QUALITY[codec] if crf is None else crf)}
    if codec == "hevc":
        # The encoder would tell about itself on standard error.
        options["x265-params"] = "log-level=none"
    return depth, pixel_format + ("10le" if depth == 10 else ""), options


def _tag(stream: av.VideoStream, colour: tuple[int, int] | None, is_rgb: bool) -> tuple[int, int]:
    """Write how colours are coded into the head of a stream; return matrix and range."""
    primaries, transfer = (BT709 if number in (0, UNKNOWN) else number for number in colour or (BT709, BT709))
    matrix = RGB if is_rgb else BT2020 if transfer in CURVES else BT709
    codec = stream.codec_context
    codec.color_primaries, codec.color_trc = primaries, transfer
    codec.colorspace, codec.color_range = matrix, FULL_RANGE if is_rgb else VIDEO_RANGE
    return matrix, int(codec.color_range)


def _ticks(sound: Soundtrack | None, rate: Fraction) -> tuple[list[int] | None, Fraction]:
    """Return times of frames and their unit, seconds; None in place of the times where they are regular."""
    intervals = np.zeros(0) if sound is None else np.diff(sound.times)
    if sound is None or len(intervals) < 2 or np.ptp(intervals) <= _IRREGULAR * float(np.median(intervals)):
        return None, 1 / rate
    return np.rint((sound.times - sound.times[0]) * _TICKS).astype(int).tolist(), Fraction(1, _TICKS)


@contextmanager
def _copier(output: OutputContainer, sound: Soundtrack | None) -> Iterator[Callable[[float], None]]:
    """Provide a function that copies the audio up to a time, as far as the format of the output can hold it."""
    import av

    if sound is None:
        yield lambda _: None
        return
    with av.open(f"file:{sound.path}") as source:
        known = [stream for stream in source.streams.audio if stream.codec.canonical_name in output.supported_codecs]
        copies = {stream.index: output.add_stream_from_template(stream) for stream in known}
        video = source.streams.video[0] if source.streams.video else None
        zero = float((video.start_time or 0) * (video.time_base or 0)) if video is not None else 0.0
        start = zero + float(sound.times[0])
        packets = source.demux(known) if known else iter(())
        held: list[av.Packet] = []

        def copy_until(time: float) -> None:
            while packet := held.pop() if held else next(packets, None):
                if packet.pts is None or packet.dts is None or packet.time_base is None:
                    continue
                if float(packet.pts * packet.time_base) - start > time:
                    held.append(packet)
                    return
                shift = round(start / packet.time_base)
                packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
                if packet.pts >= 0:
                    packet.stream = copies[packet.stream.index]
                    output.mux(packet)

        yield copy_until


class _Sink:
    """File that remembers why it takes no more: FFmpeg reports only that a callback has failed."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.error: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        # Matroska goes back to its head where the file can seek.
        return getattr(self._file, name)

    def write(self, data: bytes) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.error = error
            raise


@contextmanager
def _encoding(path: Path, sink: _Sink | None = None) -> Iterator[None]:
    import av

    try:
        yield
    except av.error.FFmpegError as error:
        if sink is not None and sink.error is not None:
            if isinstance(sink.error, BrokenPipeError):
                raise sink.error from None
            raise StorageError(f"{path}: cannot be written to ({sink.error.strerror})") from error
        raise StorageError(f"{path}: cannot be written ({error.strerror}); nothing was saved") from error

"""Video files (MP4, MOV, Matroska, AVI, MPEG, WMV and others) through PyAV, in their native pixel format.

Grey formats stay grey at their depth, 8-bit colour becomes RGB, and deeper colour 16-bit RGB. Opening a file reads all
packets once without decoding them, which gives the number of frames, their times, and damage that decoders do not
report (:mod:`turbrestore.io.containers.integrity`).  Frames that are marked as interlaced pass FFmpeg's filter bwdif.
Frames are turned upright as the display matrix of the file demands.

Damage within packets of H.264 is found, because its decoder is told not to conceal it, except in the last packet, with
which a recording may have been cut; what decoders of other lossy codecs conceal is not found. FFmpeg converts YUV
colour of more than 8 bits to values up to 0.4 % darker than exact. Grey video is taken as full range, as its decoder
returns it.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from ...core.errors import DataError
from ..limits import Limits, input_errors
from ..pixels import BAYER_REMARK, PixelArray, looks_like_bayer, upright
from ..source import FrameRange, FrameSource, check_cut_short, to_slice
from .integrity import ends_early, ffv1_slices_intact, is_cut_short, varies_in_time
from .pixel_formats import PixelFormat, frame_pixels, has_grey_palette, layout_of
from .surviving import SpoiledEndError, conceal_nothing, decoded, reads_strictly, surviving
from .transfer_curves import BT709, remark_on_curve

if TYPE_CHECKING:
    import av

# FFmpeg tells the formats apart by their content, so further suffixes are read too.
CONTAINER_SUFFIXES = (
    *(".mkv", ".mp4", ".m4v", ".mov", ".webm", ".avi", ".gif", ".mts", ".m2ts", ".ts", ".wmv", ".asf", ".3gp", ".3g2"),
    *(".y4m", ".mpg", ".mpeg", ".m2v", ".vob", ".flv", ".f4v", ".ogv", ".dv", ".mxf", ".ivf", ".nut"),
    *(".h264", ".264", ".avc", ".h265", ".265", ".hevc"),
)
# Without this list FFmpeg would also open playlists, which refer to other files.
OPEN_OPTIONS = {
    "format_whitelist": "matroska,webm,mov,mp4,avi,gif,mpegts,asf,mpeg,mpegvideo,flv,ogg,yuv4mpegpipe,dv,mxf,ivf,nut,"
    "h264,hevc"
}
# Formats with an index, which leads to a frame exactly.
_INDEXED = {"matroska,webm", "mov,mp4,m4a,3gp,3g2,mj2"}
_REMEDY = "copy the file again, select other frames or allow damaged ones to be skipped"
# Codecs whose packets are decoded independently of each other.
_INTRA_CODECS = {"ffv1", "mjpeg", "rawvideo", "png", "huffyuv", "ffvhuff", "utvideo", "prores", "dnxhd"}


@dataclass(frozen=True, eq=False)
class _Scan:
    """What reading all packets has shown."""

    count: int
    intact: int
    keyframes: int
    damaged: tuple[int, ...]
    times: NDArray[np.float64] | None
    tick: float
    last: float
    starts_whole: bool
    stamps: NDArray[np.int64]  # (count,): ascending time stamps, ticks
    entries: tuple[int, ...]  # those of the keyframes; none where they do not lead to a frame
    goes_on: bool = False  # whether a whole keyframe follows the first packet that is lost
    tolerant: bool = False  # whether packets that cannot be decoded are passed over
    strict: bool = False  # whether the decoder is told not to conceal damage

    def entry(self, number: int) -> int | None:
        """Time stamp of the keyframe to begin with for a frame; None for the first."""
        # What follows a keyframe in the file and comes before it in time needs frames before the keyframe.
        place = bisect.bisect_right(self.entries, self.stamps[number]) - 1 if self.entries else 0
        return self.entries[place] if place > 0 else None


def open_container(
    path: Path, frames: FrameRange | None, limits: Limits, skip_damaged: bool, keep_hdr: bool
) -> FrameSource:
    """Open a video file; the errors are those of :func:`turbrestore.io.video.open_frames`.

    ``frames`` is the range that will be selected: damage elsewhere is no error, but the source has all frames. With
    ``skip_damaged`` damaged frames on which no others depend are listed in ``FrameSource.damaged``.
    """
    with input_errors(path):
        cut = is_cut_short(path)
    with input_errors(path), _decoding(path, "it is cut short" if cut else "not a video, or damaged"):
        with _open(path) as container:
            stream = _video_stream(path, container, limits)
            codec, rate = stream.codec_context.name, stream.average_rate or stream.guessed_rate
            duration = _declared_duration(stream)
            frame = next(container.decode(stream), None)
            if frame is None:
                raise DataError(f"{path}: expected at least one frame, found none")
            layout = layout_of(path, frame, keep_hdr)
            notes, interlaced = _notes(frame, layout, stream), frame.interlaced_frame
            size = (frame.height, frame.width)
            notes += remark_on_curve(int(frame.color_trc), {**container.metadata, **stream.metadata}, keep_hdr)
            colour = (int(frame.color_primaries), int(frame.color_trc)) if layout.transfer is None else (BT709, BT709)
            if codec == "rawvideo" and not layout.channels and looks_like_bayer(frame_pixels(frame, layout)):
                notes += (BAYER_REMARK,)
        # The last packet of a file that is cut short spoils only itself.
        strict = codec == "h264" and not cut
        if strict:
            with _open(path) as container:
                strict = reads_strictly(container, _video_stream(path, container, limits, strict))
        scan = replace(_scan(path, cut, limits), strict=strict)
        # A filter for fields looks at the frames before and after.
        intra = codec in _INTRA_CODECS and scan.keyframes == scan.count and not interlaced
        if skip_damaged and not intra and not cut:
            scan = _survivors(path, scan, limits)
        elif not scan.starts_whole:
            # A recording of a transport stream can start anywhere; frames before the first whole one are not decoded.
            scan, missing = _decoded_scan(path, scan, limits)
            text = f"starts in the middle of a group of frames: its first {missing} cannot be decoded"
            notes += (text,) if missing else ()
    cut = cut or scan.intact < scan.count or (duration is not None and ends_early(scan.times, scan.last, duration))
    problem = "damaged" if scan.goes_on else "cut short"
    notes += check_cut_short(path, scan.intact, to_slice(frames).stop, skip_damaged, problem) if cut else ()
    damaged = scan.damaged if scan.tolerant else _check_damage(path, scan, frames, intra, skip_damaged)
    # Frames that are left out make no variable rate.
    varies = scan.times is not None and not scan.tolerant and varies_in_time(scan.times, scan.tick)
    fps = float(rate) if rate else None
    if varies and scan.times is not None:
        fps, notes = (len(scan.times) - 1) / float(scan.times[-1]), (*notes, "variable frame rate")
    return FrameSource(
        name=path.name,
        format=f"{codec}/{layout.name}",
        file_shape=(scan.intact, *(size[::-1] if layout.orientation > 4 else size), *layout.channels),
        full_scale=layout.full_scale,
        bit_depth=layout.bit_depth,
        pixels=lambda chosen: _frames(path, layout, chosen, intra, interlaced, limits, scan),
        path=path,
        fps=fps,
        timestamps=scan.times,
        colour=colour,
        warnings=notes,
        damaged=damaged,
    )


def is_container(path: Path) -> bool:
    """Whether FFmpeg finds a video of a known format in a file, whatever its suffix."""
    import av

    try:
        with input_errors(path), _open(path) as container:
            return container.streams.best("video") is not None
    except (av.error.FFmpegError, ValueError):
        return False


def _open(path: Path) -> av.container.InputContainer:
    import av

    # Without the prefix FFmpeg would take a name with a colon for a URL.
    return av.open(f"file:{path}", options=dict(OPEN_OPTIONS), metadata_errors="replace")


def _video_stream(
    path: Path, container: av.container.InputContainer, limits: Limits, strict: bool = False
) -> av.VideoStream:
    """Open the best video stream; a ``strict`` decoder of H.264 fails where it would conceal damage."""
    import av

    stream = container.streams.best("video")
    if not isinstance(stream, av.VideoStream) or stream.codec_context is None:
        raise DataError(f"{path}: holds no video stream that can be decoded")
    limits.check_size(stream.width, stream.height, str(path))
    # The size in the stream can differ from that in the container.
    options = {"max_pixels": str(min(limits.max_pixels, 2**31 - 1))}
    stream.codec_context.options = options | (conceal_nothing(stream.codec_context) if strict else {})
    return stream


def _notes(frame: av.VideoFrame, layout: PixelFormat, stream: av.VideoStream) -> tuple[str, ...]:
    notes = []
    # GIF frames are always decoded with alpha, which few images use.
    if layout.alpha and stream.codec_context.name != "gif":
        notes.append("alpha channel ignored")
    if frame.interlaced_frame:
        notes.append("interlaced video: the filter bwdif makes a whole frame of the first field of each")
    if frame.rotation % 90:
        notes.append(f"rotation of {frame.rotation} degrees ignored")
    elif layout.orientation > 1:
        notes.append("turned upright as players show it")
    aspect = stream.sample_aspect_ratio or 1
    if aspect > 0 and aspect != 1:
        shape = f"{aspect.numerator}:{aspect.denominator}"
        notes.append(f"pixels of {shape} are taken for square; widen the result by that ratio to see it as players do")
    return tuple(notes)


def _scan(path: Path, cut: bool, limits: Limits) -> _Scan:
    """Read all packets without decoding them."""
    stamps: list[int | None] = []
    entries: list[int | None] = []
    damaged: list[int] = []
    unchecked: list[int] = []
    last, intact, starts_whole, goes_on = 0.0, None, True, False
    with _open(path) as container:
        stream = _video_stream(path, container, limits)
        codec = stream.codec_context.name
        tick, indexed = float(stream.time_base or 0), container.format.name in _INDEXED
        for packet in container.demux(stream):
            # Empty packets end the stream or mark frames that the camera dropped; the edit list of an MP4 file discards
            # packets.
            if packet.size == 0 or packet.is_discard:
                continue
            if packet.is_corrupt and intact is None:
                intact = len(stamps)
            # The gap may have been noticed in the packet before.
            goes_on = goes_on or (packet.is_keyframe and intact is not None and len(stamps) > intact + 1)
            if codec == "ffv1":
                verdict = ffv1_slices_intact(bytes(packet))
                (unchecked if verdict is None else damaged if not verdict else []).append(len(stamps))
            starts_whole = starts_whole and bool(stamps or packet.is_keyframe or codec in _INTRA_CODECS)
            stamps.append(packet.dts if packet.pts is None else packet.pts)
            if packet.is_keyframe:
                entries.append(packet.pts)
            limits.check_count(len(stamps), str(path))
            if stamps[-1] is not None:
                last = max(last, stamps[-1] * tick)
    if not stamps:
        raise DataError(f"{path}: expected at least one frame, found none")
    times, ticks = None, np.zeros(0, np.int64)
    if None not in stamps:
        ticks = np.sort(np.array(stamps, np.int64))
        # Time stamps that are all the same say nothing.
        times = (ticks - ticks[0]) * tick if ticks[-1] > ticks[0] or len(ticks) == 1 else None
    # A packet with a damaged slice size seems to have no checksums; in a stream without checksums all packets do.
    if len(unchecked) < len(stamps):
        damaged = sorted(damaged + unchecked)
    count = len(stamps)
    if intact is None:
        # A truncated last frame of a GIF file is decoded without complaint.
        intact = count - 1 if cut and codec == "gif" else count
    times = None if times is None else times[:intact]
    known = [entry for entry in entries if entry is not None]
    leads = indexed and len(known) == len(entries) and len(ticks) == len(stamps) and np.diff(ticks).all()
    leading = tuple(sorted(known)) if leads else ()
    return _Scan(count, intact, len(entries), tuple(damaged), times, tick, last, starts_whole, ticks, leading, goes_on)


def _survivors(path: Path, scan: _Scan, limits: Limits) -> _Scan:
    """Count frames as a decoder gives them that passes over damage; without damage the scan stays as it is."""
    with _open(path) as container:
        times, damaged = surviving(container, _video_stream(path, container, limits, scan.strict))
    if len(damaged) == len(times):
        raise DataError(f"{path}: expected at least one whole frame, found none")
    if len(times) == scan.count and not damaged:
        return scan
    known = np.isfinite(times)
    filled = np.interp(np.arange(len(times)), np.flatnonzero(known), times[known]) if known.any() else None
    return replace(
        scan,
        count=len(times),
        intact=len(times),
        damaged=damaged,
        times=None if filled is None else filled - filled[0],
        entries=(),
        tolerant=True,
    )


def _decoded_scan(path: Path, scan: _Scan, limits: Limits) -> tuple[_Scan, int]:
    """Count the frames that can be decoded, and those that cannot."""
    stamps: list[float] = []
    with _open(path) as container:
        for frame in container.decode(_video_stream(path, container, limits)):
            if not frame.is_corrupt:
                stamps.append(np.nan if frame.time is None else frame.time)
    if not stamps:
        raise DataError(f"{path}: expected at least one whole frame, found none")
    times = np.sort(stamps) - np.min(stamps)
    count = len(stamps)
    known = times if np.isfinite(times).all() else None
    whole = replace(scan, count=count, intact=count, times=known, entries=())
    return whole, scan.count - count


def _check_damage(path: Path, scan: _Scan, frames: FrameRange | None, intra: bool, skip: bool) -> tuple[int, ...]:
    """Refuse damage in the selected frames; return the numbers of damaged frames that can be skipped."""
    needed = range(scan.intact)[to_slice(frames)]
    if needed and not intra:
        needed = range(needed[-1] + 1)
    bad = [number for number in scan.damaged if number in needed]
    if bad and not (skip and intra):
        more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
        raise DataError(f"{path}: frame {bad[0]}{more}: checksum fails; copy the file again or select other frames")
    return tuple(bad)


def _declared_duration(stream: av.VideoStream) -> float | None:
    """End of the last frame in seconds, from the header of an AVI file or the statistics of Matroska."""
    if stream.container.format.name == "avi":
        return float(stream.frames / stream.average_rate) if stream.frames and stream.average_rate else None
    try:
        hours, minutes, seconds = stream.metadata["DURATION"].split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    except (KeyError, ValueError):
        return None


def _frames(
    path: Path, layout: PixelFormat, chosen: Sequence[int], intra: bool, interlaced: bool, limits: Limits, scan: _Scan
) -> Iterator[PixelArray]:
    import av

    number = chosen[0] - 1 if intra else -1
    wanted = chosen if isinstance(chosen, range) else frozenset(chosen)
    try:
        with input_errors(path), _open(path) as container:
            stream = _video_stream(path, container, limits, scan.strict)
            packets = (packet for packet in container.demux(stream) if packet.size > 0 or packet.dts is None)
            numbers: Iterator[int] = itertools.count()
            if intra:
                # Frames outside the range or between the steps are not decoded.
                numbers = iter(chosen)
                packets = (packet for index, packet in enumerate(packets) if packet.size == 0 or index in wanted)
            frames = decoded(packets, scan.tolerant, scan.strict)
            if interlaced:
                if not scan.tolerant:
                    frames = (_check(path, frame, layout, index) for index, frame in enumerate(frames))
                frames = _deinterlaced(stream, frames)
            elif not intra and (entry := scan.entry(chosen[0])) is not None:
                container.seek(entry, stream=stream)
                if (first := _frame_at(int(scan.stamps[chosen[0]]), frames)) is None:
                    # The index has led somewhere else.
                    yield from _frames(path, layout, chosen, intra, interlaced, limits, replace(scan, entries=()))
                    return
                numbers, frames = itertools.count(chosen[0]), itertools.chain([first], frames)
            for number, frame in zip(numbers, frames, strict=False):
                if number in wanted:
                    whole = frame if interlaced else _check(path, frame, layout, number)
                    yield upright(frame_pixels(whole, layout), layout.orientation)
                if number >= chosen[-1]:
                    return
    except SpoiledEndError:
        left = [later for later in chosen if later > number]
        yield from _frames(path, layout, left, intra, interlaced, limits, replace(scan, strict=False))
    except av.error.FFmpegError as error:
        raise DataError(
            f"{path}: frame {number + 1} or after cannot be decoded ({error.strerror}); {_REMEDY}"
        ) from error


def _frame_at(stamp: int, frames: Iterator[av.VideoFrame]) -> av.VideoFrame | None:
    """Decode up to the frame with a time stamp; None where there is none, or where it lacks others."""
    import av

    with suppress(av.error.FFmpegError, SpoiledEndError):
        for frame in frames:
            if frame.pts is not None and frame.pts >= stamp:
                return None if frame.pts > stamp or frame.is_corrupt else frame
    return None


def _check(path: Path, frame: av.VideoFrame, layout: PixelFormat, number: int) -> av.VideoFrame:
    if frame.is_corrupt:
        raise DataError(f"{path}: frame {number} is damaged; {_REMEDY}")
    if frame.format.name != layout.name or layout.ramp > has_grey_palette(frame):
        raise DataError(f"{path}: frame {number}: expected pixel format {layout.name}, found {frame.format.name}")
    return frame


def _deinterlaced(stream: av.VideoStream, frames: Iterator[av.VideoFrame]) -> Iterator[av.VideoFrame]:
    """Make whole frames, as many as there are: the first field is kept, the other interpolated in space and time."""
    import av

    graph = av.filter.Graph()
    fields = graph.add("bwdif", "mode=send_frame:deint=interlaced")
    graph.link_nodes(graph.add_buffer(template=stream), fields, graph.add("buffersink")).configure()
    for frame in itertools.chain(frames, [None]):
        graph.push(frame)
        # The filter waits for the next frame before it gives one.
        with suppress(av.error.BlockingIOError, av.error.EOFError):
            while True:
                yield cast("av.VideoFrame", graph.pull())


@contextmanager
def _decoding(path: Path, reason: str) -> Iterator[None]:
    import av

    try:
        yield
    except (av.error.FileNotFoundError, av.error.PermissionError):
        raise
    except av.error.FFmpegError as error:
        raise DataError(f"{path}: cannot be opened as a video ({error.strerror}); {reason}") from error

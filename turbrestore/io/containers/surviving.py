"""Frames that survive damage within a stream: from the next key frame on nothing depends on what was lost.

Networks and disks lose packets in the middle of recordings.  The demultiplexer marks a packet as corrupt where it finds
a gap, and the decoder, which is told not to conceal damage, fails or marks its frame; what either misses is not found.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import av


class SpoiledEndError(Exception):
    """The last packet of a stream cannot be decoded: it may have been cut."""


def conceal_nothing(context: av.VideoCodecContext) -> dict[str, str]:
    """Return the options with which a decoder of H.264 fails where it would conceal damage."""
    # Threads for the slices of a frame keep their errors to themselves.  Without them only frames of several slices
    # take longer, those of four slices twice as long.
    context.thread_type = "NONE"
    return {"err_detect": "explode"}


def reads_strictly(container: av.container.InputContainer, stream: av.VideoStream) -> bool:
    """Whether a decoder that conceals nothing reads a stream up to the frame after its first key frame.

    It also refuses odd metadata, and frames before the key frame that refer to others, though nothing is damaged.
    """
    import av

    key = None
    try:
        for packet in container.demux(stream):
            key = packet.pts if key is None else key
            frames: Any = packet.decode()
            if any(frame.pts is None or key is None or frame.pts > key for frame in frames):
                return True
    except av.error.FFmpegError:
        return False
    return True


def decoded(packets: Iterable[av.Packet], tolerant: bool, strict: bool) -> Iterator[av.VideoFrame]:
    """Decode packets one after the other; ``tolerant`` passes over those that cannot be decoded.

    Raises SpoiledEndError where a ``strict`` decoder refuses the last packet only.
    """
    import av

    for packet, following in itertools.pairwise(itertools.chain(packets, [None])):
        assert packet is not None
        try:
            frames: Any = packet.decode()
        except av.error.FFmpegError as error:
            if tolerant:
                continue
            if strict and (following is None or following.size == 0):
                raise SpoiledEndError from error
            raise
        yield from frames


def surviving(
    container: av.container.InputContainer, stream: av.VideoStream
) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Decode a whole stream; return the times of its frames in seconds, and the numbers of those that are damaged.

    A gap is noticed in the packet before it, so the packet after it is taken for damaged too.
    """
    import av
    from av.codec.context import Flags

    # A frame then names the packet that it comes from; decoding reorders them.
    stream.codec_context.flags |= Flags.copy_opaque
    times: list[float] = []
    origins: list[int] = []
    keys: list[int] = []
    lost: set[int] = set()
    count = 0
    for packet in container.demux(stream):
        if packet.size > 0:
            packet.opaque = count
            lost.update((count, count + 1) if packet.is_corrupt else ())
            keys += [count] if packet.is_keyframe else []
            count += 1
        elif packet.dts is not None:
            continue
        try:
            frames: Any = packet.decode()
        except av.error.FFmpegError:
            lost.add(count - 1)
            continue
        for frame in frames:
            times.append(np.nan if frame.time is None else frame.time)
            origins.append(frame.opaque)
            lost.update([frame.opaque] if frame.is_corrupt else ())
    dependent = np.zeros(count + 1, bool)
    for number in lost:
        # An intact key frame ends what a loss has spoiled.
        dependent[number : next((key for key in keys if key > number and key not in lost), count)] = True
    return np.array(times), tuple(np.flatnonzero(dependent[origins]).tolist())

"""Video files for tests, made by PyAV alone."""

import tracemalloc
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile

from turbrestore.io.video import open_frames

RATE = Fraction(30)


def scene(count=12, height=48, width=64, seed=0):
    """Smooth moving colours with a little noise, uint8 RGB: compressible, yet every frame differs."""
    y, x = np.mgrid[:height, :width]
    rng = np.random.default_rng(seed)
    waves = [np.stack([np.sin((x + 2 * k) / 9), np.cos(y / 7), np.sin((x + y) / 11)], -1) for k in range(count)]
    return [np.clip(128 + 80 * wave + rng.normal(0, 3, wave.shape), 0, 255).astype(np.uint8) for wave in waves]


def encode(path, frames, codec="ffv1", pixel_format="gray", kind=None, stamps=None, muxer=None, **options):
    """Encode arrays of pixel format ``kind`` as they are, by PyAV alone."""
    container_options = options.pop("container_options", {})
    stamps = range(len(frames)) if stamps is None else stamps
    with av.open(str(path), "w", format=muxer, options=container_options) as output:
        stream = output.add_stream(codec, rate=RATE, options={k.replace("_", "-"): v for k, v in options.items()})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixel_format
        for stamp, pixels in zip(stamps, frames, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=kind or pixel_format)
            if frame.format.name != pixel_format:
                frame = frame.reformat(format=pixel_format)
            frame.pts, frame.time_base = stamp, 1 / RATE
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return Path(path)


def grey_ffv1(path, frames=None, **options):
    frames = [frame[..., 0] for frame in scene()] if frames is None else frames
    return encode(path, frames, level="3", slicecrc="1", **options)


@contextmanager
def refusal(error, *words):
    """What is done here fails with one line that holds the words."""
    with pytest.raises(error) as info:
        yield info
    message = str(info.value)
    assert "\n" not in message and all(word in message for word in words), message


def refused(path, error, *words, **options):
    """Opening and reading fails with one line that holds the words; returns the exit code."""
    with refusal(error, *words) as info:
        for _ in open_frames(path, **options):
            pass
    return info.value.exit_code


@contextmanager
def memory_below(limit):
    """What is done here takes fewer bytes than the limit at any time."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit


def packets(path):
    """Place in the file and bytes of every packet."""
    with av.open(str(path)) as container:
        return [(packet.pos, bytes(packet)) for packet in container.demux(video=0) if packet.size]


def write_pages(path, pages, big=False, **options):
    """A TIFF file whose pages stand each by itself."""
    with tifffile.TiffWriter(path, bigtiff=big) as tiff:
        for page in pages:
            tiff.write(page, contiguous=False, metadata=None, **options)
    return path


def cuts(path, *shares):
    """A file with shares of its bytes, one after the other."""
    data = path.read_bytes()
    for share in shares:
        path.write_bytes(data[: int(share * len(data))])
        yield path


def encode_yuv(path, planes):
    """Encode one frame whose planes are given below each other, 2/3 of the rows luma."""
    with av.open(str(path), "w") as output:
        stream = output.add_stream("ffv1", rate=RATE)
        stream.height, stream.width, stream.pix_fmt = planes.shape[0] * 2 // 3, planes.shape[1], "yuv420p"
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = 0
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return Path(path)


def gif(folder, frames):
    import PIL.Image

    images = [PIL.Image.fromarray(frame) for frame in frames]
    images[0].save(folder / "a.gif", save_all=True, append_images=images[1:], duration=40)
    return folder / "a.gif"

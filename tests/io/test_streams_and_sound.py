"""Pipes, iterators, codecs, and the audio and time stamps of another file."""

import io
from fractions import Fraction

import av
import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.containers.encoding import Encoding, write_container, write_pipe
from turbrestore.io.containers.stream import live_frames, open_pipe, read_raw, write_raw
from turbrestore.io.video import open_frames, write_video

PIXELS = np.random.default_rng(0).integers(0, 256, (4, 12, 16, 3), np.uint8)
FRAMES = PIXELS / np.float32(255)


class Once(io.RawIOBase):
    """Bytes that can be neither read twice nor skipped, as in a pipe."""

    def __init__(self, data=b""):
        self.data = io.BytesIO(data)

    def readable(self):
        return True

    def writable(self):
        return True

    def seekable(self):
        return False

    def readinto(self, buffer):
        return self.data.readinto(buffer)

    def write(self, data):
        return self.data.write(data)


@pytest.mark.parametrize(("depth", "frames"), [(8, FRAMES), (10, FRAMES[..., 0])])
def test_a_pipe_brings_what_was_sent(depth, frames):
    sent = Once()
    write_pipe(sent, frames, 30, depth)
    stream = open_pipe(Once(sent.data.getvalue()))
    assert (stream.shape, stream.bit_depth, stream.fps) == (frames.shape[1:], depth, 30.0)
    assert np.allclose(list(stream.frames), frames, atol=0.6 / (2**depth - 1))


def test_a_pipe_that_is_no_video_is_refused():
    for data in (b"", b"no video at all" * 100):
        with pytest.raises(DataError, match="standard input: expected video"):
            open_pipe(Once(data))


def test_raw_frames():
    file = io.BytesIO()
    write_raw(file, FRAMES)
    assert file.getvalue() == PIXELS.tobytes()
    file.seek(0)
    assert np.allclose(list(read_raw(file, FRAMES.shape[1:])), FRAMES)
    with pytest.raises(DataError, match="frame 3: expected 576 bytes, 16×12 RGB, found 575"):
        list(read_raw(io.BytesIO(PIXELS.tobytes()[:-1]), FRAMES.shape[1:]))


def test_a_camera_has_its_colours_in_the_other_order():
    left = list(PIXELS[..., ::-1])

    class Camera:
        def read(self):
            return (True, left.pop(0)) if left else (False, None)

    assert np.allclose(list(live_frames(Camera())), FRAMES)
    assert np.allclose(list(live_frames(iter(PIXELS))), FRAMES)
    with pytest.raises(DataError, match="frame 0: expected unsigned"):
        list(live_frames(PIXELS.astype(np.int32)))


@pytest.fixture(scope="module")
def talkie(tmp_path_factory):
    """Ten frames at irregular times, with half a second of noise."""
    path, rng = tmp_path_factory.mktemp("sound") / "a.mkv", np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        video, audio = container.add_stream("ffv1", rate=25), container.add_stream("aac", rate=44100)
        video.width, video.height, video.pix_fmt = 16, 12, "bgr0"
        for number in (0, 1, 2, 4, 5, 8, 9, 10, 11, 12):
            frame = av.VideoFrame.from_ndarray(PIXELS[number % 4], format="rgb24").reformat(format="bgr0")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            container.mux(video.encode(frame))
        for number in range(20):
            noise = rng.normal(0, 0.1, (1, 1024)).astype(np.float32)
            sound = av.AudioFrame.from_ndarray(noise, format="fltp", layout="mono")
            sound.sample_rate, sound.pts = 44100, 1024 * number
            container.mux(audio.encode(sound))
        container.mux(video.encode(None))
        container.mux(audio.encode(None))
    return open_frames(path)


def sound_times(path):
    with av.open(str(path)) as container:
        packets = container.demux(container.streams.audio)
        return np.array([float(packet.pts * packet.time_base) for packet in packets if packet.pts is not None])


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_audio_and_time_stamps_are_those_of_the_companion(talkie, tmp_path, name):
    write_video(tmp_path / name, talkie, talkie.fps, companion=talkie)
    copied = open_frames(tmp_path / name)
    assert np.allclose(copied.timestamps, talkie.timestamps, atol=2e-3)
    heard, there = sound_times(talkie.path), sound_times(tmp_path / name)
    # The encoder starts before the first frame, which MP4 can say and Matroska cannot.
    assert len(there) >= 20
    assert np.allclose(there, heard[-len(there) :], atol=2e-3)


def test_a_part_has_its_part_of_the_audio(talkie, tmp_path):
    part = talkie.select((3, 8))
    write_video(tmp_path / "a.mkv", part, part.fps, companion=part)
    assert np.allclose(open_frames(tmp_path / "a.mkv").timestamps, part.timestamps - 0.16, atol=2e-3)
    heard = sound_times(talkie.path) - 0.16
    assert np.allclose(sound_times(tmp_path / "a.mkv"), heard[(heard >= 0) & (heard <= 0.24)], atol=3e-3)


@pytest.mark.parametrize(
    ("name", "encoding", "depth", "found"),
    [
        ("a.mp4", Encoding(), 10, ("h264/yuv420p", 8)),
        ("a.mp4", Encoding("hevc"), 10, ("hevc/yuv420p10le", 10)),
        ("a.mp4", Encoding("hevc", crf=30), 8, ("hevc/yuv420p", 8)),
        ("a.mkv", Encoding(crf=20), 8, ("h264/yuv420p", 8)),
        ("a.mkv", Encoding("ffv1"), 10, ("ffv1/gbrp10le", 10)),
    ],
)
def test_codecs_and_depths(tmp_path, name, encoding, depth, found):
    smooth = np.linspace(0.2, 0.8, 64 * 48, dtype=np.float32).reshape(1, 48, 64, 1).repeat(3, -1).repeat(3, 0)
    write_video(tmp_path / name, smooth, 25, depth, encoding=encoding)
    video = open_frames(tmp_path / name)
    assert (video.format, video.bit_depth) == found
    assert np.abs(video.read() - smooth).mean() < 0.02


@pytest.mark.parametrize(
    ("name", "encoding", "message"), [("a.mp4", Encoding("ffv1"), "Matroska"), ("a.npy", Encoding(crf=20), "crf")]
)
def test_codecs_that_do_not_fit_are_refused(tmp_path, name, encoding, message):
    with pytest.raises(ConfigurationError, match=message):
        write_video(tmp_path / name, FRAMES, 25, encoding=encoding)
    assert not list(tmp_path.iterdir())
    for wrong in ({"codec": "av1"}, {"crf": 60}, {"codec": "ffv1", "crf": 10}):
        with pytest.raises(ConfigurationError, match=list(wrong)[-1]):
            Encoding(**wrong)


def test_frames_too_small_for_hevc_are_refused_in_one_line(tmp_path):
    with pytest.raises(DataError, match=r"^HEVC: expected frames of at least 16×16 pixels, found 20×15; [^\n]*$"):
        write_container(tmp_path / "a.mp4", np.zeros((2, 15, 20), np.float32), 25, encoding=Encoding("hevc"))
    assert not list(tmp_path.iterdir())

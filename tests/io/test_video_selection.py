"""Videos in: ranges of frames, and one frame at a time in memory."""

import dataclasses
import itertools
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.containers.decoding import _Scan
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from videos import encode, grey_ffv1, memory_below, packets, refused, scene


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The same 12 frames in formats with and without frames that depend on others."""
    folder = tmp_path_factory.mktemp("selection")
    frames = [frame[..., 0] for frame in scene()]
    paths = [
        grey_ffv1(folder / "intra.mkv", frames, g="1"),
        grey_ffv1(folder / "ffv1.mkv", frames),
        encode(folder / "b-frames.mp4", scene(), "libx264", "yuv420p", "rgb24", x264_params="keyint=4:open-gop=1"),
    ]
    for name in ("a.tif", "a.npy", "a.ser"):
        write_video(folder / name, np.stack(frames) / np.float32(255), 30)
        paths.append(folder / name)
    return {path.name: path for path in paths}


@pytest.mark.parametrize("name", ["long.mp4", "long.mkv"])
def test_decoding_begins_at_the_keyframe_before_the_range(tmp_path, name):
    path = encode(tmp_path / name, scene(60), "libx264", "yuv420p", "rgb24", x264_params="keyint=10:bframes=3")
    part = open_frames(path, frames=(35, 40))
    decoded = 0

    def count(_, event, argument):
        nonlocal decoded
        decoded += event == "c_call" and argument.__qualname__ == "Packet.decode"

    sys.setprofile(count)
    frames = part.read()
    sys.setprofile(None)
    assert np.array_equal(frames, open_frames(path).read()[35:40])
    # From frame 30, and some packets ahead of their frames.
    assert 5 <= decoded < 35


def test_an_index_that_leads_elsewhere_is_not_followed(sources, monkeypatch):
    path = sources["b-frames.mp4"]
    whole, part = open_frames(path).read(), open_frames(path, frames=(6, 11))
    monkeypatch.setattr(_Scan, "entry", lambda scan, _: int(scan.stamps[-1]) if scan.entries else None)
    assert np.array_equal(part.read(), whole[6:11])


class TestSelection:
    NAMES = ("intra.mkv", "ffv1.mkv", "b-frames.mp4", "a.tif", "a.npy", "a.ser")

    @pytest.mark.parametrize("name", NAMES)
    @given(data=st.data())
    @settings(max_examples=12, deadline=None)
    def test_selecting_equals_slicing(self, sources, name, data):
        path = sources[name]
        whole = open_frames(path).read()
        start = data.draw(st.integers(0, 11))
        stop = data.draw(st.integers(start + 1, 12))
        step = data.draw(st.sampled_from([None, 1, 2, 5]))
        x, y = data.draw(st.integers(0, 63)), data.draw(st.integers(0, 47))
        w, h = data.draw(st.integers(1, 64 - x)), data.draw(st.integers(1, 48 - y))
        part = open_frames(path, frames=(start, stop, step), roi=(x, y, w, h))
        expected = whole[start:stop:step, y : y + h, x : x + w]
        assert part.shape == expected.shape and len(part) == len(expected)
        np.testing.assert_array_equal(part.read(), expected)
        np.testing.assert_array_equal(part.read(1), expected[1:]) if len(expected) > 1 else None

    @pytest.mark.parametrize("name", NAMES)
    def test_every_iteration_starts_anew(self, sources, name):
        source = open_frames(sources[name])
        first = list(source)
        for again in (list(source), source.read()):
            np.testing.assert_array_equal(again, first)
        np.testing.assert_array_equal(source.read(3, 7), first[3:7])
        assert all(np.array_equal(a, b) for a, b in zip(source, source, strict=True))
        assert all(frame.dtype == np.float32 for frame in first)

    def test_open_ends_and_nesting(self):
        stack = np.arange(10 * 6 * 8, dtype=np.uint16).reshape(10, 6, 8)
        source = FrameSource.from_array(stack, fps=30)
        assert len(source.select((None, None))) == 10
        part = source.select((2, None, 3), (1, 1, 6, 4)).select((1, None), (2, 0, 3, 2))
        np.testing.assert_array_equal(part.read(), stack[5::3, 1:3, 3:6] / np.float32(65535))
        assert part.fps == 10

    def test_timestamps_and_rate_follow_the_selection(self, sources):
        part = open_frames(sources["intra.mkv"], frames=(3, 10, 2))
        np.testing.assert_allclose(part.timestamps, np.arange(3, 10, 2) / 30, atol=1e-3)
        assert part.fps == 15

    @pytest.mark.parametrize(
        "wrong",
        [
            *[{"frames": ends} for ends in ((0, 13), (12, None), (5, 5), (6, 2), (-3, None), (0, -1), (0.5, 2))],
            *[{"frames": other} for other in ((0, 5, 0), (0, 5, -1), (1,), (1, 2, 3, 4), 7)],
            *[{"roi": box} for box in ((0, 0, 65, 48), (1, 0, 64, 48), (0, 0, 0, 5), (-1, 0, 5, 5), (0, 48, 5, 1))],
            *[{"roi": other} for other in ((0, 0, 5), (0, 0, 5, 5.5), 3)],
        ],
        ids=str,
    )
    def test_what_is_outside_or_malformed_is_a_usage_error(self, sources, wrong):
        assert refused(sources["intra.mkv"], ConfigurationError, *wrong, **wrong) == 2

    def test_empty_read_is_a_usage_error(self, sources):
        with pytest.raises(ConfigurationError):
            open_frames(sources["a.npy"]).read(5, 5)

    def test_frames_and_window_default_to_all_each_by_itself(self):
        source, part = FrameSource.from_array(np.zeros((5, 4, 6), np.uint8)), (slice(1, 3), slice(2, 6))
        assert (source.numbers, source.window) == (range(5), (slice(0, 4), slice(0, 6)))
        fields = {item.name: getattr(source, item.name) for item in dataclasses.fields(source) if item.init}
        del fields["numbers"], fields["window"]
        assert FrameSource(**fields, window=part).shape == (5, 2, 4)
        assert FrameSource(**fields, numbers=(1, 3)).shape == (2, 4, 6)
        with pytest.raises(DataError, match="expected at least one selected frame, found none"):
            FrameSource(**fields, numbers=())


class TestLaziness:
    def test_decoding_ends_with_the_last_wanted_frame(self, tmp_path):
        path = encode(tmp_path / "a.mkv", scene(), "mpeg4", "yuv420p", "rgb24")
        _, last = packets(path)[-1]
        path.write_bytes(path.read_bytes().replace(last, b"\xff" * len(last)))
        refused(path, DataError, "frame 11")
        part = open_frames(path, frames=(0, 11))
        assert len(list(part)) == len(list(part.pixels(range(11)))) == 11

    @pytest.mark.parametrize("name", ["a.mkv", "a.npy", "a.tif", "a.ser"])
    def test_memory_does_not_grow_with_the_video(self, tmp_path, name):
        frame = np.random.default_rng(0).random((64, 64), dtype=np.float32)
        write_video(tmp_path / name, itertools.repeat(frame, 200), 30)
        source = open_frames(tmp_path / name)
        for _ in itertools.islice(source, 2):
            pass
        with memory_below(15 * frame.nbytes):
            for _ in source:
                pass

    @pytest.mark.parametrize("name", ["a.mkv", "a.npy", "a.tif", "a.ser", "a.mp4"])
    def test_writing_takes_one_frame_at_a_time(self, tmp_path, name):
        frame = np.zeros((64, 64), np.float32)
        write_video(tmp_path / f"warm-{name}", [frame], 30)
        with memory_below(25 * frame.nbytes):
            write_video(tmp_path / name, (frame + 0.001 * k for k in range(80)), 30)

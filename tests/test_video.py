"""Videos in and out: every format, every kind of damage, and one frame at a time in memory."""

import io
import itertools
import os
import resource
import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from turbrestore.errors import (
    ConfigurationError,
    DataError,
    InputNotFoundError,
    OutputError,
    StorageError,
)
from turbrestore.frame_source import FrameSource
from turbrestore.images import write_image
from turbrestore.integrity import ffv1_slices_intact, is_cut_short
from turbrestore.limits import Limits
from turbrestore.video import open_frames, write_video

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


def refused(path, error, *words, **options):
    """Opening and reading fails with one line that holds the words; returns the exit code."""
    with pytest.raises(error) as info:
        for _ in open_frames(path, **options):
            pass
    message = str(info.value)
    assert "\n" not in message and all(word in message for word in words), message
    return info.value.exit_code


class TestFormats:
    @pytest.mark.parametrize("depth", [8, 9, 10, 12, 14, 16])
    def test_grey_stays_grey_at_its_depth(self, tmp_path, depth):
        dtype = np.uint8 if depth == 8 else np.uint16
        pixels = np.random.default_rng(0).integers(0, 2**depth, (3, 7, 9)).astype(dtype)
        name = "gray" if depth == 8 else f"gray{depth}le"
        source = open_frames(encode(tmp_path / "a.mkv", pixels, pixel_format=name))
        assert (source.shape, source.bit_depth, source.format) == ((3, 7, 9), depth, f"ffv1/{name}")
        np.testing.assert_array_equal(source.read(), pixels / np.float32(2**depth - 1))

    @pytest.mark.parametrize(
        ("name", "kind", "depth"),
        [
            ("bgr0", "rgb24", 8),
            ("gbrp9le", None, 9),
            ("gbrp10le", None, 10),
            ("gbrp12le", None, 12),
            ("gbrp14le", None, 14),
            ("gbrp16le", None, 16),
            ("rgb48le", None, 16),
        ],
    )
    def test_rgb_is_exact(self, tmp_path, name, kind, depth):
        dtype = np.uint8 if depth == 8 else np.uint16
        pixels = np.random.default_rng(0).integers(0, 2**depth, (3, 7, 9, 3)).astype(dtype)
        source = open_frames(encode(tmp_path / "a.mkv", pixels, pixel_format=name, kind=kind))
        assert (source.shape, source.bit_depth, source.warnings) == ((3, 7, 9, 3), depth, ())
        np.testing.assert_array_equal(source.read(), pixels / np.float32(2**depth - 1))

    @pytest.mark.parametrize(
        ("name", "codec", "pixel_format"),
        [
            ("a.mp4", "libx264", "yuv420p"),
            ("a.mp4", "mpeg4", "yuv420p"),
            ("a.m4v", "libx264", "yuv444p"),
            ("a.mov", "mpeg4", "yuv420p"),
            ("a.avi", "mpeg4", "yuv420p"),
            ("a.avi", "mjpeg", "yuvj420p"),
            ("a.avi", "rawvideo", "bgr24"),
            ("a.mkv", "libx264", "yuv420p"),
            ("a.webm", "libvpx", "yuv420p"),
            ("a.webm", "libvpx-vp9", "yuv420p"),
            ("A.MKV", "ffv1", "yuv420p"),
        ],
    )
    def test_colour_video_is_read_within_the_loss_of_its_codec(self, tmp_path, name, codec, pixel_format):
        frames = scene()
        path = encode(tmp_path / name, frames, codec, pixel_format, "rgb24", b="4000000")
        source = open_frames(path)
        assert source.shape == (12, 48, 64, 3) and source.bit_depth == 8 and source.fps == 30
        assert source.warnings == ()
        np.testing.assert_allclose(source.timestamps, np.arange(12) / 30, atol=2e-3)
        assert np.mean(np.abs(source.read() - np.stack(frames) / 255)) < 0.02

    @pytest.mark.parametrize("pixel_format", ["yuv420p10le", "yuv444p12le"])
    def test_deep_yuv_keeps_more_than_8_bits(self, tmp_path, pixel_format):
        ramp = np.tile(np.linspace(0, 65535, 1024).astype(np.uint16)[None, :, None], (16, 1, 3))
        source = open_frames(encode(tmp_path / "a.mkv", [ramp], pixel_format=pixel_format, kind="rgb48le"))
        found = source.read()[0]
        assert source.bit_depth == int(pixel_format[-4:-2])
        assert len(np.unique(found[..., 1])) > 800
        np.testing.assert_allclose(found, ramp / 65535, atol=0.005)

    def test_yuv_is_rounded_to_the_nearest_level(self, tmp_path):
        luma = np.tile(np.arange(16, 236, dtype=np.uint8), (16, 1))
        planes = np.concatenate([luma.ravel(), np.full(luma.size // 2, 128, np.uint8)]).reshape(24, 220)
        source = open_frames(encode_yuv(tmp_path / "a.mkv", planes))
        exact = (luma - 16.0)[..., None] / 219
        assert np.abs(source.read()[0] - exact).max() <= 0.5 / 255 + 1e-6

    @pytest.mark.parametrize(("name", "channels"), [("ya8", ()), ("bgra", (3,)), ("yuva420p", (3,))])
    def test_alpha_is_dropped_with_a_warning(self, tmp_path, name, channels):
        kind = {"ya8": "gray", "bgra": "rgba", "yuva420p": "rgba"}[name]
        frames = [frame[..., 0] if kind == "gray" else np.dstack([frame, frame[..., 0]]) for frame in scene(3)]
        source = open_frames(encode(tmp_path / "a.mkv", frames, pixel_format=name, kind=kind))
        assert source.warnings == ("alpha channel ignored",)
        assert source.shape == (3, 48, 64, *channels)
        expected = np.stack(scene(3))[..., :3] if channels else np.stack(frames)
        assert np.mean(np.abs(source.read() - expected / 255)) < 0.02

    def test_gif_is_rgb_without_alpha(self, tmp_path):
        frames = [np.repeat(frame[..., :1] // 64 * 85, 3, 2) for frame in scene(5)]
        source = open_frames(gif(tmp_path, frames))
        assert source.shape == (5, 48, 64, 3) and source.warnings == () and source.format == "gif/bgra"
        np.testing.assert_array_equal(source.read(), np.stack(frames) / np.float32(255))

    def test_grey_avi_of_an_intra_codec(self, tmp_path):
        frames = np.stack([frame[..., 0] for frame in scene()])
        source = open_frames(grey_ffv1(tmp_path / "a.avi", frames))
        np.testing.assert_array_equal(source.read(), frames / np.float32(255))

    def test_variable_frame_rate_is_told(self, tmp_path):
        stamps = [0, 1, 2, 5, 6, 20]
        frames = [frame[..., 0] for frame in scene(6)]
        source = open_frames(grey_ffv1(tmp_path / "a.mkv", frames, stamps=stamps))
        assert source.warnings == ("variable frame rate",)
        np.testing.assert_allclose(source.timestamps, np.array(stamps) / 30, atol=2e-3)
        assert source.fps == pytest.approx(5 / (20 / 30), rel=1e-2)

    @pytest.mark.parametrize("codec", ["libx264", "mjpeg"])
    def test_frames_cut_off_by_an_edit_list_do_not_count(self, tmp_path, codec):
        pixel_format = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        frames = scene(40)
        path = encode(tmp_path / "a.mov", frames, codec, pixel_format, "rgb24", stamps=range(-12, 28))
        source = open_frames(path)
        assert len(source) == len(list(source)) == 28
        closest = np.abs(source.read(0, 1)[0] - np.stack(frames) / 255).mean(axis=(1, 2, 3)).argmin()
        assert closest == 12

    def test_rotation_and_interlacing_are_told(self, tmp_path):
        path = encode(tmp_path / "a.mp4", scene(), "libx264", "yuv420p", "rgb24", flags="+ilme+ildct")
        data = bytearray(path.read_bytes())
        matrix = data.index(b"tkhd") + 44
        quarter_turn = [0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30]
        data[matrix : matrix + 36] = np.array(quarter_turn, ">i4").tobytes()
        path.write_bytes(data)
        assert open_frames(path).warnings == (
            "interlaced video: its fields are not separated",
            "rotation of -90 degrees ignored",
        )

    @pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.gif"])
    def test_data_that_other_programs_append_are_no_damage(self, tmp_path, name):
        frames = scene(5)
        codec = {"a.mp4": "libx264", "a.mkv": "libx264", "a.avi": "mpeg4"}.get(name)
        path = encode(tmp_path / name, frames, codec, "yuv420p", "rgb24") if codec else gif(tmp_path, frames)
        with path.open("ab") as file:
            file.write(bytes(64) if name == "a.gif" else b"SEFH appended by the camera" * 9)
        assert len(list(open_frames(path))) == 5

    def test_live_recording_without_duration_is_whole(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", container_options={"live": "1"})
        assert len(list(open_frames(path))) == 12

    @pytest.mark.parametrize("name", ["http:a.mkv", "a%03d.mkv", "-a.mkv"])
    def test_names_that_look_like_something_else(self, tmp_path, monkeypatch, name):
        monkeypatch.chdir(tmp_path)
        grey_ffv1(tmp_path / "plain.mkv").rename(name)
        assert len(open_frames(name)) == 12

    @pytest.mark.parametrize("rate", [Fraction(30000, 1001), Fraction(240)])
    def test_rounding_to_milliseconds_is_no_variable_rate(self, tmp_path, rate):
        write_video(tmp_path / "a.mkv", np.zeros((20, 4, 5), np.float32), float(rate))
        assert open_frames(tmp_path / "a.mkv").warnings == ()


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


class TestArraysStacksAndFolders:
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64, ">u2"])
    @pytest.mark.parametrize("colour", [False, True])
    @pytest.mark.parametrize("form", ["npy", "tif"])
    def test_values_are_exact(self, tmp_path, dtype, colour, form):
        rng = np.random.default_rng(0)
        shape = (4, 5, 6, 3) if colour else (4, 5, 6)
        dtype = np.dtype(dtype)
        white = np.iinfo(dtype).max if dtype.kind == "u" else 1
        stack = (rng.random(shape) * white).astype(dtype)
        path = tmp_path / f"a.{form}"
        if form == "npy":
            np.save(path, stack)
        else:
            byteorder = ">" if dtype.byteorder == ">" else "<"
            kind = "rgb" if colour else "minisblack"
            tifffile.imwrite(path, stack, photometric=kind, compression="zlib", byteorder=byteorder)
        source = open_frames(path)
        assert source.shape == shape
        assert source.bit_depth == (8 * dtype.itemsize if dtype.kind == "u" else 32)
        expected = (stack / np.float32(white)).astype(np.float32)
        np.testing.assert_array_equal(source.read(), expected)
        assert source.fps is None and source.timestamps is None

    @pytest.mark.parametrize(
        "options",
        [
            {},
            {"imagej": True},
            {"imagej": True, "truncate": True},
            {"bigtiff": True},
            {"metadata": None},
            {"ome": True},
            {"compression": "zlib", "predictor": False},
        ],
    )
    def test_tiff_of_many_writers(self, tmp_path, options):
        stack = np.random.default_rng(0).integers(0, 65536, (5, 6, 7), dtype=np.uint16)
        tifffile.imwrite(tmp_path / "a.tiff", stack, **options)
        np.testing.assert_array_equal(open_frames(tmp_path / "a.tiff").read(), stack / np.float32(65535))

    def test_tiff_planes_alpha_and_inverted_grey(self, tmp_path):
        colour = np.random.default_rng(0).integers(0, 256, (4, 3, 5, 6), dtype=np.uint8)
        tifffile.imwrite(tmp_path / "p.tif", colour, photometric="rgb", planarconfig="separate")
        found = open_frames(tmp_path / "p.tif").read()
        np.testing.assert_array_equal(found, np.moveaxis(colour, 1, -1) / np.float32(255))
        four = np.random.default_rng(0).integers(0, 256, (4, 5, 6, 4), dtype=np.uint8)
        tifffile.imwrite(tmp_path / "a.tif", four, photometric="rgb", extrasamples=["unassalpha"])
        source = open_frames(tmp_path / "a.tif")
        assert source.warnings == ("alpha channel ignored",)
        np.testing.assert_array_equal(source.read(), four[..., :3] / np.float32(255))
        tifffile.imwrite(tmp_path / "w.tif", colour[:, 0], photometric="miniswhite")
        np.testing.assert_array_equal(open_frames(tmp_path / "w.tif").read(), (255 - colour[:, 0]) / np.float32(255))

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
    def test_folder_is_read_in_natural_order(self, tmp_path, dtype, suffix):
        if suffix == ".bmp" and dtype == np.uint16:
            dtype = np.uint8
        stack = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (12, 5, 6), dtype=dtype)
        for index, frame in enumerate(stack):
            assert cv2.imwrite(str(tmp_path / f"Frame{index}{suffix}"), frame)
        (tmp_path / "notes.txt").write_text("not an image")
        (tmp_path / ".hidden.png").write_text("not an image")
        (tmp_path / "sub.png").mkdir()
        source = open_frames(tmp_path)
        assert source.shape == (12, 5, 6) and source.bit_depth == np.iinfo(dtype).bits
        np.testing.assert_array_equal(source.read(), stack / np.float32(np.iinfo(dtype).max))

    def test_colour_folder_with_alpha(self, tmp_path):
        pixels = np.dstack([scene(1)[0], scene(1)[0][..., 0]])
        for name in ("a1.png", "a2.png"):
            cv2.imwrite(str(tmp_path / name), pixels)
        source = open_frames(tmp_path)
        assert source.shape == (2, 48, 64, 3) and source.warnings == ("alpha channel ignored",)

    def test_from_array_refuses_what_is_no_video(self):
        for array, word in (
            (np.zeros((4, 5)), "(4, 5)"),
            (np.zeros((4, 5, 6, 2)), "(4, 5, 6, 2)"),
            (np.zeros((0, 5, 6)), "none"),
            (np.zeros((2, 5, 6), int), "int64"),
            (np.zeros((2, 5, 6), bool), "bool"),
            (np.zeros((2, 0, 6)), "6×0"),
        ):
            with pytest.raises(DataError) as info:
                FrameSource.from_array(array, "name")
            assert word in str(info.value) and "name" in str(info.value)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The same 12 frames in formats with and without frames that depend on others."""
    folder = tmp_path_factory.mktemp("selection")
    frames = [frame[..., 0] for frame in scene()]
    stack = np.stack(frames)
    paths = [
        grey_ffv1(folder / "intra.mkv", frames, g="1"),
        grey_ffv1(folder / "ffv1.mkv", frames),
        encode(folder / "b-frames.mp4", scene(), "libx264", "yuv420p", "rgb24"),
    ]
    write_video(folder / "a.tif", stack / np.float32(255), 30)
    write_video(folder / "a.npy", stack / np.float32(255), 30)
    write_video(folder / "a.ser", stack / np.float32(255), 30)
    return {path.name: path for path in [*paths, folder / "a.tif", folder / "a.npy", folder / "a.ser"]}


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
        first, second = list(source), list(source)
        np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(source.read(), first)
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
        "frames",
        [
            (0, 13),
            (12, None),
            (5, 5),
            (6, 2),
            (-3, None),
            (0, -1),
            (0, 5, 0),
            (0, 5, -1),
            (1,),
            (1, 2, 3, 4),
            (0.5, 2),
            7,
        ],
    )
    def test_range_outside_or_malformed_is_a_usage_error(self, sources, frames):
        assert refused(sources["intra.mkv"], ConfigurationError, "frames", frames=frames) == 2

    @pytest.mark.parametrize(
        "roi",
        [(0, 0, 65, 48), (1, 0, 64, 48), (0, 0, 0, 5), (-1, 0, 5, 5), (0, 48, 5, 1), (0, 0, 5), (0, 0, 5, 5.5), 3],
    )
    def test_rectangle_outside_or_malformed_is_a_usage_error(self, sources, roi):
        assert refused(sources["intra.mkv"], ConfigurationError, "roi", roi=roi) == 2

    def test_empty_read_is_a_usage_error(self, sources):
        with pytest.raises(ConfigurationError):
            open_frames(sources["a.npy"]).read(5, 5)


class TestLaziness:
    def test_only_wanted_frames_are_asked_for(self):
        asked = []

        def pixels(chosen):
            for number in chosen:
                asked.append(number)
                yield np.zeros((4, 5), np.uint8)

        source = FrameSource("a", "test", (10**6, 4, 5), 255, 8, pixels)
        assert asked == []
        assert len(list(itertools.islice(source, 3))) == 3 and asked == [0, 1, 2]
        asked.clear()
        source.select((100, 200, 50)).read()
        assert asked == [100, 150]

    def test_decoding_ends_with_the_last_wanted_frame(self, tmp_path):
        path = encode(tmp_path / "a.mkv", scene(), "mpeg4", "yuv420p", "rgb24")
        with av.open(str(path)) as container:
            last = [bytes(packet) for packet in container.demux() if packet.size][-1]
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
        tracemalloc.start()
        for _ in source:
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 15 * frame.nbytes

    def test_writing_takes_one_frame_at_a_time(self, tmp_path):
        frame = np.zeros((64, 64), np.float32)
        for name in ("a.mkv", "a.npy", "a.tif", "a.ser", "a.mp4"):
            write_video(tmp_path / f"warm-{name}", [frame], 30)
            tracemalloc.start()
            write_video(tmp_path / name, (frame + 0.001 * k for k in range(80)), 30)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 25 * frame.nbytes, name


class TestWriting:
    @pytest.mark.parametrize("depth", [8, 10, 12, 14, 16])
    @given(data=st.data())
    @settings(max_examples=8, deadline=None)
    def test_mkv_round_trip_is_exact(self, tmp_path_factory, depth, data):
        shape = data.draw(hnp.array_shapes(min_dims=3, max_dims=3, max_side=6))
        shape = data.draw(st.sampled_from([shape, (*shape, 3)]))
        pixels = data.draw(hnp.arrays(np.uint16, shape, elements=st.integers(0, 2**depth - 1)))
        path = tmp_path_factory.mktemp("mkv") / "a.mkv"
        write_video(path, (pixels / (2**depth - 1)).astype(np.float32), 25, bit_depth=depth)
        source = open_frames(path)
        assert source.bit_depth == depth and source.fps == 25 and source.shape == shape
        np.testing.assert_array_equal(np.rint(source.read() * np.float64(2**depth - 1)), pixels)

    @pytest.mark.parametrize(("depth", "written"), [(1, 8), (9, 10), (11, 12), (15, 16), (32, 16)])
    def test_other_depths_go_to_the_next_that_mkv_has(self, tmp_path, depth, written):
        write_video(tmp_path / "a.mkv", np.ones((2, 3, 4), np.float32), 25, bit_depth=depth)
        source = open_frames(tmp_path / "a.mkv")
        assert source.bit_depth == written and source.read().min() == 1

    @pytest.mark.parametrize(
        ("name", "depth", "levels"), [("a.npy", 8, 255), ("a.npy", 12, 4095), ("a.tif", 8, 255), ("a.ser", 12, 4095)]
    )
    @pytest.mark.parametrize("colour", [False, True])
    def test_uncompressed_round_trips(self, tmp_path, name, depth, levels, colour):
        pixels = np.random.default_rng(0).integers(0, levels + 1, (5, 6, 7, 3) if colour else (5, 6, 7))
        write_video(tmp_path / name, (pixels / levels).astype(np.float32), 25, bit_depth=depth)
        found = open_frames(tmp_path / name).read()
        np.testing.assert_allclose(found * levels, pixels, atol=0.05)

    @pytest.mark.parametrize("name", ["a.npy", "a.tif"])
    def test_floating_point_is_kept(self, tmp_path, name):
        stack = np.random.default_rng(0).random((5, 6, 7), dtype=np.float32)
        write_video(tmp_path / name, stack, 25, bit_depth=32)
        source = open_frames(tmp_path / name)
        assert source.bit_depth == 32
        np.testing.assert_array_equal(source.read(), stack)

    def test_npy_is_what_numpy_reads(self, tmp_path):
        stack = np.random.default_rng(0).random((123, 2, 3), dtype=np.float32)
        write_video(tmp_path / "a.npy", iter(stack), 25, bit_depth=32)
        np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), stack)

    @pytest.mark.parametrize("shape", [(48, 64), (47, 63), (48, 64, 3)])
    def test_mp4_is_close(self, tmp_path, shape):
        frames = [(frame[: shape[0], : shape[1]] / np.float32(255)) for frame in scene()]
        frames = [frame if len(shape) == 3 else frame[..., 0] for frame in frames]
        write_video(tmp_path / "a.mp4", frames, 25)
        found = open_frames(tmp_path / "a.mp4").read()
        expected = np.stack(frames) if len(shape) == 3 else np.stack(frames)[..., None]
        assert np.mean(np.abs(found - expected)) < 0.02

    @pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.npy", "a.tif", "a.ser"])
    @pytest.mark.parametrize("shape", [(5, 16, 20), (5, 16, 20, 3)])
    def test_the_same_frames_give_the_same_bytes(self, tmp_path, name, shape):
        stack = np.random.default_rng(0).random(shape, dtype=np.float32)
        written = []
        for frames in (stack, stack, 1 - stack):
            write_video(tmp_path / name, frames, 25, overwrite=True)
            written.append((tmp_path / name).read_bytes())
        assert written[0] == written[1] != written[2]

    def test_a_source_can_be_written(self, tmp_path):
        write_video(tmp_path / "a.mkv", np.full((4, 5, 6), 0.2, np.float32), 25)
        source = open_frames(tmp_path / "a.mkv", frames=(1, 3))
        write_video(tmp_path / "b.mkv", source, 25)
        np.testing.assert_array_equal(open_frames(tmp_path / "b.mkv").read(), source.read())

    def test_broadcast_rates_survive(self, tmp_path):
        write_video(tmp_path / "a.mkv", np.zeros((3, 4, 5), np.float32), 30000 / 1001)
        assert open_frames(tmp_path / "a.mkv").fps == pytest.approx(30000 / 1001, rel=1e-9)

    @pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf"), 2000])
    def test_impossible_rates_are_usage_errors(self, tmp_path, fps):
        with pytest.raises(ConfigurationError, match="fps"):
            write_video(tmp_path / "a.mkv", np.zeros((3, 4, 5), np.float32), fps)
        assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.npy", "a.tif", "a.ser"])
    def test_failures_leave_nothing_behind(self, tmp_path, name):
        good = np.zeros((8, 8), np.float32)

        def interrupted():
            yield good
            raise KeyboardInterrupt

        cases = [
            ([], DataError),
            ([good, np.zeros((8, 10), np.float32)], DataError),
            ([good, np.zeros((8, 8, 3), np.float32)], DataError),
            ([good, np.full((8, 8), np.nan, np.float32)], DataError),
            (interrupted(), KeyboardInterrupt),
        ]
        for frames, error in cases:
            with pytest.raises(error):
                write_video(tmp_path / name, frames, 25)
            assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["a.mkv", "a.npy", "a.tif", "a.ser"])
    def test_full_disk_is_a_storage_error(self, tmp_path, name):
        noise = np.random.default_rng(0).random((8, 64, 64), dtype=np.float32)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
        try:
            with pytest.raises(StorageError, match="nothing was saved"):
                write_video(tmp_path / name, noise, 25, bit_depth=16)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert not any(tmp_path.iterdir())

    def test_existing_and_unsupported_outputs(self, tmp_path):
        stack = np.zeros((2, 8, 8), np.float32)
        with pytest.raises(ConfigurationError, match=r"\.mkv"):
            write_video(tmp_path / "a.wmv", stack, 25)
        with pytest.raises(ConfigurationError, match="bit_depth"):
            write_video(tmp_path / "a.mkv", stack, 25, bit_depth=20)
        write_video(tmp_path / "a.mkv", stack, 25)
        with pytest.raises(OutputError):
            write_video(tmp_path / "a.mkv", stack, 25)
        write_video(tmp_path / "a.mkv", stack, 25, overwrite=True)


class TestRefusals:
    def test_missing(self, tmp_path):
        assert refused(tmp_path / "no.mkv", InputNotFoundError, "no.mkv") == 66

    @pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi", ".gif", ".webm", ".mov", ".tif", ".npy", ".ser"])
    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"only text\n" * 40,
            b"1\n00:00:01,000 --> 00:00:02,000\nsubtitle\n\n" * 9,
            b"ffconcat version 1.0\nfile other.mkv\n",
            bytes(5000),
        ],
    )
    def test_other_content(self, tmp_path, suffix, content):
        grey_ffv1(tmp_path / "other.mkv")
        (tmp_path / f"a{suffix}").write_bytes(content)
        assert refused(tmp_path / f"a{suffix}", DataError, f"a{suffix}") == 65

    @pytest.mark.parametrize(("name", "word"), [("a.xyz", ".mkv"), ("a", "no suffix"), ("a.png", "folder")])
    def test_unknown_suffix(self, tmp_path, name, word):
        (tmp_path / name).write_bytes(b"x")
        refused(tmp_path / name, DataError, word)

    def test_folder_without_images(self, tmp_path):
        (tmp_path / "a.txt").write_text("x")
        refused(tmp_path, DataError, "none in the folder")

    def test_sound_only(self, tmp_path):
        with av.open(str(tmp_path / "a.mkv"), "w") as output:
            stream = output.add_stream("pcm_s16le", rate=8000, layout="mono")
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
            frame.rate = 8000
            output.mux(stream.encode(frame))
            output.mux(stream.encode(None))
        refused(tmp_path / "a.mkv", DataError, "no video stream")

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
    def test_frame_size_that_changes_in_the_middle(self, tmp_path, name):
        with av.open(str(tmp_path / name), "w") as output:
            stream = output.add_stream("mjpeg", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
            for stamp, frame in enumerate([*scene(3), *scene(3, 24, 32)]):
                encoder = av.CodecContext.create("mjpeg", "w")
                encoder.height, encoder.width = frame.shape[:2]
                encoder.pix_fmt, encoder.time_base = "yuvj420p", 1 / RATE
                picture = av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(format="yuvj420p")
                picture.pts = stamp
                for packet in [*encoder.encode(picture), *encoder.encode(None)]:
                    packet.stream, packet.time_base = stream, 1 / RATE
                    output.mux(packet)
        refused(tmp_path / name, DataError, "frame 3", "64×48", "32×24")

    def test_a_frame_in_the_middle_that_claims_to_be_huge_is_not_decoded(self, tmp_path):
        path = encode(tmp_path / "a.avi", scene(), "mjpeg", "yuvj420p", "rgb24")
        data, place = bytearray(path.read_bytes()), 0
        for _ in range(5):
            place = data.index(b"\xff\xc0\x00\x11\x08", place + 1)
        data[place + 5 : place + 9] = np.array([96, 128], ">u2").tobytes()
        path.write_bytes(data)
        refused(path, DataError, "frame 4", "cannot be decoded", limits=Limits(max_pixels=64 * 48))
        refused(path, DataError, "frame 4", limits=Limits(max_pixels=128 * 96))

    @pytest.mark.parametrize("other", ["size", "depth", "colour"])
    def test_folder_of_two_kinds(self, tmp_path, other):
        cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 5), np.uint8))
        second = {
            "size": np.zeros((5, 4), np.uint8),
            "depth": np.zeros((4, 5), np.uint16),
            "colour": np.zeros((4, 5, 3), np.uint8),
        }[other]
        cv2.imwrite(str(tmp_path / "2.png"), second)
        refused(tmp_path, DataError, "2.png", "5×4 grey uint8")

    def test_tiff_pages_of_two_sizes(self, tmp_path):
        with tifffile.TiffWriter(tmp_path / "a.tif") as tiff:
            tiff.write(np.zeros((4, 5), np.uint8), metadata=None)
            tiff.write(np.zeros((5, 4), np.uint8), metadata=None)
        refused(tmp_path / "a.tif", DataError, "frame 1", "5×4", "4×5")

    @pytest.mark.parametrize("form", ["npy", "tif"])
    @pytest.mark.parametrize(
        ("value", "word"), [(4095.0, "0 to 4095"), (-0.5, "-0.5 to 0"), (np.nan, "NaN"), (np.inf, "NaN")]
    )
    def test_floats_that_are_no_intensities(self, tmp_path, form, value, word):
        stack = np.zeros((4, 5, 6), np.float32)
        stack[2, 1, 1] = value
        if form == "npy":
            np.save(tmp_path / "a.npy", stack)
        else:
            tifffile.imwrite(tmp_path / "a.tif", stack, photometric="minisblack")
        refused(tmp_path / f"a.{form}", DataError, "frame 2", word)

    def test_arrays_that_are_no_video(self, tmp_path):
        for array in (
            np.zeros((4, 5)),
            np.zeros((4, 5, 6), np.int16),
            np.zeros((4, 5, 6), "c8"),
            np.zeros((4, 5, 6, 4)),
        ):
            np.save(tmp_path / "a.npy", array)
            refused(tmp_path / "a.npy", DataError)
        np.save(tmp_path / "a.npy", np.array([None, {}], object), allow_pickle=True)
        refused(tmp_path / "a.npy", DataError)
        with (tmp_path / "a.npy").open("wb") as file:
            np.savez(file, a=np.zeros((4, 5, 6)))
        refused(tmp_path / "a.npy", DataError, "not a whole .npy array")

    @pytest.mark.parametrize("photometric", ["palette", "cmyk"])
    def test_tiff_of_other_colours(self, tmp_path, photometric):
        if photometric == "palette":
            tifffile.imwrite(
                tmp_path / "a.tif", np.zeros((4, 5), np.uint8), photometric="palette", colormap=np.zeros((3, 256), "u2")
            )
        else:
            tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 5, 4), np.uint8), photometric="separated")
        refused(tmp_path / "a.tif", DataError, "grey or RGB")

    def test_tiff_whose_pages_form_a_circle(self, tmp_path):
        tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 5), np.uint8), metadata=None)
        data = bytearray((tmp_path / "a.tif").read_bytes())
        first = int.from_bytes(data[4:8], "little")
        link = first + 2 + 12 * int.from_bytes(data[first : first + 2], "little")
        data[link : link + 4] = first.to_bytes(4, "little")
        (tmp_path / "a.tif").write_bytes(data)
        refused(tmp_path / "a.tif", DataError, "circle")

    def test_no_permission_is_a_storage_error(self, tmp_path, monkeypatch):
        path = grey_ffv1(tmp_path / "a.mkv")
        monkeypatch.setattr(Path, "open", denied)
        assert refused(path, StorageError, "Permission denied") == 74

    def test_absurd_size_in_the_header(self, tmp_path):
        path = encode(tmp_path / "a.avi", scene(), "rawvideo", "bgr24", "rgb24")
        data = bytearray(path.read_bytes())
        sizes = data.index(b"strf") + 12
        data[sizes : sizes + 8] = np.array([16500, 16500], "<i4").tobytes()
        path.write_bytes(data)
        refused(path, DataError, "pixels")

    @pytest.mark.parametrize("name", ["a.mkv", "a.ser", "a.npy", "a.tif", "folder"])
    def test_sizes_and_counts_beyond_the_limits(self, tmp_path, name):
        path = tmp_path / name
        frames = np.stack([frame[..., 0] for frame in scene(3)]) / np.float32(255)
        if name == "folder":
            path.mkdir()
            for number, frame in enumerate(frames):
                write_image(path / f"{number}.png", frame, 8)
        else:
            write_video(path, frames, 25)
        assert len(open_frames(path, limits=Limits(64 * 48, 3))) == 3
        assert refused(path, DataError, "64×48", limits=Limits(max_pixels=64 * 48 - 1)) == 65
        assert refused(path, DataError, "up to 2 frames", limits=Limits(max_frames=2)) == 65

    def test_stream_that_states_another_size_than_its_container(self, tmp_path):
        path = encode(tmp_path / "a.avi", scene(), "mpeg4", "yuv420p", "rgb24")
        data = bytearray(path.read_bytes())
        sizes = data.index(b"strf") + 12
        data[sizes : sizes + 8] = np.array([16, 16], "<i4").tobytes()
        path.write_bytes(data)
        assert open_frames(path).shape[1:3] == (48, 64)
        refused(path, DataError, limits=Limits(max_pixels=64 * 48 - 1))


def denied(self, *arguments):
    raise PermissionError(13, "Permission denied", os.fspath(self))


class TestDamage:
    CASES = (
        ("a.mkv", "ffv1", "gray", {"level": "3", "slicecrc": "1"}),
        ("a.mkv", "libx264", "yuv420p", {}),
        ("a.webm", "libvpx-vp9", "yuv420p", {}),
        ("a.avi", "ffv1", "gray", {"level": "3"}),
        ("a.avi", "mpeg4", "yuv420p", {}),
        ("a.avi", "mjpeg", "yuvj420p", {}),
        ("a.mp4", "libx264", "yuv420p", {}),
        ("a.mp4", "mpeg4", "yuv420p", {"container_options": {"movflags": "faststart"}}),
        ("a.mp4", "libx264", "yuv420p", {"container_options": {"movflags": "frag_keyframe+empty_moov"}}),
        ("a.mov", "mpeg4", "yuv420p", {}),
    )

    @pytest.mark.parametrize(("name", "codec", "pixel_format", "options"), CASES)
    @pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.99])
    def test_truncation_is_found_and_the_whole_file_is_not_blamed(
        self, tmp_path, name, codec, pixel_format, options, share
    ):
        frames = scene() if pixel_format != "gray" else [frame[..., 0] for frame in scene()]
        kind = "rgb24" if pixel_format != "gray" else None
        path = encode(tmp_path / name, frames, codec, pixel_format, kind, **options)
        assert not is_cut_short(path) and len(list(open_frames(path))) == 12
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        assert refused(path, DataError) == 65

    def test_gif_truncation(self, tmp_path):
        path = gif(tmp_path, scene(5))
        data = path.read_bytes()
        path.write_bytes(data + bytes(100))
        assert len(list(open_frames(path))) == 5
        path.write_bytes(data[: int(0.7 * len(data))])
        refused(path, DataError, "cut short")

    @pytest.mark.parametrize("form", ["npy", "tif", "zlib"])
    @pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.99])
    def test_truncated_arrays(self, tmp_path, form, share):
        stack = np.random.default_rng(0).integers(0, 65536, (6, 20, 30), dtype=np.uint16)
        path = tmp_path / ("a.npy" if form == "npy" else "a.tif")
        if form == "npy":
            np.save(path, stack)
        else:
            compression = "zlib" if form == "zlib" else None
            with tifffile.TiffWriter(path) as tiff:
                for frame in stack:
                    tiff.write(frame, compression=compression, contiguous=False, metadata=None)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        assert refused(path, DataError) == 65

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi", "a.gif", "a.mp4"])
    def test_the_intact_part_of_a_truncated_video_can_be_read(self, tmp_path, name):
        if name == "a.gif":
            path = gif(tmp_path, scene())
        elif name == "a.mp4":
            movflags = {"movflags": "frag_keyframe+empty_moov"}
            path = encode(tmp_path / name, scene(), "mjpeg", "yuvj420p", "rgb24", container_options=movflags)
        else:
            path = grey_ffv1(tmp_path / name)
        whole = open_frames(path).read()
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        with pytest.raises(DataError) as info:
            open_frames(path)
        intact = int(str(info.value).split()[-1])
        assert 2 < intact < 10
        np.testing.assert_array_equal(open_frames(path, frames=(1, intact)).read(), whole[1:intact])
        refused(path, DataError, "cut short", frames=(1, intact + 1))

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
    @pytest.mark.parametrize("first", [6, 11])
    def test_zeros_instead_of_the_last_frames_are_found(self, tmp_path, name, first):
        path = grey_ffv1(tmp_path / name)
        with av.open(str(path)) as container:
            position = [packet.pos for packet in container.demux() if packet.size][first]
        data = path.read_bytes()
        path.write_bytes(data[:position] + bytes(len(data) - position))
        refused(path, DataError, f"cut short after {first} whole frames" if name == "a.mkv" else "frame")

    def test_loss_that_the_decoder_conceals_but_marks_is_found(self, tmp_path):
        path = encode(tmp_path / "a.avi", scene(), "mpeg4", "yuv420p", "rgb24")
        with av.open(str(path)) as container:
            packet = [bytes(packet) for packet in container.demux() if packet.size][5]
        half = len(packet) // 2
        path.write_bytes(path.read_bytes().replace(packet, packet[:half] + bytes(len(packet) - half)))
        refused(path, DataError, "frame 5")

    @pytest.mark.parametrize("part", range(1, 9))
    def test_any_damaged_byte_of_a_slice_footer_is_found(self, tmp_path, part):
        path = grey_ffv1(tmp_path / "a.mkv", slices="4")
        with av.open(str(path)) as container:
            packet = [bytes(packet) for packet in container.demux() if packet.size][5]
        damaged = bytearray(packet)
        damaged[-part] ^= 0x11
        path.write_bytes(path.read_bytes().replace(packet, damaged))
        refused(path, DataError, "frame 5:")

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
    @given(data=st.data())
    @settings(max_examples=25, deadline=None)
    def test_any_flipped_byte_in_ffv1_is_found(self, tmp_path_factory, name, data):
        path = grey_ffv1(tmp_path_factory.mktemp("flip") / name)
        with av.open(str(path)) as container:
            packets = [(packet.pos, packet.size) for packet in container.demux() if packet.size]
        content = bytearray(path.read_bytes())
        number = data.draw(st.integers(0, len(packets) - 1))
        position, size = packets[number]
        # The position is that of the container's header of the packet, some bytes before the packet itself.
        offset = data.draw(st.integers(20, size - 1))
        content[position + offset] ^= data.draw(st.integers(1, 255))
        path.write_bytes(content)
        refused(path, DataError, f"frame {number}:")

    def test_damage_outside_the_selection_is_no_error(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", g="1")
        whole = open_frames(path).read()
        with av.open(str(path)) as container:
            positions = [packet.pos for packet in container.demux() if packet.size]
        content = bytearray(path.read_bytes())
        for number in (4, 7):
            content[positions[number] + 100] ^= 0x10
        path.write_bytes(content)
        refused(path, DataError, "frame 4 and 1 more")
        refused(path, DataError, "frame 7:", frames=(5, None))
        np.testing.assert_array_equal(open_frames(path, frames=(0, 4)).read(), whole[:4])
        np.testing.assert_array_equal(open_frames(path, frames=(5, None, 3)).read(), whole[5::3])

    def test_damage_before_the_selection_counts_where_frames_build_on_each_other(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", g="12")
        with av.open(str(path)) as container:
            positions = [packet.pos for packet in container.demux() if packet.size]
        content = bytearray(path.read_bytes())
        content[positions[4] + 100] ^= 0x10
        path.write_bytes(content)
        refused(path, DataError, "frame 4:", frames=(6, None))
        assert len(list(open_frames(path, frames=(0, 4)))) == 4

    def test_ffv1_without_checksums_is_not_blamed(self, tmp_path):
        frames = [frame[..., 0] for frame in scene()]
        for name, options in (("a.mkv", {"level": "3", "slicecrc": "0"}), ("b.mkv", {"level": "1"})):
            path = encode(tmp_path / name, frames, **options)
            np.testing.assert_array_equal(open_frames(path).read(), np.stack(frames) / np.float32(255))

    def test_checksum_agrees_with_the_decoder(self, tmp_path):
        """What is refused is what FFmpeg itself logs as a mismatch."""
        path = grey_ffv1(tmp_path / "a.mkv", g="1")
        with av.open(str(path)) as container:
            packets = [bytes(packet) for packet in container.demux() if packet.size]
        assert all(ffv1_slices_intact(packet) for packet in packets)
        content = bytearray(path.read_bytes())
        content[content.index(packets[5]) + 30] ^= 1
        path.write_bytes(content)
        before = av.logging.get_level()
        av.logging.set_level(av.logging.ERROR)
        try:
            with av.logging.Capture() as logs, av.open(io.BytesIO(content)) as container:
                container.streams.video[0].codec_context.thread_count = 1
                for _ in container.decode(video=0):
                    pass
        finally:
            av.logging.set_level(before)
        assert any("CRC" in message for _, _, message in logs)
        refused(path, DataError, "frame 5:")

    def test_fewer_frames_than_promised(self):
        source = FrameSource("a", "test", (5, 2, 2), 255, 8, lambda chosen: iter([np.zeros((2, 2), np.uint8)] * 3))
        with pytest.raises(DataError, match="expected 5 frames, found 3"):
            source.read()

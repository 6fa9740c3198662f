"""Videos in: every format, exact at its depth."""

import struct
from fractions import Fraction

import cv2
import numpy as np
import pytest
import tifffile

from turbrestore.core.errors import DataError
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from videos import encode, encode_yuv, gif, grey_ffv1, scene

INTERLACED = "interlaced video: the filter bwdif makes a whole frame of the first field of each"


class TestFormats:
    @pytest.mark.parametrize(
        ("name", "kind", "depth"),
        [
            ("gray", None, 8),
            *[(f"gray{depth}le", None, depth) for depth in (9, 10, 12, 14, 16)],
            ("bgr0", "rgb24", 8),
            *[(f"gbrp{depth}le", None, depth) for depth in (9, 10, 12, 14, 16)],
            ("rgb48le", None, 16),
        ],
    )
    def test_grey_and_rgb_are_exact_at_their_depth(self, tmp_path, name, kind, depth):
        shape = (3, 7, 9) if name.startswith("gray") else (3, 7, 9, 3)
        pixels = np.random.default_rng(0).integers(0, 2**depth, shape).astype(np.uint8 if depth == 8 else np.uint16)
        source = open_frames(encode(tmp_path / "a.mkv", pixels, pixel_format=name, kind=kind))
        assert (source.shape, source.bit_depth, source.warnings) == (shape, depth, ())
        assert source.format == "ffv1/" + name.replace("rgb48le", "gbrp16le")
        np.testing.assert_array_equal(source.read(), pixels / np.float32(2**depth - 1))

    @pytest.mark.parametrize(
        ("name", "codec", "pixel_format"),
        [
            *[(f"a.{suffix}", "libx264", "yuv420p") for suffix in ("mp4", "mkv", "mts")],
            *[(f"a.{suffix}", "mpeg4", "yuv420p") for suffix in ("mp4", "mov", "avi", "3gp")],
            *[(f"a.{suffix}", "mpeg2video", "yuv420p") for suffix in ("m2ts", "ts", "mxf")],
            *[("a.m4v", "libx264", "yuv444p"), ("a.avi", "mjpeg", "yuvj420p"), ("a.avi", "rawvideo", "bgr24")],
            *[("a.webm", "libvpx", "yuv420p"), ("a.webm", "libvpx-vp9", "yuv420p"), ("a.ivf", "libvpx", "yuv420p")],
            *[("A.MKV", "ffv1", "yuv420p"), ("a.wmv", "wmv2", "yuv420p"), ("a.y4m", "wrapped_avframe", "yuv420p")],
            *[("a.mpg", "mpeg1video", "yuv420p"), ("a.flv", "flv", "yuv420p")],
        ],
    )
    def test_colour_video_is_read_within_the_loss_of_its_codec(self, tmp_path, name, codec, pixel_format):
        frames, muxer = scene(), "yuv4mpegpipe" if name == "a.y4m" else None
        path = encode(tmp_path / name, frames, codec, pixel_format, "rgb24", muxer=muxer, b="4000000")
        source = open_frames(path)
        assert source.shape == (12, 48, 64, 3) and source.bit_depth == 8 and source.fps == pytest.approx(30)
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

    @pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.gif"])
    def test_data_that_other_programs_append_are_no_damage(self, tmp_path, name):
        frames = scene(5)
        codec = {"a.mp4": "libx264", "a.mkv": "libx264", "a.avi": "mpeg4"}.get(name)
        path = encode(tmp_path / name, frames, codec, "yuv420p", "rgb24") if codec else gif(tmp_path, frames)
        with path.open("ab") as file:
            file.write(bytes(64) if name == "a.gif" else b"SEFH appended by the camera" * 9)
        assert len(list(open_frames(path))) == 5

    @pytest.mark.parametrize("name", ["http:a.mkv", "a%03d.mkv", "-a.mkv"])
    def test_live_recordings_under_names_that_look_like_something_else_are_whole(self, tmp_path, monkeypatch, name):
        monkeypatch.chdir(tmp_path)
        grey_ffv1(tmp_path / "plain.mkv", container_options={"live": "1"}).rename(name)
        assert len(open_frames(name)) == len(list(open_frames(name))) == 12

    @pytest.mark.parametrize("rate", [Fraction(30000, 1001), Fraction(240)])
    def test_rounding_to_milliseconds_is_no_variable_rate(self, tmp_path, rate):
        write_video(tmp_path / "a.mkv", np.zeros((20, 4, 5), np.float32), float(rate))
        assert open_frames(tmp_path / "a.mkv").warnings == ()


class TestArraysStacksAndFolders:
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64, ">u2"])
    @pytest.mark.parametrize("form", ["npy", "tif"])
    def test_values_are_exact(self, tmp_path, dtype, form):
        dtype, path = np.dtype(dtype), tmp_path / f"a.{form}"
        white = np.iinfo(dtype).max if dtype.kind == "u" else 1
        for shape, kind in (((4, 5, 6), "minisblack"), ((4, 5, 6, 3), "rgb")):
            stack = (np.random.default_rng(0).random(shape) * white).astype(dtype)
            if form == "npy":
                np.save(path, stack)
            else:
                byteorder = ">" if dtype.byteorder == ">" else "<"
                tifffile.imwrite(path, stack, photometric=kind, compression="zlib", byteorder=byteorder)
            source = open_frames(path)
            assert source.shape == shape and source.fps is None and source.timestamps is None
            assert source.bit_depth == (8 * dtype.itemsize if dtype.kind == "u" else 32)
            np.testing.assert_array_equal(source.read(), (stack / np.float32(white)).astype(np.float32))

    @pytest.mark.parametrize(
        "options",
        [
            *[{}, {"imagej": True}, {"imagej": True, "truncate": True}, {"bigtiff": True}, {"metadata": None}],
            *[{"ome": True}, {"compression": "zlib", "predictor": False}],
        ],
    )
    def test_tiff_of_many_writers(self, tmp_path, options):
        stack = np.random.default_rng(0).integers(0, 65536, (5, 6, 7), dtype=np.uint16)
        tifffile.imwrite(tmp_path / "a.tiff", stack, **options)
        np.testing.assert_array_equal(open_frames(tmp_path / "a.tiff").read(), stack / np.float32(65535))

    def test_tiff_planes_alpha_and_inverted_grey(self, tmp_path):
        path, values = tmp_path / "a.tif", np.random.default_rng(0).integers(0, 256, (4, 4, 5, 6), dtype=np.uint8)
        for stored, options, expected, warnings in (
            (values[:, :3], {"photometric": "rgb", "planarconfig": "separate"}, np.moveaxis(values[:, :3], 1, -1), ()),
            (
                np.moveaxis(values, 1, -1),
                {"photometric": "rgb", "extrasamples": ["unassalpha"]},
                np.moveaxis(values[:, :3], 1, -1),
                ("alpha channel ignored",),
            ),
            (values[:, 0], {"photometric": "miniswhite"}, 255 - values[:, 0], ()),
        ):
            tifffile.imwrite(path, stored, **options)
            source = open_frames(path)
            assert source.warnings == warnings
            np.testing.assert_array_equal(source.read(), expected / np.float32(255))

    @pytest.mark.parametrize(
        ("suffix", "dtype"),
        [*[(suffix, dtype) for suffix in (".png", ".tif") for dtype in (np.uint8, np.uint16)], (".bmp", np.uint8)],
    )
    def test_folder_is_read_in_natural_order(self, tmp_path, suffix, dtype):
        white = np.iinfo(dtype).max
        stack = np.random.default_rng(0).integers(0, white, (12, 5, 6), dtype=dtype)
        for index, frame in enumerate(stack):
            assert cv2.imwrite(str(tmp_path / f"Frame{index}{suffix}"), frame)
        for name in ("notes.txt", ".hidden.png"):
            (tmp_path / name).write_text("not an image")
        (tmp_path / "sub.png").mkdir()
        source = open_frames(tmp_path)
        assert source.shape == (12, 5, 6) and source.bit_depth == np.iinfo(dtype).bits
        np.testing.assert_array_equal(source.read(), stack / np.float32(white))

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


class TestInterlaced:
    """Fields of a scene that moves to the right, woven into frames, that of the odd rows first."""

    @pytest.fixture
    def fields(self):
        x, y = np.arange(96)[None, :], np.arange(64)[:, None]
        return [np.uint8(128 + 50 * np.sin((x - 3 * k) / 5) + 50 * np.cos(y / 9)) for k in range(16)]

    @pytest.fixture
    def clip(self, tmp_path, fields):
        woven = [first.copy() for first in fields[::2]]
        for frame, second in zip(woven, fields[1::2], strict=True):
            frame[::2] = second[::2]
        colours = [np.stack([frame] * 3, -1) for frame in woven]
        path = tmp_path / "a.mkv"
        return encode(path, colours, "libx264", "yuv444p", "rgb24", flags="+ilme+ildct", crf="1")

    def test_frames_are_whole_and_as_many_also_in_selections(self, clip, fields):
        source = open_frames(clip)
        assert source.warnings == (INTERLACED,) and len(source) == 8
        found = source.read()
        assert found.shape == (8, 64, 96, 3)
        np.testing.assert_array_equal(source.select((2, 8, 3), (5, 4, 30, 20)).read(), found[2:8:3, 4:24, 5:35])
        for frame, first, second in zip(found, fields[::2], fields[1::2], strict=True):
            assert np.abs(255 * frame[..., 1] - first).mean() < 4
            assert np.abs(first[::2].astype(float) - second[::2]).mean() > 15

    def test_few_frames_and_what_stands_still_keep_their_number_and_colours(self, tmp_path):
        for count in (1, 2, 5):
            still, flags = scene(1)[0], {"flags": "+ilme+ildct", "crf": "1"}
            path = encode(tmp_path / f"{count}.mkv", [still] * count, "libx264", "yuv444p", "rgb24", **flags)
            found = open_frames(path).read()
            assert len(found) == count and np.abs(255 * found - still).mean() < 2


class TestNamedAxes:
    """TIFF files of OME and ImageJ, whose pages are in the order of the axes they name."""

    @pytest.mark.parametrize("kind", ["ome", "imagej"])
    @pytest.mark.parametrize("axes", ["TYX", "ZYX", "CYX", "TCYX", "ZCYX", "TYXS"])
    def test_time_and_colour(self, tmp_path, kind, axes):
        dtype = np.uint8 if axes == "TYXS" else np.uint16
        frames = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (4, 6, 7, 3)[: len(axes)]).astype(dtype)
        stored = np.moveaxis(frames, -1, 1) if axes.endswith("CYX") and axes != "CYX" else frames
        tifffile.imwrite(tmp_path / "a.tif", stored, metadata={"axes": axes}, **{kind: True})
        source = open_frames(tmp_path / "a.tif")
        np.testing.assert_array_equal(list(source.native()), frames)
        np.testing.assert_array_equal(list(source.select((1, 4, 2)).native()), frames[1:4:2])

    def test_channels_that_come_first(self, tmp_path):
        data = np.random.default_rng(0).integers(0, 255, (3, 4, 6, 7)).astype(np.uint8)
        tifffile.imwrite(tmp_path / "a.tif", data, metadata={"axes": "CTYX"}, ome=True)
        np.testing.assert_array_equal(list(open_frames(tmp_path / "a.tif").native()), data.transpose(1, 2, 3, 0))

    @pytest.mark.parametrize(("axes", "shape"), [("TCYX", (4, 2, 6, 7)), ("TZYX", (4, 5, 6, 7))])
    def test_other_axes_are_refused(self, tmp_path, axes, shape):
        tifffile.imwrite(tmp_path / "a.tif", np.zeros(shape, np.uint8), metadata={"axes": axes}, ome=True)
        with pytest.raises(DataError, match=f"expected one axis of time or depth.*{axes[0]} of 4"):
            open_frames(tmp_path / "a.tif")

    def test_other_files_are_not_opened(self, tmp_path):
        """Two files that describe one series; each is read by itself."""
        data = np.random.default_rng(0).integers(0, 255, (4, 6, 7)).astype(np.uint8)
        tifffile.imwrite(tmp_path / "a.tif", data, metadata={"axes": "TYX"}, ome=True)
        with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
            xml = tiff.ome_metadata
        uuid = '<UUID FileName="b.tif">urn:uuid:1</UUID>'
        xml = xml.replace('SizeT="4"', 'SizeT="8"').replace(
            "</Pixels>", f'<TiffData FirstT="4">{uuid}</TiffData></Pixels>'
        )
        for name in ("a.tif", "b.tif"):
            tifffile.imwrite(tmp_path / name, data, photometric="minisblack", description=xml, metadata=None)
        np.testing.assert_array_equal(list(open_frames(tmp_path / "a.tif").native()), data)


def avi_with_palette(path, frames, palette):
    """An uncompressed AVI of 8 bits as capture programs write it: rows from the bottom up, and a palette."""
    height, width = frames[0].shape
    row = -(-width // 4) * 4

    def chunk(name, data):
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    head = struct.pack("<14I", 40_000, 0, 0, 16, len(frames), 0, 1, row * height, width, height, 0, 0, 0, 0)
    numbers = 0, 0, 0, 0, 1, 25, 0, len(frames), row * height, 0xFFFFFFFF, 0, 0, 0, width, height
    stream = b"vidsDIB " + struct.pack("<IHHIIIIIIIIhhhh", *numbers)
    image = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, row * height, 0, 0, 256, 0) + palette.tobytes()
    lists = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", image))
    pictures = (np.pad(frame[::-1], ((0, 0), (0, row - width))).tobytes() for frame in frames)
    movie = b"".join(chunk(b"00db", picture) for picture in pictures)
    body = b"AVI " + chunk(b"LIST", b"hdrl" + chunk(b"avih", head) + lists) + chunk(b"LIST", b"movi" + movie)
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    return path


def test_a_grey_palette_of_a_raw_avi_is_grey_and_may_be_a_mosaic(tmp_path):
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 4, axis=1)
    ramp[:, 3] = 0
    frames = np.random.default_rng(0).integers(0, 90, (3, 24, 30), np.uint8)
    frames[:, ::2, ::2] += 150
    frames[:, 1::2, 1::2] += 100
    path = avi_with_palette(tmp_path / "a.avi", frames, ramp)
    source = open_frames(path)
    assert source.shape == (3, 24, 30) and "--bayer" in source.warnings[0]
    np.testing.assert_array_equal(list(source.native()), frames)
    np.save(tmp_path / "a.npy", frames)
    expected = open_frames(tmp_path / "a.npy", bayer="rggb").read()
    np.testing.assert_array_equal(open_frames(path, bayer="rggb").read(), expected)
    palette = np.random.default_rng(1).integers(0, 256, (256, 4), np.uint8)
    source = open_frames(avi_with_palette(tmp_path / "b.avi", frames, palette))
    np.testing.assert_array_equal(list(source.native()), palette[frames][..., 2::-1])

"""Videos in: what is refused, and every kind of damage."""

import io
import os
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import DataError, InputNotFoundError, StorageError
from turbrestore.io.containers.integrity import ffv1_slices_intact, is_cut_short
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.limits import Limits
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from videos import RATE, cuts, encode, gif, grey_ffv1, packets, refused, scene, write_pages

GREY = np.zeros((4, 5), np.uint8)
SHARES = (0.02, 0.3, 0.6, 0.9, 0.99)


def saved(array):
    return lambda path: np.save(path, array)


def npz(path):
    with path.open("wb") as file:
        np.savez(file, a=np.zeros((4, 5, 6)))


def with_lone(value):
    stack = np.zeros((4, 5, 6), np.float32)
    stack[2, 1, 1] = value
    return stack


def pair(second):
    """A folder of two images."""

    def write(path):
        path.mkdir()
        cv2.imwrite(str(path / "1.png"), GREY)
        cv2.imwrite(str(path / "2.png"), second)

    return write


# Name of a file, what writes it, and what the refusal says.
NO_VIDEO = [
    *[("a.npy", saved(np.zeros(shape)), ()) for shape in ((4, 5), (4, 5, 6, 4))],
    *[("a.npy", saved(np.zeros((4, 5, 6), dtype)), ()) for dtype in ("c8", bool)],
    ("a.npy", saved(np.array([None, {}], object)), ()),
    ("a.npy", npz, ("not a whole .npy array",)),
    *[("a.npy", saved(with_lone(value)), ("frame 2", "NaN")) for value in (np.nan, np.inf)],
    *[("a.tif", lambda path, value=value: write_pages(path, with_lone(value)), ("frame 2", "NaN"))
      for value in (np.nan, np.inf)],
    ("a.tif", lambda path: write_pages(path, [GREY, GREY.T]), ("frame 1", "5×4", "4×5")),
    ("a.tif", lambda path: write_pages(path, [GREY], photometric="palette", colormap=np.zeros((3, 256), "u2")),
     ("grey or RGB",)),
    ("a.tif", lambda path: write_pages(path, np.zeros((1, 4, 5, 4), np.uint8), photometric="separated"),
     ("grey or RGB",)),
    *[("folder", pair(second), ("2.png", "5×4 grey uint8"))
      for second in (GREY.T, GREY.astype(np.uint16), np.zeros((4, 5, 3), np.uint8))],
]  # fmt: skip


class TestRefusals:
    def test_other_content(self, tmp_path):
        assert refused(tmp_path / "no.mkv", InputNotFoundError, "no.mkv") == 66
        grey_ffv1(tmp_path / "other.mkv")
        subtitle = b"1\n00:00:01,000 --> 00:00:02,000\nsubtitle\n\n" * 9
        for suffix in (".mp4", ".mkv", ".avi", ".gif", ".webm", ".mov", ".tif", ".npy", ".ser"):
            for content in (b"", b"only text\n" * 40, subtitle, b"ffconcat version 1.0\nfile other.mkv\n", bytes(5000)):
                (tmp_path / f"a{suffix}").write_bytes(content)
                assert refused(tmp_path / f"a{suffix}", DataError, f"a{suffix}") == 65
        for name, word in (("a.xyz", ".mkv"), ("a", "no suffix"), ("a.jpg", "folder")):
            (tmp_path / name).write_bytes(b"x")
            refused(tmp_path / name, DataError, word)
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "a.txt").write_text("x")
        refused(tmp_path / "folder", DataError, "none in the folder")

    @pytest.mark.parametrize(("name", "write", "words"), NO_VIDEO)
    def test_arrays_pages_and_images_that_are_no_video(self, tmp_path, name, write, words):
        write(tmp_path / name)
        refused(tmp_path / name, DataError, *words)

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

    # tifffile looks for circles after 100 pages, and follows longer ones without end.
    @pytest.mark.parametrize("pages", [1, 150])
    def test_tiff_whose_pages_form_a_circle(self, tmp_path, pages):
        write_pages(tmp_path / "a.tif", [GREY] * pages)
        with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
            first, link = tiff.pages[0].offset, tiff.pages.next_page_offset
        data = bytearray((tmp_path / "a.tif").read_bytes())
        data[link : link + 4] = first.to_bytes(4, "little")
        (tmp_path / "a.tif").write_bytes(data)
        refused(tmp_path / "a.tif", DataError, "circle")

    def test_no_permission_is_a_storage_error(self, tmp_path, monkeypatch):
        path = grey_ffv1(tmp_path / "a.mkv")
        monkeypatch.setattr(Path, "open", denied)
        assert refused(path, StorageError, "Permission denied") == 74

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

    def test_a_container_that_states_another_size_than_its_stream(self, tmp_path):
        def with_side(path, side):
            data = bytearray(path.read_bytes())
            sizes = data.index(b"strf") + 12
            data[sizes : sizes + 8] = np.array([side, side], "<i4").tobytes()
            path.write_bytes(data)
            return path

        raw = with_side(encode(tmp_path / "a.avi", scene(), "rawvideo", "bgr24", "rgb24"), 16500)
        refused(raw, DataError, "pixels")
        path = with_side(encode(tmp_path / "b.avi", scene(), "mpeg4", "yuv420p", "rgb24"), 16)
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
    def test_truncation_is_found_and_the_whole_file_is_not_blamed(self, tmp_path, name, codec, pixel_format, options):
        frames = scene() if pixel_format != "gray" else [frame[..., 0] for frame in scene()]
        kind = "rgb24" if pixel_format != "gray" else None
        path = encode(tmp_path / name, frames, codec, pixel_format, kind, **options)
        assert not is_cut_short(path) and len(list(open_frames(path))) == 12
        for part in cuts(path, *SHARES):
            assert refused(part, DataError) == 65

    @pytest.mark.parametrize("form", ["npy", "tif", "zlib"])
    def test_truncated_arrays(self, tmp_path, form):
        stack = np.random.default_rng(0).integers(0, 65536, (6, 20, 30), dtype=np.uint16)
        path = tmp_path / ("a.npy" if form == "npy" else "a.tif")
        if form == "npy":
            np.save(path, stack)
        else:
            write_pages(path, stack, compression="zlib" if form == "zlib" else None)
        for part in cuts(path, *SHARES):
            assert refused(part, DataError) == 65

    @pytest.mark.parametrize("big", [False, True])
    def test_tiff_strips_and_tiles_without_bytes(self, tmp_path, big):
        path, stack = tmp_path / "a.tif", np.random.default_rng(0).integers(1, 256, (3, 32, 32), dtype=np.uint8)
        for layout in ({"rowsperstrip": 32}, {"rowsperstrip": 8}, {"tile": (16, 16)}):
            for compression in (None, "deflate"):
                write_pages(path, stack, big, compression=compression, **layout)
                whole, tags = path.read_bytes(), (324, 325) if "tile" in layout else (273, 279)
                np.testing.assert_array_equal(open_frames(path).read(), stack / np.float32(255))
                # A count or an offset of zero, and offsets past the end of the file.
                for tag, value in ((tags[1], 0), (tags[0], 0), (tags[0], len(whole)), (tags[0], 2**32 - 1)):
                    path.write_bytes(whole)
                    with tifffile.TiffFile(path, mode="r+") as tiff:
                        entry = tiff.pages[2].tags[tag]
                        entry.overwrite((*entry.value[:-1], value), dtype="Q" if big else "I")
                    assert refused(path, DataError, f"{path}: frame 2: expected", "found none in 1 of") == 65
                    np.testing.assert_array_equal(open_frames(path, frames=(0, 2)).read(), stack[:2] / np.float32(255))
        tifffile.imwrite(path, stack[0], bigtiff=big, metadata=None)
        with tifffile.TiffFile(path, mode="r+") as tiff:
            tiff.pages[0].tags[279].overwrite((0,))
        with pytest.raises(DataError, match="expected pixels in all strips and tiles, found none in 1 of 1"):
            read_image(path)

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi", "a.gif", "a.mp4", "a.ser"])
    def test_the_intact_part_of_a_truncated_video_can_be_read(self, tmp_path, name):
        path = tmp_path / name
        if name == "a.gif":
            gif(tmp_path, scene())
        elif name == "a.mp4":
            movflags = {"movflags": "frag_keyframe+empty_moov"}
            encode(path, scene(), "mjpeg", "yuvj420p", "rgb24", container_options=movflags)
        elif name == "a.ser":
            write_video(path, np.stack(scene())[..., 0] / np.float32(255), 25, 8)
        else:
            grey_ffv1(path)
        whole = open_frames(path).read()
        [_] = cuts(path, 0.5)
        with pytest.raises(DataError, match="cut short") as info:
            open_frames(path)
        intact = int(str(info.value).split("after ")[1].split()[0])
        assert 2 < intact < 10
        np.testing.assert_array_equal(open_frames(path, frames=(1, intact)).read(), whole[1:intact])
        refused(path, DataError, "cut short", frames=(1, intact + 1))
        source = open_frames(path, skip_damaged=True)
        assert source.warnings == (f"cut short after {intact} whole frames; the others are missing",)
        np.testing.assert_array_equal(source.read(), whole[:intact])

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
    @pytest.mark.parametrize("first", [6, 11])
    def test_zeros_instead_of_the_last_frames_are_found(self, tmp_path, name, first):
        path = grey_ffv1(tmp_path / name)
        position, data = packets(path)[first][0], path.read_bytes()
        path.write_bytes(data[:position] + bytes(len(data) - position))
        refused(path, DataError, f"cut short after {first} whole frames" if name == "a.mkv" else "frame")

    def test_loss_that_the_decoder_conceals_but_marks_is_found(self, tmp_path):
        path = encode(tmp_path / "a.avi", scene(), "mpeg4", "yuv420p", "rgb24")
        packet = packets(path)[5][1]
        half = len(packet) // 2
        path.write_bytes(path.read_bytes().replace(packet, packet[:half] + bytes(len(packet) - half)))
        refused(path, DataError, "frame 5")
        assert len(open_frames(path, skip_damaged=True).read()) == 5

    @pytest.mark.parametrize("damage", ["lost", "overwritten"])
    def test_frames_from_the_next_key_frame_on_survive(self, tmp_path, damage):
        path = encode(tmp_path / "a.ts", scene(30, 144, 192), "libx264", "yuv420p", "rgb24", g="10", crf="8")
        whole, data = open_frames(path).read(), bytearray(path.read_bytes())
        places = [place for place, _ in packets(path)]
        # In the middle of the second of three groups.
        if damage == "lost":
            start = 188 * (places[13] // 188 + 1)
            del data[start : start + 188]
        else:
            start = 188 * (places[11] // 188 + 2) + 20
            data[start : start + 150] = np.random.default_rng(0).bytes(150)
        path.write_bytes(data)
        refused(path, DataError, "allow damaged ones to be skipped")
        source = open_frames(path, skip_damaged=True)
        (remark,) = source.warnings
        assert remark.startswith("damaged: frames ") and remark.endswith(" left out")
        assert source.fps == RATE
        kept = np.rint(np.array(source.timestamps) * float(RATE)).astype(int)
        assert {*range(10), *range(20, 30)} <= set(kept) and 20 < len(kept) < 30
        np.testing.assert_array_equal(source.read(), whole[kept])

    def test_what_a_strict_decoder_refuses_of_a_sound_clip_is_no_damage(self, tmp_path):
        path = encode(tmp_path / "a.h264", scene(count=12), "libx264", "yuv420p", "rgb24", bf="3")
        whole, data = open_frames(path).read(), path.read_bytes()
        # A message of four bytes where sixteen belong.
        start = data.index(b"\0\0\1\x65")
        path.write_bytes(data[:start] + b"\0\0\1\x06\x05\x04\1\2\3\4\x80" + data[start:])
        np.testing.assert_array_equal(open_frames(path).read(), whole)
        assert len(open_frames(path, skip_damaged=True)) == 12

    def test_frames_before_a_key_frame_in_an_open_group_are_no_damage(self, tmp_path):
        options = {"g": "10", "bf": "3", "x264_params": "open-gop=1:keyint=10:min-keyint=10"}
        path = encode(tmp_path / "a.mp4", scene(count=40), "libx264", "yuv420p", "rgb24", **options)
        with av.open(str(path)) as container, av.open(str(tmp_path / "b.mp4"), "w") as output:
            source = container.streams.video[0]
            stream, groups = output.add_stream_from_template(source), 0
            for packet in container.demux(source):
                groups += packet.is_keyframe
                if groups > 1 and packet.size > 0:
                    packet.stream = stream
                    output.mux(packet)
        for skip in (False, True):
            assert len(open_frames(tmp_path / "b.mp4", skip_damaged=skip).read()) >= 29

    def test_a_recording_that_ends_within_a_frame_is_read(self, tmp_path):
        path = encode(tmp_path / "a.ts", scene(30, 144, 192), "libx264", "yuv420p", "rgb24", bf="3", crf="8")
        whole, data = open_frames(path).read(), path.read_bytes()
        path.write_bytes(data[: -188 * 4])
        read = open_frames(path).read()
        # The decoder conceals what the last frame lacks.
        assert len(read) >= 29 and (np.abs(read - whole[: len(read)]).max(axis=(1, 2, 3)) == 0).sum() >= 28

    def test_any_damaged_byte_of_a_slice_footer_is_found(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", slices="4")
        packet, data = packets(path)[5][1], path.read_bytes()
        for part in range(1, 9):
            damaged = bytearray(packet)
            damaged[-part] ^= 0x11
            path.write_bytes(data.replace(packet, damaged))
            refused(path, DataError, "frame 5:")

    @pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
    def test_any_flipped_byte_in_ffv1_is_found(self, tmp_path, name):
        path = grey_ffv1(tmp_path / name)
        sound, content = packets(path), path.read_bytes()

        @given(data=st.data())
        @settings(max_examples=25, deadline=None)
        def flip_a_byte(data):
            number = data.draw(st.integers(0, len(sound) - 1))
            position, packet = sound[number]
            # The position is that of the container's header of the packet, some bytes before the packet itself.
            offset = data.draw(st.integers(20, len(packet) - 1))
            damaged = bytearray(content)
            damaged[position + offset] ^= data.draw(st.integers(1, 255))
            path.write_bytes(damaged)
            refused(path, DataError, f"frame {number}:")

        flip_a_byte()

    def damaged(self, path, *numbers):
        """Flip a bit in some frames of a video; its frames before that."""
        whole, content = open_frames(path).read(), bytearray(path.read_bytes())
        for number in numbers:
            content[packets(path)[number][0] + 100] ^= 0x10
        path.write_bytes(content)
        return whole

    def test_damage_outside_the_selection_is_no_error(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", g="1")
        whole = self.damaged(path, 4, 7)
        refused(path, DataError, "frame 4 and 1 more")
        refused(path, DataError, "frame 7:", frames=(5, None))
        np.testing.assert_array_equal(open_frames(path, frames=(0, 4)).read(), whole[:4])
        np.testing.assert_array_equal(open_frames(path, frames=(5, None, 3)).read(), whole[5::3])

    def test_damage_before_the_selection_counts_where_frames_build_on_each_other(self, tmp_path):
        path = grey_ffv1(tmp_path / "a.mkv", g="12")
        self.damaged(path, 4)
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
        sound = [packet for _, packet in packets(path)]
        assert all(ffv1_slices_intact(packet) for packet in sound)
        content = bytearray(path.read_bytes())
        content[content.index(sound[5]) + 30] ^= 1
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

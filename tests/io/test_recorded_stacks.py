"""Arrays, stacks and folders as programs and phones write them: axes, channels, white, turns, thumbnails."""

import cv2
import numpy as np
import PIL.Image
import pytest
import tifffile

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.footage.checks.content import check_content
from turbrestore.io.axes import frames_are_last
from turbrestore.io.images.image_files import read_image, read_pixels
from turbrestore.io.pixels import upright
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from videos import memory_below, refused, scene, write_pages

COLOUR = np.stack(scene(14, 40, 56))
# A still scene with noise; the waves of ``scene`` move.
STILL = np.clip(COLOUR[:1].mean(axis=-1) + np.random.default_rng(0).normal(0, 4, (14, 40, 56)), 0, 255).astype(np.uint8)


class TestArrays:
    @pytest.mark.parametrize("count", [8, 14, 60])
    def test_frames_along_the_last_axis(self, tmp_path, count):
        frames = np.clip(STILL[0] + np.random.default_rng(1).normal(0, 9, (count, 40, 56)), 0, 255).astype(np.uint8)
        np.save(tmp_path / "a.npy", np.moveaxis(frames, 0, -1))
        source = open_frames(tmp_path / "a.npy")
        np.testing.assert_array_equal(np.rint(source.read() * 255), frames)
        (remark,) = source.warnings
        assert "(H, W, T)" in remark and "--axes thw" in remark

    def test_an_array_in_memory_is_read_as_given_with_a_remark(self):
        last = FrameSource.from_array(np.ascontiguousarray(np.moveaxis(STILL, 0, -1)))
        assert last.shape == (40, 56, 14) and "np.moveaxis" in last.warnings[0]
        assert FrameSource.from_array(STILL).warnings == FrameSource.from_array(COLOUR).warnings == ()

    def test_frames_of_an_object_that_jumps_stay_first(self):
        rng, y, x = np.random.default_rng(4), *np.mgrid[:96, :128]
        places = zip(rng.uniform(30, 98, 40), rng.uniform(30, 66, 40), strict=True)
        frames = np.stack([np.hypot(x - u, y - v) < 20 for u, v in places]) + rng.normal(0, 0.02, (40, 96, 128))
        assert not frames_are_last(frames)
        assert frames_are_last(np.moveaxis(STILL, 0, -1))

    def test_large_arrays_are_not_copied_to_tell_their_axes(self):
        frames = np.zeros((20, 480, 640), np.float32)
        frames[:] = np.random.default_rng(2).random((480, 640), np.float32)
        with memory_below(0.3 * frames.nbytes):
            assert FrameSource.from_array(frames).warnings == ()

    @pytest.mark.parametrize(
        ("order", "axes"), [((0, 3, 1, 2), "(T, 3, H, W)"), ((1, 2, 3, 0), "(H, W, 3, T)")], ids=["TCHW", "HWCT"]
    )
    def test_channels_tell_the_order_and_one_is_none(self, tmp_path, order, axes):
        np.save(tmp_path / "a.npy", np.transpose(COLOUR, order))
        source = open_frames(tmp_path / "a.npy")
        np.testing.assert_array_equal(source.read(), COLOUR / np.float32(255))
        assert axes in source.warnings[0]
        np.save(tmp_path / "a.npy", np.expand_dims(STILL, 1 if order[1] == 3 else 3))
        assert open_frames(tmp_path / "a.npy").shape == STILL.shape

    @pytest.mark.parametrize("light", ["steady", "bracketed", "stepped", "fading"])
    @pytest.mark.parametrize("last", [False, True], ids=["THW", "HWT"])
    def test_light_that_changes_does_not_change_the_order(self, tmp_path, light, last):
        gains = {"steady": np.ones(12), "bracketed": np.tile([0.25, 0.5, 1], 4), "fading": np.linspace(1, 0.08, 12)}
        gain = {**gains, "stepped": np.repeat([1, 0.3], 6)}[light]
        rng = np.random.default_rng(3)
        scene = cv2.GaussianBlur(rng.uniform(0, 1, (40, 56)), (0, 0), 1.5)
        frames = np.uint8(255 * np.clip((scene + rng.normal(0, 0.02, (12, 40, 56))) * gain[:, None, None], 0, 1))
        np.save(tmp_path / "a.npy", np.moveaxis(frames, 0, 2 * last))
        source = open_frames(tmp_path / "a.npy")
        np.testing.assert_array_equal(np.rint(source.read() * 255), frames)
        assert len(source.warnings) == last

    def test_square_frames_come_last_where_they_are_a_little_more_alike(self, tmp_path):
        """A fence whose rows resemble each other nearly as much as the frames do."""
        rng = np.random.default_rng(0)
        fence, texture = rng.standard_normal((1, 60, 1)), 0.35 * rng.standard_normal((60, 60, 1))
        frames = fence + texture + 0.28 * rng.standard_normal((60, 60, 20))
        np.save(tmp_path / "a.npy", np.uint8(127 + 40 * frames.clip(-2, 2)))
        source = open_frames(tmp_path / "a.npy")
        assert source.shape == (20, 60, 60) and "(H, W, T)" in source.warnings[0]

    def test_square_frames_come_first_whatever_they_show(self, tmp_path):
        """A disc beside the middle, turned by 180° in half of the frames: its planes along x are the most alike."""
        y, x = np.mgrid[:60, :60]
        disc = np.clip((18 - np.hypot(x - 34, y - 24)) / 2, 0, 1) * (0.6 + 0.3 * np.sin(y / 2))
        frames = np.uint8(200 * np.stack([disc] * 10 + [disc[::-1, ::-1]] * 10))
        np.save(tmp_path / "a.npy", frames)
        source = open_frames(tmp_path / "a.npy")
        assert source.shape == frames.shape and source.warnings == ()

    def test_axes_that_are_named(self, tmp_path):
        for axes in ("thwc", "tchw", "HWCT", "hwt"):
            names = axes.lower()
            frames = COLOUR if "c" in names else STILL
            np.save(tmp_path / "a.npy", np.transpose(frames, ["thwc".index(name) for name in names]))
            source = open_frames(tmp_path / "a.npy", axes=axes)
            np.testing.assert_array_equal(np.rint(source.read() * 255), frames)
            assert source.warnings == ()
        refused(tmp_path / "a.npy", ConfigurationError, "--axes: expected thw, hwt, thwc or tchw", axes="xyt")
        refused(tmp_path / "a.npy", ConfigurationError, "--axes: expected 3 letters", axes="thwc")
        write_video(tmp_path / "a.ser", np.zeros((2, 4, 5), np.float32), 25)
        refused(tmp_path / "a.ser", ConfigurationError, "--axes: has an effect on .npy", axes="thw")

    def test_usual_orders_have_no_remark(self, tmp_path):
        rng = np.random.default_rng(0)
        striped = np.broadcast_to(STILL[:, :1], STILL.shape)
        drifting = np.stack([np.roll(STILL[k], 3 * k, axis=1) for k in range(14)])
        for frames in (STILL, COLOUR, striped, drifting, rng.integers(0, 255, (14, 40, 56)), STILL[:, ::-1, :20]):
            np.save(tmp_path / "a.npy", frames.astype(np.uint8))
            source = open_frames(tmp_path / "a.npy")
            assert source.warnings == () and source.shape == frames.shape

    def test_one_colour_image_is_refused(self, tmp_path):
        np.save(tmp_path / "a.npy", np.zeros((80, 90, 3), np.uint8))
        refused(tmp_path / "a.npy", DataError, "one colour image", "(T, H, W)")


class TestTiff:
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_stacks_are_turned_upright(self, tmp_path, orientation):
        write_pages(tmp_path / "a.tif", STILL, extratags=[(274, "H", 1, orientation, True)])
        expected = np.stack([upright(frame, orientation) for frame in STILL])
        np.testing.assert_array_equal(np.rint(open_frames(tmp_path / "a.tif").read() * 255), expected)

    def test_lzw(self, tmp_path):
        write_pages(tmp_path / "a.tif", STILL, compression="lzw")
        np.testing.assert_array_equal(open_frames(tmp_path / "a.tif").read(), STILL / np.float32(255))

    @pytest.mark.parametrize(
        ("order", "big", "first"), [("<", False, 0), ("<", True, 1), (">", False, 1), (">", True, 0)]
    )
    def test_pages_of_reduced_size_are_left_out(self, tmp_path, order, big, first):
        with tifffile.TiffWriter(tmp_path / "a.tif", byteorder=order, bigtiff=big) as output:
            for page in [STILL[0, ::4, ::4]] * first + [*STILL, STILL[0, ::4, ::4]]:
                options = {"photometric": "minisblack", "contiguous": False, "metadata": None}
                output.write(page, subfiletype=int(page.shape != STILL.shape[1:]), **options)
        source = open_frames(tmp_path / "a.tif")
        np.testing.assert_array_equal(source.read(), STILL / np.float32(255))
        assert source.warnings == (f"{1 + first} page{'s' * first} of reduced size left out",)


class TestFolders:
    @pytest.mark.parametrize("white", [100, 255, 1023, 4095, 65535])
    def test_white_of_portable_maps(self, tmp_path, white):
        values = np.linspace(0, white, 40 * 56).astype(np.int64).reshape(40, 56)
        for number in range(3):
            data = np.roll(values, number).astype(np.uint8 if white < 256 else ">u2").tobytes()
            (tmp_path / f"{number}.pgm").write_bytes(b"P5\n# a comment\n56 40\n%d\n" % white + data)
        found = open_frames(tmp_path).read()
        np.testing.assert_allclose(found[1], np.roll(values, 1) / white, atol=0.003 if white < 256 else 1e-5)
        assert read_image(tmp_path / "0.pgm").image.max() == 1

    @pytest.mark.parametrize(("white", "kind"), [(9, "uint8"), (255, "uint8"), (900, "uint16")])
    def test_text_maps_may_end_without_a_new_line(self, tmp_path, white, kind):
        (tmp_path / "a.pgm").write_bytes(b"P2 3 2 %d\n0 1 2\n3 4 %d" % (white, white))
        pixels, _ = read_pixels(tmp_path / "a.pgm")
        full = np.iinfo(kind).max
        np.testing.assert_array_equal(pixels, np.rint(np.array([[0, 1, 2], [3, 4, white]]) * full / white))
        assert pixels.dtype == kind

    @pytest.mark.parametrize("name", ["thumb.png", "0.png", "9.png", "5a.png"])
    def test_the_image_that_is_no_frame_is_named(self, tmp_path, name):
        for number in range(1, 9):
            PIL.Image.fromarray(STILL[number]).save(tmp_path / f"{number}.png")
        PIL.Image.fromarray(np.ascontiguousarray(STILL[0, ::4, ::4])).save(tmp_path / name)
        refused(tmp_path, DataError, f"{name}: expected 56×40", "found 14×10", "take it out")

    def test_photographs_of_all_orientations_are_one_scene(self, tmp_path):
        for number, frame in enumerate(COLOUR):
            turn, tag = [(0, 1), (1, 6), (2, 3), (3, 8)][number % 4]
            exif = PIL.Image.Exif()
            exif[0x112] = tag
            PIL.Image.fromarray(np.rot90(frame, turn)).save(tmp_path / f"{number}.jpg", quality=95, exif=exif)
        source = open_frames(tmp_path)
        assert source.shape == COLOUR.shape and np.abs(255 * source.read() - COLOUR).mean() < 6
        assert not check_content(source).left_out

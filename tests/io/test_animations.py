"""Animated images: frames in order, upright, at their rate, and refusals of damaged files."""

import struct
import zlib

import av
import cv2
import numpy as np
import PIL.Image
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.limits import Limits
from turbrestore.io.video import open_frames, write_video
from videos import cuts, refusal

COUNT = 6
COLOUR = np.random.default_rng(0).integers(0, 256, (COUNT, 12, 17, 3), dtype=np.uint8)
# EXIF orientations by the turn of NumPy that a reader has to undo, as (quarter turns, mirrored).
TURNS = {
    **{1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True)},
    **{5: (1, True), 6: (1, False), 7: (3, True), 8: (3, False)},
}


def stored(image, orientation):
    """Pixels as a file holds them whose orientation tag makes ``image`` of them."""
    turns, mirrored = TURNS[orientation]
    image = image[:, ::-1] if mirrored else image
    return np.ascontiguousarray(np.rot90(image, turns))


def exif(orientation):
    data = PIL.Image.Exif()
    data[274] = orientation
    return data


def animation(path, frames=COLOUR, duration=40, **options):
    images = [PIL.Image.fromarray(frame) for frame in frames]
    options = {"lossless": True, **options} if path.suffix == ".webp" else options
    images[0].save(path, format=None if path.suffix != ".apng" else "PNG", save_all=True, append_images=images[1:],
                   duration=duration, **options)  # fmt: skip
    return path


def ffmpeg_apng(path, frames, pixel_format):
    """Write 16-bit frames, of which Pillow writes too small a part."""
    with av.open(str(path), "w", format="apng") as output:
        stream = output.add_stream("apng", rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixel_format
        for frame in frames:
            native = pixel_format.replace("be", "le")
            output.mux(stream.encode(av.VideoFrame.from_ndarray(frame, native).reformat(format=pixel_format)))
        output.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("name", ["a.png", "a.apng", "a.webp"])
class TestReading:
    def test_frames_come_in_order(self, tmp_path, name):
        source = open_frames(animation(tmp_path / name))
        assert (source.shape, source.bit_depth, source.fps) == ((COUNT, 12, 17, 3), 8, 25)
        assert source.warnings == ()
        np.testing.assert_allclose(source.timestamps, np.arange(COUNT) * 0.04)
        np.testing.assert_array_equal(source.read(), COLOUR / np.float32(255))

    def test_a_selection_equals_a_slice(self, tmp_path, name):
        source = open_frames(animation(tmp_path / name), frames=(1, None, 2), roi=(3, 2, 5, 4))
        np.testing.assert_array_equal(source.read(), COLOUR[1::2, 2:6, 3:8] / np.float32(255))
        assert source.fps == 12.5
        with pytest.raises(ConfigurationError, match="frames"):
            open_frames(tmp_path / name, frames=(0, COUNT + 1))

    def test_a_varying_rate_is_reported(self, tmp_path, name):
        source = open_frames(animation(tmp_path / name, duration=[40, 40, 120, 40, 40, 40]))
        assert source.warnings == ("variable frame rate",)
        np.testing.assert_allclose(source.timestamps, [0, 0.04, 0.08, 0.2, 0.24, 0.28])

    def test_frames_are_turned_upright(self, tmp_path, name):
        for orientation in TURNS:
            frames = [stored(frame, orientation) for frame in COLOUR]
            source = open_frames(animation(tmp_path / name, frames, exif=exif(orientation)))
            np.testing.assert_array_equal(source.read(), COLOUR / np.float32(255))

    def test_alpha_is_dropped_with_a_warning(self, tmp_path, name):
        frames = np.concatenate([COLOUR, np.full((COUNT, 12, 17, 1), 200, np.uint8)], axis=3)
        source = open_frames(animation(tmp_path / name, frames, exact=True))
        assert source.warnings == ("alpha channel ignored",)
        np.testing.assert_array_equal(source.read(), COLOUR / np.float32(255))

    def test_truncation_is_refused(self, tmp_path, name):
        for part in cuts(animation(tmp_path / name), 0.02, 0.3, 0.6, 0.99):
            with refusal(DataError, name):
                open_frames(part)

    def test_limits_hold(self, tmp_path, name):
        animation(tmp_path / name)
        for limits, word in (
            (Limits(max_pixels=12 * 17 - 1), "17×12"),
            (Limits(max_frames=COUNT - 1), "up to 5 frames"),
            (Limits(max_bytes=100), "up to 100 bytes"),
        ):
            with pytest.raises(DataError, match=word):
                open_frames(tmp_path / name, limits=limits)
        assert len(open_frames(tmp_path / name, limits=Limits(12 * 17, COUNT))) == COUNT

    def test_still_images_and_other_content_are_refused(self, tmp_path, name):
        PIL.Image.fromarray(COLOUR[0]).save(tmp_path / name, format="WEBP" if name == "a.webp" else "PNG")
        with pytest.raises(DataError, match="or the folder that holds the frames"):
            open_frames(tmp_path / name)
        (tmp_path / name).write_bytes(b"text " * 20)
        with pytest.raises(DataError, match="not an image of a known format"):
            open_frames(tmp_path / name)


@pytest.mark.parametrize("name", ["a.png", "a.webp"])
def test_as_an_image_its_first_frame_is_read(tmp_path, name):
    np.testing.assert_array_equal(read_image(animation(tmp_path / name)).image, COLOUR[0] / np.float32(255))


class TestAnimatedPng:
    def test_grey_frames_a_still_image_before_them_and_frames_that_change_only_in_part(self, tmp_path):
        in_part = np.repeat(COLOUR[:1], COUNT, axis=0)
        for number, frame in enumerate(in_part):
            frame[2 + number, 3:6] = number
        grey = COLOUR[..., 0]
        for frames, expected, still in ((grey, grey, False), (COLOUR, COLOUR[1:], True), (in_part, in_part, False)):
            source = open_frames(animation(tmp_path / "a.png", frames, default_image=still))
            np.testing.assert_array_equal(source.read(), expected / np.float32(255))

    def test_sixteen_bit_grey_is_exact(self, tmp_path):
        frames = np.random.default_rng(0).integers(0, 65536, (3, 12, 17), dtype=np.uint16)
        source = open_frames(ffmpeg_apng(tmp_path / "a.png", frames, "gray16be"))
        assert source.bit_depth == 16 and source.warnings == ()
        np.testing.assert_array_equal(source.read(), frames / np.float32(65535))

    def test_sixteen_bit_colour_is_read_as_eight_bits_with_a_warning(self, tmp_path):
        source = open_frames(ffmpeg_apng(tmp_path / "a.png", COLOUR * np.uint16(257), "rgb48be"))
        assert source.bit_depth == 8 and source.warnings == ("16-bit values read as 8 bits",)
        np.testing.assert_array_equal(source.read(), COLOUR / np.float32(255))

    def test_the_whole_frames_of_a_truncated_file_can_be_read(self, tmp_path):
        [_] = cuts(animation(tmp_path / "a.png"), 0.6)
        with pytest.raises(DataError, match="cut short after 3 whole frames"):
            open_frames(tmp_path / "a.png")
        part = open_frames(tmp_path / "a.png", frames=(1, 3))
        np.testing.assert_array_equal(part.read(), COLOUR[1:3] / np.float32(255))
        source = open_frames(tmp_path / "a.png", skip_damaged=True)
        assert len(source) == 3
        assert source.warnings == ("damaged or cut short after 3 whole frames; the others are missing",)

    def test_every_flipped_byte_of_the_pixels_is_found(self, tmp_path):
        data = animation(tmp_path / "a.png").read_bytes()
        start, rng = data.index(b"IDAT"), np.random.default_rng(0)
        for place in rng.integers(start, len(data) - 12, 40):
            changed = bytearray(data)
            changed[place] ^= int(rng.integers(1, 256))
            (tmp_path / "a.png").write_bytes(changed)
            with pytest.raises(DataError):
                open_frames(tmp_path / "a.png").read()


@pytest.mark.parametrize(("name", "colours"), [("a.webp", slice(None)), ("a.gif", 0)])
def test_what_is_written_comes_back(tmp_path, name, colours):
    write_video(tmp_path / name, COLOUR[..., colours] / np.float32(255), 20)
    source = open_frames(tmp_path / name)
    expected = COLOUR if name == "a.webp" else np.repeat(COLOUR[..., :1], 3, axis=3)
    np.testing.assert_array_equal(source.read(), expected / np.float32(255))
    assert source.fps == 20


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp", "a.tif"])
def test_still_images_are_turned_upright(tmp_path, name):
    image = np.kron(COLOUR[0, :3, :4], np.ones((8, 8, 1), np.uint8))
    options = {"a.jpg": {"quality": 100, "subsampling": 0}, "a.webp": {"lossless": True}}.get(name, {})
    for orientation in TURNS:
        PIL.Image.fromarray(stored(image, orientation)).save(tmp_path / name, exif=exif(orientation), **options)
        found = read_image(tmp_path / name).image
        np.testing.assert_allclose(found, image / np.float32(255), atol=0.03 if name == "a.jpg" else 0)


@pytest.mark.parametrize("orientation", [3, 6])
def test_deep_colour_is_turned_upright(tmp_path, orientation):
    image = np.random.default_rng(0).integers(0, 65536, (5, 7, 3), dtype=np.uint16)
    data = cv2.imencode(".png", stored(image, orientation)[..., ::-1])[1].tobytes()
    PIL.Image.fromarray(COLOUR[0]).save(tmp_path / "exif.png", exif=exif(orientation))
    other = (tmp_path / "exif.png").read_bytes()
    start = other.index(b"eXIf") - 4
    chunk = other[start : start + 12 + int.from_bytes(other[start : start + 4], "big")]
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])
    np.testing.assert_array_equal(read_image(tmp_path / "a.png").image, image / np.float32(65535))


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16"])
def test_png_of_every_kind_is_exact(tmp_path, mode):
    grey = np.arange(63, dtype=np.uint8).reshape(7, 9) * 4
    colours = np.stack([grey, 255 - grey, grey // 2], axis=-1)
    alpha = np.full((7, 9), 77, np.uint8)
    image, expected, white = {
        "1": (PIL.Image.fromarray(grey > 99), grey > 99, 1),
        "L": (PIL.Image.fromarray(grey), grey, 255),
        "LA": (PIL.Image.fromarray(np.dstack([grey, alpha])), grey, 255),
        "P": (PIL.Image.fromarray(colours).quantize(63), colours, 255),
        "RGB": (PIL.Image.fromarray(colours), colours, 255),
        "RGBA": (PIL.Image.fromarray(np.dstack([colours, alpha])), colours, 255),
        "I;16": (PIL.Image.fromarray(grey * np.uint16(257)), grey * np.uint16(257), 65535),
    }[mode]
    image.save(tmp_path / "a.png")
    found = read_image(tmp_path / "a.png")
    expected = np.asarray(image.convert("RGB")) if mode == "P" else expected
    np.testing.assert_array_equal(found.image, expected / np.float32(white))
    assert found.warnings == (("alpha channel ignored",) if "A" in mode else ())


def test_a_transparent_palette_is_dropped_with_a_warning(tmp_path):
    image = PIL.Image.fromarray(COLOUR[0]).quantize(20)
    image.save(tmp_path / "a.png", transparency=0)
    found = read_image(tmp_path / "a.png")
    assert found.warnings == ("alpha channel ignored",)
    np.testing.assert_array_equal(found.image, np.asarray(image.convert("RGB")) / np.float32(255))


@pytest.mark.parametrize("channels", [2, 3, 4])
def test_deep_png_with_and_without_alpha_is_exact(tmp_path, channels):
    pixels = np.random.default_rng(0).integers(0, 65536, (5, 7, channels), dtype=np.uint16)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", 7, 5, 16, {2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    found = read_image(tmp_path / "a.png")
    expected = pixels[..., 0] if channels == 2 else pixels[..., :3]
    np.testing.assert_array_equal(found.image, expected / np.float32(65535))
    assert found.bit_depth == 16 and found.warnings == (() if channels == 3 else ("alpha channel ignored",))

"""Still images: exact round trips, refusals in one line, and nothing left behind."""

import os
import stat
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from turbrestore.core.errors import (
    ConfigurationError,
    DataError,
    InputNotFoundError,
    OutputError,
    StorageError,
    TurbrestoreError,
)
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.output import atomic_output, atomic_write, check_output
from turbrestore.io.pixels import to_unit

PATTERN = np.arange(5 * 7 * 3, dtype=np.uint16).reshape(5, 7, 3)


def refused(error: type[TurbrestoreError], *words: str):
    """Expect ``error`` with a message of one line that contains ``words``."""

    class Check:
        def __enter__(self):
            self.raises = pytest.raises(error)
            self.info = self.raises.__enter__()
            return self

        def __exit__(self, *details):
            done = self.raises.__exit__(*details)
            message = str(self.info.value)
            assert "\n" not in message and all(word in message for word in words), message
            return done

    return Check()


def test_float_depth_becomes_16_bits_in_png_and_values_are_clipped(tmp_path):
    write_image(tmp_path / "a.png", np.array([[-1.0, 0.25, 2.0]], np.float32), bit_depth=32)
    assert cv2.imread(str(tmp_path / "a.png"), -1).tolist() == [[0, 16384, 65535]]
    write_image(tmp_path / "a.tif", np.array([[-1.0, 0.25, 2.0]], np.float32), bit_depth=32)
    assert tifffile.imread(tmp_path / "a.tif").tolist() == [[0.0, 0.25, 1.0]]


def test_depths_from_9_to_15_fill_the_range_of_16_bits(tmp_path):
    write_image(tmp_path / "a.png", np.array([[0.0, 1.0]], np.float32), bit_depth=10)
    assert cv2.imread(str(tmp_path / "a.png"), -1).tolist() == [[0, 65535]]


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg", "a.bmp", "a.ppm", "a.webp", "A.PNG"])
def test_channels_come_as_red_green_blue(tmp_path, name):
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes blue, green, red
    assert cv2.imwrite(str(tmp_path / name), red)
    np.testing.assert_allclose(read_image(tmp_path / name).image[8, 8], [1, 0, 0], atol=0.02)


def test_written_channels_are_red_green_blue(tmp_path):
    write_image(tmp_path / "a.png", np.full((2, 2, 3), [1, 0, 0], np.float32), bit_depth=8)
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [0, 0, 255]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_is_dropped_with_a_warning(tmp_path, dtype):
    pixels = np.dstack([PATTERN, PATTERN[..., 0]]).astype(dtype)
    assert cv2.imwrite(str(tmp_path / "a.png"), pixels)
    found = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(found.image, (PATTERN[..., ::-1] / np.float32(np.iinfo(dtype).max)))
    assert found.warnings == ("alpha channel ignored",)


def test_missing_image_is_not_found(tmp_path):
    with refused(InputNotFoundError, "missing.png"):
        read_image(tmp_path / "missing.png")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.bmp", "a.webp"])
@pytest.mark.parametrize("content", [b"", b"not an image at all, only text\n" * 20])
def test_empty_and_text_files_are_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with refused(DataError, name):
        read_image(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_truncated_image_is_refused(tmp_path, suffix, share):
    noise = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, noise)[1].tobytes()
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    with refused(DataError, path.name):
        read_image(path)


def test_flipped_bit_in_png_is_refused_without_a_word_from_libpng(tmp_path, capfd):
    data = bytearray(cv2.imencode(".png", PATTERN)[1].tobytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with refused(DataError):
        read_image(tmp_path / "a.png")
    assert capfd.readouterr() == ("", "")


def test_unknown_suffix_is_refused(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    with refused(DataError, ".png", ".txt"):
        read_image(tmp_path / "a.txt")


@pytest.mark.parametrize("side", [20_000, 100_000])
def test_decompression_bomb_is_refused_by_its_header(tmp_path, side):
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    body = zlib.compress(bytes(1000))
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(data)
    with refused(DataError, "pixels"):
        read_image(tmp_path / "bomb.png")


def test_bomb_in_tiff_is_refused_by_its_header(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((2, 3), np.uint8))
    data = bytearray((tmp_path / "a.tif").read_bytes())
    for tag in (256, 257):  # width and height, 32-bit values in little-endian entries
        place = data.index(struct.pack("<HH", tag, 4))
        data[place + 8 : place + 12] = struct.pack("<I", 60_000)
    (tmp_path / "a.tif").write_bytes(data)
    with refused(DataError, "60000×60000"):
        read_image(tmp_path / "a.tif")


def test_stack_of_pages_is_no_single_image(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 4, 5), np.uint8), photometric="minisblack")
    with refused(DataError, "3 pages"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("values", "word"),
    [([0, np.nan], "1 NaN"), ([np.inf, 0], "1 NaN")],
)
def test_values_that_are_not_finite_are_refused(tmp_path, values, word):
    tifffile.imwrite(tmp_path / "a.tif", np.array([values], np.float32))
    with refused(DataError, word):
        read_image(tmp_path / "a.tif")


def test_small_overshoot_is_clipped():
    values = np.array([-0.009, 0.5, 1.009], np.float64)
    assert to_unit(values, 1, "a").tolist() == [0.0, 0.5, 1.0]
    assert values[0] == -0.009


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32, np.float64])
def test_counts_are_scaled_and_come_back(tmp_path, dtype):
    counts = np.arange(-3, 997).reshape(20, 50).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", counts)
    found = read_image(tmp_path / "a.tif")
    np.testing.assert_allclose(found.image, (counts + 3.0) / 999, atol=1e-6)
    assert found.warnings == ("values -3 to 996 are scaled: -3 is black, 996 is white",) and found.bit_depth == 32
    write_image(tmp_path / "b.tif", found.image, levels=(-3, 996))
    np.testing.assert_allclose(tifffile.imread(tmp_path / "b.tif"), counts, atol=1e-3)


def test_unreadable_file_is_a_storage_error(tmp_path, monkeypatch):
    write_image(tmp_path / "a.png", np.zeros((2, 2), np.float32))

    def denied(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", denied)
    with refused(StorageError, "Permission denied"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.exr"])
def test_other_output_suffixes_are_a_usage_error(tmp_path, name):
    with refused(ConfigurationError, ".png", ".tif"):
        write_image(tmp_path / name, np.zeros((2, 2), np.float32))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("depth", [0, 17, 31, 33, -8, True])
def test_unknown_bit_depth_is_a_usage_error(tmp_path, depth):
    with refused(ConfigurationError, "bit_depth"):
        write_image(tmp_path / "a.png", np.zeros((2, 2), np.float32), bit_depth=depth)


def test_nan_is_not_written(tmp_path):
    with refused(DataError, "NaN"):
        write_image(tmp_path / "a.png", np.full((2, 2), np.nan, np.float32))
    assert not any(tmp_path.iterdir())


def test_existing_output_needs_overwrite(tmp_path):
    write_image(tmp_path / "a.png", np.zeros((2, 2), np.float32))
    with refused(OutputError, "exists"):
        write_image(tmp_path / "a.png", np.ones((2, 2), np.float32))
    assert read_image(tmp_path / "a.png").image.max() == 0
    write_image(tmp_path / "a.png", np.ones((2, 2), np.float32), overwrite=True)
    assert read_image(tmp_path / "a.png").image.min() == 1


def test_output_without_a_place_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    for name, word in (("no/a.png", "does not exist"), ("file/a.png", "does not exist"), ("folder.png", "is a folder")):
        with refused(OutputError, word):
            check_output(tmp_path / name, overwrite=True)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with refused(OutputError, "not writable"):
        check_output(tmp_path / "a.png")


@pytest.mark.parametrize("link", ["same", "symbolic", "hard", "detour", "folder"])
def test_output_that_is_an_input_is_refused_under_any_name(tmp_path, link):
    source = tmp_path / "in.png"
    source.write_bytes(b"x")
    places = {"same": source, "detour": tmp_path / "sub" / ".." / "in.png", "folder": tmp_path / "here" / "in.png"}
    target = places.get(link, tmp_path / "out.png")
    (tmp_path / "sub").mkdir()
    (tmp_path / "here").symlink_to(".")
    if link == "symbolic":
        target.symlink_to(source)
    if link == "hard":
        target.hardlink_to(source)
    with refused(OutputError, "is the input"):
        check_output(target, inputs=[tmp_path / "other.mkv", source], overwrite=True)


def test_output_in_the_input_folder_is_refused(tmp_path):
    with refused(OutputError, "input folder"):
        check_output(tmp_path / "result.png", inputs=[tmp_path])


def test_possible_output_is_accepted(tmp_path):
    (tmp_path / "in").mkdir()
    check_output(tmp_path / "a.png", inputs=[tmp_path / "in", tmp_path / "missing.mkv"])
    check_output(tmp_path / "a.json", suffixes=None)
    assert [entry.name for entry in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, DataError])
@pytest.mark.parametrize("exists", [False, True])
def test_interrupted_writing_leaves_everything_as_it_was(tmp_path, error, exists):
    path = tmp_path / "a.bin"
    if exists:
        path.write_bytes(b"old")
    with pytest.raises(error), atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(b"new")
        raise error("stop")
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == ([("a.bin", b"old")] * exists)


def test_full_disk_is_a_storage_error_and_leaves_nothing(tmp_path):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with refused(StorageError, "nothing was saved"):
            atomic_write(tmp_path / "a.bin", bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not any(tmp_path.iterdir())


def test_uncreatable_file_is_an_output_error(tmp_path, monkeypatch):
    def denied(self, *arguments):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    with refused(OutputError, "Permission denied"):
        atomic_write(tmp_path / "a.bin", b"x")


def test_failing_encoder_is_a_storage_error(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imencode", lambda *arguments: (False, None))
    with refused(StorageError):
        write_image(tmp_path / "a.png", np.zeros((2, 2), np.float32))
    assert not any(tmp_path.iterdir())


def test_symbolic_link_is_followed(tmp_path):
    (tmp_path / "real.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to(tmp_path / "real.bin")
    atomic_write(tmp_path / "link.bin", b"new", overwrite=True)
    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "real.bin").read_bytes() == b"new"


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        atomic_write(tmp_path / "a.bin", b"x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.bin").stat().st_mode) == 0o640


def test_two_writes_give_the_same_bytes(tmp_path):
    image = np.random.default_rng(0).random((8, 9, 3), dtype=np.float32)
    for name in ("a.png", "b.png", "a.tif", "b.tif"):
        write_image(tmp_path / name, image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_text_under_the_name_of_an_image_is_said_to_be_none(tmp_path):
    path = tmp_path / "text.png"
    path.write_text("no picture")
    with pytest.raises(DataError, match=r"text\.png: not an image of a known format$"):
        read_image(path)

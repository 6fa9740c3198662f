"""Still images: exact round trips, refusals in one line, and nothing left behind."""

import os
import stat
from pathlib import Path

import cv2
import hostile_files as hostile
import numpy as np
import pytest
import tifffile

from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, OutputError, StorageError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.output import atomic_output, atomic_write, check_output
from turbrestore.io.pixels import to_unit
from videos import cuts
from videos import refusal as refused

PATTERN = np.arange(5 * 7 * 3, dtype=np.uint16).reshape(5, 7, 3)


def test_deep_values_become_16_bits_in_png_and_are_clipped(tmp_path):
    for depth in (10, 32):
        write_image(tmp_path / f"{depth}.png", np.array([[-1.0, 0.25, 2.0]], np.float32), bit_depth=depth)
        black, grey, white = cv2.imread(str(tmp_path / f"{depth}.png"), -1)[0].tolist()
        assert (black, white) == (0, 65535) and (grey == 16384 or depth == 10)
    write_image(tmp_path / "a.tif", np.array([[-1.0, 0.25, 2.0]], np.float32), bit_depth=32)
    assert tifffile.imread(tmp_path / "a.tif").tolist() == [[0.0, 0.25, 1.0]]


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg", "a.bmp", "a.ppm", "a.webp", "A.PNG"])
def test_channels_come_as_red_green_blue(tmp_path, name):
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes blue, green, red
    assert cv2.imwrite(str(tmp_path / name), red)
    np.testing.assert_allclose(read_image(tmp_path / name).image[8, 8], [1, 0, 0], atol=0.02)


def test_missing_image_is_not_found(tmp_path):
    with refused(InputNotFoundError, "missing.png"):
        read_image(tmp_path / "missing.png")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.bmp", "a.webp"])
def test_empty_and_text_files_are_refused(tmp_path, name):
    kind = "not a TIFF file" if name == "a.tif" else "not an image of a known format"
    for content, word in ((b"", name), (b"not an image at all, only text\n" * 20, f"{name}: {kind}")):
        (tmp_path / name).write_bytes(content)
        with refused(DataError, word):
            read_image(tmp_path / name)


def test_a_tiff_file_of_numbers_of_an_unknown_kind_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((8, 10), np.int16))
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as tiff:
        tiff.pages[0].tags["SampleFormat"].overwrite(0)
    with refused(DataError, "SampleFormat 0; convert the file"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm"])
def test_truncated_image_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8))
    for part in cuts(path, 0.1, 0.5, 0.95):
        with refused(DataError, path.name):
            read_image(part)


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


@pytest.mark.parametrize(
    ("bomb", "word"), [("huge.png", "pixels"), ("absurd.png", "pixels"), ("huge.tif", "60000×60000")]
)
def test_bombs_are_refused_by_their_headers(tmp_path, bomb, word):
    hostile.BOMBS[bomb].write(tmp_path / bomb)
    with refused(DataError, word):
        read_image(tmp_path / bomb)


def test_stack_of_pages_is_no_single_image(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 4, 5), np.uint8), photometric="minisblack")
    with refused(DataError, "3 pages"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("values", [[0, np.nan], [np.inf, 0]])
def test_values_that_are_not_finite_are_refused(tmp_path, values):
    tifffile.imwrite(tmp_path / "a.tif", np.array([values], np.float32))
    with refused(DataError, "1 NaN"):
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


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_two_writes_give_the_same_bytes(tmp_path, suffix):
    paths = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for path in paths:
        write_image(path, np.random.default_rng(0).random((8, 9, 3), dtype=np.float32))
    assert paths[0].read_bytes() == paths[1].read_bytes()

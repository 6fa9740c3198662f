"""Compressed pixels that inflate to more, or to something else, than their file says; those that are right are read."""

import struct
import zlib
from itertools import product

import cv2
import hostile_files as hostile
import numpy as np
import PIL.Image
import pytest
import tifffile

from turbrestore.core.errors import DataError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.images.tiff import open_tiff
from videos import memory_below


class TestInflation:
    def test_tiff_whose_pixels_inflate_beyond_its_page(self, tmp_path):
        packed, options = zlib.compress(bytes(5 * 10**7)), {"dtype": np.uint8, "compression": "zlib", "metadata": None}
        tifffile.imwrite(tmp_path / "a.tif", iter([packed]), shape=(40, 50), **options)
        source = open_tiff(tmp_path / "a.tif")
        damaged = "compressed pixels are damaged .*; copy the file again"
        with memory_below(5e6), pytest.raises(DataError, match=damaged):
            source.read()

    @pytest.mark.parametrize("compression", ["zlib", "lzma"])
    @pytest.mark.parametrize("options", [{}, {"tile": (16, 16)}, {"rowsperstrip": 5}, {"planarconfig": "separate"}])
    def test_whole_tiffs_are_read(self, tmp_path, compression, options):
        stack = np.random.default_rng(0).integers(0, 65536, (3, 33, 35, 3), dtype=np.uint16)
        pages = np.moveaxis(stack, -1, 1) if "planarconfig" in options else stack
        with tifffile.TiffWriter(tmp_path / "a.tif") as tiff:
            for page in pages:
                tiff.write(page, photometric="rgb", compression=compression, metadata=None, **options)
        np.testing.assert_array_equal(open_tiff(tmp_path / "a.tif").read(), stack / np.float32(65535))

    @pytest.mark.parametrize("compression", [1, 5, 8, 32773, 32946])
    def test_whole_still_tiffs_are_read(self, tmp_path, compression):
        for form, dtype in product([(33, 35), (33, 35, 3), (33, 35, 4)], [np.uint8, np.uint16, np.float32]):
            pixels = np.random.default_rng(0).integers(0, 2, form).astype(dtype)
            cv2.imwrite(str(tmp_path / "a.tif"), pixels, [cv2.IMWRITE_TIFF_COMPRESSION, compression])
            with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
                assert tiff.pages.first.compression == compression
            assert np.ptp(read_image(tmp_path / "a.tif").image) > 0, (form, dtype)

    # OpenCV does not read tiles of RGB that are not compressed.
    @pytest.mark.parametrize(
        ("options", "compression"),
        [
            ({"tile": (16, 16)}, "zlib"),
            ({"rowsperstrip": 5}, "zlib"),
            ({"rowsperstrip": 5}, None),
            ({"planarconfig": "separate"}, "zlib"),
            ({"planarconfig": "separate"}, None),
        ],
    )
    def test_still_tiffs_of_tiles_strips_and_planes_are_read(self, tmp_path, options, compression):
        pixels = np.random.default_rng(0).integers(0, 256, (33, 35, 3), dtype=np.uint8)
        stored = np.moveaxis(pixels, -1, 0) if "planarconfig" in options else pixels
        tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", compression=compression, **options)
        np.testing.assert_array_equal(read_image(tmp_path / "a.tif").image, pixels / np.float32(255))

    @pytest.mark.parametrize("compression", ["raw", "packbits", "tiff_lzw", "tiff_adobe_deflate", "jpeg"])
    def test_still_tiffs_of_other_kinds_are_read(self, tmp_path, compression):
        image = PIL.Image.fromarray(np.uint8(np.arange(63).reshape(7, 9)))
        for mode in ("L", "RGB") if compression == "jpeg" else ("1", "P", "L", "RGBA"):
            image.convert(mode).save(tmp_path / "a.tif", compression=compression)
            assert read_image(tmp_path / "a.tif").image.shape[:2] == (7, 9), mode

    def test_packed_bits_and_further_compressions_are_read(self, tmp_path):
        path, rng = tmp_path / "a.tif", np.random.default_rng(0)
        for bits in (10, 12, 14):
            packed = rng.integers(0, 2**bits, (2, 33, 35), np.uint16)
            rows = (packed[..., None] >> np.arange(bits)[::-1] & 1).reshape(2, 33, -1)
            pages = (page.tobytes() for page in np.packbits(rows.astype(bool), axis=-1))
            tifffile.imwrite(
                path, pages, shape=packed.shape, dtype=np.uint16, bitspersample=bits, photometric="minisblack"
            )
            np.testing.assert_array_equal(open_tiff(path).read(), packed / np.float32(2**bits - 1))
        frames = rng.integers(0, 256, (2, 33, 35, 3), np.uint8)
        for compression in ("zstd", "png", "webp", "jpeg2000"):
            tifffile.imwrite(path, frames, photometric="rgb", compression=compression)
            np.testing.assert_array_equal(open_tiff(path).read(), frames / np.float32(255), compression)
            tifffile.imwrite(path, frames[0], photometric="rgb", compression=compression)
            np.testing.assert_array_equal(read_image(path).image, frames[0] / np.float32(255), compression)
        for compression in ("lerc", "jpegxr", "jpegxl"):
            tifffile.imwrite(path, frames, photometric="rgb", compression=compression)
            with pytest.raises(DataError, match=f"found {compression.upper()}; convert the file to one of these"):
                open_tiff(path).read()

    @pytest.mark.parametrize("side", [9000, 11_000, 65_500])
    def test_tiff_whose_parts_are_larger_images(self, tmp_path, side):
        packed = bytearray(cv2.imencode(".jpg", np.zeros((40, 50), np.uint8))[1].tobytes())
        # Height and width follow the mark of the frame, its length and its depth.
        place = packed.index(b"\xff\xc0") + 5
        packed[place : place + 4] = struct.pack(">HH", side, side)
        options = {"dtype": np.uint8, "compression": "jpeg", "metadata": None}
        tifffile.imwrite(tmp_path / "a.tif", iter([bytes(packed)]), shape=(40, 50), **options)
        with memory_below(5e6):
            for read in (read_image, lambda path: open_tiff(path).read()):
                with pytest.raises(DataError, match="pixels"):
                    read(tmp_path / "a.tif")

    @pytest.mark.parametrize("compression", ["zlib", "lzma", "jpeg"])
    def test_stacks_of_flipped_or_short_parts_are_refused(self, tmp_path, compression):
        path, frames = tmp_path / "a.tif", np.random.default_rng(0).integers(0, 256, (2, 48, 64), dtype=np.uint8)
        tifffile.imwrite(path, frames, photometric="minisblack", compression=compression)
        assert np.abs(open_tiff(path).read() - frames / np.float32(255)).mean() < 0.1
        with tifffile.TiffFile(path) as tiff:
            start, size = tiff.pages[1].dataoffsets[0], tiff.pages[1].databytecounts[0]
        data = path.read_bytes()
        # A flip within pixels of JPEG is another picture.
        places = [(size // 2, size - size // 2)] if compression == "jpeg" else [(size - 20, 20), (size // 2, 1)]
        for place, length in places:
            path.write_bytes(data[: start + place] + bytes(length) + data[start + place + length :])
            words = r"damaged .cut short.; copy the file again" if compression == "jpeg" else "damaged"
            with pytest.raises(DataError, match=words):
                open_tiff(path).read()

    def test_every_flip_and_a_zeroed_end_of_a_deflated_still_are_found(self, tmp_path):
        span = hostile.write_still(tmp_path / "a.tif", "deflate")
        whole = (tmp_path / "a.tif").read_bytes()
        zeroed = whole[: span[1] - 30] + bytes(30) + whole[span[1] :]
        for data in (zeroed, *hostile.flipped_still(tmp_path / "a.tif", span, 40)):
            (tmp_path / "b.tif").write_bytes(data)
            with pytest.raises(DataError, match="compressed pixels are damaged .*; copy the file again"):
                read_image(tmp_path / "b.tif")

    @pytest.mark.parametrize("levels", [1, 2, 20, 256])
    def test_whole_lzw_is_decoded(self, tmp_path, capfd, levels):
        for shape in ((1, 1), (7, 300), (150, 200), (300, 400)):
            pixels = np.random.default_rng(levels).integers(0, levels, shape, dtype=np.uint8)
            PIL.Image.fromarray(pixels).save(tmp_path / "a.tif", compression="tiff_lzw")
            np.testing.assert_array_equal(read_image(tmp_path / "a.tif").image, pixels / np.float32(255))
            assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("compression", ["LZW", "PackBits"])
    def test_what_a_decoder_would_complain_of_is_refused(self, tmp_path, capfd, compression):
        span, refusals = hostile.write_still(tmp_path / "a.tif", compression), 0
        for data in hostile.flipped_still(tmp_path / "a.tif", span, 60):
            (tmp_path / "b.tif").write_bytes(data)
            try:
                read_image(tmp_path / "b.tif")
            except DataError:
                refusals += 1
        assert capfd.readouterr().err == ""
        assert refusals

    @pytest.mark.parametrize("lost", [1, 40])
    def test_png_of_too_few_rows_is_refused_without_a_word_from_libpng(self, tmp_path, capfd, lost):
        hostile._png(tmp_path / "a.png", 32, extra=b"")
        data = (tmp_path / "a.png").read_bytes()
        header = struct.pack(">IIBBBBB", 32, 2000 // 33 + lost, 8, 0, 0, 0, 0)
        data = data[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + data[33:]
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(DataError, match="truncated"):
            read_image(tmp_path / "a.png")
        assert capfd.readouterr() == ("", "")

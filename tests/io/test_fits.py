"""FITS: cubes, folders and images against arrays, what is refused, and what is written."""

import gzip
import importlib.util
import warnings

import numpy as np
import pytest
from astropy.io import fits

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.footage.sensor.calibration import calibrated, make_calibration
from turbrestore.io.astronomy.fits import open_fits
from turbrestore.io.astronomy.fits_output import write_fits
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.limits import Limits
from turbrestore.io.output import check_output
from turbrestore.io.video import open_frames
from turbrestore_cli.__main__ import main
from videos import memory_below, refusal

RNG = np.random.default_rng(4)
UINT16 = RNG.integers(0, 65536, (5, 6, 7), np.uint16)
SMALL = Limits(max_pixels=10_000, max_frames=100, max_bytes=100_000)


@pytest.fixture
def written(tmp_path):
    def write(data, name="a.fits", **cards):
        hdu = fits.PrimaryHDU(data)
        hdu.header.update(cards)
        hdu.writeto(tmp_path / name, overwrite=True)
        return tmp_path / name

    return write


def refused(path, word, error=DataError, **options):
    with refusal(error, word):
        open_frames(path, **options)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.fits", RNG.integers(0, 256, (5, 6, 7), np.uint8)),
        *[(name, UINT16) for name in ("a.fits", "a.FIT", "a.fts", "a.fits.gz")],
        ("a.fits", RNG.integers(0, 2**32, (5, 6, 7), np.uint32)),
        *[(name, RNG.random((5, 6, 7), np.float32)) for name in ("a.fits", "a.fits.gz")],
        ("a.fits", RNG.random((5, 6, 7))),
    ],
    ids=str,
)
def test_a_cube_is_the_array(written, tmp_path, name, data):
    source = open_frames(written(data, name))
    np.save(tmp_path / "a.npy", data)
    same = open_frames(tmp_path / "a.npy")
    assert (source.shape, source.bit_depth, source.full_scale) == (same.shape, same.bit_depth, same.full_scale)
    np.testing.assert_array_equal(source.read(), same.read())
    np.testing.assert_array_equal(source.select((1, 4, 2), (2, 1, 3, 4)).read(), same.read()[1:4:2, 1:5, 2:5])


@pytest.mark.parametrize(
    ("shape", "order"),
    [
        *[((5, 3, 6, 7), (0, 2, 3, 1)), ((3, 5, 6, 7), (1, 2, 3, 0)), ((5, 6, 7, 3), (0, 1, 2, 3))],
        *[((3, 3, 6, 7), (0, 2, 3, 1)), ((5, 1, 6, 7), (0, 2, 3, 1))],
    ],
)
def test_axes_of_colour_and_of_a_single_plane(written, shape, order):
    data = RNG.integers(0, 65536, shape, np.uint16)
    expected = data.transpose(order)
    found = list(open_frames(written(data)).native())
    np.testing.assert_array_equal(found, expected[..., 0] if 1 in shape else expected)


def test_the_first_image_is_found_behind_an_empty_one_and_a_table(tmp_path):
    table = fits.BinTableHDU.from_columns([fits.Column("t", "E", array=np.arange(900.0))])
    path = tmp_path / "a.fits"
    fits.HDUList([fits.PrimaryHDU(), table, fits.ImageHDU(UINT16), fits.ImageHDU(UINT16[:1])]).writeto(path)
    np.testing.assert_array_equal(list(open_frames(path).native()), UINT16)


class TestLevels:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16, np.int32, np.int64])
    def test_from_zero_to_the_highest_of_all_frames(self, written, dtype):
        data = (np.arange(4 * 6 * 7).reshape(4, 6, 7) * 3 + 10).astype(dtype)
        source = open_frames(written(data))
        np.testing.assert_allclose(source.read(), data / data.max(), atol=1e-7)
        assert source.warnings == ("values 10 to 511 are scaled: 0 is black, 511 is white",)
        # A selection has the same levels.
        np.testing.assert_array_equal(open_frames(written(data), frames=(0, 1)).read(), source.read(0, 1))

    def test_from_the_lowest_where_that_is_negative(self, written):
        data = np.linspace(-50, 200, 4 * 6 * 7, dtype=np.float32).reshape(4, 6, 7)
        source = open_frames(written(data))
        np.testing.assert_allclose(source.read(), (data + 50) / 250, atol=1e-6)
        assert "-50 is black, 200 is white" in source.warnings[0]

    def test_scaled_integers_have_their_values(self, written):
        path = written(np.arange(24, dtype=np.int16).reshape(1, 4, 6))
        with fits.open(path, "update", do_not_scale_image_data=True) as file:
            file[0].header.update(BSCALE=0.5, BZERO=3)
        source = open_frames(path)
        np.testing.assert_allclose(source.read()[0], (np.arange(24).reshape(4, 6) / 2 + 3) / 14.5, atol=1e-7)

    def test_nothing_but_zeros_stays_black(self, written):
        assert open_frames(written(np.zeros((2, 3, 4), np.int16))).read().max() == 0


class TestMissingValues:
    def test_nan_is_filled_as_in_an_array(self, written, tmp_path):
        data = RNG.random((5, 20, 20), np.float32)
        data[2, 4, 5] = np.nan
        np.save(tmp_path / "a.npy", data)
        found = []
        for path in (written(data), tmp_path / "a.npy"):
            source = open_frames(path)
            cleaned = clean_source(source, check_content(source))
            assert cleaned.warnings == ("1 NaN or infinite value in frame 2: filled from around",)
            found.append(cleaned.read())
        np.testing.assert_array_equal(*found)

    @pytest.mark.parametrize("zero", [0, 32768])
    def test_blank_is_missing(self, written, zero):
        numbers = RNG.integers(1, 30000, (3, 20, 20)).astype(np.int16)
        numbers[1, 7, 8] = -1
        path = written(numbers)
        with fits.open(path, "update", do_not_scale_image_data=True) as file:
            file[0].header.update(BLANK=-1, BZERO=zero)
        frames = list(open_frames(path).native())
        assert np.argwhere(np.isnan(frames)).tolist() == [[1, 7, 8]]
        white = 65535 if zero else numbers.max()
        np.testing.assert_allclose(frames[0], (numbers[0].astype(float) + zero) / white, atol=1e-7)
        assert open_frames(path).bit_depth == (16 if zero else 32)


class TestFolder:
    def test_one_file_a_frame(self, written, tmp_path):
        for number, frame in enumerate(UINT16):
            written(frame, f"frame{number + 7}.fits" + ".gz" * (number == 1), OBJECT="Moon")
        source = open_frames(tmp_path)
        np.testing.assert_array_equal(list(source.native()), UINT16)
        assert source.name == tmp_path.name and any("Moon" in card for card in source.header)

    def test_colour_and_one_scale_for_all(self, written, tmp_path):
        data = RNG.random((3, 3, 6, 7), np.float32) * 900
        for number, frame in enumerate(data):
            written(frame, f"{number}.fit")
        np.testing.assert_allclose(open_frames(tmp_path).read(), data.transpose(0, 2, 3, 1) / data.max(), atol=1e-6)

    def test_others_are_refused(self, written, tmp_path):
        written(UINT16[0], "1.fits")
        written(UINT16[0].astype(np.float32), "2.fits")
        refused(tmp_path, "as the first image, found")
        written(UINT16, "2.fits")
        refused(tmp_path, "as the first image, found")
        (tmp_path / "1.fits").unlink()
        refused(tmp_path, "expected one image")
        write_image(tmp_path / "3.png", np.zeros((6, 7), np.float32))
        refused(tmp_path, "images of one kind")


class TestRefused:
    def test_single_images_and_other_axes(self, written):
        refused(written(UINT16[0]), "a single image")
        refused(written(UINT16[None, :, :, :4].repeat(2, 0)), "expected (T, H, W)")
        refused(written(UINT16[None, None]), "two to four axes")

    @pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
    def test_cut_short(self, written, name):
        path = written(np.zeros((5, 60, 70), np.uint16), name)
        data = path.read_bytes()
        for length in (0, 50, len(data) // 2, len(data) - 2800 if name == "a.fits" else len(data) - 9):
            path.write_bytes(data[:length])
            refused(path, "" if length == 0 else str(path))

    @pytest.mark.parametrize(
        ("key", "value"), [("NAXIS1", 10**9), ("NAXIS3", 10**9), ("NAXIS1", -4), ("NAXIS", 999), ("BITPIX", 12)]
    )
    def test_sizes_beyond_the_limits_before_any_data(self, written, key, value):
        path = written(UINT16)
        data = path.read_bytes()
        cards = [data[place : place + 80] for place in range(0, 2880, 80)]
        old = next(card for card in cards if card[:8].strip() == key.encode())
        path.write_bytes(data.replace(old, f"{key:<8}= {value:>20}".ljust(80).encode()))
        refused(path, str(path))

    def test_a_compressed_file_that_holds_far_more(self, tmp_path):
        head = fits.PrimaryHDU(np.zeros((50, 90, 90), np.uint8)).header.tostring().encode()
        path = tmp_path / "a.fits.gz"
        for content in (head + bytes(405_000), b"SIMPLE  =".ljust(80) + b" " * 50_000_000):
            path.write_bytes(gzip.compress(content, 1))
            with memory_below(20_000_000):
                refused(path, str(path), limits=SMALL)

    def test_compressed_tiles(self, tmp_path):
        path = tmp_path / "a.fits.fz"
        for data in (UINT16, UINT16.astype(np.int32), RNG.random((5, 40, 30), np.float32)):
            tiles = fits.CompImageHDU(data, quantize_level=0, compression_type="GZIP_1")
            fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(path, overwrite=True)
            plain = tmp_path / "b.fits"
            fits.PrimaryHDU(data).writeto(plain, overwrite=True)
            np.testing.assert_array_equal(list(open_frames(path).native()), list(open_frames(plain).native()))
            assert not any(card.startswith(("ZIMAGE", "TTYPE", "ZBITPIX")) for card in open_frames(path).header)
        refused(path, "expected up to 1000 bytes", limits=Limits(max_bytes=1000))
        path.write_bytes(path.read_bytes()[:-3000])
        refused(path, "a.fits.fz")

    def test_changed_bytes_end_in_one_line_or_in_frames(self, written):
        path = written(RNG.random((5, 6, 7), np.float32), OBJECT="Moon")
        whole = path.read_bytes()
        rng = np.random.default_rng(0)
        for _ in range(200):
            data = bytearray(whole)
            for place in rng.integers(0, 900, 3):
                data[place] = rng.integers(256)
            path.write_bytes(data)
            try:
                check_content(open_frames(path, limits=SMALL))
            except (DataError, ConfigurationError) as error:
                assert "\n" not in str(error)

    def test_without_astropy(self, written, monkeypatch, tmp_path):
        path = written(UINT16)
        monkeypatch.setitem(__import__("sys").modules, "astropy.io", None)
        refused(path, "pip install 'astropy", ConfigurationError)
        monkeypatch.setattr("turbrestore.io.output.find_spec", lambda name: None)
        with pytest.raises(ConfigurationError, match="pip install 'astropy"):
            check_output(tmp_path / "b.fits")


class TestWriting:
    @pytest.mark.parametrize(("depth", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16), (32, np.float32)])
    @pytest.mark.parametrize("channels", [(), (3,)])
    def test_round_trip(self, tmp_path, depth, dtype, channels):
        image = RNG.random((6, 7, *channels), np.float32)
        write_image(tmp_path / "a.fits", image, depth)
        found = read_image(tmp_path / "a.fits")
        assert fits.getdata(tmp_path / "a.fits").dtype.newbyteorder("=") == dtype and found.bit_depth == max(
            depth, 16 * (depth > 8)
        )
        np.testing.assert_allclose(found.image, image, atol=0.5 / 255 if depth == 8 else 1e-5)

    def test_header_of_the_input_is_kept_where_it_is_true(self, written, tmp_path):
        kept = {"OBJECT": "Moon", "LONG": 100 * "long ", "CRPIX1": 10.0, "CRPIX2": 4.0}
        dropped = {"CRPIX3": 1.0, "CTYPE3": "TIME", "DATAMAX": 9, "CHECKSUM": "x"}
        source = open_frames(written(UINT16, **kept, **dropped))
        made = {"header": source.header, "history": ["σ = 1.2 px"], "origin": (2, 1)}
        write_fits(tmp_path / "b.fits", np.zeros((3, 3)), 16, **made)
        header = fits.getheader(tmp_path / "b.fits")
        assert header["OBJECT"] == "Moon" and (header["CRPIX1"], header["CRPIX2"]) == (8, 3)
        assert header["LONG"] == (100 * "long ").rstrip()
        assert not {*dropped, "NAXIS3"} & set(header)
        assert str(header["HISTORY"]) == "? = 1.2 px"

    def test_damaged_cards_do_no_harm(self, tmp_path):
        cards = ["OBJECT  = 'never ends", "\x01BAD", "COMMENT é", "LONG-KEYWORD = 3", "A       = 1 2 3 / x"]
        write_fits(tmp_path / "a.fits", np.zeros((2, 2)), header=[card.ljust(80) for card in cards])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert fits.getdata(tmp_path / "a.fits").shape == (2, 2)


def test_restore_gives_the_bytes_of_the_array(sequence, tmp_path, written, capsys):
    data = np.uint16(np.clip(sequence.frames[:4, :40, :40], 0, 1) * 65535)
    np.save(tmp_path / "a.npy", data)
    path = written(data, OBJECT="Chart")
    for name in ("a.npy", "a.fits"):
        assert main(["restore", str(tmp_path / name), str(tmp_path / f"{name}.png"), "--quiet", "--threads", "1"]) == 0
    assert (tmp_path / "a.npy.png").read_bytes() == (tmp_path / "a.fits.png").read_bytes()
    words = ["--frames", "0:4", "--roi", "4,2,32,32", "--quiet", "--threads", "1"]
    assert main(["restore", str(path), str(tmp_path / "b.fits"), *words]) == 0
    with fits.open(tmp_path / "b.fits") as file:
        assert file[0].header["OBJECT"] == "Chart" and file[0].header["BITPIX"] == 16
        assert "turbrestore restore" in "".join(file[0].header["HISTORY"])
        assert file["UNCERT"].data.shape == file[0].data.shape
        assert importlib.util.find_spec("astropy") and np.all(file["UNCERT"].data > 0)


def test_flows_stand_behind_the_image_that_they_begin_at(sequence, tmp_path, written):
    data = np.uint16(np.clip(sequence.frames[:3, :48, :64], 0, 1) * 65535)
    clip = written(data, OBJECT="Chart", CRPIX1=10.0)
    write_image(tmp_path / "still.fits", data[0, 2:42, 4:] / np.float32(65535))
    words = ["flow", str(tmp_path / "still.fits"), str(clip), "--roi", "4,2,60,40", "--quiet", "--threads", "1"]
    for name in ("flows.npy", "flows.fits"):
        assert main([*words[:3], str(tmp_path / name), *words[3:]]) == 0
    flows = np.load(tmp_path / "flows.npy")
    with fits.open(tmp_path / "flows.fits") as file:
        assert [image.name for image in file] == ["PRIMARY", "FLOW"]
        assert (file[0].header["OBJECT"], file[0].header["CRPIX1"]) == ("Chart", 6)
        assert file["FLOW"].header["BUNIT"] == "pixel"
        assert "turbrestore flow" in "".join(file[0].header["HISTORY"])
        np.testing.assert_allclose(file[0].data, data[0, 2:42, 4:] / 65535, atol=1e-6)
        assert flows.shape == (3, 40, 60, 2) and np.abs(flows[1]).max() > 0.1
        np.testing.assert_array_equal(np.moveaxis(file["FLOW"].data, 1, -1), flows)


def mosaic_of(pattern, shape, kind):
    level = {"R": 200, "G": 120, "B": 30}
    mosaic = np.empty(shape, kind)
    for place, letter in enumerate(pattern):
        mosaic[..., place // 2 :: 2, place % 2 :: 2] = level[letter] / (1 if np.dtype(kind).kind == "u" else 255)
    return mosaic


@pytest.mark.parametrize(
    ("pattern", "kind"), [("RGGB", np.uint8), ("GRBG", np.uint16), ("GBRG", np.uint32), ("BGGR", np.float32)]
)
def test_a_bayer_pattern_in_the_header_gives_colours(written, pattern, kind):
    data = mosaic_of(pattern, (2, 8, 10), kind)
    source = open_frames(written(data, BAYERPAT=pattern), roi=(2, 2, 4, 4))
    assert source.warnings == () and source.shape == (2, 4, 4, 3) and source.format.endswith(f"as {pattern.lower()}")
    scale = {1: 255, 2: 65535, 4: 2**32 - 1 if kind == np.uint32 else 255}[data.itemsize]
    np.testing.assert_allclose(source.read() * scale, np.broadcast_to([200, 120, 30], (2, 4, 4, 3)), atol=0.01)


def test_the_pattern_of_a_header_agrees_with_ser(written, tmp_path):
    mosaic = RNG.integers(0, 65536, (3, 8, 10), np.uint16)
    np.save(tmp_path / "a.npy", mosaic)
    expected = open_frames(tmp_path / "a.npy", bayer="grbg").read()
    np.testing.assert_array_equal(open_frames(written(mosaic, BAYERPAT="GRBG")).read(), expected)
    # In the interior floating point is the same but for rounding to the type.
    found = open_frames(written((mosaic / 65535).astype(np.float32), BAYERPAT="GRBG")).read()
    assert np.abs(found - expected)[:, 1:-1, 1:-1].max() < 1 / 65535


@pytest.mark.parametrize("height", [8, 9])
def test_offsets_and_rows_from_the_bottom_up_shift_the_pattern(written, height):
    sensor = mosaic_of("RGGB", (2, 13, 14), np.uint8)
    shifted = {
        "offsets": (sensor[:, 3:11, 5:], {"XBAYROFF": 5, "YBAYROFF": 3}),
        "bottom up": (sensor[:, :height][:, ::-1], {"ROWORDER": "BOTTOM-UP"}),
    }
    for mosaic, cards in shifted.values():
        inner = open_frames(written(mosaic, BAYERPAT="RGGB", **cards), roi=(2, 2, 4, 4)).read() * 255
        np.testing.assert_allclose(inner, np.broadcast_to([200, 120, 30], (2, 4, 4, 3)), atol=0.01)


def test_one_image_with_a_pattern_and_patterns_that_are_unknown(written):
    image = mosaic_of("RGGB", (8, 10), np.uint8)
    assert read_image(written(image, BAYERPAT="RGGB")).image.shape == (8, 10, 3)
    source = open_frames(written(image[None], BAYERPAT="XTRANS"))
    assert source.shape == (1, 8, 10) and "XTRANS is unknown" in source.warnings[0]


def test_darks_and_flats_of_a_bayer_sensor_come_before_colours(written, tmp_path):
    mosaic = mosaic_of("RGGB", (4, 16, 18), np.float32)
    dark = np.full((16, 18), 0.1, np.float32)
    hot = mosaic * 0.5 + dark
    hot[:, 7, 7] = dark[7, 7] = 0.9
    clip, single = written(hot, BAYERPAT="RGGB"), written(dark, "dark.fits", BAYERPAT="RGGB")
    source = calibrated(open_frames(clip), make_calibration(open_frames(clip), open_fits(single, single=True), None))
    expected = np.broadcast_to(np.array([200, 120, 30]) / 510, (4, 12, 14, 3))
    np.testing.assert_allclose(source.select(roi=(2, 2, 14, 12)).read(), expected, atol=1e-4)


def test_rows_of_other_formats_are_said_to_begin_at_the_top(tmp_path):
    write_fits(tmp_path / "a.fits", np.zeros((2, 2)))
    assert fits.getheader(tmp_path / "a.fits")["ROWORDER"] == "TOP-DOWN"
    write_fits(tmp_path / "b.fits", np.zeros((2, 2)), header=["OBJECT  = 'Moon    '".ljust(80)])
    assert "ROWORDER" not in fits.getheader(tmp_path / "b.fits")


def test_the_colours_of_an_image_are_not_taken_for_frames(tmp_path):
    write_fits(tmp_path / "a.fits", np.zeros((20, 30, 3)))
    with pytest.raises(DataError, match="a single image in colour"):
        open_frames(tmp_path / "a.fits")
    assert read_image(tmp_path / "a.fits").image.shape == (20, 30, 3)

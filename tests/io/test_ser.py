"""SER files: against bytes laid out by hand, and round trips."""

import struct

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError, OutputError
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.io.astronomy.ser import read_ser_header, write_ser
from turbrestore.io.pixels import doubted_pattern
from turbrestore.io.video import open_frames
from videos import refusal

MONO = np.arange(2 * 3 * 4).reshape(2, 3, 4)


def ser_bytes(frames, colour=0, depth=16, flag=0, order="<", ticks=None, count=None, size=None):
    """A SER file as its description lays it out, independent of the writer under test."""
    frames = np.asarray(frames)
    head = struct.pack(
        "<14s7i40s40s40s2q",
        b"LUCAM-RECORDER",
        *(0, colour, flag, *(size or frames.shape[2:0:-1]), depth, len(frames) if count is None else count),
        b"observer",
        b"instrument",
        b"telescope",
        *(0, 0),
    )
    assert len(head) == 178
    body = frames.astype(np.uint8 if depth <= 8 else f"{order}u2").tobytes()
    return head + body + (b"" if ticks is None else np.asarray(ticks, "<i8").tobytes())


@pytest.fixture
def ser(tmp_path):
    def write(*arguments, **options):
        path = tmp_path / "a.ser"
        path.write_bytes(ser_bytes(*arguments, **options))
        return path

    return write


def refused(path, error, *words, **options):
    with refusal(error, *words):
        open_frames(path, **options)


@pytest.mark.parametrize("depth", [8, 10, 12, 16])
def test_mono_is_scaled_by_its_depth(ser, depth):
    source = open_frames(ser(MONO, depth=depth))
    assert source.shape == (2, 3, 4) and source.bit_depth == depth and source.format == f"ser/mono{depth}"
    np.testing.assert_array_equal(source.read(), (MONO / np.float32(2**depth - 1)).astype(np.float32))
    assert source.fps is None and source.timestamps is None


@pytest.mark.parametrize("depth", [8, 16])
def test_rgb_and_bgr_come_as_rgb(ser, depth):
    colour = np.random.default_rng(0).integers(0, 2**depth, (2, 3, 4, 3))
    for code in (100, 101):
        stored = colour if code == 100 else colour[..., ::-1]
        found = open_frames(ser(stored, colour=code, depth=depth)).read()
        np.testing.assert_allclose(found, colour / (2**depth - 1), rtol=1e-6)


@pytest.mark.parametrize(("code", "pattern"), [(8, "RGGB"), (9, "GRBG"), (10, "GBRG"), (11, "BGGR")])
@pytest.mark.parametrize("depth", [8, 16])
def test_bayer_pattern_of_one_colour_becomes_that_colour(ser, code, pattern, depth):
    level = {"R": 200, "G": 120, "B": 30}
    mosaic = np.empty((1, 8, 10), int)
    for place, letter in enumerate(pattern):
        mosaic[:, place // 2 :: 2, place % 2 :: 2] = level[letter]
    found = open_frames(ser(mosaic, colour=code, depth=depth), roi=(2, 2, 4, 4)).read() * (2**depth - 1)
    np.testing.assert_allclose(found, np.broadcast_to([200, 120, 30], (1, 4, 4, 3)), atol=0.01)


def test_times_come_from_the_trailer(ser):
    source = open_frames(ser(MONO, ticks=[5_000_000, 10_000_000]))
    assert source.timestamps.tolist() == [0.0, 0.5]
    assert source.fps == 2.0


@pytest.mark.parametrize("ticks", [[0, 0, 0], [7, 5, 3], [0, 9, 3]])
def test_useless_times_are_left_out(ser, ticks):
    source = open_frames(ser(np.zeros((3, 3, 4)), ticks=ticks))
    assert source.timestamps is None and source.fps is None


def test_writer_lays_bytes_out_as_described(tmp_path):
    write_ser(tmp_path / "a.ser", (MONO / 4095).astype(np.float32), bit_depth=12)
    expected = ser_bytes(MONO, depth=12)
    found = (tmp_path / "a.ser").read_bytes()
    assert found[:42] == expected[:42] and found[178:] == expected[178:]


def test_written_dates_are_of_the_year_2000(tmp_path):
    write_ser(tmp_path / "a.ser", np.zeros((2, 1, 1), np.float32), bit_depth=8, fps=10)
    ticks = np.frombuffer((tmp_path / "a.ser").read_bytes()[-16:], "<i8")
    start = np.datetime64("0001-01-01", "us") + (ticks // 10).astype("timedelta64[us]")
    assert start.astype(str).tolist() == ["2000-01-01T00:00:00.000000", "2000-01-01T00:00:00.100000"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"colour": 17}, "colour code 17"),
        *[({"depth": depth}, word) for depth, word in ((0, "bits"), (24, "24"))],
        *[({"count": count}, "frame") for count in (0, -3)],
        *[({"size": size}, "pixels") for size in ((0, 3), (-5, 3), (2**30, 3), (4, 2**31 - 1))],
        ({"depth": 3}, "values up to 7"),
    ],
)
def test_unsupported_headers_are_refused(ser, options, word):
    refused(ser(MONO, **options), DataError, word)


def test_truncated_file_is_refused_unless_the_lost_frames_are_left_out(ser):
    frames = np.arange(5 * 3 * 4).reshape(5, 3, 4)
    path = ser(frames, ticks=range(1, 6))
    path.write_bytes(path.read_bytes()[: 178 + 2 * 12 * 3 + 7])
    refused(path, DataError, "after 3 whole frames")
    refused(path, DataError, "select frames up to 3", frames=(0, 4))
    found = open_frames(path, frames=(1, 3))
    np.testing.assert_allclose(found.read() * 65535, frames[1:3], rtol=1e-6)
    refused(path, ConfigurationError, "frames", frames=(3, 3))
    path.write_bytes(path.read_bytes()[:185])
    refused(path, DataError, "before the end of the first frame")
    refused(path, DataError, "none", frames=(0, 0))


def test_reading_again_gives_the_same_and_changes_nothing(ser):
    path = ser(MONO)
    before = path.read_bytes()
    source = open_frames(path)
    first = [frame.copy() for frame in source]
    for frame in source:
        frame[:] = 1
    np.testing.assert_array_equal(source.read(), first)
    assert path.read_bytes() == before


def test_header_is_read_without_the_frames(ser):
    header = read_ser_header(ser(MONO, count=10**6))
    assert (header.width, header.height, header.frames, header.little_endian) == (4, 3, 10**6, True)


def test_writer_refuses_depths_and_files_that_exist(tmp_path):
    path, frames = tmp_path / "a.ser", [np.zeros((2, 2), np.float32)]
    with pytest.raises(ConfigurationError):
        write_ser(path, frames, bit_depth=20)
    assert not any(tmp_path.iterdir())
    write_ser(path, frames)
    with pytest.raises(OutputError):
        write_ser(path, frames)


def test_debayering_of_a_scene_agrees_with_opencv(ser):
    mosaic = np.random.default_rng(0).integers(0, 65536, (1, 6, 8))
    expected = cv2.cvtColor(mosaic[0].astype(np.uint16), cv2.COLOR_BayerRGGB2RGB)
    for flag, order in ((0, "<"), (1, ">")):
        found = open_frames(ser(mosaic, colour=8, flag=flag, order=order)).read()[0]
        np.testing.assert_allclose(found * 65535, expected, atol=0.01)


def moon_like(count=12, side=64, noise=60.0, full=65535):
    """A bright disc with craters that drifts, with noise, uint16."""
    rng, (y, x) = np.random.default_rng(3), np.mgrid[:side, :side].astype(np.float64)
    frames = []
    for k in range(count):
        u = x + 0.8 * k
        disc = 0.6 * (np.hypot(u - 36, y - 32) < 24) * (0.7 + 0.2 * np.sin(u / 3) * np.cos(y / 4)) + 0.05
        frames.append(cv2.GaussianBlur(disc, (0, 0), 1.2) + noise / 65535 * rng.standard_normal(disc.shape))
    return np.uint16(np.clip(np.rint(full * np.array(frames)), 0, full))


class TestByteOrder:
    @pytest.mark.parametrize(("flag", "order"), [(1, "<"), (0, ">")])
    @pytest.mark.parametrize("depth", [12, 16])
    @pytest.mark.parametrize("colour", [0, 9])
    def test_pixels_decide_against_the_header(self, ser, flag, order, depth, colour):
        frames = moon_like(full=2**depth - 1)
        source = open_frames(ser(frames, flag=flag, order=order, depth=depth, colour=colour))
        found = source.read()
        kept = open_frames(ser(frames, depth=depth, colour=colour))
        np.testing.assert_array_equal(found, kept.read())
        assert kept.warnings == () and "endian by its pixels" in source.warnings[0]

    @pytest.mark.parametrize(("flag", "order"), [(0, "<"), (1, ">")])
    def test_noise_and_coarse_values_leave_the_header_right(self, ser, flag, order):
        rng = np.random.default_rng(0)
        for frames in (rng.integers(0, 65536, (2, 32, 32)), 256 * (moon_like() // 256), moon_like(noise=20000)):
            source = open_frames(ser(frames, flag=flag, order=order))
            assert source.warnings == ()
            np.testing.assert_allclose(65535 * source.read(), frames, atol=0.01)


class TestMosaics:
    """Raw frames of colour cameras."""

    COLOURS = np.array([[0.9, 0.5], [0.5, 0.25]])  # of the pixels of RGGB

    def mosaic(self):
        return np.uint16(moon_like() * np.tile(self.COLOURS, (32, 32)))

    def test_a_mosaic_that_is_called_mono_is_remarked_on_and_read_in_colour(self, ser):
        path = ser(self.mosaic())
        mono, part = open_frames(path), open_frames(path, bayer="rggb", roi=(1, 2, 9, 8))
        assert "--bayer" in mono.warnings[0] and mono.shape == (12, 64, 64)
        found = open_frames(path, bayer="rggb").read()
        np.testing.assert_array_equal(part.read(), found[:, 2:10, 1:10])
        np.testing.assert_array_equal(open_frames(ser(self.mosaic(), colour=8)).read(), found)

    def test_mono_is_not_taken_for_a_mosaic(self, ser):
        assert open_frames(ser(moon_like())).warnings == ()

    @pytest.mark.parametrize("right", range(8, 12))
    def test_greens_of_a_wrong_pattern_are_unlike(self, ser, right):
        colours = {8: "rggb", 9: "grbg", 10: "gbrg", 11: "bggr"}
        levels = np.array([{"r": 0.9, "g": 0.5, "b": 0.25}[colour] for colour in colours[right]]).reshape(2, 2)
        mosaic = np.uint16(moon_like() * np.tile(levels, (32, 32)))
        expected = open_frames(ser(mosaic, colour=right)).read()
        better = "grbg or --bayer gbrg" if right in (9, 10) else "rggb or --bayer bggr"
        for given, pattern in colours.items():
            # Red and blue may be exchanged without a trace.
            alike = (right in (9, 10)) == (given in (9, 10))
            doubt = f"the greens of the Bayer pattern {pattern} are unlike: try --bayer {better}"
            path = ser(mosaic, colour=given)
            assert open_frames(path).warnings == (() if alike else (doubt,))
            replaced = open_frames(path, bayer=colours[right])
            assert replaced.warnings == ()
            np.testing.assert_array_equal(replaced.read(), expected)

    @pytest.mark.parametrize("pattern", ["rggb", "grbg"])
    def test_a_right_pattern_is_not_doubted(self, pattern):
        y, x = np.mgrid[:64, :64]
        ramp, rng = (x + y) / 128, np.random.default_rng(0)
        damaged = np.where((x == 9) & (y == 9), np.nan, ramp)
        for mosaic in (ramp, damaged, 0.5 + 0.1 * rng.standard_normal(x.shape), np.full(x.shape, np.nan)):
            assert doubted_pattern(mosaic, pattern) == ()

    def test_colour_is_no_mosaic(self, ser):
        refused(ser(np.tile(self.mosaic()[..., None], 3), colour=100), DataError, "--bayer", bayer="rggb")
        refused(ser(self.mosaic()), ConfigurationError, "rggb", bayer="rgb")

    @pytest.mark.parametrize("how", [{"colour": 8}, {"bayer": "rggb"}])
    def test_hot_pixels_are_found_in_the_mosaic(self, ser, how):
        clean, rng = self.mosaic(), np.random.default_rng(5)
        hot = {tuple(place) for place in rng.integers(2, 62, (15, 2)).tolist()}
        dirty = clean.copy()
        for row, column in hot:
            dirty[:, row, column] = 65000
        options = {key: how[key] for key in how if key == "bayer"}
        source = open_frames(ser(dirty, colour=how.get("colour", 0)), **options)
        report = check_content(source)
        assert {tuple(place) for place in report.stuck.tolist()} == hot
        found = clean_source(source, report).read()
        wanted = open_frames(ser(clean, colour=8))
        assert np.sqrt(np.mean((found - wanted.read()) ** 2)) < 0.004
        assert clean_source(wanted, check_content(wanted)).repair is None

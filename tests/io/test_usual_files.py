"""Counts, folders and FITS files as programs and cameras write them."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st
from usual_files import without_times

from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.io.astronomy.fits_output import write_fits
from turbrestore.io.counts import range_of_counts
from turbrestore.io.folders import in_order
from turbrestore.io.images.image_files import write_image
from turbrestore.io.video import open_frames

RNG = np.random.default_rng(6)
SCENE = RNG.uniform(0.1, 1, (8, 20, 24))


class TestCounts:
    @pytest.mark.parametrize("dtype", [np.int16, np.int32, np.int64, np.float32, np.float64, np.uint32, np.uint64])
    @pytest.mark.parametrize("form", ["npy", "tif", "folder"])
    def test_one_range_for_all_frames(self, tmp_path, dtype, form):
        counts = (3000 * SCENE - (0 if np.dtype(dtype).kind == "u" else 310)).astype(dtype)
        path = tmp_path / f"a.{form}"
        if form == "npy":
            np.save(path, counts)
        elif form == "tif":
            tifffile.imwrite(path, counts, photometric="minisblack")
        else:
            path.mkdir()
            for number, frame in enumerate(counts):
                tifffile.imwrite(path / f"{number}.tif", frame)
        source = open_frames(path)
        black, white = min(0, counts.min()), counts.max()
        assert source.levels == (black, white) and source.bit_depth == 32 and len(source.warnings) == 1
        np.testing.assert_allclose(source.read(), (counts - float(black)) / (white - float(black)), atol=1e-6)

    def test_lone_values_set_neither_black_nor_white(self, tmp_path):
        counts = 3000 * SCENE
        for number, frame in enumerate(counts):
            frame[number, 2 * number], frame[number + 5, 3] = 65535, -20_000
        np.save(tmp_path / "a.npy", counts)
        source = open_frames(tmp_path / "a.npy")
        assert source.levels[0] == 0 and 2900 < source.levels[1] <= 3000
        assert source.warnings[0].endswith("and the few values beyond, which are isolated, are clipped")
        assert source.read().max() == 1

    def test_stars_are_no_lone_values(self):
        y, x = np.mgrid[:30, :30]
        star = 50 + 9000 * np.exp(-((x - 11.3) ** 2 + (y - 14.8) ** 2) / 2)
        found = range_of_counts([star] * 5, "a")
        assert found.white == star.max()

    def test_values_just_beyond_the_unit_range_are_intensities(self, tmp_path):
        values = SCENE.astype(np.float32)
        values[3, 4, 5] = 1.4
        np.save(tmp_path / "a.npy", values)
        source = open_frames(tmp_path / "a.npy")
        assert source.levels is None and "0 is black, 1 is white" in source.warnings[0]
        np.testing.assert_array_equal(source.read(), np.minimum(values, 1))

    def test_results_have_the_counts_of_the_input(self, tmp_path):
        image = RNG.random((5, 6), np.float32)
        write_image(tmp_path / "a.tif", image, 32, levels=(-100, 900))
        write_fits(tmp_path / "a.fits", image, 32, levels=(-100, 900), uncertainty=image)
        np.testing.assert_allclose(tifffile.imread(tmp_path / "a.tif"), 1000 * image - 100, atol=1e-3)
        np.testing.assert_allclose(fits.getdata(tmp_path / "a.fits"), 1000 * image - 100, atol=1e-3)
        np.testing.assert_allclose(fits.getdata(tmp_path / "a.fits", "UNCERT"), 1000 * image, rtol=1e-6)


class TestFolders:
    @given(st.lists(st.integers(0, 500_000), min_size=2, max_size=12, unique=True))
    def test_decimal_seconds_are_in_order(self, milliseconds):
        # Printed to a fixed number of decimals they would be in order by any rule.
        names = [Path(f"t{value!r}s.png") for value in (number / 1000 for number in milliseconds)]
        found = [float(path.stem[1:-1]) for path in in_order(names)]
        assert found == sorted(found)

    @given(st.permutations(range(1, 31)))
    def test_counters_after_a_dot_are_in_order(self, numbers):
        found = in_order(Path(f"scene2.{number}.png") for number in numbers)
        assert [path.name for path in found] == [f"scene2.{number}.png" for number in range(1, 31)]

    def test_dates_are_in_order(self):
        names = [f"2024.01.{day} 9.{minute}.5.png" for day in (9, 10) for minute in (7, 25, 30)]
        assert [path.name for path in in_order(map(Path, names[::-1]))] == names

    def test_twins_are_read_once(self, tmp_path):
        for number in range(3):
            for suffix in ("tif", "png"):
                write_image(tmp_path / f"IMG_{number}.{suffix}", SCENE[number], 8)
        source = open_frames(tmp_path)
        assert len(source) == 3 and source.warnings == ("3 shots found as .tif and .png: .tif is read",)
        (tmp_path / "IMG_1.tif").unlink()
        assert "as .tif and .png: .png is read" in open_frames(tmp_path).warnings[0]


def test_matroska_without_times_is_whole(tmp_path):
    frames = SCENE.repeat(4, axis=1).repeat(4, axis=2).astype(np.float32)
    source = open_frames(without_times(tmp_path, frames))
    assert len(source) == 8 and source.timestamps is None and source.warnings == ()


def test_rows_of_a_scene_in_strong_air_are_no_frames(tmp_path):
    scene = RNG.random((40, 60))
    frames = np.stack([np.roll(scene, shift, axis=1) for shift in (0, 1, 0, 2, 1, 0, 1, 2)])
    np.save(tmp_path / "a.npy", np.moveaxis((255 * frames).astype(np.uint8), 0, -1))
    assert open_frames(tmp_path / "a.npy").shape == (8, 40, 60)


class TestFits:
    def units(self, path, *units):
        fits.HDUList([fits.PrimaryHDU(), *units]).writeto(path, overwrite=True)
        return open_frames(path)

    def test_scene_before_errors_whatever_the_order(self, tmp_path):
        data = SCENE.astype(np.float32)
        for order in (("ERR", "SCI", "DQ"), ("DQ", "SKY", "SCI"), ("SCI", "ERR", "DQ")):
            units = [fits.ImageHDU(data if name == "SCI" else data / 9, name=name) for name in order]
            found = self.units(tmp_path / "a.fits", *units)
            np.testing.assert_array_equal(found.read(), data)

    def test_one_frame_per_extension(self, tmp_path):
        units = [fits.ImageHDU((60_000 * frame).astype(np.uint16), name=f"FRAME{n}") for n, frame in enumerate(SCENE)]
        found = self.units(tmp_path / "a.fits", *units, fits.ImageHDU(SCENE[0].astype(np.float32), name="MASK"))
        assert found.warnings == ("its 8 extensions of one size are taken for frames",)
        np.testing.assert_array_equal(list(found.native()), (60_000 * SCENE).astype(np.uint16))
        named = [(name, n, frame) for n, frame in enumerate(SCENE) for name in ("SCI", "ERR")]
        pairs = [fits.ImageHDU(frame / (1 + 2 * (name == "ERR")), name=name, ver=n + 1) for name, n, frame in named]
        np.testing.assert_allclose(self.units(tmp_path / "a.fits", *pairs).read(), SCENE, rtol=1e-6)

    def test_every_file_has_its_own_scale(self, tmp_path):
        for number, frame in enumerate(SCENE):
            unit = fits.PrimaryHDU(1000 * frame * (number + 1))
            unit.scale("int16", "minmax")
            unit.writeto(tmp_path / f"{number}.fits")
        expected = SCENE * np.arange(1, 9)[:, None, None]
        np.testing.assert_allclose(open_frames(tmp_path).read(), expected / expected.max(), atol=1e-3)

    def test_a_border_without_values_is_unseen(self, tmp_path):
        data = SCENE.repeat(2, axis=1).repeat(2, axis=2).astype(np.float32)
        data[:, :5] = np.nan
        data[2, :, :9] = np.nan
        source = self.units(tmp_path / "a.fits", fits.ImageHDU(data)).select(roi=(0, 2, 48, 38))
        report = check_content(source)
        assert "by what other frames show, and from around" in report.warnings[0]
        cleaned = clean_source(source, report)
        assert cleaned.unseen[2:5].all() and cleaned.unseen.sum() == 3 * 48
        frames = cleaned.read()
        np.testing.assert_array_equal(frames[:2, 3:], data[:2, 5:])
        others = np.delete(data, 2, axis=0)[:, 5:, :9]
        np.testing.assert_allclose(frames[2, 3:, :9], others.mean(axis=0), atol=1e-6)
        assert np.isfinite(frames).all() and np.ptp(frames[:, :3]) < 1

"""What frames show: defects that are put in are found and repaired, and clean clips come back bit for bit."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import make_sequence
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.footage.checks.content import ContentParams, check_content, clean_source, keep_all, without_blank
from turbrestore.footage.checks.stuck_pixels import StuckPixelDetector
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import restore
from turbrestore.settings import RestoreParams

SAMPLE = Path(__file__).parents[2] / "sample_data" / "chart.mkv"


@pytest.fixture(scope="module")
def frames():
    return np.clip(0.1 + 0.8 * make_sequence(3, count=14, size=64).frames, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def elsewhere():
    return np.clip(make_sequence(4, count=14, size=64, scene="camera").frames, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def planet():
    """Disc with bands that resembles itself when it is turned; only its spot tells the way."""
    y, x = np.mgrid[:64, :80]
    disc = np.clip((20 - np.hypot(x - 42, y - 33)) / 2, 0, 1)
    drawn = disc * (0.5 + 0.2 * np.sin(y / 2) + 0.15 * (np.hypot(x - 48, 1.6 * (y - 39)) < 4))
    rng = np.random.default_rng(0)
    shifted = [np.roll(drawn, rng.integers(-1, 2, 2), (0, 1)) for _ in range(16)]
    return np.clip(shifted + rng.normal(0, 0.01, (16, 64, 80)), 0, 1).astype(np.float32)


def cleaned(stack, **settings):
    source = FrameSource.from_array(stack, "clip")
    report = check_content(source, ContentParams(**settings))
    return report, clean_source(source, report)


class TestCleanClips:
    def test_the_sample_clip_is_left_as_it_is(self):
        source = open_frames(SAMPLE)
        report = check_content(source)
        assert report.warnings == () and not report.left_out and len(report.scenes) == 1
        np.testing.assert_array_equal(clean_source(source, report).read(), source.read())

    @pytest.mark.parametrize("scene", ["chart", "camera"])
    @pytest.mark.parametrize("statistics", [{"rms": 0.3}, {"rms": 4.0}, {"blur": 3.0}, {"noise": 0.1}, {"noise": 0.0}])
    def test_synthesized_clips_are_left_as_they_are(self, scene, statistics):
        stack = np.clip(make_sequence(5, count=12, size=64, scene=scene, **statistics).frames, 0, 1)
        report, source = cleaned(stack)
        assert report.warnings == ()
        np.testing.assert_array_equal(source.read(), stack)
        assert source.repair is None and source.numbers == range(12)

    def test_quantised_colour_is_left_as_it_is(self, frames):
        stack = np.stack([np.uint8(255 * frames), np.uint8(200 * frames), np.uint8(90 * frames)], -1)
        report, source = cleaned(stack)
        assert report.warnings == ()
        np.testing.assert_array_equal(source.read(), stack / np.float32(255))

    def test_a_drifting_shaking_camera_a_slow_change_and_brightness_make_no_cut(self, frames, elsewhere):
        shifts = np.linspace(0, 20, 14)[:, None] + np.random.default_rng(0).normal(0, 2, (14, 2))
        moves = np.rint(shifts).astype(int)
        shaken = np.stack([np.roll(frame, move, (0, 1)) for frame, move in zip(elsewhere, moves, strict=True)])
        share = np.linspace(0, 1, 80, dtype=np.float32)[:, None, None]
        slow = (1 - share) * np.resize(frames, (80, 64, 64)) + share * np.resize(elsewhere, (80, 64, 64))
        for stack in (shaken, slow):
            assert len(cleaned(stack)[0].scenes) == 1
        assert cleaned(elsewhere * np.linspace(0.3, 1, 14, dtype=np.float32)[:, None, None])[0].warnings == ()

    def test_pure_noise_makes_no_cut(self):
        stack = np.random.default_rng(0).random((30, 40, 40), dtype=np.float32)
        report, _ = cleaned(stack)
        assert len(report.scenes) == 1 and not report.left_out and not len(report.stuck)


class TestValuesThatAreNotFinite:
    @given(data=st.data())
    @settings(max_examples=20, deadline=None)
    def test_isolated_ones_are_filled_within_the_range_of_the_rest(self, frames, data):
        stack = frames.copy()
        places = data.draw(
            st.lists(st.tuples(st.integers(0, 13), st.integers(0, 63), st.integers(0, 63)), min_size=1, max_size=20)
        )
        for place in places:
            stack[place] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
        report, source = cleaned(stack)
        assert report.filled_values == len(set(places))
        assert report.filled == tuple(sorted({place[0] for place in places}))
        found, bad = source.read(), ~np.isfinite(stack)
        np.testing.assert_array_equal(found[~bad], stack[~bad])
        assert found.min() >= frames.min() and found.max() <= frames.max()

    def test_a_hole_is_filled_smoothly_channel_by_channel(self, frames):
        ramp = np.tile(np.linspace(0, 1, 40, dtype=np.float32), (3, 40, 1))
        stack = ramp.copy()
        stack[1, 10:13, 20:23] = np.nan
        np.testing.assert_allclose(cleaned(stack)[1].read(), ramp, atol=0.03)
        stack = np.stack([frames, 0.5 * frames, 0.2 * frames], -1)
        stack[2, 30, 30, 1] = np.nan
        found = cleaned(stack)[1].read()
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(found[..., ::2], stack[..., ::2])

    def test_too_many_are_refused_with_count_and_frame(self, frames):
        stack = frames.copy()
        stack[4, :33] = np.nan
        with pytest.raises(DataError, match=r"clip: frame 4: .* 2112 of 4096 NaN"):
            cleaned(stack)

    def test_many_are_filled_by_other_frames_and_do_not_count_outside_of_the_region(self, frames):
        stack = frames.copy()
        stack[4, :10] = np.nan
        report, source = cleaned(stack)
        assert report.warnings == ("640 NaN or infinite values in frame 4: filled by what other frames show",)
        others = np.delete(stack, 4, axis=0)[:, :10].mean(axis=0)
        np.testing.assert_allclose(source.read()[4, :10], others, atol=1e-6)
        assert source.unseen is None
        stack[:, :20] = np.nan
        assert check_content(FrameSource.from_array(stack).select(roi=(0, 20, 64, 44))).warnings == ()

    @pytest.mark.parametrize("name", ["a.npy", "a.tif"])
    def test_a_hole_in_the_first_frame_of_a_file(self, tmp_path, frames, name):
        import tifffile

        stack = frames.copy()
        stack[0, 5, 5] = np.nan
        np.save(tmp_path / "a.npy", stack)
        tifffile.imwrite(tmp_path / "a.tif", stack, photometric="minisblack")
        source = open_frames(tmp_path / name)
        with pytest.raises(DataError, match="frame 0: expected finite values"):
            source.read()
        assert np.isfinite(clean_source(source, check_content(source)).read()).all()


class TestStuckPixels:
    @pytest.mark.parametrize("dtype", [np.float32, np.uint8, ">u2"])
    @pytest.mark.parametrize(("level", "place"), [(1.0, (20, 30)), (0.0, (40, 11)), (1.0, (1, 62))])
    def test_hot_and_dead_pixels_are_replaced(self, frames, level, place, dtype):
        white = 1 if dtype == np.float32 else np.iinfo(dtype).max
        whole = (frames * white).astype(dtype)
        # A dead pixel is seen where it is surrounded by light.
        stack = whole.copy()
        around = (slice(None), slice(place[0] - 1, place[0] + 2), slice(place[1] - 1, place[1] + 2))
        stack[around] = np.clip(stack[around], 0.3 * white, 0.7 * white)
        expected = stack / np.float32(white)
        stack[:, place[0], place[1]] = level * white
        report, source = cleaned(stack)
        assert report.stuck.tolist() == [list(place)]
        found = source.read()
        assert np.abs(found - expected).max() < 0.5
        found[:, place[0], place[1]] = expected[:, place[0], place[1]]
        np.testing.assert_allclose(found, expected, atol=1e-6)

    def test_places_are_those_of_the_file_under_any_crop(self, frames):
        stack = frames.copy()
        stack[:, 40, 50] = 1
        stack[:, 39:42, 49:52] = np.clip(stack[:, 39:42, 49:52], 0, 0.5)
        stack[:, 40, 50] = 1
        source = FrameSource.from_array(stack).select(roi=(45, 35, 16, 16))
        report = check_content(source)
        assert report.stuck.tolist() == [[40, 50]]
        repaired = clean_source(source, report)
        assert repaired.read()[:, 5, 5].max() <= 0.5
        assert repaired.select(roi=(4, 4, 3, 3)).read()[:, 1, 1].max() <= 0.5

    def test_a_small_light_of_the_scene_is_kept_and_few_frames_tell_nothing(self, frames):
        rng = np.random.default_rng(0)
        scene = np.full((64, 64), 0.2, np.float32)
        scene[30, 30] = 8.0
        moved = [np.roll(scene, rng.integers(-1, 2, 2), (0, 1)) for _ in range(20)]
        stack = [cv2.GaussianBlur(frame, (0, 0), 0.8) + rng.normal(0, 0.01, (64, 64)) for frame in moved]
        report, _ = cleaned(np.clip(np.float32(stack), 0, 1))
        assert report.warnings == ()
        few = frames[:6].copy()
        few[:, 20, 30] = 1
        assert not len(cleaned(few)[0].stuck)

    def test_the_end_of_a_letter_is_kept_and_a_pixel_beside_an_edge_is_not(self):
        def found():
            detector = StuckPixelDetector()
            for frame in stack:
                detector.update(frame)
            return detector.found().tolist()

        stack = np.random.default_rng(0).uniform(0.2, 0.5, (20, 20, 20)).astype(np.float32)
        stack[:, 4, 5] = 1
        assert found() == [[4, 5]]
        # A stroke covers half of a neighbour, which moves by the other half.
        stack[:, 4, 4] = 0.5 + 0.5 * stack[:, 4, 4]
        assert found() == []
        # The edge of something bright stands out as much in every frame, but moves.
        stack[:, 4, 4] = 0.76 + 0.15 * (-1) ** np.arange(20)
        assert found() == [[4, 5]]


class TestFramesLeftOut:
    def test_duplicates_blanks_and_numbers_of_the_file(self, frames, elsewhere):
        stack = frames.copy()
        stack[5] = stack[4]
        stack[9] = 0
        stack[0] = 1
        report, source = cleaned(stack)
        assert (report.duplicated, report.blank) == ((5,), (0, 9))
        assert source.numbers == tuple(n for n in range(14) if n not in (0, 5, 9))
        np.testing.assert_array_equal(source.read(), stack[list(source.numbers)])
        np.testing.assert_array_equal(list(source), list(source))
        assert len(source) == len(list(source)) == source.shape[0] == 11
        np.testing.assert_array_equal(source.select((2, 8, 2)).read(), stack[list(source.numbers)[2:8:2]])
        # A lens cap shows the noise of the sensor.
        capped = elsewhere.copy()
        capped[:3] = np.abs(np.random.default_rng(0).normal(0, 0.01, (3, 64, 64)))
        assert cleaned(capped)[0].blank == (0, 1, 2)

    @pytest.mark.parametrize("name", ["a.mkv", "a.ser", "a.tif", "a.npy"])
    def test_every_reader_passes_over_them_and_times_follow(self, tmp_path, frames, name):
        stack = frames.copy()
        stack[[3, 4, 8]] = 0
        write_video(tmp_path / name, stack, 25)
        source = open_frames(tmp_path / name, frames=(1, 13, 2))
        whole, report = source.read(), check_content(source)
        assert report.blank == (3,)
        found = clean_source(source, report)
        np.testing.assert_array_equal(found.read(), np.delete(whole, 1, 0))
        if name == "a.mkv":
            np.testing.assert_allclose(found.timestamps, np.array([1, 5, 7, 9, 11]) / 25, atol=1e-3)

    def test_the_longest_scene_is_used_and_one_that_comes_back_is_one(self, frames, elsewhere):
        report, source = cleaned(np.concatenate([elsewhere[:8], frames]))
        assert [(scene.first, scene.last, scene.count) for scene in report.scenes] == [(0, 7, 8), (8, 21, 14)]
        np.testing.assert_array_equal(source.read(), frames)
        assert "to use another, select its frames (0:8)" in report.warnings[0]
        report, source = cleaned(np.concatenate([frames[:6], elsewhere[:3], frames[6:]]))
        assert len(report.scenes) == 2
        np.testing.assert_array_equal(source.read(), frames)

    def test_still_images_and_frames_without_any_contrast_are_kept_with_a_remark(self, frames):
        report, source = cleaned(np.repeat(frames[:1], 12, 0))
        assert len(source) == 12 and report.warnings == ("all frames are the same: there is no turbulence to take out",)
        report, source = cleaned(np.full((12, 20, 20), 0.3, np.float32))
        assert len(source) == 12 and report.blank == () and report.contrast == 0
        assert report.warnings == ("every frame is of one intensity: there is no scene",)


def test_saturation_is_told_and_nothing_is_changed(frames):
    stack = np.clip(frames * 1.6, 0, 1)
    report, source = cleaned(stack)
    assert report.saturated > 0.5 and "at white" in report.warnings[0]
    np.testing.assert_array_equal(source.read(), stack)


def test_a_report_belongs_to_its_frames(frames):
    source = FrameSource.from_array(frames)
    with pytest.raises(ConfigurationError, match="other frames"):
        clean_source(source, check_content(source.select((0, 5))))


@pytest.mark.parametrize("shape", [(3, 1, 1), (3, 1, 40), (3, 2, 2), (1, 5, 5), (12, 3, 3, 3), (2, 33, 31)])
def test_any_size_is_looked_at(shape):
    stack = np.random.default_rng(0).random(shape, dtype=np.float32)
    assert len(cleaned(stack)[1]) == shape[0]


class TestTurnedFrames:
    def flipped(self, stack, start=9):
        return np.concatenate([stack[:start], stack[start:, ::-1, ::-1]])

    @pytest.mark.parametrize("start", [5, 9])
    def test_the_fewer_ones_are_turned_back_exactly(self, planet, start):
        report, source = cleaned(self.flipped(planet, start))
        assert len(report.scenes) == 1 and report.turned == (tuple(range(9, 16)) if start == 9 else tuple(range(5)))
        np.testing.assert_array_equal(source.read(), planet if start == 9 else planet[:, ::-1, ::-1])
        assert report.warnings[0].endswith("turned back")

    def test_about_the_centre_of_the_region(self, planet):
        stack = np.zeros((16, 100, 120), np.float32)
        stack[:, 20:84, 30:110] = self.flipped(planet)
        source = FrameSource.from_array(stack).select(roi=(30, 20, 80, 64))
        found = clean_source(source, check_content(source))
        np.testing.assert_array_equal(found.read(), planet)
        np.testing.assert_array_equal(found.select(roi=(10, 5, 20, 15)).read(), planet[:, 5:20, 10:30])

    def test_stuck_pixels_are_repaired_before(self, planet):
        stack = self.flipped(planet)
        stack[:, 50, 10] = 1
        report, source = cleaned(stack)
        assert report.stuck.tolist() == [[50, 10]] and len(report.turned) == 7
        assert source.read().max() < 1

    def test_they_are_a_scene_of_their_own_where_frames_lack_pixels(self, planet):
        stack = self.flipped(planet)
        stack[4, :10] = np.nan
        report, source = cleaned(stack)
        assert report.turned == () and [scene.count for scene in report.scenes] == [9, 7]
        assert source.numbers == tuple(range(9))

    @pytest.mark.parametrize("shape", ["point", "disc", "line"])
    def test_what_looks_the_same_both_ways_is_not_turned(self, shape):
        rng = np.random.default_rng(1)
        y, x = np.mgrid[-50:50, -50:50]
        frames = []
        for dx, dy in rng.normal(0, 3, (60, 2)):
            distance = np.abs(x - dx) if shape == "line" else np.hypot(x - dx, y - dy)
            light = np.clip((30 - distance) / 2, 0, 1) if shape == "disc" else np.exp(-(distance**2) / 4)
            frames.append(light + rng.normal(0, 0.03, light.shape))
        assert cleaned(np.clip(np.float32(frames), 0, 1))[0].turned == ()

    def test_strict_refuses_them_and_a_steadied_video_keeps_them(self, planet):
        stack = self.flipped(planet)
        with pytest.raises(DataError, match="7 turned by 180°"):
            cleaned(stack, strict=True)
        source = FrameSource.from_array(stack)
        np.testing.assert_array_equal(clean_source(source, keep_all(check_content(source))).read(), stack)


class TestBlankFrames:
    def test_numbers_are_those_of_the_file_and_times_go_with_the_frames(self, frames):
        stack = np.insert(frames, [3, 5], 0.3, axis=0)
        timed = dataclasses.replace(FrameSource.from_array(stack), timestamps=np.arange(16.0))
        source, (found,) = without_blank(timed.select(frames=(2, None)))
        assert found.choice == "frames 3, 6 left out"
        np.testing.assert_array_equal(source.read(), frames[2:])
        assert source.timestamps.tolist() == [2, 4, 5, *range(7, 16)]

    def test_a_clip_without_any_or_of_nothing_else_is_the_same_source(self, frames):
        for stack in (frames, np.full((4, 32, 32), 0.3)):
            source = FrameSource.from_array(stack)
            found, decisions = without_blank(source)
            assert found is source and (decisions == () or stack is not frames)


def test_a_cleaned_clip_is_restored_as_it_is(elsewhere):
    fading = np.concatenate([np.zeros_like(elsewhere[:7]), 0.05 * elsewhere[:1], elsewhere[:7]])
    source = FrameSource.from_array(fading)
    cleaned = clean_source(source, check_content(source))
    found = restore(cleaned, RestoreParams(until="centroid"))
    assert found.train == len(cleaned) and "blank frames" not in {one.subject for one in found.decisions}


def test_frames_that_are_white_where_half_of_the_clip_shows_the_scene_are_left_out():
    gains = np.tile([0.25, 1.0, 4.0], 5)[:, None, None]
    scene = 0.1 + 0.8 * np.random.default_rng(0).random((32, 32))
    bracket = FrameSource.from_array(np.float32(np.clip(gains * scene + noise(15), 0, 1)))
    report = check_content(bracket)
    assert report.overexposed == (2, 5, 8, 11, 14) and report.left_out == set(report.overexposed)
    assert "5 overexposed: frames 2, 5, 8, 11, 14 left out" in " ".join(report.warnings)
    assert keep_all(report).overexposed == ()
    # White is no reason where most frames have it, or where frames are no brighter, as where the camera pans.
    for some in (
        np.clip(4 * scene + noise(15), 0, 1),
        np.where(gains > 1, np.where(scene > 0.8, 1, 0.9 * scene), scene),
    ):
        assert check_content(FrameSource.from_array(np.float32(some + noise(15)).clip(0, 1))).overexposed == ()


def noise(count):
    return np.random.default_rng(1).normal(0, 0.002, (count, 32, 32))

"""Clips as people record them come out as well as under steady light, at full scale, and with nobody in the way."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import SCENES, corrected, make_sequence, surveyed
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.footage.bars import find_bars
from turbrestore.footage.checks.content import check_content
from turbrestore.footage.lighting.light import find_light
from turbrestore.footage.lighting.range import find_range
from turbrestore.footage.overlays import Title, _titles, find_overlay, find_title, read_static_mask
from turbrestore.io.images.image_files import write_image
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.results import Restoration
from turbrestore.settings import RestoreParams

COUNT = 20
FUSED = RestoreParams(until="filter")


@pytest.fixture(scope="module")
def clip():
    return make_sequence(7, COUNT, 80, "camera", blur=0.8, noise=0.008, rms=1.2)


@pytest.fixture(scope="module")
def steady(clip):
    return score(u8(0.8 * clip.frames), clip)


def u8(frames):
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)


def u16(frames):
    return np.rint(65535 * np.clip(frames, 0, 1)).astype(np.uint16)


def restored(frames) -> Restoration:
    return restore(FrameSource.from_array(frames), FUSED)


def score(frames, clip):
    return compare(restored(frames).image, clip.scene).psnr_fit


def subjects(restoration):
    return {decision.subject for decision in restoration.decisions}


T, Y = np.arange(COUNT)[:, None, None], np.arange(80)[None, :, None]
PHASE = np.random.default_rng(3).uniform(0, 2 * np.pi, COUNT)[:, None, None]
LIGHT = {
    "exposure hunts by a tenth": (1 + 0.1 * np.sin(T / 4), 0),
    "exposure hunts by a quarter": (1 + 0.25 * np.sin(T / 4), 0),
    "bands of the mains": (1 + 0.2 * np.sin(2 * np.pi * Y / 60 + PHASE), 0),
    "clouds": (1 - 0.3 * (T > 15) * (T < 30), 0),
    "stray light": (1, 0.08 * np.sin(T / 5)),
}


class TestLight:
    @pytest.mark.parametrize("how", LIGHT)
    def test_what_changes_is_taken_out(self, clip, steady, how):
        gain, offset = LIGHT[how]
        found = restored(u8(0.7 * clip.frames * gain + 0.1 + offset))
        assert "light" in subjects(found)
        assert compare(found.image, clip.scene).psnr_fit > steady - 0.5

    def test_in_colour_with_drift(self, clip):
        colours = clip.frames[..., None] * np.float32([0.8, 0.6, 0.4])
        drifting = np.stack([np.roll(frame, k // 3, axis=1) for k, frame in enumerate(colours)])
        source, found = corrected(u8(drifting * (1 + 0.2 * np.sin(T / 4))[..., None]), find_light)
        even = source.read()
        left = [np.roll(frame, -(k // 3), axis=1)[:, :66].mean() for k, frame in enumerate(even)]
        assert found.decisions[0].subject == "light" and np.ptp(left) < 0.05 * np.mean(left)

    def test_rows_of_a_region_are_those_of_the_file(self, clip):
        bands = u8(0.8 * clip.frames * LIGHT["bands of the mains"][0])
        whole, _ = corrected(bands, find_light)
        part = whole.select((3, 9), (5, 40, 20, 30))
        np.testing.assert_array_equal(part.read(), whole.read(3, 9)[:, 40:70, 5:25])

    @pytest.mark.parametrize("scene", ["camera", "chart"])
    @pytest.mark.parametrize("rms", [0.5, 3.0])
    def test_steady_light_is_left_as_it_is(self, scene, rms):
        assert find_light(surveyed(make_sequence(5, 20, 96, scene, rms=rms).frames.clip(0, 1))) is None


@pytest.fixture(scope="module")
def shaken():
    """The scene under a camera that moves by some pixels."""
    rng = np.random.default_rng(2)
    clip = make_sequence(9, COUNT, 170, "camera", blur=0.8, noise=0.008, rms=0.8)
    places = 28 + np.rint(np.clip(rng.normal(0, 7, (COUNT, 2)), -20, 20)).astype(int)
    return u8(np.stack([frame[y : y + 112, x : x + 112] for frame, (x, y) in zip(clip.frames, places, strict=True)]))


@pytest.fixture(scope="module")
def uncovered(shaken):
    return restored(shaken)


class TestOverlays:
    """What is static while the scene moves is no part of the scene."""

    def alike(self, whole, covered):
        """Signal to noise between results around the middle, in dB."""
        found = restored(covered)
        assert "overlay" in subjects(found)
        return compare(found.image[22:90, 22:90], whole.image[22:90, 22:90]).psnr

    def test_field_stop(self, shaken, uncovered):
        y, x = np.mgrid[:112, :112]
        stop = np.clip(52.5 - np.hypot(x - 56, y - 56), 0, 1)
        assert self.alike(uncovered, np.rint(shaken * stop).astype(np.uint8)) > 30

    def test_reticle_and_clock(self, shaken, uncovered):
        covered = shaken.copy()
        covered[:, 56, 36:76] = covered[:, 36:76, 56] = 255
        covered[:, 96:106, 6:30] = 0
        for k, frame in enumerate(covered):
            cv2.putText(frame, f"{k:02d}", (8, 104), cv2.FONT_HERSHEY_SIMPLEX, 0.3, 255, 1)
        assert self.alike(uncovered, covered) > 30

    def test_a_stop_may_cover_half_of_the_frame_and_not_nearly_all(self, shaken):
        y, x = np.mgrid[:112, :112]
        for radius, is_one in ((45, True), (25, False)):
            stop = np.clip(radius - np.hypot(x - 56, y - 56), 0, 1)
            assert (find_overlay(surveyed(np.rint(shaken * stop).astype(np.uint8))) is not None) == is_one, radius

    def test_thin_lines_alone(self, shaken):
        covered = shaken.copy()
        covered[:, 56, 36:76] = covered[:, 36:76, 56] = 255
        read = corrected(covered, find_overlay)[0].read()
        assert read[:, 56, 36:76].mean() < 0.9 and read[:, 36:76, 56].mean() < 0.9

    def test_what_a_camera_that_hardly_moves_shows_is_kept(self):
        rng = np.random.default_rng(0)
        places, noise = rng.standard_normal((12, 2)), 0.008 * rng.standard_normal((12, 64, 64))
        places -= places.mean(axis=0)
        places /= np.sqrt(np.mean(np.sum(places**2, axis=1)))
        scene = 0.8 * SCENES["chart"](104)
        for motion, what in ((2, "kept"), (4, "replaced")):
            corners = 20 + np.rint(motion * places).astype(int)
            frames = noise + np.stack([scene[y : y + 64, x : x + 64] for x, y in corners])
            frames[:, 48:58, 6:40] = 0
            frames[:, 50:56, 8:38:3] = 1
            assert what in find_overlay(surveyed(u8(frames))).decisions[0].choice

    def test_switched_off(self, shaken):
        covered = shaken.copy()
        covered[:, 40, 20:60] = 255
        params = RestoreParams(until="centroid", static_mask="off")
        assert "overlay" not in subjects(restore(FrameSource.from_array(covered), params))

    def test_given_as_a_file(self, shaken, uncovered, tmp_path):
        covered, mask = shaken.copy(), np.zeros((112, 112), np.float32)
        covered[:, 40:44, 20:60] = np.random.default_rng(0).integers(0, 255, (COUNT, 4, 40))
        mask[40:44, 20:60] = 1
        write_image(tmp_path / "mask.png", mask, 8)
        params = replace(FUSED, static_mask=str(tmp_path / "mask.png"))
        found = restore(FrameSource.from_array(covered), params)
        assert [decision.reason for decision in found.decisions if decision.subject == "overlay"] == ["asked for"]
        assert compare(found.image[22:90, 22:90], uncovered.image[22:90, 22:90]).psnr > 30

    def test_a_file_of_the_wrong_size_or_without_marks_is_refused(self, shaken, tmp_path):
        source = FrameSource.from_array(shaken).select(roi=(10, 20, 60, 50))
        for name, mask in (("small", np.ones((40, 60))), ("black", np.zeros((112, 112))), ("white", np.ones((50, 60)))):
            write_image(tmp_path / f"{name}.png", mask.astype(np.float32), 8)
            with pytest.raises(DataError, match=rf"{name}.png: expected .*, found (60×40|none|all of them)"):
                read_static_mask(tmp_path / f"{name}.png", source)
        mask = np.zeros((112, 112), np.float32)
        mask[25, 12] = 1
        write_image(tmp_path / "file.png", mask, 8)
        assert np.argwhere(read_static_mask(tmp_path / "file.png", source)).tolist() == [[5, 2]]

    def test_what_is_neither_a_choice_nor_an_image_is_refused(self):
        with pytest.raises(ConfigurationError, match="static_mask: expected auto, off or an image file, found 'yes'"):
            RestoreParams(static_mask="yes")

    def test_scenes_have_none(self, shaken, clip):
        for frames in (shaken, u8(clip.frames), u8(0.2 + 0 * clip.frames[:1] + 0.3 * clip.frames)):
            assert find_overlay(surveyed(frames)) is None

    def test_edges_along_a_pan_are_no_overlay(self):
        """They move by no more than the air bends them."""
        wide = u8(make_sequence(3, 32, 144, "chart", blur=0.8, noise=0.008, rms=0.3).frames)
        panned = np.stack([frame[20:120, number : number + 100] for number, frame in enumerate(wide)])
        assert find_overlay(surveyed(panned)) is None
        # Beside an overlay they are left alone, too.
        panned[:, 40:60, 49:51] = panned[:, 49:51, 40:60] = 0
        clip, _ = corrected(panned, find_overlay)
        changed = np.abs(clip.read() - panned / np.float32(255)).max(axis=0) > 1e-3
        assert changed[42:58, 49:51].mean() > 0.9
        changed[28:72, 28:72] = False
        assert not changed.any()

    def test_a_window_is_that_of_the_whole_frame(self, shaken):
        covered = shaken.copy()
        covered[:, 40:44, 20:60] = 255
        assert find_title(surveyed(covered)) is None
        source, _ = corrected(covered, find_overlay)
        assert (source.read()[:, 41:43, 22:58] < 1).any()
        part = source.select((2, 5), (15, 30, 30, 25))
        np.testing.assert_array_equal(part.read(), source.read(2, 5)[:, 30:55, 15:45])


@pytest.fixture(scope="module")
def titled(clip):
    frames = u8(0.8 * clip.frames)
    for frame in frames:
        for shade, width in ((0, 3), (255, 1)):
            cv2.putText(frame, "GATE 7", (6, 70), cv2.FONT_HERSHEY_SIMPLEX, 0.5, shade, width)
    return frames


class TestTitles:
    """Text that is burnt in keeps its pixels where the camera is static."""

    def test_they_stay_as_in_the_mean_and_the_scene_as_without_them(self, clip, titled):
        found, alone = (restore(FrameSource.from_array(some)) for some in (titled, u8(0.8 * clip.frames)))
        assert "overlay" in subjects(found)
        letters = titled.min(axis=0) == 255
        assert letters.sum() > 20
        assert found.image[letters].min() > 0.97
        rows = np.s_[10:48, 10:70]
        assert np.sqrt(np.mean((found.image[rows] - alone.image[rows]) ** 2)) < 0.025

    def test_a_window_is_that_of_the_whole_frame_and_letters_are_no_stuck_pixels(self, titled):
        title = find_title(surveyed(titled))
        assert np.array_equal(find_overlay(surveyed(titled)).hidden, title.mask)
        np.testing.assert_allclose(title.put_back(np.zeros((20, 30)), 5, 55)[title.mask[55:75, 5:35]].max(), 1)
        assert len(check_content(FrameSource.from_array(titled)).stuck) == 0

    def test_three_frames_are_enough(self, clip, titled):
        plain = u8(0.8 * clip.frames)
        found = [find_overlay(surveyed(some)) is not None for some in (plain[:2], plain[:3], titled[:3])]
        assert found == [False, False, True]

    def test_the_mask_is_that_of_the_text(self, titled):
        rim, letters = np.zeros((2, 96, 96), np.uint8)
        for canvas, width in ((rim, 3), (letters, 1)):
            cv2.putText(canvas, "GATE 7", (6, 82), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, width)
        scene = 0.05 + 0.8 * make_sequence(17, COUNT, 96, "camera", blur=0.8, noise=0.008, rms=1.2).frames
        for frames in (titled, u8(np.where(rim == 255, letters == 255, scene))):
            text, mask = frames.std(axis=0) == 0, find_title(surveyed(frames)).mask
            assert mask[text].mean() > 0.95
            assert not mask[cv2.dilate(text.astype(np.uint8), np.ones((13, 13))) == 0].any()

    def test_where_little_moves_lines_are_found_and_nothing_else(self):
        frames = u8(0.05 + 0.8 * make_sequence(17, COUNT, 96, "chart", blur=0.8, noise=0.008, rms=0.4).frames)
        assert find_overlay(surveyed(frames)) is None
        frames[:, 48, 28:68] = frames[:, 28:68, 48] = 255
        assert find_title(surveyed(frames)).mask[48, 28:68].mean() > 0.9

    def test_a_small_mark_that_a_coder_made_noisy_keeps_its_colour(self, clip):
        frames = np.repeat(u8(0.8 * clip.frames)[..., None], 3, axis=3)
        plain = frames.copy()
        noise = np.random.default_rng(0).normal(0, 6, (COUNT, 6, 6, 1))
        frames[:, :6, 50:56] = np.clip(np.array([230, 20, 20]) + noise, 0, 255)
        title = find_title(surveyed(frames))
        assert title is not None and title.mask[:6, 50:56].all() and title.mask.sum() < 100
        found = restore(FrameSource.from_array(frames))
        np.testing.assert_allclose(found.image[:6, 50:56], found.mean[:6, 50:56], atol=0.01)
        assert find_title(surveyed(plain)) is None

    def test_dark_lines_along_the_border_and_still_clips_have_none(self, clip, titled):
        lined = u8(0.8 * clip.frames)
        lined[:, :, -2:] = 20
        assert find_title(surveyed(lined)) is None
        noise = np.random.default_rng(1).normal(0, 2, titled.shape)
        still = np.where(titled[0] == 255, 255, np.clip(titled[0] + noise, 0, 250)).astype(np.uint8)
        assert find_title(surveyed(still)) is None

    def test_dim_clips_of_16_bits_have_those_of_bright_ones(self, clip, titled, shaken, sequence):
        plain, marked = u8(0.8 * clip.frames), shaken.copy()
        marked[:, 40:44, 20:60] = 255
        # A camera of more bits sees what lies between two levels.
        between = np.random.default_rng(1).uniform(-0.5, 0.5, (COUNT, 112, 112))
        for name, bright in {"title": titled, "reticle": marked, "plain": plain, "shaken": shaken}.items():
            dim = u16(0.1 + 0.02 / 255 * (bright + between[:, : bright.shape[1], : bright.shape[2]]))
            title, overlay = find_title(surveyed(dim)), find_overlay(surveyed(dim))
            assert (title is not None, overlay is not None) == (name == "title", name in ("title", "reticle")), name
            if title is not None:
                assert (title.mask == find_title(surveyed(bright)).mask).mean() > 0.98
        # Levels of 8 bits stay coarse in a file of 16.
        for steps in (2, 6, 8):
            coarse = 257 * np.rint(steps * sequence.frames.clip(0, 1)).astype(np.uint16)
            assert find_overlay(surveyed(coarse)) is None

    def test_they_are_large_enough_and_the_scene_bends_enough(self):
        waves = np.arange(48) + np.zeros((12, 48, 1))
        turns = np.where(T[:12] % 2, 1, -1)
        for bending, side, found in ((0.2, 8, False), (0.4, 8, True), (0.8, 3, False), (0.8, 4, True)):
            frames = 0.5 + 0.3 * np.sin(np.pi / 6 * (waves + bending * turns))
            frames[:, 20 : 20 + side, 20 : 20 + side] = 1
            assert (find_title(surveyed(u8(frames))) is not None) == found, (bending, side)

    def test_parts_stay_unless_half_of_their_edges_move_by_half_a_pixel(self):
        ramp, mask = np.tile(np.linspace(0, 1, 41, dtype=np.float32), (30, 1)), np.zeros((30, 41), bool)
        mask[5:25, 5:35] = True
        title = Title(mask, ramp, np.s_[:30, :41])
        for rows, pixels, stays in ((20, 0.35, True), (20, 0.7, False), (7, 2, True), (14, 2, False)):
            frame = ramp.copy()
            frame[5 : 5 + rows] += pixels / 40
            assert title.at_rest(frame, 0.001) is (title if stays else None), (rows, pixels)

    def test_a_quiet_row_of_a_broad_edge_is_no_title(self):
        clear, drawn = np.zeros((2, 60, 60), bool)
        clear[4:7, 5:55], clear[40:48, 30:38] = True, True
        drawn[5, 20:33], drawn[40:48, 30:38] = True, True
        found = _titles(drawn, clear)
        assert not found[5].any() and found[40:48, 30:38].all()


class TestClocks:
    """Digits that change keep their pixels, although they are not static all the time."""

    def test_they_stay_as_in_the_mean(self, clip):
        frames = u8(0.8 * clip.frames)
        plain = frames.copy()
        for number, frame in enumerate(frames):
            for shade, width in ((0, 3), (255, 1)):
                cv2.putText(frame, f"1:{number // 2:02d}", (8, 70), cv2.FONT_HERSHEY_SIMPLEX, 0.5, shade, width)
        title = find_title(surveyed(frames))
        changing = (frames.std(axis=0) > 40) & ((frames != plain).mean(axis=0) >= 0.5)
        assert title is not None and title.mask[changing].mean() > 0.9
        assert title.mask[:46].sum() == 0
        found = restored(frames)
        np.testing.assert_allclose(found.image[title.mask], frames.mean(axis=0)[title.mask] / 255, atol=0.01)

    def test_the_last_digit_of_a_time_code_belongs_to_it(self):
        """Most edges that move near it stay from frame to frame, as hardly any of the scene do."""
        frames = u8(make_sequence(19, 32, 144, "camera", blur=0.8, noise=0.008, rms=1.2).frames)
        for number, frame in enumerate(frames):
            for shade, width in ((0, 3), (255, 1)):
                text = f"14:06:{51 + number // 25}:{number % 25:02d}"
                cv2.putText(frame, text, (30, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, width)
            cv2.rectangle(frame, (50, 120), (132, 138), 0, -1)
            cv2.putText(frame, f"No {2871 + number:06d}", (54, 133), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 255, 1, cv2.LINE_AA)
        without, whole = (
            cv2.putText(np.zeros((144, 144), np.uint8), text, (30, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1, 1)
            for text in ("14:06:51:0", "14:06:51:08")
        )
        title = find_title(surveyed(frames))
        assert title is not None and title.mask[without != whole].mean() > 0.8

    def test_a_camera_that_moves_shows_the_scene_behind_them(self, shaken):
        frames = shaken.copy()
        for number, frame in enumerate(frames):
            for shade, width in ((0, 3), (255, 1)):
                cv2.putText(frame, f"1:{number // 2:02d}", (8, 98), cv2.FONT_HERSHEY_SIMPLEX, 0.5, shade, width)
        read = 255 * corrected(frames, find_overlay)[0].read()
        text = frames != shaken
        assert (np.abs(read - frames)[text] > 1).mean() > 0.95
        far = cv2.dilate(text.any(axis=0).astype(np.uint8), np.ones((13, 13))) == 0
        assert (np.rint(read[:, far]) != shaken[:, far]).mean() < 0.005


@pytest.fixture(scope="module")
def without_bars(clip):
    return restored(u8(0.2 + 0.7 * clip.frames))


class TestBars:
    @pytest.mark.parametrize("sides", [(12, 12, 0, 0), (0, 0, 20, 30), (8, 0, 4, 0)])
    def test_the_picture_is_as_without_them(self, clip, without_bars, sides):
        top, bottom, left, right = sides
        frames = u8(0.2 + 0.7 * clip.frames)
        barred = np.pad(frames, ((0, 0), (top, bottom), (left, right)), constant_values=16)
        found = restored(barred)
        assert "bars" in subjects(found) and found.image.shape == barred.shape[1:]
        part = found.image[top : top + 80, left : left + 80]
        scores = [compare(image, clip.scene).psnr_fit for image in (part, without_bars.image)]
        assert scores[0] > scores[1] - 0.5
        outside = np.ones(found.image.shape, bool)
        outside[top : top + 80, left : left + 80] = False
        np.testing.assert_allclose(255 * found.image[outside], 16, atol=0.01)

    def test_windows_are_those_of_the_whole_frame(self, clip):
        source, _ = corrected(np.pad(u8(clip.frames), ((0, 0), (9, 9), (0, 0))), find_bars)
        np.testing.assert_array_equal(source.select((1, 3), (5, 0, 30, 25)).read(), source.read(1, 3)[:, :25, 5:35])

    def test_black_around_a_disc_is_no_bar(self):
        y, x = np.mgrid[:64, :80]
        disc = 0.8 * (np.hypot(x - 40, y - 32) < 20)
        assert find_bars(surveyed(u8(np.stack([np.roll(disc, k, axis=1) for k in range(5)])))) is None


class TestRange:
    def test_scale_does_not_matter(self, clip):
        # What is known of the blur does not depend on it; which of two widths loses less may, where they lose alike.
        params = RestoreParams(deconvolution=DeconvolutionParams(sigma=0.8))
        clips = [u16(k / 30 + 0.95 * k * clip.frames[:12]) for k in (1, 0.35, 0.1, 1 / 160)]
        scores = [compare(restore(frames, params).image, clip.scene).psnr_fit for frames in clips]
        widths = [restore(frames).posterior.width for frames in clips[:3]]
        assert np.ptp(scores[1:3]) < 0.1 and np.ptp(scores) < 0.3
        # The wide end of what may be is the least certain of the three.
        np.testing.assert_allclose(widths[1:], widths[:1] * 2, rtol=0.04)

    @pytest.mark.parametrize("span", [200, 2000])
    def test_thermal_counts(self, clip, steady, span):
        rng = np.random.default_rng(1)
        counts = 7000 + span * clip.frames + 2 * rng.standard_normal(clip.frames.shape)
        found = restored(np.rint(counts).astype(np.uint16))
        assert compare(found.image, clip.scene).psnr_fit > steady - 1.5
        # The levels are those of the counts.
        np.testing.assert_allclose(
            np.median(65535 * found.image), 7000 + span * np.median(clip.scene), atol=0.03 * span
        )
        assert abs(float((found.mean - counts.mean(axis=0) / 65535).mean())) < 0.001 * span / 65535

    def test_results_of_all_stages_have_the_levels_of_the_clip(self, clip):
        found = restore(FrameSource.from_array(u16(0.3 + clip.frames[:12] / 50)))
        for image in (found.image, found.mean, found.centroid.image, found.filtered.image, found.deconvolution.image):
            assert abs(float(np.mean(image)) - 0.3 - float(clip.scene.mean()) / 50) < 0.001
        assert found.filtered.image_noise < 1e-5 and "range" in subjects(found)

    def test_a_disc_that_jumps_is_not_dark(self):
        y, x = np.mgrid[:64, :80]
        rng = np.random.default_rng(0)
        discs = [0.8 * (np.hypot(x - 40 - dx, y - 32 - dy) < 8) for dx, dy in rng.uniform(-20, 20, (20, 2))]
        assert find_range(surveyed(u8(np.stack(discs)))) is None

    def test_wide_clips_are_left_as_they_are(self, clip):
        assert find_range(surveyed(u8(clip.frames))) is None

    @pytest.mark.parametrize("deviation", [0, 0.0002])
    def test_noise_is_no_scene(self, deviation):
        noise = 0.1 + deviation * np.random.default_rng(0).standard_normal((20, 48, 48))
        with pytest.raises(DataError, match="some contrast"):
            find_range(surveyed(noise.astype(np.float32)))

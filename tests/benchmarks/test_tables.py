"""Clips that nothing was chosen on, tables that split by them, and the line that says what a table is of."""

import blur_clips
import clips
import cv2
import numpy as np
import oracles
import pytest
import quality
from provenance import LINE, revision, with_origin

import turbrestore
from turbrestore.registration.warp import warp


class TestDrawnClips:
    def test_they_are_those_of_the_version(self):
        one, same, other = (clips.drawn_clips(version)["drawn_lens_coins"]() for version in ("1.0", "1.0", "1.1"))
        np.testing.assert_array_equal(one.frames, same.frames)
        assert not np.array_equal(one.truth, other.truth)
        assert one.frames.dtype == np.float32
        # The truth is the scene in the geometry of the frames: their mean lies about it.
        errors = [np.abs(one.frames.mean(axis=0) - truth).mean() for truth in (one.truth, other.truth)]
        assert errors[0] < 0.5 * errors[1]

    def test_no_other_clip_shows_their_scenes(self):
        shown = {name.split("_")[-1] for name in clips.find_clips() if name.startswith(("smooth_", "screens_"))}
        assert not shown & set(clips.DRAWN_SCENES)
        assert not set(clips.DRAWN_SCENES) & set(blur_clips.CHOSEN)

    def test_they_are_found_and_told_apart(self):
        assert {*filter(clips.is_reported, clips.find_clips())} == {*clips.drawn_clips(turbrestore.__version__)}


def test_reported_and_other_clips_have_means_of_their_own():
    rows = {"drawn_air_page": 30.0, "drawn_lens_page": 20.0, "smooth_cat": 40.0}
    figures = {clip: {"default": {"psnr": value, "ssim": 0.5}} for clip, value in rows.items()}
    text = quality.document(figures)
    reported, others = text.split("## PSNR, dB\n")[1].split("## ")[0].split("| **mean** |")[1:]
    assert "25.00" in reported and "smooth_cat" in reported and "40.00" in others


def test_a_table_says_what_it_is_of_once():
    once = with_origin("# Title\n\nText.\n")
    assert with_origin(once).count("turbrestore") == 1
    found = LINE.search(once)
    assert found["version"] == turbrestore.__version__ and found["revision"] == revision()
    assert LINE.sub("", once) == "# Title\n\nText.\n"


def test_oracles_know_the_motion_and_the_blur():
    case = oracles.Case(count=6, displacement=1.5, blur=1.2, noise=0.0)
    frames, flows, truth, _ = oracles.clip("coins", case)
    inside = np.s_[12:-12, 12:-12]
    blurred = cv2.GaussianBlur(truth, (0, 0), case.blur)
    registered = np.mean([warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)], axis=0)
    assert np.abs(registered - blurred)[inside].mean() < 0.2 * np.abs(frames[0] - blurred)[inside].mean()
    assert np.abs(flows.mean(axis=0))[inside].max() < 0.1
    assert oracles.blur_of(blurred, truth).sigma == pytest.approx(case.blur, rel=0.15)

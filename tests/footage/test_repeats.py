"""Frames that repeat others but for noise or what a codec leaves, against frames that do not."""

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.footage.checks.repeats import RepeatDetector
from turbrestore.io.containers.encoding import Encoding
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video

RNG = np.random.default_rng(3)


def repeats(frames):
    detector = RepeatDetector()
    for frame in frames:
        detector.update(np.asarray(frame, np.float32))
    return np.flatnonzero(detector.found()).tolist()


@pytest.fixture(scope="module", params=[(0.004, 0.2), (0.004, 1.2), (0.02, 0.5)], ids=str)
def live(request):
    noise, rms = request.param
    return make_sequence(11, 20, 96, "camera", blur=0.8, noise=noise, rms=rms).frames


def test_frames_behind_moving_air_are_no_repeats(live):
    assert repeats(live) == []
    assert repeats(live * 0.02) == []


def test_air_that_calms_down_gives_no_repeats():
    frames = [make_sequence(11, 10, 96, "camera", blur=0.8, noise=0.004, rms=rms).frames for rms in (1.5, 0.15)]
    assert repeats(np.concatenate(frames)) == []


def test_a_picture_that_stops_is_found_under_noise(live):
    frozen = live.copy()
    frozen[5:15] = live[5]
    for noise in (0, 0.002):
        assert repeats(frozen + noise * RNG.standard_normal(frozen.shape)) == list(range(6, 15))


def test_every_frame_twice_is_found_under_noise(live):
    twice = live[:10].repeat(2, axis=0)
    assert repeats(twice + 0.001 * RNG.standard_normal(twice.shape)) == list(range(1, 20, 2))


def test_a_picture_that_stops_is_found_in_h264(live, tmp_path):
    frozen = live.copy()
    frozen[5:15] = live[5]
    write_video(tmp_path / "a.mp4", frozen, 25, encoding=Encoding("h264", 20))
    source = open_frames(tmp_path / "a.mp4")
    cleaned = clean_source(source, check_content(source))
    assert list(cleaned.numbers) == [*range(6), *range(15, 20)]
    assert cleaned.warnings[0] == "9 duplicated: frames 6, 7, 8, 9, 10 and 4 more left out"


def test_without_air_no_frame_repeats_another():
    still = make_sequence(11, 2, 96, "camera", blur=0.8, noise=0, rms=0.1).scene
    frames = still + 0.004 * RNG.standard_normal((20, *still.shape))
    assert repeats(frames) == []
    frames[10:] = np.roll(frames[10:], 2, axis=2)
    assert repeats(frames) == []
    assert repeats(np.repeat(still[None], 20, axis=0)) == []


def test_colours_and_narrow_frames():
    frames = RNG.uniform(0.2, 0.8, (8, 40, 40, 3))
    frames[4] = frames[3]
    assert repeats(frames) == [4]
    assert check_content(FrameSource.from_array(RNG.random((4, 30, 2)))).duplicated == ()

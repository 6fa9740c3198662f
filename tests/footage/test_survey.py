"""A survey reads every frame once, and its frames are corrected as those of the clip are."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence, surveyed
from turbrestore.core.robust import spread
from turbrestore.footage.correction import Correction
from turbrestore.footage.survey import survey_memory, survey_scratch_bytes, take_survey
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import restore
from turbrestore.preparation import prepare
from turbrestore.settings import RestoreParams

RNG, COUNT = np.random.default_rng(0), 24
# Of what a file holds: types that are kept, and one that is not.
KINDS = {np.uint8: 255, np.uint16: 1023, ">u2": 65535, np.float32: 1, np.uint32: 2**32 - 1}


def counting(frames):
    """A source, and the numbers of the frames that have been read."""
    read, source = [], FrameSource.from_array(frames)

    def pixels(chosen):
        for number in chosen:
            read.append(number)
            yield frames[number]

    return replace(source, pixels=pixels), read


@pytest.mark.parametrize("scratch", [False, True])
def test_whole_frames_are_those_of_the_clip(tmp_path, scratch):
    for dtype, white in KINDS.items():
        frames = (RNG.random((60, 20, 30, 3)) * white).astype(dtype)
        source = replace(FrameSource.from_array(frames), full_scale=white)
        clip = source.select(frames=(3, None)).adjusted(lambda number, values, _: values * np.float32(0.9) + number)
        survey = take_survey(clip, tmp_path if scratch else None)
        assert len(survey.numbers) == 48 and survey.numbers[0] == 3 and survey.numbers[-1] == 59
        for number, frame in zip(survey.numbers, survey, strict=True):
            np.testing.assert_allclose(frame, clip.read(number - 3, number - 2)[0], rtol=1e-6)
        assert spread(len(survey.numbers), 5) == [0, 12, 24, 35, 47]
        doubled = survey.corrected(Correction((), lambda _, values, window: 2 * values))
        np.testing.assert_allclose(next(iter(doubled)), 2 * next(iter(survey)))
    assert not list(tmp_path.iterdir())


def test_reduced_frames_are_all_frames():
    frames = np.repeat(np.repeat(RNG.random((7, 40, 60)), 8, axis=1), 8, axis=2).astype(np.float32)
    small = surveyed(frames).small
    assert small.shape == (7, 128, 192)
    np.testing.assert_allclose(small.mean(axis=(1, 2)), frames.mean(axis=(1, 2)), atol=1e-4)


def test_memory_hardly_grows_with_the_clip():
    # Reduced frames take 32 MB, and what is derived from them twice as much.
    many = [survey_memory((count, 480, 640), True) for count in (10**3, 3 * 10**4)]
    assert max(many) < 1.1e8 + 4 * 2 * 480 * 640
    assert (
        survey_scratch_bytes((10**4, 1080, 1920)) < 4.1e8
        and survey_scratch_bytes((10**4, 4320, 7680)) == 9 * 4 * 4320 * 7680
    )


def test_a_clip_is_read_for_the_survey_and_for_the_filter_and_once_more_for_moving_objects():
    frames = make_sequence(7, COUNT, 64, "camera", blur=0.8, noise=0.008, rms=1.2).frames.clip(0, 1)
    walked = 0.8 * frames
    for number, frame in enumerate(walked):
        frame[26:50, 3 * number : 3 * number + 9] = 0.05
    flickering = 0.6 * frames * (1 + 0.3 * np.sin(np.arange(COUNT) / 4))[:, None, None]
    flickering[:, :8] = 0
    for clip, subjects, times in (
        (frames, set(), 2),
        (flickering, {"bars", "light"}, 2),
        (walked, {"moving objects"}, 3),
    ):
        source, read = counting(clip.astype(np.float32))
        assert {found.subject for found in prepare(source).decisions} >= subjects
        assert len(read) == COUNT * (times - 1)
        read.clear()
        restore(source, RestoreParams(until="filter"))
        assert len(read) == COUNT * times

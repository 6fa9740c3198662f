"""White balance that hunts is evened out; one that is fixed is left as it is."""

import numpy as np
import pytest
from usual_files import clip, tinted

from conftest import corrected, surveyed
from turbrestore.footage.lighting.white_balance import find_white_balance
from turbrestore.io.source import FrameSource
from turbrestore.preparation import prepare


@pytest.fixture(scope="module")
def colours():
    return clip("astronaut", 5)[1]


def ratios(frames):
    means = frames.mean(axis=(1, 2))
    return means[:, [0, 2]] / means[:, 1:2]


def test_channels_are_brought_to_their_mean(colours):
    frames = np.clip(tinted(colours), 0, 1)
    assert np.ptp(ratios(frames), axis=0).min() > 0.15
    steady, found = corrected(frames, find_white_balance)
    (decision,) = found.decisions
    assert np.ptp(ratios(steady.read()), axis=0).max() < 0.01
    np.testing.assert_allclose(ratios(steady.read()).mean(axis=0), ratios(0.85 * colours).mean(axis=0), rtol=0.01)
    assert decision.subject == "white balance" and "of its mean against the other colours" in decision.reason
    # A window of the frames has the colours of the whole.
    window = steady.select(roi=(10, 20, 30, 40)).read()
    np.testing.assert_array_equal(window, steady.read()[:, 20:60, 10:40])


def test_it_is_told_apart_from_light(colours):
    light = 0.8 * (1 + 0.2 * np.sin(np.arange(len(colours)) / 3))[:, None, None, None]
    assert find_white_balance(surveyed(np.clip(light * colours, 0, 1))) is None
    both = prepare(FrameSource.from_array(np.clip(0.8 * light * tinted(colours), 0, 1)))
    assert [decision.subject for decision in both.decisions][:2] == ["white balance", "light"]
    assert np.ptp(ratios(both.source.read()), axis=0).max() < 0.02


def test_a_fixed_balance_and_grey_frames_stay(colours):
    assert find_white_balance(surveyed(colours)) is None
    # Somebody in red walks through.
    walked = colours.copy()
    for number, frame in enumerate(walked):
        frame[50:90, 6 * number : 6 * number + 14] = (0.8, 0.1, 0.1)
    assert find_white_balance(surveyed(walked)) is None
    assert find_white_balance(surveyed(colours.mean(axis=3))) is None


def test_a_shaken_camera_is_no_change_of_colours(colours):
    rng = np.random.default_rng(1)
    places = rng.integers(0, 14, (len(colours), 2))
    shaken = np.stack([frame[y : y + 96, x : x + 96] for frame, (y, x) in zip(colours, places, strict=True)])
    assert find_white_balance(surveyed(shaken)) is None

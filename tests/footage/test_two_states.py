"""A sign that switches is told, with a range of frames for either text; air and a camera that moves are not."""

import cv2
import numpy as np
import pytest

from conftest import make_sequence, surveyed
from turbrestore.core.verdict import CheckKind
from turbrestore.footage.checks.two_states import find_two_states


def with_sign(frames, shown):
    """Frames in which a part is a sign that says OPEN, or SALE where it is so marked."""
    stack = frames.copy()
    for frame, second in zip(stack, shown, strict=True):
        frame[36:60, 16:80] = 0.1
        letters = np.zeros(frame.shape, np.uint8)
        cv2.putText(letters, "SALE" if second else "OPEN", (20, 54), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1, 2)
        frame[letters > 0] = 0.9
    return stack


@pytest.fixture(scope="module")
def frames():
    return make_sequence(3, count=32, size=96, scene="camera").frames


@pytest.mark.parametrize(("period", "ranges"), [(8, "0:8 8:16"), (16, "0:16 16:32"), (20, "0:20 20:32")])
def test_either_range_is_offered(frames, period, ranges):
    (decision,) = find_two_states(surveyed(with_sign(frames, np.arange(32) // period % 2))).decisions
    first, second = ranges.split()
    assert decision.check is CheckKind.TWO_STATES
    assert decision.reason == f"one is in --frames {first}, the other in --frames {second}"


def test_in_colour(frames):
    stack = with_sign(frames, np.arange(32) // 16)
    assert find_two_states(surveyed(np.stack([stack, 0.5 * stack, 0.2 * stack], -1))) is not None


@pytest.mark.parametrize("shown", [np.zeros(32), np.arange(32) >= 28])
def test_a_sign_that_stays_or_changes_at_the_end_has_one_state(frames, shown):
    assert find_two_states(surveyed(with_sign(frames, shown))) is None


def test_a_camera_that_has_moved_once_has_changed_no_part(frames):
    assert find_two_states(surveyed(np.concatenate([frames[:16], np.roll(frames[16:], 4, 2)]))) is None


def test_frames_that_are_all_the_same_have_one_state(frames):
    assert find_two_states(surveyed(np.repeat(frames[:1], 6, 0))) is None

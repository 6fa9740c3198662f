"""Words over the scene: opaque ones are kept, and those that the scene shows through are named."""

import functools

import cv2
import numpy as np
import pytest

from conftest import photograph, surveyed
from turbrestore.core.verdict import CheckKind
from turbrestore.footage.overlays import find_overlay
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIDE, MARGIN, COUNT = 160, 24, 40


@functools.cache
def bent_cups() -> np.ndarray:
    """Frames of a cup with a margin, which all tests look at."""
    rng, wide = np.random.default_rng(3), photograph("coffee", SIDE + 2 * MARGIN)
    flows = smooth_flows(COUNT, *wide.shape, rng, SmoothFlowParams(correlation_length=12))
    return distort(wide, flows, rng, blur=1.0, noise=0.008)


def clip_behind_words(opacity: float, shake: float) -> np.ndarray:
    """Frames of a cup, each moved by whole pixels, behind words that stay in place."""
    moves = np.random.default_rng(3).normal(0, shake, (COUNT, 2))
    shifts = MARGIN + np.clip(np.rint(moves), -MARGIN, MARGIN).astype(int)
    frames = np.stack([frame[y : y + SIDE, x : x + SIDE] for frame, (x, y) in zip(bent_cups(), shifts, strict=True)])
    word = np.zeros((SIDE, SIDE), np.uint8)
    cv2.putText(word, "STOCK", (12, 95), cv2.FONT_HERSHEY_SIMPLEX, 1.4, 255, 5)
    cover = opacity * np.float32(word) / 255
    return np.rint(255 * np.clip(frames * (1 - cover) + cover, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize("shake", [0, 2, 4])
def test_a_watermark_is_named_and_left_in_the_frames_where_the_camera_moves(shake):
    found = find_overlay(surveyed(clip_behind_words(0.35, shake)))
    assert [decision.check for decision in found.decisions] == [CheckKind.WATERMARK] and found.hidden is None
    assert (found.put_back is None) == (found.apply is None) == (shake > 0)


@pytest.mark.parametrize("level", [20, 255])
def test_what_is_opaque_is_replaced_while_the_camera_moves(level):
    """A title, and a dark stop that has the noise of the sensor."""
    frames = clip_behind_words(0.0, 4)
    if level == 20:
        y, x = np.mgrid[: frames.shape[1], : frames.shape[2]]
        stop = np.hypot(x - 80, y - 80) > 75
        frames[:, stop] = np.random.default_rng(0).normal(level, 2, frames[:, stop].shape).round()
    else:
        frames[:, 90:110, 40:120] = level
    found = find_overlay(surveyed(frames))
    assert found.put_back is None and found.hidden is not None
    assert [decision.check for decision in found.decisions] == [None]


def test_an_opaque_title_is_kept_without_a_doubt():
    found = find_overlay(surveyed(clip_behind_words(1.0, 0)))
    assert found.put_back is not None and found.hidden is not None
    assert [decision.check for decision in found.decisions] == [None]


def test_a_clip_without_words_is_returned_as_it_is():
    assert find_overlay(surveyed(clip_behind_words(0.0, 0))) is None

"""Moving objects are left out by the filter, though they are sharp and cover a pixel in up to 30 % of the frames."""

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import filter_frames
from turbrestore.metrics import psnr
from turbrestore.registration.centroid import find_centroid

COUNT, WALKER = 40, (24, 12)


@pytest.fixture(scope="module")
def clip():
    clip = make_sequence(4, COUNT, 112, "camera", blur=0.8, noise=0.008, rms=1.0)
    return clip.scene, clip.frames, error(filtered(clip.frames), clip.scene)


def with_walker(frames, share):
    """A dark coat with a bright face and sharp edges, which covers a pixel in ``share`` of the frames."""
    walker = np.full(WALKER, 0.1, np.float32)
    walker[:6, 3:9], walker[9:12] = 0.9, 0.4
    walked = frames.copy()
    for number, frame in enumerate(walked):
        left = round(number * WALKER[1] / (share * COUNT))
        if left + WALKER[1] <= frame.shape[1]:
            frame[50:74, left : left + WALKER[1]] = walker
    return walked


def filtered(frames):
    centroid = find_centroid(frames)
    return filter_frames(frames, centroid.image, identify(centroid.flows), known_flows=centroid.flows).image


def error(image, truth):
    return psnr(image, cv2.GaussianBlur(truth, (0, 0), 0.8))


@pytest.mark.parametrize("share", [0.15, 0.22, 0.3])
def test_walkers_are_left_out(clip, share):
    truth, frames, without = clip
    walked = with_walker(frames, share)
    found, mean = (error(image, truth) for image in (filtered(walked), walked.mean(axis=0)))
    assert found > mean + 7 and found > without - 13

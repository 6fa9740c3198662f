"""Halves of a clip tell the noise of its mean, and what lasts longer than a frame."""

import cv2
import numpy as np
import pytest

from turbrestore.registration.registered_noise import halve, noise_of_frames
from turbrestore.synthesis.scenes import SCENES

SHAPE, COUNT, NOISE = (96, 128), 24, 0.03


def still(count=COUNT):
    return np.zeros((count, *SHAPE, 2), np.float32)


def smooth_noise(rng):
    return NOISE * 2 * np.sqrt(np.pi) * cv2.GaussianBlur(rng.standard_normal(SHAPE).astype(np.float32), (0, 0), 1.0)


@pytest.fixture(scope="module")
def frames():
    rng, scene = np.random.default_rng(0), SCENES["camera"](*SHAPE)
    return np.stack([scene + smooth_noise(rng) for _ in range(COUNT)])


def test_halves_are_means_of_frames_moved_in_place():
    rng = np.random.default_rng(0)
    scene = rng.random((24, 40)).astype(np.float32)
    moves = rng.integers(-3, 4, 12)
    moved = np.stack([np.roll(scene, move, axis=1) for move in moves])
    flows = np.zeros((12, 24, 40, 2), np.float32)
    flows[..., 0] = moves[:, None, None]
    clip = halve(moved, flows, scene.shape, 12)
    for pair in (clip.alternate, clip.lasting):
        for half in (pair.first, pair.second):
            np.testing.assert_allclose(half[:, 4:-4], scene[:, 4:-4], atol=1e-3)


@pytest.mark.parametrize("count", [2, 5, 8])
def test_every_frame_is_in_one_half_of_each_pair(count):
    colours = np.arange(1, count + 1, dtype=np.float32)[:, None, None, None] * np.ones((1, *SHAPE, 3), np.float32)
    clip = halve(colours, still(count), colours.shape[1:], count)
    numbers = np.arange(1, count + 1)
    early = 2 * np.arange(count) // count == 0
    for pair, first in ((clip.alternate, np.arange(count) % 2 == 0), (clip.lasting, early)):
        assert pair.first[20, 20] == pytest.approx(numbers[first].mean())
        assert pair.second[20, 20] == pytest.approx(numbers[~first].mean())


def test_noise_of_a_frame_and_of_the_mean_agree_where_frames_are_independent(frames):
    mean = frames.mean(axis=0)
    of_frame = noise_of_frames(frames, still(), mean)
    clip = halve(frames, still(), SHAPE, COUNT)
    assert of_frame.deviation == pytest.approx(NOISE, rel=0.1)
    for pair in (clip.alternate, clip.lasting):
        assert pair.noise().deviation * np.sqrt(COUNT) == pytest.approx(NOISE, rel=0.1)


def test_texture_that_lasts_shows_in_beginning_and_end_only():
    rng, scene, state, frames = np.random.default_rng(1), SCENES["camera"](*SHAPE), None, []
    for _ in range(COUNT):
        fresh = smooth_noise(rng)
        state = fresh if state is None else 0.9 * state + np.sqrt(1 - 0.81) * fresh
        frames.append(scene + state)
    clip = halve(np.array(frames), still(), SHAPE, COUNT)
    new, lasting = clip.alternate.noise(), clip.lasting.noise()
    assert lasting.deviation > 3 * new.deviation

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


def test_a_frame_that_others_are_registered_to_has_noise_of_its_own(frames):
    found = noise_of_frames(frames[1:], still(COUNT - 1), frames[0], is_mean=False)
    assert found.deviation == pytest.approx(NOISE, rel=0.1)


def lasting_noise(rho, seed, count=COUNT):
    """Frames of smooth noise that is alike from frame to frame, about a scene, and the noise of their mean."""
    rng, scene, state, frames = np.random.default_rng(seed), SCENES["camera"](*SHAPE), None, []
    for _ in range(count):
        fresh = smooth_noise(rng)
        state = fresh if state is None else rho * state + np.sqrt(1 - rho**2) * fresh
        frames.append(scene + state)
    stack = np.array(frames)
    return stack, stack.mean(axis=0) - scene


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.5])
def test_the_mean_has_the_noise_that_frames_share(rho, seed):
    frames, left = lasting_noise(rho, seed)
    clip = halve(frames, still(), SHAPE, COUNT)
    # Alternate frames tell a third of it where ρ is one half.
    assert clip.noise.deviation == pytest.approx(left.std(), rel=0.25)
    assert np.sqrt(clip.frame_noise) == pytest.approx(NOISE, rel=0.2)
    assert clip.beyond < 0.05 * NOISE**2


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7])
def test_few_frames_tell_no_noise_that_they_share(count):
    frames, _ = lasting_noise(0.0, 0, count)
    clip = halve(frames, still(count), SHAPE, count)
    np.testing.assert_array_equal(clip.noise.power, clip.alternate.noise().power)


def test_texture_that_lives_for_several_frames_is_beyond_noise_and_shows_in_beginning_and_end_only():
    frames, _ = lasting_noise(0.9, 1)
    clip = halve(frames, still(), SHAPE, COUNT)
    assert clip.lasting.noise().deviation > 3 * clip.alternate.noise().deviation
    assert clip.beyond > 0.1 * NOISE**2
    assert clip.noise.deviation > 2 * clip.alternate.noise().deviation


def test_what_registration_leaves_for_long_is_no_noise_of_the_mean():
    rng, scene = np.random.default_rng(3), cv2.GaussianBlur(SCENES["camera"](*SHAPE), (0, 0), 1.0)
    drift = np.float32(np.linspace(-1, 1, COUNT))
    slope = (np.roll(scene, -1, axis=1) - np.roll(scene, 1, axis=1)) / 2
    places = cv2.GaussianBlur(rng.standard_normal(SHAPE).astype(np.float32), (0, 0), 12)
    clean = [smooth_noise(rng) / 5 for _ in range(COUNT)]
    frames = np.stack([scene + by * slope * places / places.std() + one for by, one in zip(drift, clean, strict=True)])
    clip = halve(frames, still(), SHAPE, COUNT)
    assert clip.lasting.noise().deviation > 1.5 * np.mean(clean, axis=0).std()
    assert clip.noise.deviation == pytest.approx(np.mean(clean, axis=0).std(), rel=0.15)

"""Light that hunts neither flickers nor leaves ghosts, and a lamp that is switched on shows at once."""

import numpy as np
import pytest
import skimage.data

from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.steady.windows import coarse_image, light_between, relit
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

COUNT = 24
PICTURE = np.float32(skimage.data.coffee()[100:260:2, 200:400:2] / 320)


@pytest.fixture(scope="module")
def shaken():
    """Frames without any change of the light."""
    rng = np.random.default_rng(0)
    flows = smooth_flows(COUNT, *PICTURE.shape[:2], rng, SmoothFlowParams(rms=0.8, correlation_length=16.0))
    return distort(PICTURE, flows - flows.mean(0), rng, noise=0.005)


def steadied(frames):
    return list(steady_frames(frames, SteadyParams(sigma=0), Runtime(threads=1)))


def in_light_of_truth(frames):
    """PSNR of the last frames, each with the mean colour of the truth."""
    errors = [frame.image * (PICTURE.mean((0, 1)) / frame.image.mean((0, 1))) - PICTURE for frame in frames[15:]]
    return -10 * np.log10(np.mean(np.square(errors)[:, 8:-8, 8:-8]))


def changes(images):
    """Mean change of the mean colour from frame to frame, away from the ends."""
    return np.abs(np.diff([image.mean((0, 1)) for image in images[8:-8]], axis=0)).mean()


def test_a_hunting_camera_neither_flickers_nor_leaves_ghosts(shaken):
    still = steadied(shaken)
    swing = 0.1 * np.where(np.arange(COUNT) % 6 < 3, 1, -1)
    for gain in (np.stack([swing] * 3, -1), np.stack([swing, 0 * swing, -swing], -1)):
        frames = np.float32(shaken * (1 + gain)[:, None, None])
        found = steadied(frames)
        assert in_light_of_truth(found) > in_light_of_truth(still) - 0.5
        assert max(frame.moving.mean() for frame in found) < 0.03
        assert changes([frame.image for frame in found]) < 0.4 * changes(frames)


def test_a_lamp_that_is_switched_on_shows_at_once(shaken):
    gain = np.where(np.arange(COUNT) < 15, 0.5, 1.0)
    frames = np.float32(shaken * gain[:, None, None, None])
    for frame, seen in zip(steadied(frames), frames, strict=True):
        assert frame.image.mean() == pytest.approx(seen.mean(), rel=0.03)


def test_gain_is_that_of_most_squares():
    other = coarse_image(PICTURE)
    gain = np.float32([0.1, 0.0, -0.2])
    frame = other * np.exp(gain)
    frame[:4] = 0.5
    assert light_between(frame, other) == pytest.approx(gain, abs=1e-3)
    assert not light_between(other * 1.002, other).any()
    moved = np.roll(other, 3, axis=0)
    assert np.abs(light_between(1.05 * moved, moved) - np.log(1.05)).max() < 1e-3
    assert np.abs(light_between(moved, other)).max() < 0.01
    assert not light_between(np.ones_like(other), other).any()


def test_white_stays_white():
    image = np.float32([[0.1, 0.5, 1.0]])
    assert relit(image, np.float32([0.1]))[0] == pytest.approx([0.1 * np.exp(0.1), 0.5 * np.exp(0.1), 1.0], rel=1e-3)
    assert relit(image, np.float32([0.0])) is image

"""Light that changes in place is measured as a smooth field and taken out; air, walkers and cameras are not light."""

import cv2
import numpy as np

from conftest import corrected, make_sequence, surveyed
from turbrestore.footage.lighting.light import find_light

COUNT, SIDE = 24, 128


def clip():
    return 0.7 * make_sequence(6, COUNT, SIDE, "camera", blur=0.8, noise=0.008, rms=1.2).frames.clip(0, 1)


def shadow():
    """A shadow with a wide penumbra that creeps over the scene; 1 on average, in the logarithm."""
    x = np.arange(SIDE)[None, None] / SIDE
    edge = np.linspace(-0.2, 1.2, COUNT)[:, None, None]
    gain = 1 - 0.4 / (1 + np.exp((x - edge) / 0.08)) + np.zeros((COUNT, SIDE, SIDE))
    return np.float32(gain / np.exp(np.log(gain).mean(axis=0)))


def test_a_shadow_is_taken_out_in_windows_as_in_whole_frames():
    frames, gain = clip(), shadow()
    source, found = corrected(frames * gain, find_light)
    assert "light that changes in place evened out" in [decision.choice for decision in found.decisions]
    left = source.read()
    change = np.log(cv2.blur(left.mean(axis=2).T, (1, 9)) / cv2.blur(frames.mean(axis=2).T, (1, 9)))
    assert change.std() < 0.2 * np.log(gain.mean(axis=2)).std()
    smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), 8) for frame in left / frames.clip(0.02)])
    assert smooth.std(axis=0).mean() < 0.3 * gain.std(axis=0).mean()
    part = source.select(roi=(40, 30, 50, 60)).read()
    np.testing.assert_allclose(part, left[:, 30:90, 40:90], atol=1e-5)


def test_air_walkers_and_moving_cameras_are_no_light():
    frames = clip()
    walked = frames.copy()
    for number, frame in enumerate(walked):
        frame[50:90, 5 * number : 5 * number + 14] = 0.05
    moved = np.stack([np.roll(frame, 4 * number, axis=1) for number, frame in enumerate(frames)])
    for some in (frames, walked, moved[:, :, 92:]):
        found = find_light(surveyed(some))
        assert found is None or not any("in place" in decision.choice for decision in found.decisions)

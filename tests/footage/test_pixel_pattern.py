"""Offsets of all pixels of the sensor are subtracted, also where they change; fine detail of the scene stays."""

import numpy as np
import pytest

from conftest import corrected, make_sequence, surveyed
from turbrestore.footage.sensor.pixel_pattern import _white_part, find_pixel_pattern

SIDE, COUNT = 128, 24


@pytest.fixture(scope="module")
def frames():
    return 0.3 + 0.2 * make_sequence(3, COUNT, SIDE, "camera", blur=1.0, noise=0.02, rms=1.2).frames.clip(0, 1)


def pattern(seed, *shape):
    return np.float32(0.015 * np.random.default_rng(seed).standard_normal((SIDE, SIDE, *shape)))


def cleaned(frames):
    return corrected(np.float32(frames), find_pixel_pattern)


def left(found, frames, offsets):
    """What is left of offsets, as a share of them."""
    return np.std((found.read() - frames).mean(axis=0)) / np.std(offsets)


@pytest.mark.parametrize("colours", [1, 3])
def test_a_pattern_of_single_pixels_is_subtracted(frames, colours):
    still = np.squeeze(np.repeat(frames[..., None], colours, axis=3))
    offsets = pattern(1) if colours == 1 else pattern(1, 3)
    found, correction = cleaned(still + offsets)
    assert left(found, still, offsets) < 0.35
    assert correction.decisions[0].choice == "offsets of single pixels subtracted: 1.4 % of full scale"
    part = found.select(roi=(30, 50, 20, 10)).read()
    np.testing.assert_allclose(part, found.read()[:, 50:60, 30:50], atol=1e-6)


def test_a_pattern_that_changes_is_subtracted_from_the_frames_that_have_it(frames):
    # Survey frames are some of these, so the change lies between two of them.
    many = np.tile(frames, (8, 1, 1))
    for first in (69, 70, 71, 72):
        offsets = np.where(np.arange(len(many))[:, None, None] < first, pattern(1), pattern(2))
        found, correction = cleaned(many + offsets)
        assert f"change at frame {first}," in correction.decisions[0].choice
    for part in (slice(0, first), slice(first, None)):
        assert np.std((found.read() - many)[part].mean(axis=0)) < 0.35 * 0.015


@pytest.mark.parametrize(("count", "left_of_noise"), [(1, 0.7), (30, 1.1)])
def test_little_of_the_noise_of_few_frames_is_taken_for_a_pattern(count, left_of_noise):
    offsets, rng = pattern(1), np.random.default_rng(5)
    # As strong as the offsets in one frame.
    noise = np.float32(0.015 / np.sqrt(count) * rng.standard_normal((SIDE, SIDE)))
    found = _white_part(0.5 + offsets + noise, float(noise.var()))
    assert np.square(found - offsets).mean() < left_of_noise * np.square(noise).mean()


def test_frames_without_a_pattern_are_left(frames):
    assert find_pixel_pattern(surveyed(frames)) is None
    # Noise that renews itself is no pattern, and neither is a texture that moves with the scene, or a still clip.
    noise = 0.015 * np.random.default_rng(1).standard_normal(frames.shape)
    moving = make_sequence(4, COUNT, SIDE, "chart", blur=0.5, noise=0.005, rms=0.6).frames
    still = np.repeat(frames[:1] + pattern(1), COUNT, axis=0) + 0.1 * noise
    for some in (frames + noise, moving, still, frames[:4] + pattern(1), frames + 0.15 * pattern(1)):
        assert find_pixel_pattern(surveyed(np.float32(some))) is None


def test_a_part_where_nothing_moves_keeps_its_detail(frames):
    offsets = pattern(1)
    some = frames + offsets
    wall = some[0, :, : SIDE // 3]
    some[:, :, : SIDE // 3] = wall + 0.004 * np.random.default_rng(0).standard_normal((COUNT, *wall.shape))
    found, _ = cleaned(some)
    change = (found.read() - some).mean(axis=0)
    assert np.std(change[:, : SIDE // 8]) < 0.1 * np.std(offsets)
    assert np.std(change[:, -SIDE // 3 :] + offsets[:, -SIDE // 3 :]) < 0.4 * np.std(offsets)


def test_a_drawn_sign_is_no_pattern():
    image = pattern(1)
    image[40:50, 40:60] = 0.5
    offsets = _white_part(image)
    assert np.abs(offsets).max() < 5.5 * 0.015
    assert np.corrcoef(offsets[70:].ravel(), image[70:].ravel())[0, 1] > 0.85


def test_wiener_filter_keeps_white_noise_and_drops_what_is_smooth():
    noise = pattern(5)
    y, x = np.mgrid[:SIDE, :SIDE]
    smooth = np.float32(0.2 * np.sin(x / 9) * np.cos(y / 7))
    assert np.std(_white_part(noise) - noise) < 0.25 * 0.015
    assert np.std(_white_part(noise + smooth) - noise) < 0.35 * 0.015

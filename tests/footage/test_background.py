"""Moving objects are replaced by the background, and nothing else is."""

import functools

import cv2
import numpy as np
import pytest

from conftest import corrected, photograph, surveyed
from turbrestore.footage.background import find_moving_objects
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.moving_objects import draw_objects
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

COUNT, SIDE = 32, 112


@functools.cache
def clip(scene, objects=0, d_over_r0=2.5):
    """Frames with and without objects, which several tests look at."""
    truth = SCENES[scene](SIDE, SIDE)
    moving = draw_objects(objects, truth.shape, np.random.default_rng(5))
    params = PhaseScreenParams(d_over_r0)

    def seen(some):
        frames = phase_screen_frames(truth, COUNT, np.random.default_rng(7), params, objects=some)
        frames = np.stack([frame.image for frame in frames])
        frames.flags.writeable = False
        return frames

    empty = seen(())
    return (seen(moving) if objects else empty), empty


@pytest.mark.parametrize("channels", [1, 3])
def test_frames_show_the_background_behind_moving_objects(channels):
    frames, empty = clip("brick", 3)
    if channels == 3:
        frames, empty = (some[..., None] * np.float32([1.0, 0.8, 0.6]) for some in (frames, empty))
    cleaned, found = corrected(frames, find_moving_objects)
    cleaned = cleaned.read()
    covered = np.abs(frames - empty).reshape(*empty.shape[:3], -1).max(axis=3) > 0.1
    assert covered.mean() > 0.03
    before, after = (np.sqrt(np.mean((some - empty)[covered] ** 2)) for some in (frames, cleaned))
    assert after < 0.4 * before
    far = cv2.dilate(covered.any(axis=0).astype(np.uint8), np.ones((21, 21))) == 0
    assert np.array_equal(cleaned[:, far], frames[:, far])
    assert found.decisions[0].subject == "moving objects"


def test_the_image_is_that_of_the_clip_without_objects():
    frames, empty = clip("brick", 3)
    # Before the deconvolution, because the widths that are measured differ.
    params = RestoreParams(until="filter")
    with_objects, without = (restore(some, params).image for some in (frames, empty))
    assert compare(with_objects, without).psnr > 30


def test_a_window_of_a_frame_is_cleaned_as_the_whole_frame_is():
    cleaned, _ = corrected(clip("brick", 3)[0], find_moving_objects)
    whole, part = cleaned.read(), cleaned.select(roi=(20, 10, 80, 90)).read()
    assert np.array_equal(whole[:, 10:100, 20:100], part)


@pytest.mark.parametrize("scene", ["chart", "brick"])
def test_turbulence_is_no_moving_object(scene):
    assert find_moving_objects(surveyed(clip(scene, d_over_r0=5.0)[1])) is None


@pytest.mark.parametrize("scene", ["coffee", "page"])
def test_frames_that_are_bent_by_many_pixels_hold_no_moving_objects(scene):
    rng = np.random.default_rng(1)
    moved = smooth_flows(25, 160, 160, rng, SmoothFlowParams(rms=4.0))
    assert find_moving_objects(surveyed(distort(photograph(scene, 160), moved, rng, blur=1.2, noise=0.01))) is None


def test_a_planet_that_drifts_and_the_scene_of_a_moving_camera_are_no_moving_objects():
    y, x = np.mgrid[:96, :160]
    frames = np.float32([0.8 * (np.hypot(x - 30 - 4 * k, y - 48) < 20) for k in range(25)])
    frames += 0.05 * (np.random.default_rng(0).random((96, 160)) > 0.998)  # Stars, which the planet covers.
    soft = np.stack([cv2.GaussianBlur(frame, (0, 0), 1.5) for frame in frames])
    scene = SCENES["camera"](160, 240)
    for some in (soft, np.stack([scene[:, 4 * k : 4 * k + 140] for k in range(25)])):
        assert find_moving_objects(surveyed(some)) is None


def test_a_black_frame_is_left_as_it_is_and_few_frames_tell_nothing():
    frames, empty = (some.copy() for some in clip("brick", 3))
    frames[[5, 20]] = 0
    cleaned, _ = corrected(frames, find_moving_objects)
    assert not cleaned.read()[[5, 20]].any()
    empty[5] = 0
    assert find_moving_objects(surveyed(empty)) is None
    assert find_moving_objects(surveyed(clip("brick", 3)[0][:8])) is None


def snowy(frames, share, seed=3):
    """Soft white flakes that cover a share of every frame, and that share as 1."""
    rng, covers = np.random.default_rng(seed), np.zeros(frames.shape, np.float32)
    for cover in covers:
        while (cover > 0.3).mean() < share:
            x, y = rng.integers(0, SIDE * 16, 2)
            cv2.circle(cover, (int(x), int(y)), int(16 * rng.uniform(1, 2.5)), 1.0, -1, cv2.LINE_AA, 4)
    covers = np.stack([cv2.GaussianBlur(cover, (0, 0), 0.8) for cover in covers])
    return frames * (1 - covers) + 0.95 * covers, covers


def test_snow_is_replaced_by_the_background():
    empty, truth = 0.8 * clip("camera")[1], 0.8 * SCENES["camera"](SIDE, SIDE)
    frames, covers = snowy(empty, 0.06)
    cleaned, found = corrected(frames, find_moving_objects)
    before, after = (np.abs(some - empty)[covers > 0.3].mean() for some in (frames, cleaned.read()))
    assert after < 0.25 * before
    assert "snow" in found.decisions[0].reason
    assert compare(restore(frames).image, truth).psnr > compare(np.median(frames, axis=0), truth).psnr + 1


def test_a_car_is_replaced_while_the_camera_moves():
    scene, rng = SCENES["camera"](160, 300), np.random.default_rng(2)
    empty = np.stack([scene[:, 2 * k : 2 * k + 160] for k in range(COUNT)])
    empty = (empty + 0.01 * rng.standard_normal(empty.shape)).clip(0, 1).astype(np.float32)
    frames = empty.copy()
    for k, frame in enumerate(frames):
        frame[90:120, 6 * k - 50 : 6 * k] = 0.95 if 50 <= 6 * k <= 160 else frame[90:120, 6 * k - 50 : 6 * k]
    cleaned, found = corrected(frames, find_moving_objects)
    covered = np.abs(frames - empty) > 0.1
    assert covered.any() and found.decisions[0].subject == "moving objects"
    before, after = (np.sqrt(np.mean((some - empty)[covered] ** 2)) for some in (frames, cleaned.read()))
    assert after < 0.3 * before

"""Frames that show nothing, between others and at the start, and what is a scene."""

import cv2
import numpy as np
import pytest
from shaken_scenes import SIZE, photo, psnr, shaken

from turbrestore.steady.scene_mean import iter_scene_means
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.steady.windows import iter_scenes, iter_windows


def kinds(frames):
    """Scene of every frame, None for blank ones."""
    return [None if blank else int(scene) for _, scene, blank in iter_scenes(frames)]


@pytest.mark.parametrize("shape", [(100, 130), (128, 128), (90, 160, 3)])
@pytest.mark.parametrize("grey", [0.0, 0.1, 0.7])
def test_flat_frames_are_blank_in_their_scene(shape, grey):
    scene = np.resize(cv2.resize(photo(), shape[1::-1]).T, shape[::-1]).T
    assert kinds([scene] * 2 + [np.full(shape, grey, np.float32)] * 3 + [scene]) == [0, 0, None, None, None, 0]


def test_noise_is_blank_and_a_scene_of_little_contrast_is_not():
    rng, bright, faint = np.random.default_rng(0), photo(), 0.5 + 0.2 * (photo("brick") - 0.5)
    noise = [rng.normal(0.03, 0.005, bright.shape).clip(0, 1) for _ in range(3)]
    assert kinds([bright, *noise, bright]) == [0, None, None, None, 0]
    # The first frame of it may as well be a dropout.
    assert kinds([bright, bright, *shaken([faint] * 3)]) == [0, 0, None, 1, 1]


def test_a_scene_that_fades_out_and_in_is_one():
    rng, gains = np.random.default_rng(1), [1, 0.5, 0.2, 0.09, 0.06, 0.04, 0, 0, 0, 0.04, 0.2, 0.5, 1, 1]
    found = kinds([(0.1 + 0.9 * gain * photo() + rng.normal(0, 0.012, (SIZE, SIZE))).clip(0, 1) for gain in gains])
    assert {scene for scene in found if scene is not None} == {0}
    assert found[6:9] == [None] * 3


def test_black_frames_at_the_start_are_a_scene_of_their_own():
    scene = photo("brick")
    frames = [np.zeros_like(scene)] * 4 + shaken([scene] * 14)
    assert kinds(frames) == [0] * 4 + [1] * 14
    steadied = list(steady_frames(frames, SteadyParams(sigma=0)))
    alone = list(steady_frames(frames[4:], SteadyParams(sigma=0)))
    assert all(np.allclose(ours.image, other.image, atol=1e-3) for ours, other in zip(steadied[4:], alone, strict=True))


def test_blank_frames_are_neighbours_of_nobody():
    frames = shaken([photo()] * 8)
    frames[3] = np.zeros_like(frames[3])
    found = [set(window.neighbours) for window in iter_windows(frames, (1, 2))]
    assert found[3] == set()
    assert found[2] == {-2, -1, 2}
    assert found[5] == {-1, 1, 2}


def test_blank_frames_are_not_in_the_mean():
    frames = [photo()] * 12
    frames[5] = np.zeros_like(frames[5])
    means = list(iter_scene_means(frames))
    assert 5 not in {8 + offset for offset in means[8].path}
    mean, known = means[8].seen_from(np.eye(3))
    assert np.abs(mean - cv2.resize(photo(), mean.shape[::-1], interpolation=cv2.INTER_AREA)).max() < 1e-3
    assert np.allclose(known[4:-4, 4:-4], 11 / 12)


@pytest.mark.parametrize(("how", "least"), [("file", 27.0), ("pipe", 28.0), ("live", 28.0)])
def test_a_pan_goes_on_after_blank_frames(how, least):
    large = photo(size=SIZE + 80)
    truth = [large[:SIZE, 2 * k : 2 * k + SIZE] for k in range(40)]
    frames = shaken(truth, rms=1.5)
    frames[20] = np.zeros_like(frames[20])
    steadied = list(steady_frames(frames if how == "file" else iter(frames), SteadyParams(sigma=0, live=how == "live")))
    assert np.mean([psnr(frame.image, scene) for frame, scene in zip(steadied, truth, strict=True)][26:38]) > least
    assert np.allclose(steadied[20].image, 0, atol=1e-3)
    assert not steadied[20].moving.any()
    assert [frame.number for frame in steadied if frame.starts_scene] == [0]


@pytest.mark.parametrize("once", [True, False])
def test_what_is_remembered_waits(once):
    scene = photo("coins")
    frames = shaken([scene] * 24)
    frames[16] = np.random.default_rng(0).normal(0.03, 0.005, scene.shape).clip(0, 1).astype(np.float32)
    steadied = list(steady_frames(iter(frames) if once else frames, SteadyParams(sigma=0)))
    assert psnr(steadied[17].image, scene) > 29.5
    deblurred = list(steady_frames(iter(frames) if once else frames, SteadyParams(sigma=0.8)))
    assert np.abs(deblurred[16].image - frames[16]).max() < 1e-3
    assert [frame.sigma for frame in deblurred[15:18]] == [0.8, 0, 0.8]


def test_the_blur_is_that_of_windows_that_show_the_scene():
    soft = cv2.GaussianBlur(photo(), (0, 0), 1.6)
    frames = shaken([soft] * 40)
    of_all = next(steady_frames(frames)).sigma
    frames[6] = frames[31] = np.zeros_like(soft)
    assert next(steady_frames(frames)).sigma == pytest.approx(of_all, rel=0.2)
    cut = shaken([soft] * 31) + shaken([photo("brick")] * 14)
    assert next(steady_frames(cut)).sigma == pytest.approx(of_all, rel=0.2)
    live = list(steady_frames(frames[:12], SteadyParams(live=True)))
    assert live[-1].sigma == pytest.approx(of_all, rel=0.3)

"""Stripes of the sensor are subtracted and dead columns filled; stripes of the scene stay."""

import cv2
import numpy as np

from conftest import corrected, make_sequence, surveyed
from turbrestore.footage.sensor.stripes import _dead, find_stripes

SIDE = 160


def clip(scene="camera"):
    return make_sequence(3, 24, SIDE, scene, blur=0.8, noise=0.008, rms=1.2).frames.clip(0, 1)


def test_offsets_of_columns_and_rows_are_subtracted():
    frames, rng = 0.1 + 0.8 * clip(), np.random.default_rng(1)
    columns, rows = 0.02 * rng.standard_normal(SIDE), 0.02 * rng.standard_normal((SIDE, 1))
    for pattern in (columns, rows, columns + rows):
        cleaned, found = corrected(np.float32(frames + pattern), find_stripes)
        left = (cleaned.read() - frames).mean(axis=0)
        assert np.diff(left, axis=0).std() + np.diff(left, axis=1).std() < 0.35 * (
            np.diff(pattern + np.zeros((SIDE, SIDE)), axis=0).std()
            + np.diff(pattern + np.zeros((SIDE, SIDE)), axis=1).std()
        )
        assert found.decisions[0].subject == "sensor"


def test_dead_columns_and_rows_are_filled_in_windows_as_in_whole_frames():
    frames = clip()
    broken = frames.copy()
    broken[:, :, 40], broken[:, 61] = 0.03, 1.0
    source, found = corrected(broken, find_stripes)
    whole = source.read()
    assert np.abs(whole - frames)[:, 61].mean() < 0.06 and np.abs(whole - frames)[:, :, 40].mean() < 0.06
    assert "2 dead" in found.decisions[0].choice
    np.testing.assert_allclose(source.select(roi=(30, 50, 20, 20)).read(), whole[:, 50:70, 30:50], atol=1e-6)


def test_warm_pixels_are_evened_out_and_points_of_the_scene_stay():
    frames, rng = 0.6 * clip(), np.random.default_rng(2)
    places = rng.choice(SIDE * SIDE, 60, replace=False)
    warm = frames.copy()
    warm.reshape(len(warm), -1)[:, places] += rng.uniform(0.1, 0.4, 60).astype(np.float32)
    warm = warm.clip(0, 1)
    for colours in (1, 3):
        seen, still = (np.squeeze(np.repeat(some[..., None], colours, axis=3)) for some in (warm, frames))
        source, found = corrected(seen, find_stripes)
        assert "warm pixels" in found.decisions[0].choice
        left = (source.read() - still).reshape(len(warm), SIDE * SIDE, -1)
        assert np.abs(left[:, places]).mean() < 0.2 * np.abs((warm - frames).reshape(len(warm), -1)[:, places]).mean()
        assert np.count_nonzero(np.abs(left).max(axis=(0, 2)) > 1e-6) <= 60
    # A star moves with the air.
    flows = np.random.default_rng(0).normal(0, 0.6, (24, 2))
    y, x = np.mgrid[:64, :64]
    stars = np.zeros((24, 64, 64))
    for number, (dx, dy) in enumerate(flows):
        for place in ((20, 20), (40, 31), (11, 50)):
            stars[number] += np.exp(-((x - place[0] - dx) ** 2 + (y - place[1] - dy) ** 2) / 0.5)
    assert find_stripes(surveyed(np.float32(0.1 + 0.6 * stars + rng.normal(0, 0.005, stars.shape)))) is None


def test_gaps_between_strokes_of_a_clock_that_ticks_are_no_warm_pixels():
    frames = np.rint(255 * clip()).astype(np.uint8)
    for number, frame in enumerate(frames):
        for shade, width in ((0, 3), (255, 1)):
            text = f"05:12:4{5 + number // 12}"
            cv2.putText(frame, text, (8, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, width)
    assert find_stripes(surveyed(frames / np.float32(255))) is None


def test_stripes_of_the_scene_are_left():
    for scene in ("camera", "chart"):
        assert find_stripes(surveyed(clip(scene))) is None
    x = np.arange(96)
    flows = np.cumsum(np.random.default_rng(0).normal(0, 1, 24))
    waves = np.stack([np.tile(0.5 + 0.2 * np.sin((x - shift - shift.mean()) / 2), (96, 1)) for shift in flows])
    assert find_stripes(surveyed(np.float32(waves + np.random.default_rng(1).normal(0, 0.01, waves.shape)))) is None


def test_columns_at_the_border_are_not_dead():
    variance = np.full((40, 400), 1e-4, np.float32)
    variance[:, [0, 1, 30, 399]] = 0
    assert np.flatnonzero(_dead(variance, 0.01)).tolist() == [30]

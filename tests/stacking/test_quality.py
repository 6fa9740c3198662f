"""The list of frames by quality: its order, its figures, and the share that it suggests."""

import json

import cv2
import numpy as np
import pytest

from conftest import natural_scene
from turbrestore.footage.frame_selection import best_frames
from turbrestore.io.video import write_video
from turbrestore.stacking.quality import KeptShare, measure_quality, quality_table, sort_by_quality


def frames(blurs, noise, size=96):
    scene, rng = natural_scene(size), np.random.default_rng(0)
    soft = [cv2.GaussianBlur(scene, (0, 0), blur) for blur in blurs]
    return [(image + rng.normal(0, noise, image.shape)).astype(np.float32) for image in soft]


def quality_list(images):
    return sort_by_quality(measure_quality(images))


def test_frames_are_sorted_by_their_blur_and_noise_adds_no_quality():
    blurs = np.random.default_rng(1).permutation(np.linspace(0.6, 2.4, 20))
    for noise in (0.003, 0.03):
        found = quality_list(frames(blurs, noise))
        # Neighbours may change places in noise.
        assert np.abs(np.argsort(np.argsort(blurs)) - np.argsort(found.order)).max() <= (0 if noise < 0.01 else 5)
    clean, noisy = (quality_list(frames([1.2] * 8, noise)).quality.mean() for noise in (0.001, 0.03))
    assert noisy == pytest.approx(clean, rel=0.15)


def test_a_share_costs_noise_and_gains_sharpness():
    found = quality_list(frames(np.linspace(0.6, 2.4, 40), 0.003))
    assert [one.frames for one in found.kept] == [4, 10, 20]
    assert [one.noise for one in found.kept] == pytest.approx([10**0.5, 2, 2**0.5])
    assert found.kept[0].sharpness > found.kept[1].sharpness > found.kept[2].sharpness > 1
    # What the figure claims is what the mean of frames in place has.
    stack = np.stack(frames(np.linspace(0.6, 2.4, 40), 0.0))
    ratio = np.sqrt(quality_list([stack[:10].mean(axis=0)]).quality / quality_list([stack.mean(axis=0)]).quality)
    assert found.kept[1].sharpness == pytest.approx(float(ratio[0]), rel=0.1)


def test_the_suggested_share_rises_with_noise_and_is_worth_most():
    varied = np.linspace(0.5, 4, 40) ** 1.2
    lists = [quality_list(frames(varied, noise)) for noise in (0.001, 0.01, 0.04)]
    shares = [found.suggested.share for found in lists]
    assert shares[0] <= shares[1] <= shares[2] < 0.9
    for found in lists:
        # The table does not contradict what it suggests, and fewer frames would draw a check of their own.
        assert found.suggested.worth >= max(1.05, *(one.worth for one in found.kept if one.frames >= 8))
        assert found.suggested.frames >= 8


@pytest.mark.parametrize(
    ("frames", "of", "percent"),
    [(104, 1000, 11), (1, 1000, 1), (4, 33, 12), (55, 100, 55), (8, 30, 27), (300, 300, 100)],
)
def test_whole_percent_keep_no_fewer_frames(frames, of, percent):
    assert KeptShare(frames / of, frames, 1.0, 1.0, 1.0).percent == percent
    assert best_frames(np.arange(of), percent / 100).sum() >= frames


def test_no_share_is_suggested_where_all_frames_are_as_good():
    # A few frames are a little sharper: sharpness × 1.03 is not worth noise × 2.
    nearly = np.linspace(1.15, 1.25, 40)
    for blurs in (np.full(40, 1.2), nearly):
        found = quality_list(frames(blurs, 0.002))
        assert found.suggested is None
        assert "no share is suggested" in quality_table(found, range(40))


def test_the_command_prints_the_list(run, tmp_path):
    write_video(tmp_path / "a.npy", np.stack(frames(np.linspace(0.6, 2.4, 30), 0.005)).clip(0, 1), 25, 32)
    code, out, _ = run("info", tmp_path / "a.npy", "--quality")
    assert code == 0
    lines = out.splitlines()
    start = lines.index("rank    frame   quality")
    assert lines[start + 1].split()[:3] == ["1", "0", "100.0%"]
    assert "…" in lines[start + 11] and len(lines) == start + 22
    assert any(line.split()[1:2] == ["8"] for line in lines if line.startswith("27% "))
    record = json.loads(run("info", tmp_path / "a.npy", "--quality", "--json")[1])["quality"]
    assert [row["frame"] for row in record["quality"][:3]] == [0, 1, 2]
    assert record["suggested"]["worth"] > 1
    assert "100.0%" in quality_table(quality_list(frames([1, 2], 0.01)), [4, 7])

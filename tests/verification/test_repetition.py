"""Repetition in an image: the period of patterns, and none in scenes."""

import numpy as np
import pytest

from conftest import natural_scene
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.verification.repetition import repetition


@pytest.mark.parametrize("period", [6, 9, 15])
def test_the_period_of_a_grid_is_found(period):
    y, x = np.mgrid[:160, :200]
    windows = ((x % period > period // 3) & (y % (2 * period) > period)).astype(np.float32)
    noisy = windows + 0.1 * np.random.default_rng(0).standard_normal(windows.shape).astype(np.float32)
    assert repetition(windows) == pytest.approx(period, abs=0.01)
    assert repetition(noisy) == pytest.approx(period, abs=0.01)
    assert repetition(np.dstack([noisy] * 3)) == pytest.approx(period, abs=0.01)


def test_a_scene_with_a_fence_and_noise_have_none():
    scene = natural_scene(160)
    fenced = scene.copy()
    fenced[100:140, 10:70] = np.indices((40, 60))[1] // 3 % 2
    noise = np.random.default_rng(1).standard_normal((160, 200)).astype(np.float32)
    for image in (scene, fenced, noise, resolution_chart(160, 160), np.zeros((64, 64), np.float32)):
        assert repetition(image) == np.inf

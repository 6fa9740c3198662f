"""Drawn scenes: colour, any size, the same from call to call, and the same picture at twice the size."""

import cv2
import numpy as np
import pytest

from turbrestore.synthesis.drawn_scenes import DRAWN


@pytest.mark.parametrize("name", DRAWN)
def test_a_drawn_scene(name):
    draw = DRAWN[name]
    for height, width in ((224, 224), (160, 256), (256, 160)):
        scene = draw(height, width)
        assert scene.shape == (height, width, 3) and scene.dtype == np.float32
        assert scene.min() >= 0 and scene.max() <= 1 and scene.std() > 0.1
    np.testing.assert_array_equal(draw(128, 128), draw(128, 128))
    if name != "planet":  # its eddies are random
        halved = cv2.resize(draw(256, 256), (128, 128), interpolation=cv2.INTER_AREA)
        assert np.corrcoef(halved.ravel(), draw(128, 128).ravel())[0, 1] > 0.85


def test_synthesize_knows_them(run, tmp_path):
    code, _, err = run("synthesize", "plate", tmp_path / "a.npy", "--frames", "2", "--size", "64x64")
    assert code == 0, err
    assert np.load(tmp_path / "a.npy").shape == (2, 64, 64, 3)

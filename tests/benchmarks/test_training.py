"""Clips from which the blur is learnt, and what a title hides of them."""

import cv2
import numpy as np
import pytest
from blur_scenes import SCENES
from blur_simulators import simulate
from blur_training import CORE, WIDTHS, errors_of, without_title

from turbrestore.core.noise_spectrum import white_noise


@pytest.fixture
def leaves(monkeypatch):
    """Scenes that need no photographs of other packages."""
    monkeypatch.setattr("blur_simulators.SCENES", {name: float(name == "leaves") for name in SCENES})


def test_what_a_title_hides_is_known(leaves):
    bare, titled = (simulate(seed, "lens") for seed in (3, 42))
    assert not bare.hidden.any() and bare.hidden.shape == bare.truth.shape
    # A title stands still and is dark or bright, all around it stays seen.
    assert 0.02 < titled.hidden.mean() < 0.4
    still = np.ptp(titled.frames, axis=0) < 0.1
    assert still[titled.hidden].mean() > still[~titled.hidden].mean() + 0.1


def test_a_title_neither_tells_the_blur_nor_counts_as_an_error():
    scene = cv2.GaussianBlur(np.random.default_rng(0).random((96, 96), np.float32), (0, 0), 2)
    scene = np.clip(0.5 + 0.2 * scene / scene.std() - 0.2 * scene.mean() / scene.std(), 0, 1).astype(np.float32)
    blurred = cv2.GaussianBlur(scene, (0, 0), 1.5)
    hidden = np.zeros(scene.shape, bool)
    hidden[4:40, 20:76] = True
    titled, truth = blurred.copy(), scene.copy()
    for image in (titled, truth):
        image[18:26, 34:62] = np.float32(0.95)
    noise, seen = white_noise(0.002), ~hidden[CORE]
    hurt, spared = (errors_of(titled, truth, noise, count, WIDTHS, 2.0) for count in (np.ones_like(seen), seen))
    gains = [-10 * np.log10(row[WIDTHS == 1.65] / row[0]) for row in (hurt, spared)]
    # The ringing title alone makes the right width hopeless, which is NaN.
    assert gains[1] > 3 and not gains[0] > 0
    faded = without_title(titled, hidden)
    assert np.ptp(faded[18:26, 34:62]) < 0.02 and abs(faded[70:, 70:] - titled[70:, 70:]).max() < 1e-3

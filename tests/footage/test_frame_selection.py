"""Lucky imaging: the sharpest frames are found, whatever their brightness."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.footage.frame_selection import Share, best_frames, frame_quality
from turbrestore.synthesis.scenes import SCENES


def test_quality_falls_with_blur_and_ignores_gain():
    scene = SCENES["camera"](96, 96)
    rng = np.random.default_rng(0)
    sigmas, gains = [0.8, 1.2, 1.8, 2.6, 4.0], [0.5, 0.9, 0.3, 1.0, 0.7]
    frames = [gain * cv2.GaussianBlur(scene, (0, 0), s) for s, gain in zip(sigmas, gains, strict=True)]
    noisy = [(frame + rng.normal(0, 0.003, frame.shape)).astype(np.float32) for frame in frames]
    assert (np.diff(frame_quality(noisy)) < 0).all()
    assert frame_quality([0.5 * scene]) == pytest.approx(frame_quality([scene]), rel=1e-4)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=40), st.floats(0.01, 1))
@settings(deadline=None)
def test_exactly_the_share_is_kept_and_none_left_out_is_better(quality, share):
    kept = best_frames(quality, share)
    assert kept.sum() == np.ceil(round(share * len(quality), 9))
    values = np.array(quality)
    assert kept.all() or values[kept].min() >= values[~kept].max()


@pytest.mark.parametrize(("text", "value"), [("30%", 0.3), ("0.3", 0.3), (" 12.5 % ", 0.125), (1, 1.0)])
def test_shares_are_read(text, value):
    assert Share(text) == pytest.approx(value)


def test_ties_keep_the_earlier_and_bad_input_is_refused():
    assert best_frames(np.zeros(10), 0.3).tolist() == [True] * 3 + [False] * 7
    with pytest.raises(DataError, match="expected at least 1"):
        frame_quality([])
    for share in (0, -0.1, 1.1):
        with pytest.raises(ConfigurationError, match="keep_best"):
            best_frames([1.0, 2.0], share)
    for text in ("thirty", "", "%", "30%%"):
        with pytest.raises(ConfigurationError, match="^keep_best: expected a share such as"):
            Share(text)

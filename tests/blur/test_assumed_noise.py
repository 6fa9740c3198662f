"""The noise of a fused image is smooth, and the width of its blur must not follow from that."""

import cv2
import numpy as np
import pytest

from turbrestore.blur.estimation import assumed_noise, estimate_blur, noise_multiple
from turbrestore.synthesis.scenes import SCENES

WIDTH, LEVEL = 1.2, 0.012


@pytest.fixture(scope="module")
def blurred():
    return cv2.GaussianBlur(SCENES["brick"](160, 160), (0, 0), WIDTH)


def noise(shape, smooth):
    values = np.random.default_rng(0).normal(0, 1, shape).astype(np.float32)
    if smooth:
        values = cv2.GaussianBlur(values, (0, 0), 0.6)
    return LEVEL * values / values.std()


@pytest.mark.parametrize("smooth", [False, True])
def test_the_width_does_not_depend_on_how_smooth_the_noise_is(blurred, smooth):
    assert abs(estimate_blur(blurred + noise(blurred.shape, smooth), exponent=2.0).sigma - WIDTH) < 0.2


def test_more_noise_is_assumed_only_where_it_is_smooth_and_clear(blurred):
    white, smooth = (blurred + noise(blurred.shape, kind) for kind in (False, True))
    faint = blurred + 0.1 * noise(blurred.shape, True)
    assert noise_multiple(white) < 1.6
    assert noise_multiple(smooth) == 2.0
    assert noise_multiple(faint) == 1.5


def test_the_assumed_noise_has_a_share_of_the_contrast():
    image = np.tile(np.float32([0.2, 0.6]), (16, 8))
    assert assumed_noise(image, noise=0.0) == pytest.approx(0.025 * 0.2)
    assert assumed_noise(np.zeros((16, 16), np.float32)) == 1e-4

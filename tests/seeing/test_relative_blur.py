"""How much wider one image is blurred than another, on scenes whose blur is known."""

import numpy as np
import pytest

from conftest import SCENES, blurred
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.seeing.relative_blur import relative_blur


@pytest.mark.parametrize("scene", SCENES)
def test_a_known_relative_blur_is_found(scene):
    image, rng = SCENES[scene](160), np.random.default_rng(0)
    for soft, softer in ((0.8, 1.0), (1.0, 1.5), (1.5, 1.8), (1.0, 2.0)):
        found = relative_blur(blurred(image, softer, rng), blurred(image, soft, rng), 0.01)
        assert np.sqrt(found.variance) == pytest.approx(np.sqrt(softer**2 - soft**2), rel=0.05)


def test_exchanging_the_images_changes_the_sign():
    image, rng = SCENES["chart"](96), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng), blurred(image, 1.0, rng, 0.02)
    there, back = relative_blur(one, two, (0.01, 0.02)), relative_blur(two, one, (0.02, 0.01))
    assert there == pytest.approx((-back.variance, back.deviation), rel=1e-4)


def test_noise_floors_are_accounted_for():
    """Without them, noise in the sharper image alone makes it look sharper than it is."""
    image, rng = SCENES["camera"](160), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng, 0.001), blurred(image, 1.0, rng, 0.1)
    right, wrong = relative_blur(one, two, (0.001, 0.1)), relative_blur(one, two, 0.001)
    assert right.variance == pytest.approx(1.25, rel=0.1)
    assert wrong.variance > right.variance + 0.2


def test_a_small_shift_between_the_images_hardly_matters():
    image, rng = SCENES["camera"](176), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng), blurred(image, 1.0, rng)
    assert relative_blur(one[1:], two[:-1], 0.01).variance == pytest.approx(1.25, rel=0.1)


@pytest.mark.parametrize(("soft", "softer", "noise"), [(1.0, 1.5, 0.01), (0.8, 1.0, 0.01)])
def test_the_deviation_covers_the_error(soft, softer, noise):
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        image = list(SCENES.values())[seed % 2](160)[seed : 144 + seed]
        found = relative_blur(blurred(image, softer, rng, noise), blurred(image, soft, rng, noise), noise)
        errors.append((found.variance - (softer**2 - soft**2)) / found.deviation)
    assert 0.05 < np.mean(np.square(errors)) < 1.4


def test_images_without_content_say_nothing():
    for shape in ((16, 16), (20, 100), (66, 65)):
        flat = np.full(shape, 0.5, np.float32)
        assert relative_blur(flat, flat, 0.01) == (0, np.inf)


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    for images, noise, error, words in (
        ((image, image[1:]), 0.01, DataError, "second"),
        ((image[:8], image[:8]), 0.01, DataError, "16 pixels"),
        ((image, image), (0.01, -1.0), ConfigurationError, "noise"),
    ):
        with pytest.raises(error, match=words):
            relative_blur(*images, noise)

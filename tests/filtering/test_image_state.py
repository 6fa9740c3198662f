from __future__ import annotations

import numpy as np
import pytest
from flow_systems import textbook_update

from turbrestore.core.errors import DataError
from turbrestore.filtering.estimates import Gaussian, PixelGaussian, PixelStacks
from turbrestore.filtering.image_state import predict_image, update_image
from turbrestore.filtering.kalman import predict


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_pixel_equals_the_general_kalman_filter(rng, channels, dtype):
    shape, drift = (3, 4), 0.25
    state = PixelStacks(rng.random((channels, *shape)).astype(dtype), rng.uniform(0.1, 2.0, shape).astype(dtype))
    noise, frame = rng.uniform(0.1, 2.0, shape).astype(dtype), rng.random((channels, *shape)).astype(dtype)
    after, gain = update_image(predict_image(state, drift), frame, noise)
    assert after.mean.dtype == after.variance.dtype == gain.dtype == dtype
    tolerance, unit = 1e-12 if dtype is np.float64 else 1e-5, np.eye(channels)
    for y, x in np.ndindex(shape):
        one = predict(Gaussian(state.mean[:, y, x], state.variance[y, x] * unit), unit, drift * unit)
        prior = one.cov[0, 0]
        one = textbook_update(one, frame[:, y, x], unit, noise[y, x] * unit)
        np.testing.assert_allclose(after.mean[:, y, x], one.mean, rtol=tolerance)
        np.testing.assert_allclose(after.variance[y, x], one.cov[0, 0], rtol=tolerance)
        np.testing.assert_allclose(gain[y, x], prior / (prior + noise[y, x]), rtol=tolerance)


def test_the_variance_survives_nearly_exact_measurements():
    prior = PixelStacks(np.zeros((1, 1, 1), np.float32), np.ones((1, 1), np.float32))
    after, _ = update_image(prior, prior.mean + 1, np.full((1, 1), 1e-9, np.float32))
    assert after.variance[0, 0] == pytest.approx(1e-9, rel=1e-5)


def test_inputs_are_left_alone(rng):
    arrays = [rng.random((3, 2, 5)), rng.random((2, 5)), rng.random((3, 2, 5)), rng.random((2, 5))]
    before = [array.copy() for array in arrays]
    update_image(predict_image(PixelStacks(*arrays[:2]), drift=0.1), *arrays[2:])
    for array, copy in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize(
    ("mean", "variance", "words"),
    [
        (np.zeros((2, 3)), -np.ones((2, 3)), "variance: expected finite"),
        (np.zeros((2, 3, 2)), np.ones((2, 3)), "mean: expected the shape"),
        (np.full((2, 3), np.nan), np.ones((2, 3)), "mean: expected finite"),
    ],
)
def test_unusable_images_are_a_clear_error(mean, variance, words):
    with pytest.raises(DataError, match=words) as caught:
        PixelGaussian(mean, variance)
    assert "\n" not in str(caught.value)

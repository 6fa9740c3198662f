"""Cramér–Rao bounds against the Kalman filter."""

from itertools import pairwise

import numpy as np
import pytest

from turbrestore.blur_moments.experiments.bounds import image_information, moment_information, posterior_bound
from turbrestore.blur_moments.experiments.scenarios import wavefront_model
from turbrestore.blur_moments.moments import predicted_moments
from turbrestore.blur_moments.state_estimation.observers import steady_kalman
from turbrestore.core.errors import DataError


class TestBounds:
    def test_of_a_linear_measurement_is_the_kalman_covariance(self):
        model = wavefront_model()
        _, settled = steady_kalman(model)
        _, H, R = predicted_moments(model, np.zeros(2), np.zeros(200), (1,))
        information = moment_information(model, np.zeros(2), np.zeros(200), (1,))
        np.testing.assert_allclose(information, H.T @ H / R[0, 0])
        bounds = posterior_bound(model.motion.A, model.motion.Q, settled, [information] * 4)
        gain = settled @ H.T / (H @ settled @ H.T + R)
        np.testing.assert_allclose(bounds[-1], settled - gain @ H @ settled, rtol=1e-8)

    def test_more_moments_never_hold_less_and_the_image_most(self):
        model, rng = wavefront_model(), np.random.default_rng(0)
        states, inputs = rng.normal(0, 0.2, (5, 2)), rng.normal(size=(5, 200))
        whole = image_information(model, states, inputs)
        found = [moment_information(model, states, inputs, tuple(range(1, p + 1))) for p in (1, 2, 4)] + [whole]
        for less, more in pairwise(found):
            assert (np.linalg.eigvalsh(more - less) > -0.01 * np.trace(whole, axis1=1, axis2=2)[:, None]).all()

    def test_singular_start(self):
        with pytest.raises(DataError, match="singular"):
            posterior_bound(np.eye(2), np.eye(2), np.diag([1.0, 0.0]), [np.eye(2)])

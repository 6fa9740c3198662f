"""Cramér–Rao bounds against the Kalman filter."""

from itertools import pairwise

import numpy as np

from turbrestore.blur_moments.experiments.comparison import error_bound, information, posterior_bound
from turbrestore.blur_moments.experiments.scenarios import wavefront_setup
from turbrestore.blur_moments.moments import predicted_moments
from turbrestore.blur_moments.state_estimation.observers import steady_kalman

MODEL = wavefront_setup().model


def test_of_a_linear_measurement_is_the_kalman_covariance(monkeypatch):
    monkeypatch.setattr("turbrestore.blur_moments.experiments.comparison._MOMENTS", {"first": (1,)})
    _, settled = steady_kalman(MODEL)
    _, H, R = predicted_moments(MODEL, np.zeros(2), np.zeros(200), (1,))
    gained = information(MODEL, np.zeros(2), np.zeros(200))["first"]
    np.testing.assert_allclose(gained, H.T @ H / R[0, 0])
    bounds = posterior_bound(MODEL.motion.A, MODEL.motion.Q, settled, [gained] * 4)
    gain = settled @ H.T / (H @ settled @ H.T + R)
    np.testing.assert_allclose(bounds[-1], settled - gain @ H @ settled, rtol=1e-8)
    # Settled as it is, every frame has the same bound, whatever the burn-in.
    of_state = error_bound(MODEL.motion, settled, [gained] * 4, 1, of_state=True)
    np.testing.assert_allclose(of_state, np.sqrt(np.trace(bounds[-1])), rtol=1e-8)


def test_more_moments_never_hold_less_and_the_image_most():
    rng = np.random.default_rng(0)
    found = information(MODEL, rng.normal(0, 0.2, (5, 2)), rng.normal(size=(5, 200)))
    assert list(found) == ["moments", "moments_1_to_4", "image"]
    for less, more in pairwise(found.values()):
        assert (np.linalg.eigvalsh(more - less) > -0.01 * np.trace(found["image"], axis1=1, axis2=2)[:, None]).all()

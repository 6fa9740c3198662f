"""Correction by an innovation: the gain of equation 18 in a form that rounding leaves alone."""

import numpy as np
import pytest
from flow_systems import textbook_update

from turbrestore.blur_moments.state_estimation.innovation import correct
from turbrestore.core.errors import DataError
from turbrestore.filtering.estimates import Gaussian
from turbrestore.filtering.kalman import predict


def covariance(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T + 0.1 * np.eye(n)


def test_it_is_the_update_of_the_paper():
    rng = np.random.default_rng(0)
    prior, H = Gaussian(rng.standard_normal(3), covariance(rng, 3)), rng.standard_normal((2, 3))
    z, R = rng.standard_normal(2), covariance(rng, 2)
    (after, innovation), expected = correct(prior, z - H @ prior.mean, H, R), textbook_update(prior, z, H, R)
    np.testing.assert_allclose(after.mean, expected.mean, rtol=1e-10)
    np.testing.assert_allclose(after.cov, expected.cov, rtol=1e-10, atol=1e-12)
    residual = z - H @ prior.mean
    squared = residual @ np.linalg.inv(H @ prior.cov @ H.T + R) @ residual
    assert (innovation.normalised_squared, innovation.observed) == (pytest.approx(squared), 2)


def test_innovations_of_a_true_model_are_chi_squared():
    rng = np.random.default_rng(4)
    n, m, runs, steps = 2, 3, 400, 10
    A, Q, H, R = 0.6 * np.eye(n) + 0.2, covariance(rng, n), rng.standard_normal((m, n)), covariance(rng, m)
    truth = rng.multivariate_normal(np.zeros(n), np.eye(n), size=runs)
    state, squared = Gaussian(np.zeros((runs, n)), np.eye(n)), []
    for _ in range(steps):
        truth = truth @ A.T + rng.multivariate_normal(np.zeros(n), Q, size=runs)
        z = truth @ H.T + rng.multivariate_normal(np.zeros(m), R, size=runs)
        state = predict(state, A, Q)
        state, innovation = correct(state, z - state.mean @ H.T, H, R)
        squared.append(innovation.normalised_squared)
    # Innovations are white, so the 4000 values are independent: mean m, variance 2 m.
    assert np.mean(squared) == pytest.approx(m, abs=4 * np.sqrt(2 * m / (runs * steps)))
    error = truth - state.mean
    nees = np.einsum("bi,ij,bj->b", error, np.linalg.inv(state.cov), error)
    assert nees.mean() == pytest.approx(n, abs=4 * np.sqrt(2 * n / runs))


def test_nearly_exact_measurements_leave_their_own_variance():
    # P is 1e18 times R: the short form (I − M H) P would leave rounding errors, negative ones among them.
    rng = np.random.default_rng(4)
    for _ in range(20):
        prior = Gaussian(np.zeros(3), 1e8 * covariance(rng, 3))
        after, _ = correct(prior, np.zeros(2), np.eye(2, 3), 1e-10 * np.eye(2))
        np.testing.assert_allclose(after.cov[:2, :2], 1e-10 * np.eye(2), rtol=1e-6, atol=1e-16)


def test_noise_that_is_no_covariance_is_named():
    prior = Gaussian(np.zeros(2), np.eye(2))
    for H, R, words in (
        (np.zeros((1, 2)), np.zeros((1, 1)), "innovation covariance"),
        (np.ones((1, 2)), -0.5 * np.eye(1), "R: expected a positive"),
    ):
        with pytest.raises(DataError, match=words):
            correct(prior, np.ones(1), H, R)

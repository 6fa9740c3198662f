from __future__ import annotations

import numpy as np
import pytest
from flow_systems import textbook_update
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import DataError
from turbrestore.filtering.estimates import Gaussian
from turbrestore.filtering.kalman import predict, update


def covariance(rng: np.random.Generator, n: int, *batch: int) -> np.ndarray:
    root = rng.standard_normal((*batch, n, n))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(n)


def transition(rng: np.random.Generator, n: int, radius: float = 0.9) -> np.ndarray:
    A = rng.standard_normal((n, n))
    return radius * A / np.abs(np.linalg.eigvals(A)).max()


def assert_same(a: Gaussian, b: Gaussian, tolerance: float = 1e-10) -> None:
    np.testing.assert_allclose(a.mean, b.mean, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(a.cov, b.cov, rtol=tolerance, atol=tolerance)


def batch_estimate(prior, A, Q, H, R, measurements):
    """Mean and covariance of the last state, from the joint precision matrix of the whole trajectory."""
    n, steps = len(prior.mean), len(measurements)
    J, h = np.zeros((steps * n, steps * n)), np.zeros(steps * n)
    J[:n, :n] = np.linalg.inv(prior.cov)
    h[:n] = J[:n, :n] @ prior.mean
    Q_inverse = np.linalg.inv(Q)
    for k in range(1, steps):
        pair = slice((k - 1) * n, (k + 1) * n)
        difference = np.hstack([-A, np.eye(n)])
        J[pair, pair] += difference.T @ Q_inverse @ difference
    for k, z in enumerate(measurements):
        at, weighted = slice(k * n, (k + 1) * n), H.T @ np.linalg.inv(R)
        J[at, at] += weighted @ H
        h[at] += weighted @ z
    cov = np.linalg.inv(J)
    return (cov @ h)[-n:], cov[-n:, -n:]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_filter_equals_batch_least_squares(rng):
    n, m, steps = 3, 4, 12
    A, H = transition(rng, n), rng.standard_normal((m, n))
    variance = rng.uniform(0.2, 2.0, m)
    Q, prior = covariance(rng, n), Gaussian(rng.standard_normal(n), covariance(rng, n))
    measurements = rng.standard_normal((steps, m))
    state = prior
    for k, z in enumerate(measurements):
        state = update(state if k == 0 else predict(state, A, Q), z, H, variance)
    mean, cov = batch_estimate(prior, A, Q, H, np.diag(variance), measurements)
    assert_same(state, Gaussian(mean, 0.5 * (cov + cov.T)))


@pytest.mark.parametrize("scalar", [False, True])
def test_the_information_form_equals_the_gain_of_equation_18(rng, scalar):
    n, m = 4, 30
    prior = Gaussian(rng.standard_normal(n), covariance(rng, n))
    H, z = rng.standard_normal((m, n)), rng.standard_normal(m)
    variance = 0.7 if scalar else rng.uniform(0.2, 2.0, m)
    R = np.diag(np.broadcast_to(variance, m))
    assert_same(update(prior, z, H, variance), textbook_update(prior, z, H, R))


def test_a_singular_prior_stays_on_its_line(rng):
    n, m = 3, 8
    direction = rng.standard_normal((n, 1))
    prior = Gaussian(np.zeros(n), direction @ direction.T)
    H, z = rng.standard_normal((m, n)), rng.standard_normal(m)
    assert_same(update(prior, z, H, 0.5), textbook_update(prior, z, H, 0.5 * np.eye(m)))


def test_no_state_at_all():
    state = update(Gaussian(np.zeros(0), np.zeros((0, 0))), np.ones(4), np.zeros((4, 0)), 0.5)
    assert state.mean.shape == (0,)
    assert predict(state, np.zeros((0, 0)), np.zeros((0, 0))).cov.shape == (0, 0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 4))
def test_an_update_never_adds_uncertainty(seed, n, m):
    rng = np.random.default_rng(seed)
    prior = Gaussian(rng.standard_normal(n), covariance(rng, n))
    after = update(prior, rng.standard_normal(m), rng.standard_normal((m, n)), rng.uniform(0.1, 3.0, m))
    assert np.linalg.eigvalsh(prior.cov - after.cov).min() > -1e-10 * np.abs(prior.cov).max()
    assert np.trace(after.cov) < np.trace(prior.cov)


def test_batched_equals_loop(rng):
    batch, n, m = 6, 3, 4
    means, covs = rng.standard_normal((batch, n)), covariance(rng, n, batch)
    A, Q = np.stack([transition(rng, n) for _ in range(batch)]), covariance(rng, n)
    H, z = rng.standard_normal((batch, m, n)), rng.standard_normal((batch, m))
    together = update(predict(Gaussian(means, covs), A, Q), z, H, 0.5)
    for i in range(batch):
        alone = update(predict(Gaussian(means[i], covs[i]), A[i], Q), z[i], H[i], 0.5)
        assert_same(alone, Gaussian(together.mean[i], together.cov[i]), 1e-12)


def test_one_covariance_serves_a_batch_of_means(rng):
    n, batch = 2, 5
    means, P, H, z = rng.standard_normal((batch, n)), covariance(rng, n), np.ones((1, n)), rng.standard_normal((5, 1))
    together = update(Gaussian(means, P), z, H, 1.0)
    assert together.cov.shape == (n, n)
    for i in range(batch):
        assert_same(update(Gaussian(means[i], P), z[i], H, 1.0), Gaussian(together.mean[i], together.cov))


def test_unusable_input_is_a_clear_error():
    good, one = Gaussian(np.zeros(2), np.eye(2)), np.ones((1, 2))
    for call, words in (
        (lambda: Gaussian(np.zeros(2), np.diag([1.0, -1.0])), "cov: expected a positive semi-definite"),
        (lambda: Gaussian(np.zeros(2), np.array([[1.0, 0.5], [0.0, 1.0]])), "cov: expected a symmetric"),
        (lambda: Gaussian(np.zeros(2), np.eye(3)), "cov: expected shape"),
        (lambda: Gaussian(np.zeros((4, 2)), np.stack([np.eye(2)] * 3)), "cov: expected leading axes"),
        (lambda: Gaussian(np.array([np.nan]), np.eye(1)), "mean: expected finite"),
        (lambda: Gaussian(np.float64(1.0), np.eye(1)), "mean: expected shape"),
        (lambda: predict(good, np.eye(3), np.eye(2)), "A: expected shape"),
        (lambda: predict(good, np.eye(2), -np.eye(2)), "Q: expected a positive"),
        (lambda: update(good, [np.nan], one, 1.0), "measurement: expected finite"),
        (lambda: update(good, [1.0, 2.0], one, 1.0), "H: expected shape"),
        (lambda: update(good, 1.0, one, 1.0), "measurement: expected shape"),
        (lambda: update(good, [1.0], one, 0.0), "noise_variance: expected finite"),
        (lambda: update(good, [1.0], one, [1.0, 2.0]), "noise_variance: expected one"),
        (lambda: update(good, [1.0], np.full((1, 2), np.nan), 1.0), "expected finite"),
    ):
        with pytest.raises(DataError, match=f"^[^\\n]*{words}[^\\n]*$"):
            call()


def test_an_unstable_system_ends_in_an_error_not_in_nan():
    state = Gaussian(np.zeros(2), np.eye(2))
    with pytest.raises(DataError, match="unstable"):
        for _ in range(400):
            state = predict(state, 10.0 * np.eye(2), np.eye(2))


def test_inputs_are_left_alone(rng):
    prior = Gaussian(rng.standard_normal(2), covariance(rng, 2))
    H, z = rng.standard_normal((3, 2)), np.array([1.0, 3.0, 2.0])
    arrays = [prior.mean, prior.cov, H, z]
    before = [array.copy() for array in arrays]
    update(prior, z, H, 1.0)
    predict(prior, np.eye(2), np.eye(2))
    for array, copy in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, copy)

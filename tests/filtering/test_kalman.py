from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from turbrestore.core.errors import DataError
from turbrestore.filtering.estimates import Gaussian
from turbrestore.filtering.kalman import predict, update_covariance_form, update_information_form


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
        seen = ~np.isnan(z)
        if seen.any():
            at, Hs = slice(k * n, (k + 1) * n), H[seen]
            weight = np.linalg.inv(R[np.ix_(seen, seen)])
            J[at, at] += Hs.T @ weight @ Hs
            h[at] += Hs.T @ weight @ z[seen]
    cov = np.linalg.inv(J)
    return (cov @ h)[-n:], cov[-n:, -n:]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.mark.parametrize("form", ["covariance", "information"])
@pytest.mark.parametrize("gaps", [False, True])
def test_filter_equals_batch_least_squares(rng, form, gaps):
    n, m, steps = 3, 4, 12
    A, H = transition(rng, n), rng.standard_normal((m, n))
    variance = rng.uniform(0.2, 2.0, m)
    R = np.diag(variance) if form == "information" else covariance(rng, m)
    Q, prior = covariance(rng, n), Gaussian(rng.standard_normal(n), covariance(rng, n))
    measurements = rng.standard_normal((steps, m))
    if gaps:
        measurements[rng.random((steps, m)) < 0.3] = np.nan
        measurements[5] = np.nan
    state = prior
    for k, z in enumerate(measurements):
        state = state if k == 0 else predict(state, A, Q)
        state, _ = (
            update_covariance_form(state, z, H, R)
            if form == "covariance"
            else update_information_form(state, z, H, variance)
        )
    mean, cov = batch_estimate(prior, A, Q, H, R, measurements)
    assert_same(state, Gaussian(mean, 0.5 * (cov + cov.T)))


@pytest.mark.parametrize("scalar", [False, True])
def test_information_equals_covariance_form_and_its_record(rng, scalar):
    n, m = 4, 30
    prior = Gaussian(rng.standard_normal(n), covariance(rng, n))
    H, z = rng.standard_normal((m, n)), rng.standard_normal(m)
    z[[3, 17]] = np.nan
    variance = 0.7 if scalar else rng.uniform(0.2, 2.0, m)
    R = np.diag(np.broadcast_to(variance, m))
    a, record_a = update_covariance_form(prior, z, H, R)
    b, record_b = update_information_form(prior, z, H, variance)
    assert_same(a, b)
    np.testing.assert_allclose(record_a.normalised_squared, record_b.normalised_squared, rtol=1e-10)
    np.testing.assert_allclose(record_a.log_likelihood, record_b.log_likelihood, rtol=1e-10)
    assert record_a.observed == record_b.observed == m - 2
    seen = ~np.isnan(z)
    projection = np.where(seen, 1 / np.diag(R), 0)[:, None] * H
    np.testing.assert_allclose(record_b.values, projection[seen].T @ record_a.values[seen], rtol=1e-9)
    expected = projection[seen].T @ record_a.cov[np.ix_(seen, seen)] @ projection[seen]
    np.testing.assert_allclose(record_b.cov, expected, rtol=1e-9)


def test_information_form_takes_a_singular_prior(rng):
    n, m = 3, 8
    direction = rng.standard_normal((n, 1))
    prior = Gaussian(np.zeros(n), direction @ direction.T)
    H, z = rng.standard_normal((m, n)), rng.standard_normal(m)
    assert_same(update_covariance_form(prior, z, H, 0.5 * np.eye(m))[0], update_information_form(prior, z, H, 0.5)[0])


def test_information_form_with_no_state_at_all():
    state, record = update_information_form(Gaussian(np.zeros(0), np.zeros((0, 0))), np.ones(4), np.zeros((4, 0)), 0.5)
    assert state.mean.shape == (0,)
    assert record.normalised_squared == pytest.approx(8.0)
    assert predict(state, np.zeros((0, 0)), np.zeros((0, 0))).cov.shape == (0, 0)


def test_two_predictions_are_one_of_the_squared_system(rng):
    A, Q = transition(rng, 3), covariance(rng, 3)
    state = Gaussian(rng.standard_normal(3), covariance(rng, 3))
    assert_same(predict(predict(state, A, Q), A, Q), predict(state, A @ A, A @ Q @ A.T + Q))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 4))
def test_an_update_never_adds_uncertainty(seed, n, m):
    rng = np.random.default_rng(seed)
    prior = Gaussian(rng.standard_normal(n), covariance(rng, n))
    after, _ = update_covariance_form(prior, rng.standard_normal(m), rng.standard_normal((m, n)), covariance(rng, m))
    assert np.linalg.eigvalsh(prior.cov - after.cov).min() > -1e-10 * np.abs(prior.cov).max()
    assert np.trace(after.cov) < np.trace(prior.cov)


@pytest.mark.parametrize("form", ["covariance", "information"])
def test_batched_equals_loop(rng, form):
    batch, n, m = 6, 3, 4
    means, covs = rng.standard_normal((batch, n)), covariance(rng, n, batch)
    A, Q = np.stack([transition(rng, n) for _ in range(batch)]), covariance(rng, n)
    H, z = rng.standard_normal((batch, m, n)), rng.standard_normal((batch, m))
    z[rng.random(z.shape) < 0.3] = np.nan
    R = 0.5 * np.eye(m)

    def step(mean, cov, A, H, z):
        state = predict(Gaussian(mean, cov), A, Q)
        return (
            update_covariance_form(state, z, H, R)
            if form == "covariance"
            else update_information_form(state, z, H, 0.5)
        )

    together, record = step(means, covs, A, H, z)
    for i in range(batch):
        alone, record_alone = step(means[i], covs[i], A[i], H[i], z[i])
        assert_same(alone, Gaussian(together.mean[i], together.cov[i]), 1e-12)
        assert record.observed[i] == record_alone.observed
        np.testing.assert_allclose(record.log_likelihood[i], record_alone.log_likelihood, rtol=1e-10)
        np.testing.assert_allclose(record.values[i], record_alone.values, rtol=1e-10, atol=1e-12)


def test_one_covariance_serves_a_batch_of_means(rng):
    n, batch = 2, 5
    means, P, H, z = (
        rng.standard_normal((batch, n)),
        covariance(rng, n),
        np.ones((1, n)),
        rng.standard_normal((5, 1)),
    )
    together, _ = update_covariance_form(Gaussian(means, P), z, H, np.eye(1))
    assert together.cov.shape == (n, n)
    information = update_information_form(Gaussian(means, P), z, H / np.sqrt(n), 1.0)[0]
    for i in range(batch):
        assert_same(
            update_covariance_form(Gaussian(means[i], P), z[i], H, np.eye(1))[0],
            Gaussian(together.mean[i], together.cov),
        )
        alone = update_information_form(Gaussian(means[i], P), z[i], H / np.sqrt(n), 1.0)[0]
        np.testing.assert_allclose(information.mean[i], alone.mean, rtol=1e-12)


def test_missing_measurement_is_no_update(rng):
    prior = Gaussian(rng.standard_normal(3), covariance(rng, 3))
    H, z = rng.standard_normal((2, 3)), np.full(2, np.nan)
    for after, record in (update_covariance_form(prior, z, H, np.eye(2)), update_information_form(prior, z, H, 1.0)):
        np.testing.assert_array_equal(after.mean, prior.mean)
        np.testing.assert_allclose(after.cov, prior.cov, rtol=1e-13)
        assert record.observed == 0
        assert record.log_likelihood == pytest.approx(0.0, abs=1e-12)


def test_missing_component_is_the_shorter_measurement(rng):
    prior = Gaussian(rng.standard_normal(3), covariance(rng, 3))
    H, R, z = rng.standard_normal((3, 3)), covariance(rng, 3), rng.standard_normal(3)
    z[1] = np.nan
    seen = [0, 2]
    after, record = update_covariance_form(prior, z, H, R)
    shorter, record_shorter = update_covariance_form(prior, z[seen], H[seen], R[np.ix_(seen, seen)])
    assert_same(after, shorter)
    np.testing.assert_allclose(record.log_likelihood, record_shorter.log_likelihood, rtol=1e-12)
    np.testing.assert_allclose(record.values[seen], record_shorter.values)
    np.testing.assert_allclose(record.cov[np.ix_(seen, seen)], record_shorter.cov)
    assert np.isnan(record.values[1]) and np.isnan(record.cov[1]).all()


def test_splitting_a_measurement_changes_nothing(rng):
    prior = Gaussian(rng.standard_normal(3), covariance(rng, 3))
    H, z = rng.standard_normal((4, 3)), rng.standard_normal(4)
    variance = rng.uniform(0.5, 1.5, 4)
    whole, _ = update_covariance_form(prior, z, H, np.diag(variance))
    state = prior
    for i in range(4):
        state, _ = update_covariance_form(state, z[i : i + 1], H[i : i + 1], variance[i] * np.eye(1))
    assert_same(whole, state)


def test_iterating_from_the_same_prior_changes_nothing_on_a_linear_model(rng):
    prior = Gaussian(rng.standard_normal(3), covariance(rng, 3))
    H, z, R = rng.standard_normal((4, 3)), rng.standard_normal(4), covariance(rng, 4)
    first, _ = update_covariance_form(prior, z, H, R)
    at = first.mean
    for _ in range(3):
        # The iterated extended Kalman filter linearises at the last estimate and keeps the prior.
        predicted = H @ at + H @ (prior.mean - at)
        again, _ = update_covariance_form(prior, z, H, R, predicted=predicted)
        assert_same(again, first)
        at = again.mean


def test_nonlinear_measurement_uses_its_own_prediction():
    prior = Gaussian(np.array([2.0]), np.eye(1))
    after, record = update_covariance_form(prior, [4.5], [[4.0]], [[1.0]], predicted=[4.0])
    assert record.values == pytest.approx([0.5])
    assert after.mean == pytest.approx([2.0 + 4.0 / 17.0 * 0.5])


def test_log_likelihoods_add_up_to_the_joint_density(rng):
    n, m, steps = 2, 2, 5
    A, Q, H, R = transition(rng, n), covariance(rng, n), rng.standard_normal((m, n)), covariance(rng, m)
    prior = Gaussian(rng.standard_normal(n), covariance(rng, n))
    z = rng.standard_normal((steps, m))
    powers = [np.linalg.matrix_power(A, k) for k in range(steps)]
    cov = np.zeros((steps * n, steps * n))
    for i in range(steps):
        for j in range(steps):
            block = powers[i] @ prior.cov @ powers[j].T
            block = block + sum(powers[i - k] @ Q @ powers[j - k].T for k in range(1, min(i, j) + 1))
            cov[i * n : (i + 1) * n, j * n : (j + 1) * n] = block
    big = np.kron(np.eye(steps), H)
    joint = multivariate_normal(
        big @ np.concatenate([power @ prior.mean for power in powers]),
        big @ cov @ big.T + np.kron(np.eye(steps), R),
    )
    total, state = 0.0, prior
    for k in range(steps):
        state = state if k == 0 else predict(state, A, Q)
        state, record = update_covariance_form(state, z[k], H, R)
        total += float(record.log_likelihood)
    assert total == pytest.approx(joint.logpdf(z.ravel()), rel=1e-10)


def test_innovations_of_a_true_model_are_chi_squared(rng):
    n, m, runs, steps = 2, 3, 400, 10
    A, Q, H, R = transition(rng, n), covariance(rng, n), rng.standard_normal((m, n)), covariance(rng, m)
    truth = rng.multivariate_normal(np.zeros(n), np.eye(n), size=runs)
    state, squared = Gaussian(np.zeros((runs, n)), np.eye(n)), []
    for _ in range(steps):
        truth = truth @ A.T + rng.multivariate_normal(np.zeros(n), Q, size=runs)
        z = truth @ H.T + rng.multivariate_normal(np.zeros(m), R, size=runs)
        state, record = update_covariance_form(predict(state, A, Q), z, H, R)
        squared.append(record.normalised_squared)
    # Innovations are white, so the 4000 values are independent: mean m, variance 2 m.
    assert np.mean(squared) == pytest.approx(m, abs=4 * np.sqrt(2 * m / (runs * steps)))
    error = truth - state.mean
    nees = np.einsum("bi,ij,bj->b", error, np.linalg.inv(state.cov), error)
    assert nees.mean() == pytest.approx(n, abs=4 * np.sqrt(2 * n / runs))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6), st.floats(-4, 6), st.floats(0.1, 1.1))
def test_covariance_stays_positive_over_many_steps(seed, n, log_noise, radius):
    rng = np.random.default_rng(seed)
    m = 3
    A, Q, noise = transition(rng, n, radius), 1e-6 * covariance(rng, n), 10.0**log_noise
    H = rng.standard_normal((m, n))
    states = [Gaussian(np.zeros(n), 1e2 * np.eye(n))] * 2
    for _ in range(80):
        z = np.where(rng.random(m) < 0.2, np.nan, rng.standard_normal(m))
        states = [predict(state, A, Q) for state in states]
        states = [
            update_covariance_form(states[0], z, H, noise * np.eye(m))[0],
            update_information_form(states[1], z, H, noise)[0],
        ]
        for state in states:
            np.testing.assert_array_equal(state.cov, state.cov.T)
            assert np.linalg.eigvalsh(state.cov).min() > 0


def test_nearly_exact_measurements_leave_their_own_variance(rng):
    # P is 1e18 times R: the short form (I − M H) P would leave rounding errors, negative ones among them.
    for _ in range(20):
        after, _ = update_covariance_form(
            Gaussian(np.zeros(3), 1e8 * covariance(rng, 3)), np.zeros(2), np.eye(2, 3), 1e-10 * np.eye(2)
        )
        np.testing.assert_allclose(after.cov[:2, :2], 1e-10 * np.eye(2), rtol=1e-6, atol=1e-16)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Gaussian(np.zeros(2), np.diag([1.0, -1.0])), "cov: expected a positive semi-definite"),
        (lambda: Gaussian(np.zeros(2), np.array([[1.0, 0.5], [0.0, 1.0]])), "cov: expected a symmetric"),
        (lambda: Gaussian(np.zeros(2), np.eye(3)), "cov: expected shape"),
        (lambda: Gaussian(np.zeros((4, 2)), np.stack([np.eye(2)] * 3)), "cov: expected leading axes"),
        (lambda: Gaussian(np.array([np.nan]), np.eye(1)), "mean: expected finite"),
        (lambda: Gaussian(np.float64(1.0), np.eye(1)), "mean: expected shape"),
        (lambda: predict(GOOD, np.eye(3), np.eye(2)), "A: expected shape"),
        (lambda: predict(GOOD, np.eye(2), -np.eye(2)), "Q: expected a positive"),
        (lambda: update_covariance_form(GOOD, [1.0], np.zeros((1, 2)), np.zeros((1, 1))), "innovation covariance"),
        (lambda: update_covariance_form(GOOD, [1.0], np.ones((1, 2)), -0.5 * np.eye(1)), "R: expected a positive"),
        (lambda: update_covariance_form(GOOD, [np.inf], np.ones((1, 2)), np.eye(1)), "measurement: expected finite"),
        (lambda: update_covariance_form(GOOD, [1.0, 2.0], np.ones((1, 2)), np.eye(2)), "H: expected shape"),
        (lambda: update_information_form(GOOD, 1.0, np.ones((1, 2)), 1.0), "measurement: expected shape"),
        (lambda: update_information_form(GOOD, [1.0], np.ones((1, 2)), 0.0), "noise_variance: expected finite"),
        (lambda: update_information_form(GOOD, [1.0], np.ones((1, 2)), [1.0, 2.0]), "noise_variance: expected one"),
        (lambda: update_information_form(GOOD, [1.0], np.full((1, 2), np.nan), 1.0), "expected finite"),
    ],
)
def test_unusable_input_is_a_clear_error(call, words):
    with pytest.raises(DataError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


GOOD = Gaussian(np.zeros(2), np.eye(2))


def test_an_unstable_system_ends_in_an_error_not_in_nan():
    state = GOOD
    with pytest.raises(DataError, match="unstable"):
        for _ in range(400):
            state = predict(state, 10.0 * np.eye(2), np.eye(2))


def test_inputs_are_left_alone(rng):
    prior = Gaussian(rng.standard_normal(2), covariance(rng, 2))
    H, z, R = rng.standard_normal((3, 2)), np.array([1.0, np.nan, 2.0]), np.eye(3)
    arrays = [prior.mean, prior.cov, H, z, R]
    before = [array.copy() for array in arrays]
    update_covariance_form(prior, z, H, R)
    update_information_form(prior, z, H, 1.0)
    predict(prior, np.eye(2), np.eye(2))
    for array, copy in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, copy)

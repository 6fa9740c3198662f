from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov

from turbrestore import dynamics as module
from turbrestore.dynamics import (
    DynamicsParams,
    flow_of,
    identify,
    predict_flow,
    project,
    simulate,
    stable_system,
    with_displacement,
)
from turbrestore.errors import ConfigurationError, DataError


def rotation(angle: float, modulus: float) -> np.ndarray:
    return modulus * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def run_system(A, Q, length, rng, runs=1):
    """States of independent runs from the stationary distribution, shape (runs, n, length)."""
    n = len(A)
    states = np.empty((runs, n, length))
    states[..., 0] = rng.multivariate_normal(np.zeros(n), solve_discrete_lyapunov(A, Q), size=runs)
    noise = rng.multivariate_normal(np.zeros(n), Q, size=(runs, length))
    for k in range(length - 1):
        states[..., k + 1] = states[..., k] @ A.T + noise[:, k]
    return states


def orthonormal(shape, n, rng):
    return np.linalg.qr(rng.standard_normal((2 * shape[0] * shape[1], n)))[0]


def flows_from(C, states, shape, mean=0.0, noise=0.0):
    return ((C @ states).T.reshape(-1, *shape, 2) + mean + noise).astype(np.float32)


def rotating_flows(turns=3, period=12, shape=(6, 7), rng=None):
    rng = rng or np.random.default_rng(3)
    angle = 2 * np.pi * np.arange(turns * period) / period
    fields = rng.standard_normal((2, *shape, 2))
    mean = rng.standard_normal((*shape, 2))
    return (mean + np.einsum("it,ihwc->thwc", [np.cos(angle), np.sin(angle)], fields)).astype(np.float32)


def assert_same_dynamics(a, b, tolerance=1e-6):
    for field in ("A", "C", "Q", "R", "residual_variance", "mean_flow", "states", "singular_values"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=tolerance, atol=tolerance, err_msg=field)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def noise_flows(rng) -> np.ndarray:
    flows = rng.standard_normal((20, 9, 11, 2)).astype(np.float32)
    return flows * np.linspace(0.2, 2, 20, dtype=np.float32)[rng.permutation(20)][:, None, None, None] + np.float32(3)


def test_gram_route_equals_singular_value_decomposition(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=8))
    X = (noise_flows - noise_flows.mean(0)).reshape(20, -1).T.astype(np.float64)
    U, s, Vt = np.linalg.svd(X, full_matrices=False)
    np.testing.assert_allclose(dynamics.singular_values[:-1], s[:-1], rtol=1e-7)
    np.testing.assert_allclose(np.abs(np.sum(dynamics.C * U[:, :8], axis=0)), 1.0, rtol=1e-6)
    signs = np.sign(np.sum(dynamics.C * U[:, :8], axis=0))
    np.testing.assert_allclose(dynamics.C, U[:, :8] * signs, atol=1e-6)
    np.testing.assert_allclose(dynamics.states, (signs * s[:8])[:, None] * Vt[:8], atol=1e-5 * s[0])
    np.testing.assert_allclose(dynamics.energy_share, np.sum(s[:8] ** 2) / np.sum(s**2), rtol=1e-6)
    rest = (X - U[:, :8] @ (s[:8, None] * Vt[:8])).reshape(9, 11, 2, 20)
    np.testing.assert_allclose(dynamics.residual_variance, np.sum(rest**2, axis=(2, 3)) / 2 / (20 - 1 - 8), rtol=1e-4)
    assert pytest.approx(dynamics.residual_variance.mean(), rel=1e-6) == dynamics.R


def test_system_is_the_least_squares_fit_of_the_paper(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=5))
    before, after = dynamics.states[:, :-1], dynamics.states[:, 1:]
    np.testing.assert_allclose(dynamics.A, after @ np.linalg.pinv(before), atol=1e-10)
    e = after - dynamics.A @ before
    np.testing.assert_allclose(dynamics.Q, e @ e.T / (20 - 2 - 5), rtol=1e-10)


@pytest.mark.parametrize("spread", [1.0, 1e-3, 3e-6])
def test_modes_are_orthonormal_however_unequal(rng, spread):
    shape, n, count = (12, 10), 6, 40
    states = rng.standard_normal((n, count)) * np.geomspace(1.0, spread, n)[:, None]
    C = identify(flows_from(orthonormal(shape, n, rng), states, shape), DynamicsParams(rank=n)).C.astype(np.float64)
    assert C.shape == (240, n)
    np.testing.assert_allclose(C.T @ C, np.eye(n), atol=1e-4 if spread < 1e-5 else 1e-6)


def test_signs_do_not_depend_on_the_decomposition(noise_flows):
    states = identify(noise_flows, DynamicsParams(rank=6)).states
    assert (states[np.arange(6), np.abs(states).argmax(1)] > 0).all()


@pytest.mark.parametrize("size", [1, 5000, 2**25])
def test_strips_equal_the_whole(noise_flows, monkeypatch, size):
    whole = identify(noise_flows, DynamicsParams(rank=6))
    monkeypatch.setattr(module, "_STRIP_BYTES", size)
    assert len(module._Strips.of(noise_flows).rows()) == {1: 9, 5000: 9, 2**25: 1}[size]
    assert_same_dynamics(whole, identify(noise_flows, DynamicsParams(rank=6)))


def test_any_container_of_flows_gives_the_same(noise_flows, tmp_path):
    class Lazy:
        def __iter__(self):
            return (flow for flow in noise_flows)

    np.save(tmp_path / "flows.npy", noise_flows)
    params = DynamicsParams(rank=6)
    whole = identify(noise_flows, params)
    mapped = np.load(tmp_path / "flows.npy", mmap_mode="r")
    for flows in (mapped, list(noise_flows), Lazy(), noise_flows.astype(np.float64)):
        assert_same_dynamics(whole, identify(flows, params))


def test_full_rank_reconstructs_the_flows(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=19))
    assert dynamics.rank == 19
    for k, flow in enumerate(noise_flows):
        np.testing.assert_allclose(flow_of(dynamics, dynamics.states[:, k]), flow, atol=2e-6)
        np.testing.assert_allclose(project(dynamics, flow), dynamics.states[:, k], atol=1e-5)
    assert pytest.approx(0.0, abs=1e-10) == dynamics.R
    assert dynamics.energy_share == pytest.approx(1.0)


def test_projection_undoes_the_flow_of_a_state(rng, noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=7))
    state = rng.standard_normal(7)
    np.testing.assert_allclose(project(dynamics, flow_of(dynamics, state)), state, atol=1e-5)
    flow = noise_flows[4]
    rest = flow - flow_of(dynamics, project(dynamics, flow))
    np.testing.assert_allclose(dynamics.C.T @ rest.reshape(-1), 0, atol=1e-5)


def test_rotating_flow_is_predicted_exactly():
    flows = rotating_flows()
    dynamics = identify(flows)
    assert dynamics.rank == 2
    np.testing.assert_allclose(np.abs(dynamics.eigenvalues), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.angle(dynamics.eigenvalues)), 2 * np.pi / 12, atol=1e-6)
    for k in range(len(flows) - 1):
        np.testing.assert_allclose(predict_flow(dynamics, dynamics.states[:, k]), flows[k + 1], atol=1e-5)
    np.testing.assert_allclose(predict_flow(dynamics, dynamics.last_state), flows[0], atol=1e-5)
    np.testing.assert_allclose(dynamics.initial_state, project(dynamics, flows[0]), atol=1e-5)


def test_identification_recovers_the_system(rng):
    count, shape = 400, (5, 6)
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = rotation(0.7, 0.9), 0.6
    Q = np.array([[1.0, 0.3, 0.1], [0.3, 0.8, -0.2], [0.1, -0.2, 0.5]])
    C = orthonormal(shape, 3, rng)
    dynamics = identify(flows_from(C, run_system(A, Q, count, rng)[0], shape, mean=0.4), DynamicsParams(rank=3))
    # Four standard errors: sqrt((1 − |λ|²)/τ) for an eigenvalue, sqrt(2/τ) relative for a variance.
    expected = np.array([0.9 * np.exp(0.7j), 0.9 * np.exp(-0.7j), 0.6])
    for value in expected:
        error = np.abs(dynamics.eigenvalues - value).min()
        assert error < 4 * np.sqrt((1 - np.abs(value) ** 2) / count)
    assert (np.diff(np.abs(dynamics.eigenvalues)) <= 0).all()
    basis = dynamics.C.T @ C
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(dynamics.Q, basis @ Q @ basis.T, atol=4 * np.sqrt(2 / count) * np.trace(Q) / 2)
    np.testing.assert_allclose(basis.T @ dynamics.A @ basis, A, atol=4 * np.sqrt(1 / count))


def test_process_noise_is_nearly_unbiased_on_short_sequences(rng):
    n, count, shape, runs = 4, 14, (3, 4), 300
    A, C = 0.5 * np.eye(n), orthonormal(shape, n, rng)
    traces = [
        np.trace(identify(flows_from(C, states, shape), DynamicsParams(rank=n)).Q)
        for states in run_system(A, np.eye(n), count, rng, runs)
    ]
    # Standard error about 1 %. The divisor τ − 2 of the paper would give (τ − 2 − n)/(τ − 2) = 0.67.
    assert np.mean(traces) / n == pytest.approx(1.0, abs=0.07)


def test_residual_variance_is_that_of_white_noise(rng):
    shape, n, count = (30, 40), 3, 60
    deviation = np.where(np.arange(40) < 20, 0.1, 0.3)[:, None]
    states = 40 * run_system(0.5 * np.eye(n), np.eye(n), count, rng)[0]
    noise = deviation * rng.standard_normal((count, *shape, 2))
    dynamics = identify(flows_from(orthonormal(shape, n, rng), states, shape, noise=noise), DynamicsParams(rank=n))
    # 2 · 600 · 56 squares in each half: standard error half a percent.
    assert dynamics.residual_variance[:, :20].mean() == pytest.approx(0.01, rel=0.03)
    assert dynamics.residual_variance[:, 20:].mean() == pytest.approx(0.09, rel=0.03)
    assert pytest.approx(0.05, rel=0.03) == dynamics.R


@pytest.mark.parametrize("energy", [0.95, 1.0])
def test_automatic_rank_finds_the_states_in_noise(rng, energy):
    shape, n, count = (20, 20), 5, 60
    states = 30 * run_system(0.5 * np.eye(n), np.eye(n), count, rng)[0]
    noise = 0.5 * rng.standard_normal((count, *shape, 2))
    flows = flows_from(orthonormal(shape, n, rng), states, shape, noise=noise)
    dynamics = identify(flows, DynamicsParams(energy=energy))
    assert dynamics.rank == n
    assert not dynamics.overfitted and not dynamics.notes


def test_noise_threshold_ignores_the_singular_value_that_the_mean_took():
    # beta = 4/1000; the median of 4, 3, 2, 1 is 2.5.
    omega = 0.56 * 0.004**3 - 0.95 * 0.004**2 + 1.82 * 0.004 + 1.43
    assert module._noise_threshold(np.array([4.0, 3, 2, 1, 0]), 1000) == pytest.approx(2.5 * omega)
    # Two numbers a flow make two singular values, however many flows there are.
    omega = 0.56 * 0.5**3 - 0.95 * 0.5**2 + 1.82 * 0.5 + 1.43
    assert module._noise_threshold(np.array([3.0, 2, 0, 0, 0]), 2) == pytest.approx(2.5 * omega)


def test_automatic_rank_keeps_the_energy_and_the_caps(rng):
    shape, count = (8, 8), 60
    states = rng.standard_normal((30, count)) * np.geomspace(1, 1e-3, 30)[:, None]
    flows = flows_from(orthonormal(shape, 30, rng), states, shape)
    for energy in (0.5, 0.9, 0.99):
        dynamics = identify(flows, DynamicsParams(energy=energy))
        squares = np.cumsum(dynamics.singular_values**2) / np.sum(dynamics.singular_values**2)
        assert squares[dynamics.rank - 1] >= energy > squares[dynamics.rank - 2]
        assert dynamics.energy_share == pytest.approx(squares[dynamics.rank - 1])
    assert identify(flows, DynamicsParams(energy=1, max_rank=4)).rank == 4
    assert identify(flows, DynamicsParams(energy=1)).rank == 20
    assert identify(flows, DynamicsParams(energy=1, frames_per_state=6)).rank == 10


def test_pure_noise_and_too_few_flows_have_no_states(rng):
    noise = identify(rng.standard_normal((30, 20, 20, 2)).astype(np.float32))
    assert noise.rank == 0
    assert pytest.approx(1.0, rel=0.03) == noise.R
    assert any("too noisy" in note for note in noise.notes)


def test_as_many_states_as_flows_only_repeat_them(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=20))
    assert dynamics.rank == 19
    assert dynamics.overfitted
    assert any("20 states asked for, 19" in note for note in dynamics.notes)
    assert any("repeats" in note for note in dynamics.notes)
    roots = np.exp(2j * np.pi * np.arange(1, 20) / 20)
    for root in roots:
        assert np.abs(dynamics.eigenvalues - root).min() < 1e-6
    # What follows the last flow is the first.
    np.testing.assert_allclose(predict_flow(dynamics, dynamics.last_state), noise_flows[0], atol=1e-4)
    np.testing.assert_allclose(dynamics.Q, 0, atol=1e-10)
    assert not identify(noise_flows, DynamicsParams(rank=6)).overfitted
    assert identify(noise_flows, DynamicsParams(rank=7)).overfitted


@pytest.mark.parametrize("value", [0.0, 0.1, -7.3])
def test_flows_that_do_not_change_have_no_states_and_no_nan(rng, value):
    flows = np.full((8, 5, 4, 2), value, np.float32)
    for params in (DynamicsParams(), DynamicsParams(rank=3)):
        dynamics = identify(flows, params)
        assert dynamics.rank == 0 and dynamics.R == 0 and dynamics.energy_share == 1
        assert dynamics.C.shape == (40, 0) and dynamics.states.shape == (0, 8)
        assert dynamics.eigenvalues.shape == (0,) and dynamics.state_covariance.shape == (0, 0)
        assert any("do not change" in note for note in dynamics.notes)
        state = project(dynamics, flows[0])
        simulated = simulate(dynamics, 4, rng)
        for flow in (flow_of(dynamics, state), predict_flow(dynamics, dynamics.last_state), *simulated):
            np.testing.assert_array_equal(flow, flows[0])


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("rank", [None, 1, 4])
def test_very_short_sequences_stay_finite(rng, count, rank):
    flows = rng.standard_normal((count, 6, 5, 2)).astype(np.float32)
    dynamics = identify(flows, DynamicsParams(rank=rank))
    assert dynamics.rank <= count - 1
    assert dynamics.shape == (6, 5) and dynamics.frame_count == count
    assert dynamics.overfitted == (count < 3 * dynamics.rank)
    for field in (dynamics.A, dynamics.C, dynamics.Q, dynamics.R, dynamics.residual_variance, dynamics.states):
        assert np.isfinite(field).all()
    assert np.isfinite(np.stack(list(simulate(dynamics, 5, rng)))).all()
    np.testing.assert_allclose(flow_of(dynamics, np.zeros(dynamics.rank)), flows.mean(0), atol=1e-6)


def test_fewer_independent_flows_than_states_asked_for(rng):
    flows = rotating_flows(turns=2)
    dynamics = identify(flows, DynamicsParams(rank=10))
    assert dynamics.rank == 2
    assert any("10 states asked for, 2" in note for note in dynamics.notes)
    few_pixels = identify(rng.standard_normal((30, 1, 2, 2)).astype(np.float32), DynamicsParams(rank=10))
    assert few_pixels.rank == 4


def test_ridge_damps_the_transition(noise_flows):
    n, ridge = 6, 0.5
    plain, damped = (identify(noise_flows, DynamicsParams(rank=n, ridge=r)) for r in (0.0, ridge))
    before, after = damped.states[:, :-1], damped.states[:, 1:]
    second = before @ before.T
    second += ridge * np.trace(second) / n * np.eye(n)
    np.testing.assert_allclose(damped.A, after @ before.T @ np.linalg.inv(second), rtol=1e-8, atol=1e-10)
    assert np.linalg.norm(damped.A) < np.linalg.norm(plain.A)


def unstable_dynamics(seed: int, n: int, radius: float):
    rng = np.random.default_rng(seed)
    flows = flows_from(orthonormal((6, 6), n, rng), rng.standard_normal((n, 40)), (6, 6))
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    dynamics = identify(flows, DynamicsParams(rank=n))
    deviation = np.sqrt(np.diag(dynamics.state_covariance))
    return dataclasses.replace(dynamics, A=A * deviation[:, None] / deviation)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12), st.floats(0.2, 1.6), st.floats(0.5, 0.995))
def test_stable_system_keeps_training_covariance_and_eigenvalues(seed, n, radius, largest):
    dynamics = unstable_dynamics(seed, n, radius)
    A, Q = stable_system(dynamics, largest)
    P = dynamics.state_covariance
    np.testing.assert_allclose(A @ P @ A.T + Q, P, atol=1e-7 * P.max())
    np.testing.assert_allclose(solve_discrete_lyapunov(A, Q), P, atol=1e-6 * P.max())
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > -1e-10 * P.max()
    expected = dynamics.eigenvalues
    expected = expected * np.minimum(1.0, largest / np.abs(expected))
    found = np.linalg.eigvals(A)
    for value in expected:
        # Where A is far from normal, eigenvalues carry more than rounding.
        assert np.abs(found - value).min() < 1e-5


def test_stable_system_leaves_a_stable_one_alone(rng):
    count, shape = 300, (4, 4)
    A = np.diag([0.8, 0.3])
    flows = flows_from(orthonormal(shape, 2, rng), run_system(A, np.eye(2), count, rng)[0], shape)
    dynamics = identify(flows, DynamicsParams(rank=2))
    stable_A, stable_Q = stable_system(dynamics)
    np.testing.assert_allclose(stable_A, dynamics.A, atol=1e-9)
    np.testing.assert_allclose(stable_Q, dynamics.Q, atol=0.04 * dynamics.Q.max())


@pytest.mark.parametrize("radius", [0.8, 1.3])
def test_simulation_has_training_variance_and_does_not_drift(radius):
    dynamics = unstable_dynamics(5, 4, radius)
    flows = simulate(dynamics, 2000, np.random.default_rng(2), largest_modulus=0.8)
    deviation = np.sqrt(np.diag(dynamics.state_covariance))
    scaled = flows.states / deviation[:, None]
    # Modulus at most 0.8 leaves at least 2000 · 0.36/1.64 = 440 independent squares: four standard errors are 27 %.
    np.testing.assert_allclose(np.mean(scaled**2, axis=1), 1.0, rtol=0.27)
    np.testing.assert_allclose(np.mean(scaled[:, 1000:] ** 2, axis=1), np.mean(scaled[:, :1000] ** 2, axis=1), rtol=0.6)
    # Means over 2000 steps have a deviation of at most 1/sqrt(2000 / 9) = 0.067.
    assert np.abs(np.mean(scaled, axis=1)).max() < 4 * 0.067
    assert np.abs(scaled).max() < 6


def test_default_simulation_of_an_overfitted_system_stays_bounded(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=19))
    flows = simulate(dynamics, 3000, np.random.default_rng(0))
    power = np.mean(flows.states**2) / np.mean(dynamics.states**2)
    assert 0.5 < power < 2


def test_simulated_flows_identify_the_system_they_came_from(rng):
    A, shape, count = rotation(0.5, 0.9), (4, 5), 400
    states = run_system(A, np.eye(2), count, rng)[0]
    training = identify(flows_from(orthonormal(shape, 2, rng), states, shape, mean=1.5), DynamicsParams(rank=2))
    again = identify(simulate(training, count, np.random.default_rng(1)), DynamicsParams(rank=2))
    for value in training.eigenvalues:
        assert np.abs(again.eigenvalues - value).min() < 4 * np.sqrt((1 - 0.81) / count)
    np.testing.assert_allclose(np.trace(again.Q), np.trace(training.Q), rtol=4 * np.sqrt(1 / count))
    np.testing.assert_allclose(again.mean_flow, training.mean_flow, atol=0.3)


def test_simulation_is_reproducible_and_lazy(rng):
    dynamics = identify(rotating_flows())
    a, b, c = (simulate(dynamics, 30, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.states, b.states)
    assert np.abs(a.states - c.states).max() > 0.1
    assert len(a) == len(list(a)) == 30
    np.testing.assert_array_equal(a[-1], flow_of(dynamics, a.states[:, 29]))
    assert a[3].dtype == np.float32 and a[3].shape == (6, 7, 2)
    with pytest.raises(IndexError):
        a[30]


def test_simulation_starts_where_it_is_told(rng):
    dynamics = identify(rotating_flows())
    flows = simulate(dynamics, 1, rng, initial=dynamics.last_state)
    np.testing.assert_array_equal(flows[0], flow_of(dynamics, dynamics.last_state))
    first = np.array([simulate(dynamics, 1, rng).states[:, 0] for _ in range(2000)])
    np.testing.assert_allclose(first.var(axis=0), np.diag(dynamics.state_covariance), rtol=0.13)


def test_growing_flows_are_noted(rng):
    flows = (1.2 ** np.arange(12))[:, None, None, None] * rng.standard_normal((4, 5, 2))
    dynamics = identify(flows.astype(np.float32))
    assert np.abs(dynamics.eigenvalues).max() > 1
    assert any("do not fade" in note for note in dynamics.notes)


def test_inputs_are_left_alone(noise_flows):
    before = noise_flows.copy()
    dynamics = identify(noise_flows, DynamicsParams(rank=3))
    project(dynamics, noise_flows[0])
    np.testing.assert_array_equal(noise_flows, before)
    state = np.ones(3)
    A = dynamics.A.copy()
    predict_flow(dynamics, state)
    stable_system(dynamics, 0.5)
    simulate(dynamics, 3, np.random.default_rng(0), initial=state)
    np.testing.assert_array_equal(state, 1.0)
    np.testing.assert_array_equal(dynamics.A, A)


GOOD = np.zeros((4, 3, 3, 2), np.float32)


@pytest.mark.parametrize(
    ("flows", "words"),
    [
        (np.zeros((1, 3, 3, 2), np.float32), "at least 2 flows"),
        (np.zeros(()), "at least 2 flows"),
        (np.zeros((4, 3, 3), np.float32), "one shape"),
        (np.zeros((4, 3, 3, 3), np.float32), "one shape"),
        (np.zeros((4, 0, 3, 2), np.float32), "one shape"),
        ([np.zeros((3, 3, 2)), np.zeros((3, 4, 2))], "one shape"),
        ([], "at least 2 flows"),
        (iter(GOOD), "make a list"),
        (7, "make a list"),
        (np.where(np.arange(2) == 1, np.nan, GOOD), "finite"),
    ],
)
def test_unusable_flows_are_a_clear_error(flows, words):
    with pytest.raises(DataError, match=words) as caught:
        identify(flows)
    assert "\n" not in str(caught.value)


def test_unusable_states_and_flows_are_a_clear_error(rng):
    dynamics = identify(rotating_flows())
    for call, words in (
        (lambda: flow_of(dynamics, np.zeros(3)), "state: expected shape"),
        (lambda: predict_flow(dynamics, [np.nan, 0.0]), "state: expected finite"),
        (lambda: simulate(dynamics, 3, rng, initial=np.zeros((2, 1))), "state: expected shape"),
        (lambda: project(dynamics, np.zeros((5, 7, 2))), "flow: expected shape"),
        (lambda: project(dynamics, np.full((6, 7, 2), np.nan)), "flow: expected finite"),
    ):
        with pytest.raises(DataError, match=words):
            call()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: DynamicsParams(rank=-1), "rank"),
        (lambda: DynamicsParams(energy=0.0), "energy"),
        (lambda: DynamicsParams(energy=1.1), "energy"),
        (lambda: DynamicsParams(max_rank=-1), "max_rank"),
        (lambda: DynamicsParams(frames_per_state=0.5), "frames_per_state"),
        (lambda: DynamicsParams(ridge=-0.1), "ridge"),
        (lambda: simulate(identify(GOOD), 0, np.random.default_rng(0)), "length"),
        (lambda: stable_system(identify(GOOD), 1.0), "largest_modulus"),
    ],
)
def test_unusable_settings_are_a_clear_error(call, words):
    with pytest.raises(ConfigurationError, match=words):
        call()


@pytest.mark.parametrize("rank", [0, 5, 19])
def test_flow_variance_is_that_of_the_flows_whatever_the_rank(noise_flows, rank):
    found = identify(noise_flows, DynamicsParams(rank=rank)).flow_variance
    np.testing.assert_allclose(found, noise_flows.var(axis=0, ddof=1).mean(axis=-1), rtol=1e-4)


def even_flows(size=1.0):
    """Flows whose variance is the same at every pixel."""
    angle = 2 * np.pi * np.arange(36) / 12
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return (size * directions[:, None, None] * np.ones((6, 7, 1))).astype(np.float32)


@given(st.floats(0.2, 5), st.floats(0, 3))
@settings(max_examples=20, deadline=None)
def test_displacement_and_flows_are_weighed_by_their_uncertainty(share, deviation):
    dynamics = identify(even_flows())
    measured = float(even_flows().var(axis=0, ddof=1).mean())
    cue, error = share * measured, deviation * measured
    lost = max(measured, cue) ** 2 / 20
    weights = 1 / np.array([(0.3 * measured) ** 2, error**2 + (0.15 * cue) ** 2 + lost**2])
    expected = weights @ [measured, cue] / weights.sum() / measured
    np.testing.assert_allclose(with_displacement(dynamics, cue, error).motion_factor, expected, rtol=1e-4)
    assert min(1, share) - 1e-4 <= expected <= max(1, share) + 1e-4


def test_the_motion_factor_scales_state_and_process_noise_and_nothing_else(noise_flows):
    dynamics = identify(noise_flows)
    less = with_displacement(dynamics, 0.5 * dynamics.flow_variance, 0.0)
    factor = float(less.motion_factor.mean())
    assert 0.45 < factor < 0.7
    np.testing.assert_allclose(less.Q, factor * dynamics.Q, rtol=1e-6)
    np.testing.assert_allclose(less.state_covariance, factor * dynamics.state_covariance, rtol=1e-6)
    assert_same_dynamics(dataclasses.replace(less, Q=dynamics.Q), dynamics)
    # A second cue replaces the first one.
    again = with_displacement(less, 2 * dynamics.flow_variance, 0.0)
    np.testing.assert_allclose(again.Q, again.motion_factor.mean() * dynamics.Q, rtol=1e-6)


def test_a_cue_acts_where_it_is():
    flows = np.tile(even_flows(), (1, 8, 16, 1))
    deviation = np.full(flows.shape[1:3], np.inf)
    deviation[:, :56] = 0.01
    factor = with_displacement(identify(flows), 0.1, deviation).motion_factor
    assert factor[:, :56].max() < 0.35
    assert (factor[:, 56:] == 1).all()


def test_flows_are_simulated_at_the_size_of_the_motion():
    dynamics = identify(even_flows())
    less = with_displacement(dynamics, 0.2, 0.0)
    full, small = (
        np.var(np.stack(list(simulate(model, 3000, np.random.default_rng(0)))), axis=0).mean()
        for model in (dynamics, less)
    )
    assert small / full == pytest.approx(less.motion_factor.mean(), rel=1e-3)


def test_large_motion_is_left_to_the_flows():
    """A displacement variance saturates at about 25 squared pixels."""
    dynamics = identify(even_flows(14.0))
    assert dynamics.flow_variance.min() > 90
    assert with_displacement(dynamics, 25.0, 1.5).motion_factor.min() > 0.9


def test_a_displacement_that_says_nothing_changes_nothing():
    dynamics = identify(even_flows())
    nothing = with_displacement(dynamics, 0.0, np.inf)
    assert (nothing.motion_factor == 1).all()
    assert_same_dynamics(nothing, dynamics)
    still = identify(np.ones((5, 4, 4, 2), np.float32))
    assert np.isfinite(with_displacement(still, 1.0, 0.1).motion_factor).all()
    assert 0 < with_displacement(dynamics, 0.0, 0.0).motion_factor.min() < 0.1
    with pytest.raises(DataError, match=r"deviation: expected one number or shape \(6, 7\)"):
        with_displacement(dynamics, 1.0, np.ones((7, 6)))

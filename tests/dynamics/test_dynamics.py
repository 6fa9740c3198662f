from __future__ import annotations

import numpy as np
import pytest
from flow_systems import flows_from, orthonormal, rotating_flows, rotation, run_system

from turbrestore.core.errors import DataError
from turbrestore.dynamics import dynamic_texture as module
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify, identify_memory, modes_memory
from turbrestore.dynamics.flow_model import flow_of, predict_flow, project_deviation
from turbrestore.dynamics.simulate import simulate


def test_system_is_the_least_squares_fit_of_the_paper(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=5))
    before, after = dynamics.states[:, :-1], dynamics.states[:, 1:]
    np.testing.assert_allclose(dynamics.A, after @ np.linalg.pinv(before), atol=1e-10)
    e = after - dynamics.A @ before
    np.testing.assert_allclose(dynamics.Q, e @ e.T / (20 - 2 - 5), rtol=1e-10)


def test_rotating_flow_is_predicted_exactly():
    flows = rotating_flows()
    dynamics = identify(flows)
    assert dynamics.rank == 2
    np.testing.assert_allclose(np.abs(dynamics.eigenvalues), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.angle(dynamics.eigenvalues)), 2 * np.pi / 12, atol=1e-6)
    for k in range(len(flows) - 1):
        np.testing.assert_allclose(predict_flow(dynamics, dynamics.states[:, k]), flows[k + 1], atol=1e-5)
    np.testing.assert_allclose(predict_flow(dynamics, dynamics.last_state), flows[0], atol=1e-5)
    np.testing.assert_allclose(
        dynamics.states[:, 0], project_deviation(dynamics, flows[0] - dynamics.mean_flow), atol=1e-5
    )


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
        state = project_deviation(dynamics, flows[0] - dynamics.mean_flow)
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


def test_growing_flows_are_noted(rng):
    flows = (1.2 ** np.arange(12))[:, None, None, None] * rng.standard_normal((4, 5, 2))
    dynamics = identify(flows.astype(np.float32))
    assert np.abs(dynamics.eigenvalues).max() > 1
    assert any("do not fade" in note for note in dynamics.notes)


GOOD = np.zeros((4, 3, 3, 2), np.float32)


@pytest.mark.parametrize(
    ("flows", "words"),
    [
        (np.zeros((1, 3, 3, 2), np.float32), "at least 2 flows"),
        (np.zeros(()), "at least 2 flows"),
        (np.zeros((4, 3, 3), np.float32), "T, H, W, 2"),
        (np.zeros((4, 3, 3, 3), np.float32), "T, H, W, 2"),
        (np.zeros((4, 0, 3, 2), np.float32), "T, H, W, 2"),
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


def test_memory_follows_the_number_of_flows_and_states():
    assert identify_memory((9, 10, 10), 6) == 70 * 100 * 6
    assert identify_memory((9, 1000, 1000, 3), 6) == 140e6
    assert modes_memory((90, 10, 10), 60) == 8 * 100 * 20
    assert modes_memory((90, 10, 10), 60, DynamicsParams(rank=70)) == 8 * 100 * 59

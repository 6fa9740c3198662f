from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from flow_systems import flows_from, orthonormal, rotating_flows, rotation, run_system
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov

from turbrestore.core.errors import ConfigurationError
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.dynamics.flow_model import flow_of
from turbrestore.dynamics.simulate import simulate, stable_system


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
    np.testing.assert_allclose(A @ P @ A.T + Q, P, atol=1e-6 * P.max())
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


def test_unusable_settings_are_a_clear_error(rng, noise_flows):
    dynamics = identify(noise_flows)
    with pytest.raises(ConfigurationError, match="length"):
        simulate(dynamics, 0, rng)
    with pytest.raises(ConfigurationError, match="largest_modulus"):
        stable_system(dynamics, 1.0)

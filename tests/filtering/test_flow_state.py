from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flow_systems import textbook_update, uneven_flows

from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.dynamics.flow_model import flow_of, project_measured
from turbrestore.filtering.estimates import Gaussian
from turbrestore.filtering.flow_state import advance_flow_state, update_flow_state
from turbrestore.filtering.kalman import predict


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.fixture
def dynamics():
    return identify(uneven_flows(), DynamicsParams(rank=5))


def test_the_projected_update_is_that_of_the_whole_flow(rng, dynamics):
    """Eq. 19 with z = Cᵀ(W − W̄) against eq. 18 with all 2 H W components."""
    state = whole = Gaussian(rng.standard_normal(5), dynamics.state_covariance)
    C, R = dynamics.C.astype(np.float64), dynamics.R * np.eye(len(dynamics.C))
    for flow in uneven_flows()[:4]:
        whole = predict(whole, dynamics.A, dynamics.Q)
        expected = (flow - flow_of(dynamics, whole.mean)).ravel()
        state, innovation = advance_flow_state(state, project_measured(flow, dynamics), dynamics)
        whole = textbook_update(whole, (flow - dynamics.mean_flow).ravel(), C, R)
        np.testing.assert_allclose(state.mean, whole.mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(state.cov, whole.cov, rtol=1e-5, atol=1e-6 * whole.cov.max())
        assert innovation == pytest.approx(np.sqrt(np.mean(expected.astype(np.float64) ** 2)), rel=1e-4)


def test_the_gain_is_that_of_the_information_form(rng, dynamics):
    predicted = Gaussian(rng.standard_normal(5), dynamics.state_covariance)
    measured = project_measured(uneven_flows()[0], dynamics)
    M = np.linalg.inv(np.eye(5) / dynamics.R + np.linalg.inv(predicted.cov)) / dynamics.R
    state, _ = update_flow_state(predicted, measured, dynamics)
    np.testing.assert_allclose(state.mean, predicted.mean + M @ (measured.state - predicted.mean), rtol=1e-9)
    np.testing.assert_allclose(state.cov, (np.eye(5) - M) @ predicted.cov, rtol=1e-8, atol=1e-9 * predicted.cov.max())


def test_a_model_that_explains_everything_keeps_a_gain(rng, dynamics):
    exact = replace(dynamics, R=0.0)
    state, _ = update_flow_state(
        Gaussian(np.zeros(5), dynamics.state_covariance), project_measured(uneven_flows()[1], dynamics), exact
    )
    assert np.linalg.eigvalsh(state.cov).min() > 0
    np.testing.assert_allclose(state.mean, project_measured(uneven_flows()[1], dynamics).state, rtol=1e-4)


def test_a_covariance_without_rank_stays_one(dynamics):
    """P is singular where a state is known exactly, and spans twelve orders of magnitude at the start."""
    basis = np.linalg.qr(np.random.default_rng(5).standard_normal((5, 5)))[0]
    P = (basis * [1e6, 1e3, 1.0, 1e-6, 0.0]) @ basis.T
    state, _ = update_flow_state(
        Gaussian(np.zeros(5), (P + P.T) / 2), project_measured(uneven_flows()[0], dynamics), replace(dynamics, R=1e-6)
    )
    values = np.linalg.eigvalsh(state.cov)
    assert values.min() > -1e-18 and values.max() <= 1e-6
    assert (state.cov == state.cov.T).all()


def test_a_model_without_states_learns_nothing(dynamics):
    still = identify(np.zeros((3, 2, 2, 2), np.float32))
    state, innovation = update_flow_state(
        Gaussian(np.zeros(0), np.zeros((0, 0))), project_measured(np.ones((2, 2, 2), np.float32), still), still
    )
    assert state.mean.size == 0 and innovation == pytest.approx(1.0)

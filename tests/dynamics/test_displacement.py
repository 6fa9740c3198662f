from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from flow_systems import (
    assert_same_dynamics,
    uneven_flows,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import DataError
from turbrestore.dynamics.displacement import with_displacement
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.dynamics.simulate import simulate


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def noise_flows() -> np.ndarray:
    return uneven_flows()


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

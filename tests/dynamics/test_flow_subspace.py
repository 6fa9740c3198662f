from __future__ import annotations

import numpy as np
import pytest
from flow_systems import assert_same_dynamics, flows_from, orthonormal

from turbrestore.dynamics import dynamic_texture
from turbrestore.dynamics.dynamic_texture import DynamicsParams, FlowStrips, identify


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
    monkeypatch.setattr(dynamic_texture, "_STRIP_BYTES", size)
    assert len(list(FlowStrips.of(noise_flows).rows())) == {1: 9, 5000: 9, 2**25: 1}[size]
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

"""Flows of known linear systems."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from turbrestore.filtering.estimates import Gaussian


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


def textbook_update(state, z, H, R):
    """Update of a Gaussian state as paper 3 prints it, (17) and (18)."""
    M = state.cov @ H.T @ np.linalg.inv(H @ state.cov @ H.T + R)
    cov = state.cov - M @ H @ state.cov
    return Gaussian(state.mean + M @ (z - H @ state.mean), (cov + cov.T) / 2)


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


def uneven_flows():
    """White flows about a mean, of another size each."""
    rng = np.random.default_rng(7)
    flows = rng.standard_normal((20, 9, 11, 2)).astype(np.float32)
    return flows * np.linspace(0.2, 2, 20, dtype=np.float32)[rng.permutation(20)][:, None, None, None] + np.float32(3)

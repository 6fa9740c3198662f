"""Kalman filter of a linear state: its prediction, and its update by a measurement (paper 3, eqs. 14, 17 and 19).

:mod:`turbrestore.filtering.flow_state` has the equations, with the flow less its mean in the place of z and C in that
of H; the observers of blur moments use them as well.

Symbols
-------
ξ̂, P : mean and covariance of the state
A, Q : transition of the state, and covariance of its noise
z, H, R : measurement ``z = H ξ + r``, its matrix, and the covariance of its noise r
M : gain

Matrix operations act on the last two axes, so leading axes are batches and broadcast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import DataError
from ..dynamics.flow_model import Float64Array
from .estimates import Gaussian, check_batches, check_covariance, check_matrix


def predict(state: Gaussian, A: ArrayLike, Q: ArrayLike) -> Gaussian:
    """Predict the state one step ahead: A ξ̂ (14b) and A P Aᵀ + Q (14d), with A and Q of shape (..., n, n)."""
    n = state.mean.shape[-1]
    A, Q = np.asarray(A, np.float64), np.asarray(Q, np.float64)
    check_matrix(A, n, n, "A")
    check_covariance(Q, n, "Q")
    check_batches(state.mean.shape[:-1], A=A.shape[:-2], Q=Q.shape[:-2])
    # Gaussian raises a DataError where the result overflows, so NumPy need not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        return Gaussian(apply(A, state.mean), symmetric(A @ state.cov @ A.mT + Q))  # (14b), (14d)


def update(state: Gaussian, measurement: ArrayLike, H: ArrayLike, noise_variance: ArrayLike) -> Gaussian:
    """Update the state by a measurement (17) with the gain of (19), which suits many components and few states.

    ``M = (G + P⁻¹)⁻¹ Hᵀ R⁻¹`` with ``G = Hᵀ R⁻¹ H``: only n×n matrices are decomposed. With ``P = L Lᵀ`` and ``Lᵀ G L =
    V D Vᵀ`` the new covariance is ``T Tᵀ``, ``T = L V (I + D)^(-1/2)``: P may be singular, and the result is symmetric
    and positive semi-definite. Its relative error is about 1e-16 times the largest of D.
    ``measurement`` (..., m); ``H`` (..., m, n); ``noise_variance`` (m,) or one number.
    """
    z, H, variance = (np.asarray(values, np.float64) for values in (measurement, H, noise_variance))
    _check(state, z, H, variance)
    weighted = (H * np.broadcast_to(1.0 / variance, H.shape[-2:-1])[:, None]).mT  # Hᵀ R⁻¹
    G = symmetric(weighted @ H)
    T = _posterior_root(state.cov, G)
    cov = symmetric(T @ T.mT)  # (G + P⁻¹)⁻¹, of M in (19)
    return Gaussian(state.mean + apply(cov, apply(weighted, z) - apply(G, state.mean)), cov)  # (17)


def _posterior_root(P: Float64Array, G: Float64Array) -> Float64Array:
    """T with T Tᵀ = (G + P⁻¹)⁻¹."""
    values, vectors = np.linalg.eigh(P)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    gained, directions = np.linalg.eigh(symmetric(root.mT @ G @ root))
    return root @ directions / np.sqrt(1.0 + np.maximum(gained, 0.0))[..., None, :]


def apply(matrix: Float64Array, vector: Float64Array) -> Float64Array:
    """Multiply vectors (..., n) by matrices (..., m, n)."""
    return np.matmul(matrix, vector[..., None])[..., 0]


def symmetric(matrix: Float64Array) -> Float64Array:
    """Symmetric part of matrices (..., n, n), which rounding leaves out of balance."""
    return 0.5 * (matrix + matrix.mT)


def _check(state: Gaussian, z: Float64Array, H: Float64Array, variance: Float64Array) -> None:
    if z.ndim < 1:
        raise DataError("measurement: expected shape (..., m), found a single number")
    m = z.shape[-1]
    check_matrix(H, m, state.mean.shape[-1], "H")
    check_batches(state.mean.shape[:-1], measurement=z.shape[:-1], H=H.shape[:-2])
    if not np.isfinite(z).all():
        raise DataError("measurement: expected finite values, found NaN or infinite ones")
    if variance.shape not in ((), (m,)):
        raise DataError(f"noise_variance: expected one number or shape ({m},), found shape {variance.shape}")
    if not (np.isfinite(variance) & (variance > 0)).all():
        raise DataError("noise_variance: expected finite values above 0, found others; give the noise a floor")

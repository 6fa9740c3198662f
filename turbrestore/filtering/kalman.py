"""Kalman filter of a linear state: prediction, and measurement update in covariance and in information form.

Equations (14), (17), (18) and (19) are those of :mod:`turbrestore.filtering.flow_state`, with any measurement z in the
place of the flow less its mean, and its matrix H in the place of C; the observers of blur moments use them as well.

Symbols
-------
ξ̂, P : mean and covariance of the state
A, Q : transition of the state, and covariance of its noise
z, H, R : measurement ``z = H ξ + r``, its matrix, and the covariance of its noise r
M : gain

Matrix operations act on the last two axes, so leading axes are batches and broadcast.  A component of a measurement
that is NaN is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import DataError
from ..dynamics.flow_model import Float64Array
from .estimates import Gaussian, check_batches, check_covariance, check_matrix, cholesky

_LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True, eq=False)
class Innovation:
    """Difference between a measurement and its prediction, for consistency checks.

    If the model is right, the mean of ``normalised_squared`` over many updates is that of ``observed``, and the sum of
    ``log_likelihood`` is the log-density of all measurements.
    """

    # (..., m) or (..., n). Covariance form: z − H ξ̂, NaN where the component is missing. Information form: its
    # projection Hᵀ R⁻¹ (z − H ξ̂), which is all that the update needs.
    values: Float64Array
    cov: Float64Array  # (..., m, m) or (..., n, n): covariance of ``values``, NaN where a component is missing
    # (...): squared innovation in units of its covariance; chi-squared with ``observed`` degrees of freedom.
    normalised_squared: Float64Array
    log_likelihood: Float64Array  # (...): log-density of the measurement given all before it
    observed: NDArray[np.intp]  # (...): number of components that are not missing


def predict(state: Gaussian, A: ArrayLike, Q: ArrayLike) -> Gaussian:
    """Predict the state one step ahead: A ξ̂ (14b) and A P Aᵀ + Q (14d), with A and Q of shape (..., n, n)."""
    n = state.mean.shape[-1]
    A, Q = np.asarray(A, np.float64), np.asarray(Q, np.float64)
    check_matrix(A, n, n, "A")
    check_covariance(Q, n, "Q")
    check_batches(state.mean.shape[:-1], A=A.shape[:-2], Q=Q.shape[:-2])
    # Gaussian raises a DataError where the result overflows, so NumPy need not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        return Gaussian(_apply(A, state.mean), _symmetric(A @ state.cov @ A.mT + Q))  # (14b), (14d)


def update_covariance_form(
    state: Gaussian, measurement: ArrayLike, H: ArrayLike, R: ArrayLike, predicted: ArrayLike | None = None
) -> tuple[Gaussian, Innovation]:
    """Update the state by a measurement (17) with the gain of (18), which suits few components.

    The new covariance is Joseph's ``(I − M H) P (I − M H)ᵀ + M R Mᵀ`` where the paper has ``(I − M H) P``: both are the
    same in exact arithmetic, but only the first stays symmetric and positive semi-definite in floating point.
    ``measurement`` (..., m); ``H`` (..., m, n); ``R`` (..., m, m); ``predicted`` (..., m).
    """
    n = state.mean.shape[-1]
    z, H, R = np.asarray(measurement, np.float64), np.asarray(H, np.float64), np.asarray(R, np.float64)
    m = _check_measurement(z, H, n)
    check_covariance(R, m, "R")
    check_batches(state.mean.shape[:-1], measurement=z.shape[:-1], H=H.shape[:-2], R=R.shape[:-2])
    residual = z - (_apply(H, state.mean) if predicted is None else np.asarray(predicted, np.float64))
    missing = np.isnan(z)
    if missing.any():
        # An identity block in the place of missing components decouples them: no gain, no likelihood.
        residual = np.where(missing, 0.0, residual)
        H = np.where(missing[..., None], 0.0, H)
        R = np.where(missing[..., None] | missing[..., None, :], np.eye(m), R)
    HP = H @ state.cov
    S = _symmetric(HP @ H.mT + R)
    lower = cholesky(S, "innovation covariance H P Hᵀ + R", "positive definite")
    M = np.asarray(np.linalg.solve(S, HP), np.float64).mT  # P Hᵀ (H P Hᵀ + R)⁻¹, (18)
    F = np.eye(n) - M @ H
    after = Gaussian(state.mean + _apply(M, residual), _symmetric(F @ state.cov @ F.mT + M @ R @ M.mT))
    squared = (residual * np.linalg.solve(S, residual[..., None])[..., 0]).sum(-1)
    log_det = 2 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    observed = m - missing.sum(-1)
    if missing.any():
        residual = np.where(missing, np.nan, residual)
        S = np.where(missing[..., None] | missing[..., None, :], np.nan, S)
    return after, _innovation(residual, S, squared, log_det, observed)


def update_information_form(
    state: Gaussian, measurement: ArrayLike, H: ArrayLike, noise_variance: ArrayLike
) -> tuple[Gaussian, Innovation]:
    """Update the state by a measurement (17) with the gain of (19), which suits many components and few states.

    ``M = (G + P⁻¹)⁻¹ Hᵀ R⁻¹`` with ``G = Hᵀ R⁻¹ H``: only n×n matrices are decomposed. With ``P = L Lᵀ`` and ``Lᵀ G L =
    V D Vᵀ`` the new covariance is ``T Tᵀ``, ``T = L V (I + D)^(-1/2)``: P may be singular, and the result is symmetric
    and positive semi-definite. Its relative error is about 1e-16 times the largest of D.
    ``measurement`` (..., m); ``H`` (..., m, n); ``noise_variance`` (m,).
    """
    n = state.mean.shape[-1]
    z, H = np.asarray(measurement, np.float64), np.asarray(H, np.float64)
    m = _check_measurement(z, H, n)
    check_batches(state.mean.shape[:-1], measurement=z.shape[:-1], H=H.shape[:-2])
    variance = np.asarray(noise_variance, np.float64)
    if variance.shape not in ((), (m,)):
        raise DataError(f"noise_variance: expected one number or shape ({m},), found shape {variance.shape}")
    if not (np.isfinite(variance) & (variance > 0)).all():
        raise DataError("noise_variance: expected finite values above 0, found others; give the noise a floor")
    missing = np.isnan(z)
    weight, z = np.where(missing, 0.0, 1.0 / variance), np.where(missing, 0.0, z)
    weighted = (H * weight[..., None]).mT
    G, Hz, zz = _symmetric(weighted @ H), _apply(weighted, z), (weight * z**2).sum(-1)
    T, gained = _posterior_root(state.cov, G)
    cov = _symmetric(T @ T.mT)  # (G + P⁻¹)⁻¹, of M in (19)
    score = Hz - _apply(G, state.mean)
    step = _apply(cov, score)  # M (z − H ξ̂)
    # zᵀR⁻¹z − 2 ξ̂ᵀHᵀR⁻¹z + ξ̂ᵀGξ̂ needs no further pass over H; rounding may leave it a little below zero.
    squared = np.maximum(zz - (state.mean * (Hz + score)).sum(-1) - (score * step).sum(-1), 0.0)
    log_det = np.where(missing, 0.0, np.log(variance)).sum(-1) + np.log1p(gained).sum(-1)
    score_cov = _symmetric(G + G @ state.cov @ G)
    innovation = _innovation(score, score_cov, squared, log_det, m - missing.sum(-1))
    return Gaussian(state.mean + step, cov), innovation


def _posterior_root(P: Float64Array, G: Float64Array) -> tuple[Float64Array, Float64Array]:
    """T with T Tᵀ = (G + P⁻¹)⁻¹, and the eigenvalues of P G: how much more is known in each direction."""
    values, vectors = np.linalg.eigh(P)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    gained, directions = np.linalg.eigh(_symmetric(root.mT @ G @ root))
    gained = np.maximum(gained, 0.0)
    return root @ directions / np.sqrt(1.0 + gained)[..., None, :], gained


def _innovation(
    values: Float64Array, cov: Float64Array, squared: Float64Array, log_det: Float64Array, observed: NDArray[np.intp]
) -> Innovation:
    log_likelihood = -0.5 * (squared + log_det + observed * _LOG_2PI)
    return Innovation(values, cov, np.asarray(squared), np.asarray(log_likelihood), np.asarray(observed))


def _apply(matrix: Float64Array, vector: Float64Array) -> Float64Array:
    return np.matmul(matrix, vector[..., None])[..., 0]


def _symmetric(matrix: Float64Array) -> Float64Array:
    return 0.5 * (matrix + matrix.mT)


def _check_measurement(z: NDArray[np.floating], H: NDArray[np.floating], n: int) -> int:
    if z.ndim < 1:
        raise DataError("measurement: expected shape (..., m), found a single number")
    check_matrix(H, z.shape[-1], n, "H")
    if np.isinf(z).any():
        raise DataError("measurement: expected finite values, or NaN where missing, found infinite ones")
    return int(z.shape[-1])

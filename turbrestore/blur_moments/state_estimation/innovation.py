"""Correction of a state by the difference between a measurement and its prediction (paper 3, eqs. 17 and 18).

Symbols
-------
r, S : innovation ``z − h(x̂)`` and its covariance
H, R, P, M : matrix and noise of the measurement; covariance of the state; gain
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...filtering.estimates import Gaussian, check_covariance, cholesky
from ...filtering.kalman import apply, symmetric
from ..sensor import Float64Array


@dataclass(frozen=True, eq=False)
class Innovation:
    """Size of the difference between a measurement and its prediction, for checks of consistency."""

    # (...): squared innovation in units of its covariance; if the model is right, it is chi-squared.
    normalised_squared: Float64Array
    observed: int  # degrees of freedom: number of values measured


def correct(state: Gaussian, residual: Float64Array, H: Float64Array, R: Float64Array) -> tuple[Gaussian, Innovation]:
    """Correct a state by an innovation (..., m) with the gain of (18), which suits few components.

    The new covariance is Joseph's ``(I − M H) P (I − M H)ᵀ + M R Mᵀ`` where the paper has ``(I − M H) P``: both are the
    same in exact arithmetic, but only the first stays symmetric and positive semi-definite in floating point.
    ``H`` (..., m, n); ``R`` (..., m, m).
    """
    m, n = H.shape[-2:]
    check_covariance(R, m, "R")
    HP = H @ state.cov
    S = symmetric(HP @ H.mT + R)
    cholesky(S, "innovation covariance H P Hᵀ + R", "positive definite")
    M = np.asarray(np.linalg.solve(S, HP), np.float64).mT  # P Hᵀ (H P Hᵀ + R)⁻¹, (18)
    F = np.eye(n) - M @ H
    after = Gaussian(state.mean + apply(M, residual), symmetric(F @ state.cov @ F.mT + M @ R @ M.mT))
    squared = (residual * np.linalg.solve(S, residual[..., None])[..., 0]).sum(-1)
    return after, Innovation(squared, m)

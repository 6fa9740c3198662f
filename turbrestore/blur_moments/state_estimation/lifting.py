"""Lift a fast system to the rate of the frames: the step from one exposure to the next, and the output within one.

Symbols (paper 1, section V; paper 2, section IV)
-------------------------------------------------
A_f, B_f, C_f : fast system with the step T_f, :class:`FastSystem`.
A_s, B_s, C_s, D_s : the same at the rate of the frames, :class:`LiftedSystem`, made by :func:`lift`.
u_s(j) : inputs of frame period j, ``[u(jN), …, u(jN + N − 1)]``.
Q : covariance of the disturbance that is added between two exposures.
ŷ(i) : output at the fast steps i = 0 … N_e − 1 of the exposure, given the state at its start.

Departures from the papers
--------------------------
The matrices A_f, B_f printed in paper 2 are continuous (poles −6.8 ± 33.3i, gain 1 at rest); :func:`discretise`
makes them discrete.  C_s carries the factor 1 / N_e that the paper omits, because a moment is an average; it averages
the steps 0 … N_e − 1, so entry n of D_s is ``C_f Σ_{i ≤ N_e − 2 − n} A_f^i B_f / N_e`` (the printed sum up to
N_e − 1 − n belongs to the steps 1 … N_e).  The input enters as ``Σ_i A_f^i B_f u(jN − 1 − i)``, where paper 1 prints
u(jN − i).  Both papers state that (A_s, C_s) is observable whenever (A_f, C_f) is.  This fails if a frame period is
half a period of an oscillation, or an exposure a whole one, so :func:`lift` checks it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from ...core.errors import ConfigurationError, require
from ...filtering.estimates import Gaussian
from ...filtering.kalman import predict
from ..sensor import ExposureTiming, Float64Array

# A direction of the state counts as unobservable below this share of the strongest effect on the output (float64);
# chosen.
_OBSERVABLE = 1e-9
# In float64 the two eigenvalues of a double root come out about 1e-8 apart.
_APART = 1e-6


@dataclass(frozen=True, eq=False)
class FastSystem:
    """Linear system with one input and one output, at the fast rate."""

    A: Float64Array  # (n, n): a_f, discrete
    # (n,): b_f and C_f.
    B: Float64Array
    C: Float64Array

    def __post_init__(self) -> None:
        A, B, C = (np.asarray(matrix, np.float64) for matrix in (self.A, self.B, self.C))
        B, C = np.atleast_1d(B.squeeze()), np.atleast_1d(C.squeeze())
        n = len(B)
        require(
            n >= 1 and A.shape == (n, n) and C.shape == (n,),
            f"system: expected shapes (n, n), (n,) and (n,), n of at least 1, found {A.shape}, {B.shape} and {C.shape}",
        )
        require(
            all(bool(np.isfinite(matrix).all()) for matrix in (A, B, C)),
            "system: expected finite matrices, found NaN or infinite values",
        )
        radius = float(np.abs(np.linalg.eigvals(A)).max())
        require(
            radius <= 1 + 1e-9, f"A: expected a stable system, found an eigenvalue of size {radius:.6g}; stabilise it"
        )
        for name, matrix in (("A", A), ("B", B), ("C", C)):
            object.__setattr__(self, name, matrix)


@dataclass(frozen=True, eq=False)
class LiftedSystem:
    """A fast system observed once per frame, made by :func:`lift`."""

    timing: ExposureTiming
    A: Float64Array  # (n, n): a_s, from the start of an exposure to the start of the next
    B: Float64Array  # (n, N): b_s
    C: Float64Array  # (n,): c_s, average output over the exposure
    D: Float64Array  # (N,): d_s
    free: Float64Array  # (N, n): output at every fast step as a function of the state at the start of the exposure
    forced: Float64Array  # (N, N): output at every fast step as a function of the inputs
    Q: Float64Array  # (n, n): covariance of the disturbance between two exposures

    @property
    def order(self) -> int:
        """Number n of states."""
        return len(self.C)

    def path_and_jacobian(
        self, mean: Float64Array, inputs: Float64Array, steps: int | None = None
    ) -> tuple[Float64Array, Float64Array]:
        """Output ŷ at the first fast steps, by default those of the exposure, and its derivative by the state.

        ``mean`` (..., n); ``inputs`` (..., N); returns ``path`` (..., steps), ``jacobian`` (..., steps, n).
        """
        steps = steps or self.timing.exposure_steps
        path = mean @ self.free[:steps].T + inputs[..., :steps] @ self.forced[:steps, :steps].T
        return path, np.broadcast_to(self.free[:steps], (*path.shape, self.order))

    def advance(self, state: Gaussian, inputs: Float64Array) -> Gaussian:
        """Predict the state at the start of the next exposure."""
        ahead = predict(state, self.A, self.Q)
        return Gaussian(ahead.mean + inputs @ self.B.T, ahead.cov)


def discretise(A: ArrayLike, B: ArrayLike, period: float) -> tuple[Float64Array, Float64Array]:
    """Discretise ``ẋ = A x + B u`` with an input that is constant over each step (zero-order hold).

    ``A`` (n, n); ``B`` (n,); returns ``A_f`` (n, n), ``B_f`` (n,).
    """
    A, B = np.asarray(A, np.float64), np.atleast_1d(np.asarray(B, np.float64))
    require(0 < period < np.inf, f"period: expected a time above 0 s, found {period:g}")
    n = len(B)
    require(B.shape == (n,) and A.shape == (n, n), f"system: expected shapes (n, n), (n,), found {A.shape}, {B.shape}")
    require(bool(np.isfinite(A).all() and np.isfinite(B).all()), "system: expected finite matrices, found others")
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = A, B
    held = expm(joint * period)
    return held[:n, :n], held[:n, n]


def lift(fast: FastSystem, timing: ExposureTiming, Q: ArrayLike) -> LiftedSystem:
    """Lift a fast system to the rate of the frames (paper 2, section IV).

    ``Q`` (n, n).
    """
    steps, n = timing.frame_steps, len(fast.B)
    noise = np.asarray(Q, np.float64)
    require(noise.shape == (n, n), f"Q: expected shape {(n, n)}, found {noise.shape}")
    reached = np.empty((steps, n))
    free = np.empty((steps, n))
    row, column = fast.C, fast.B
    for i in range(steps):
        free[i], reached[i] = row, column
        row, column = row @ fast.A, fast.A @ column
    pulse = np.concatenate([[0.0], reached[:-1] @ fast.C])
    lag = np.subtract.outer(np.arange(steps), np.arange(steps))
    forced = np.where(lag >= 0, pulse[np.maximum(lag, 0)], 0.0)
    A, C = np.linalg.matrix_power(fast.A, steps), free[: timing.exposure_steps].mean(0)
    if not is_observable(A, C):
        raise ConfigurationError(
            "system: expected a state that the mean outputs of the exposures determine, found one that they do not "
            "((A_s, C_s) is not observable); change exposure or frame period"
        )
    return LiftedSystem(timing, A, reached[::-1].T, C, forced[: timing.exposure_steps].mean(0), free, forced, noise)


def is_observable(A: ArrayLike, C: ArrayLike) -> bool:
    """Whether the outputs C x, C A x, … determine the state (test of Popov, Belevitch and Hautus).

    A simple eigenvalue needs an eigenvector v with C v ≠ 0. Eigenvalues count as distinct relative to their size, so
    that modes that die out within a step are kept apart. For multiple eigenvalues λ the rank of ``[λ I − A; C]``
    decides.
    ``A`` (n, n); ``C`` (n,) or (m, n).
    """
    A, C = np.asarray(A, np.float64), np.atleast_2d(np.asarray(C, np.float64))
    values, vectors = np.linalg.eig(A)
    strength = np.linalg.norm(C)
    for i, value in enumerate(values):
        others = np.delete(values, i)
        if (np.abs(others - value) > _APART * np.maximum(np.abs(others), abs(value))).all():
            visible = np.linalg.norm(C @ vectors[:, i])
        else:
            scale = max(float(np.abs(values).max()), 1e-300) / max(float(strength), 1e-300)
            stacked = np.concatenate([value * np.eye(len(A)) - A, scale * C]) / scale
            visible = np.linalg.svd(stacked, compute_uv=False)[-1]
        if visible <= _OBSERVABLE * strength:
            return False
    return True

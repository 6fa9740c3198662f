"""Lift a fast system to the rate of the frames: what happens from one exposure to the next, and within one.

Symbols (paper 1, section V; paper 2, section IV)
-------------------------------------------------
A_f, B_f, C_f, D_f : fast system with the step T_f, :class:`FastSystem`.
A_s, B_s, C_s, D_s : the same at the rate of the frames, :class:`LiftedSystem`, made by :func:`lift`.
u_s(j) : inputs of a slow step, ``[u(jN), …, u(jN + N − 1)]``.
Q : covariance of the disturbance that enters between two exposures.
ŷ(i) : output at the fast steps i = 0 … N_e − 1 of the exposure, given the state at its start.

Departures from the papers
--------------------------
The matrices A_f, B_f that paper 2 prints are continuous (poles −6.8 ± 33.3i, gain 1 at rest); :func:`discretise`
makes them discrete.  C_s carries the factor 1 / N_e that the paper leaves out, for a moment is an average; it
averages the steps 0 … N_e − 1, so that entry n of D_s is ``C_f Σ_{i ≤ N_e − 2 − n} A_f^i B_f / N_e`` (the printed
sum up to N_e − 1 − n goes with the steps 1 … N_e).  Input enters as ``Σ_i A_f^i B_f u(jN − 1 − i)``, where paper 1 has
u(jN − i).  Both papers say that (A_s, C_s) is observable whenever (A_f, C_f) is; this fails where a slow step is
half a period of an oscillation, or an exposure a whole one, so it is checked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from ..core.errors import ConfigurationError, DataError, require
from ..filtering.kalman import Gaussian, predict
from .kernels import Float64Array
from .sensor import ExposureTiming

# Directions of the state that reach the output 1e-9 times as strongly as the best one cannot be estimated in float64.
_OBSERVABLE = 1e-9
# Eigenvalues of a double root come out of float64 about 1e-8 apart.
_APART = 1e-6


@dataclass(frozen=True, eq=False)
class FastSystem:
    """Linear system with one input and one output, at the fast rate.

    Parameters
    ----------
    A : ndarray, float64, shape (n, n)
        A_f, discrete.
    B : ndarray, float64, shape (n,)
        B_f.
    C : ndarray, float64, shape (n,)
        C_f.
    D : float
        D_f.

    Raises
    ------
    ConfigurationError
        Shapes do not agree, values are not finite, or the system is unstable.

    Examples
    --------
    >>> FastSystem([[0.5]], [1.0], [1.0]).order
    1
    """

    A: Float64Array
    B: Float64Array
    C: Float64Array
    D: float = 0.0

    def __post_init__(self) -> None:
        A, B, C = (np.asarray(matrix, np.float64) for matrix in (self.A, self.B, self.C))
        B, C = np.atleast_1d(B.squeeze()), np.atleast_1d(C.squeeze())
        n = len(B)
        require(
            n >= 1 and A.shape == (n, n) and C.shape == (n,),
            f"system: expected shapes (n, n), (n,) and (n,), n of at least 1, found {A.shape}, {B.shape} and {C.shape}",
        )
        require(
            all(bool(np.isfinite(matrix).all()) for matrix in (A, B, C, self.D)),
            "system: expected finite matrices, found NaN or infinite values",
        )
        radius = float(np.abs(np.linalg.eigvals(A)).max())
        require(
            radius <= 1 + 1e-9, f"A: expected a stable system, found an eigenvalue of size {radius:.6g}; stabilise it"
        )
        for name, matrix in (("A", A), ("B", B), ("C", C)):
            object.__setattr__(self, name, matrix)

    @property
    def order(self) -> int:
        """Number n of states."""
        return len(self.B)


@dataclass(frozen=True, eq=False)
class LiftedSystem:
    """A fast system seen once per frame, made by :func:`lift`.

    Parameters
    ----------
    fast : FastSystem
    timing : ExposureTiming
    A : ndarray, float64, shape (n, n)
        A_s, from the start of an exposure to the start of the next.
    B : ndarray, float64, shape (n, N)
        B_s.
    C : ndarray, float64, shape (n,)
        C_s, average output over the exposure.
    D : ndarray, float64, shape (N,)
        D_s.
    free : ndarray, float64, shape (N, n)
        Output at every fast step of the slow step for a state at its start.
    forced : ndarray, float64, shape (N, N)
        Output at every fast step for the inputs.
    Q : ndarray, float64, shape (n, n)
        Covariance of the disturbance between two exposures.

    Examples
    --------
    >>> timing = ExposureTiming(fast_period=1.0, exposure=2.0, readout=1.0, frame_period=3.0)
    >>> lifted = lift(FastSystem([[0.5]], [1.0], [1.0]), timing, [[0.1]])
    >>> lifted.path(np.array([1.0]), np.array([1.0, 0.0, 0.0]))
    array([1. , 1.5])
    >>> lifted.fast_output(Gaussian(np.ones(1), np.eye(1)), np.zeros(3))
    (array([1.  , 0.5 , 0.25]), array([1.    , 0.25  , 0.0625]))
    """

    fast: FastSystem
    timing: ExposureTiming
    A: Float64Array
    B: Float64Array
    C: Float64Array
    D: Float64Array
    free: Float64Array
    forced: Float64Array
    Q: Float64Array

    @property
    def order(self) -> int:
        """Number n of states."""
        return len(self.C)

    def path(self, mean: Float64Array, inputs: Float64Array) -> Float64Array:
        """Output ŷ at the fast steps of the exposure.

        Parameters
        ----------
        mean : ndarray, float64, shape (..., n)
            State at the start of the exposure.
        inputs : ndarray, float64, shape (..., N)
            u_s.

        Returns
        -------
        ndarray, float64, shape (..., N_e)
        """
        steps = self.timing.exposure_steps
        return mean @ self.free[:steps].T + inputs[..., :steps] @ self.forced[:steps, :steps].T

    def path_and_jacobian(self, mean: Float64Array, inputs: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Output ŷ at the fast steps of the exposure, and its derivative with respect to the state.

        Parameters
        ----------
        mean : ndarray, float64, shape (..., n)
            State at the start of the exposure.
        inputs : ndarray, float64, shape (..., N)
            u_s.

        Returns
        -------
        path : ndarray, float64, shape (..., N_e)
        jacobian : ndarray, float64, shape (..., N_e, n)
        """
        path, steps = self.path(mean, inputs), self.timing.exposure_steps
        return path, np.broadcast_to(self.free[:steps], (*path.shape, self.order))

    def advance(self, state: Gaussian, inputs: Float64Array) -> Gaussian:
        """From the start of an exposure to the start of the next.

        Parameters
        ----------
        state : Gaussian
            At the start of the exposure, shape (..., n).
        inputs : ndarray, float64, shape (..., N)
            u_s.

        Returns
        -------
        Gaussian
        """
        ahead = predict(state, self.A, self.Q)
        return Gaussian(ahead.mean + inputs @ self.B.T, ahead.cov)

    def fast_output(self, state: Gaussian, inputs: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Output at every fast step of the slow step: within the exposure and until the next one.

        Parameters
        ----------
        state : Gaussian
            At the start of the exposure, after its frame; shape (..., n).
        inputs : ndarray, float64, shape (..., N)
            u_s.

        Returns
        -------
        mean, variance : ndarray, float64, shape (..., N)
            The disturbance enters at the end of the step, so the variance is that of the state.
        """
        mean = state.mean @ self.free.T + inputs @ self.forced.T
        return mean, np.einsum("in,...nm,im->...i", self.free, state.cov, self.free)


def discretise(A: ArrayLike, B: ArrayLike, period: float) -> tuple[Float64Array, Float64Array]:
    """Discrete form of ``ẋ = A x + B u`` with the input held over each step (zero-order hold).

    Parameters
    ----------
    A : array_like, shape (n, n)
    B : array_like, shape (n,)
    period : float
        T_f, s.

    Returns
    -------
    A_f : ndarray, float64, shape (n, n)
    B_f : ndarray, float64, shape (n,)

    Raises
    ------
    ConfigurationError
        The period is not positive, shapes do not agree, or values are not finite.

    Examples
    --------
    >>> A_f, B_f = discretise([[0, 1], [-20, -30]], [0, 20], 1e-3)
    >>> A_f.round(4)
    array([[ 1.    ,  0.001 ],
           [-0.0197,  0.9704]])
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

    Parameters
    ----------
    fast : FastSystem
    timing : ExposureTiming
    Q : array_like, shape (n, n)
        Covariance of the disturbance that enters between two exposures.

    Returns
    -------
    LiftedSystem

    Raises
    ------
    ConfigurationError
        Q has the wrong shape, or the state cannot be seen in the average output of the exposures.

    Examples
    --------
    >>> timing = ExposureTiming(fast_period=1.0, exposure=2.0, readout=1.0, frame_period=3.0)
    >>> lifted = lift(FastSystem([[0.5]], [1.0], [1.0]), timing, [[0.1]])
    >>> lifted.A, lifted.B, lifted.C, lifted.D
    (array([[0.125]]), array([[0.25, 0.5 , 1.  ]]), array([0.75]), array([0.5, 0. , 0. ]))
    """
    steps, n = timing.frame_steps, fast.order
    noise = np.asarray(Q, np.float64)
    require(noise.shape == (n, n), f"Q: expected shape {(n, n)}, found {noise.shape}")
    reached = np.empty((steps, n))
    free = np.empty((steps, n))
    row, column = fast.C, fast.B
    for i in range(steps):
        free[i], reached[i] = row, column
        row, column = row @ fast.A, fast.A @ column
    pulse = np.concatenate([[fast.D], reached[:-1] @ fast.C])
    lag = np.subtract.outer(np.arange(steps), np.arange(steps))
    forced = np.where(lag >= 0, pulse[np.maximum(lag, 0)], 0.0)
    lifted = LiftedSystem(
        fast=fast,
        timing=timing,
        A=np.linalg.matrix_power(fast.A, steps),
        B=reached[::-1].T,
        C=free[: timing.exposure_steps].mean(0),
        D=forced[: timing.exposure_steps].mean(0),
        free=free,
        forced=forced,
        Q=noise,
    )
    if not is_observable(lifted.A, lifted.C):
        raise ConfigurationError(
            "system: expected a state that the mean outputs of the exposures show, found one they do not show "
            "(A_s, C_s not observable); change exposure or frame period"
        )
    return lifted


def is_observable(A: ArrayLike, C: ArrayLike) -> bool:
    """Whether the outputs C x, C A x, … tell the state (Popov, Belevitch & Hautus).

    An eigenvalue that is apart from the others needs an eigenvector that C shows; apart is meant relative to its
    size, so that modes which die out within a step are not confused with each other.  For the rest the rank of
    ``[λ I − A; C]`` decides.

    Parameters
    ----------
    A : array_like, shape (n, n)
    C : array_like, shape (n,) or (m, n)

    Returns
    -------
    bool

    Examples
    --------
    >>> is_observable([[0.5, 0.0], [0.0, 0.5]], [1.0, 1.0])
    False
    >>> is_observable([[1.0, 1.0], [0.0, 1.0]], [1.0, 0.0])
    True
    """
    A, C = np.asarray(A, np.float64), np.atleast_2d(np.asarray(C, np.float64))
    values, vectors = np.linalg.eig(A)
    strength = np.linalg.norm(C)
    for i, value in enumerate(values):
        others = np.delete(values, i)
        if (np.abs(others - value) > _APART * np.maximum(np.abs(others), abs(value))).all():
            shown = np.linalg.norm(C @ vectors[:, i])
        else:
            scale = max(float(np.abs(values).max()), 1e-300) / max(float(strength), 1e-300)
            stacked = np.concatenate([value * np.eye(len(A)) - A, scale * C]) / scale
            shown = np.linalg.svd(stacked, compute_uv=False)[-1]
        if shown <= _OBSERVABLE * strength:
            return False
    return True


def check_inputs(inputs: ArrayLike, steps: int) -> Float64Array:
    """Return the inputs of a slow step as a float64 array.

    Parameters
    ----------
    inputs : array_like, shape (..., N)
        u_s.
    steps : int
        N.

    Returns
    -------
    ndarray, float64, shape (..., N)

    Raises
    ------
    DataError
        Wrong number of inputs, or values that are not finite.

    Examples
    --------
    >>> check_inputs([0, 1], 2)
    array([0., 1.])
    """
    values = np.asarray(inputs, np.float64)
    if values.ndim < 1 or values.shape[-1] != steps or not np.isfinite(values).all():
        raise DataError(f"input: expected finite values of shape (..., {steps}), found shape {values.shape}")
    return values


def check_state(state: Gaussian, order: int) -> None:
    """Raise unless a state has as many components as the motion.

    Parameters
    ----------
    state : Gaussian
        Shape (..., n).
    order : int
        n.

    Raises
    ------
    DataError
        Another number of components.

    Examples
    --------
    >>> check_state(Gaussian(np.zeros(2), np.eye(2)), 2)
    """
    if state.mean.shape[-1] != order:
        raise DataError(f"state: expected a mean of shape (..., {order}), found {state.mean.shape}")

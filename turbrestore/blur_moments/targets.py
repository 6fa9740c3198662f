"""A target in the plane: its motion, and the Kalman filter on the moments of the frames that show it.

Both axes follow the same motion independently of each other, ``ẋ = A x + w`` with a random force w of the covariance
``q δ(t − s)``.

Symbols (paper 1, sections III to V, for two outputs)
-----------------------------------------------------
A, q : matrices of the motion of one axis in continuous time, method ``dynamics``.
Q : covariance that the random force adds in a frame period.
x, y : outputs, columns and rows.
z : state, that of x followed by that of y.
f_i : derivative of an output with respect to the state at fast step i of the exposure.
h(z) : moments of the frame of the orders (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), Legendre or monomial.
H, M : derivative of h, and its second derivatives, ``M = 2/N_e Σ f_i f_iᵀ`` for the second moments.
V, R : density of the pixel noise; covariance of the noise of the moments.

Departures from the papers
--------------------------
The papers use one axis.  Here the mixed moment (1, 1) joins two, which distinguishes a streak along one diagonal from
one along the other.  Paths are linear in the state and the moments of order 2 quadratic, so mean and covariance of
the predicted moments are exact: ``h(ẑ) + ½ tr M P`` and ``H P Hᵀ + ½ tr M P M P``.  The extended filter of the papers
omits the traces, which matters as long as the velocity is unknown.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, expm

from ..core.errors import DataError, require
from ..filtering.kalman import Gaussian, Innovation, update
from .moments import BASES, basis_change, basis_functions, kernel_relation
from .sensor import ExposureTiming, Float64Array, GaussianKernel, PixelGrid
from .state_estimation.lifting import FastSystem, LiftedSystem, lift

# (p, q) of the moments, x^p y^q; the path has one more, that of order 0.
_ORDERS = {1: ((1, 0), (0, 1)), 2: ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}


@dataclass(frozen=True)
class RandomWalk:
    """A target that performs a random walk."""

    diffusion: float  # growth of the variance of each coordinate, squared pixels per second

    def __post_init__(self) -> None:
        _check_positive(diffusion=self.diffusion)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of the position."""
        return np.zeros((1, 1)), np.array([[self.diffusion]])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance around the first centroid."""
        return np.array([[step**2]])

    def smear(self, exposure: float) -> float:
        """Variance of the path about its own mean: for a Brownian path a sixth of the variance gained."""
        return self.diffusion * exposure / 6


@dataclass(frozen=True)
class ConstantVelocity:
    """A target whose velocity changes little."""

    acceleration: float  # growth of the variance of each velocity, pixels² per second³

    def __post_init__(self) -> None:
        _check_positive(acceleration=self.acceleration)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of position and velocity."""
        return np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, self.acceleration])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance that covers all velocities compatible with the displacements."""
        return np.diag([step**2, (2 * step / frame_period) ** 2])

    def smear(self, exposure: float) -> float:
        """Variance that the random force adds within an exposure: negligible."""
        return 0.0


@dataclass(frozen=True)
class Oscillation:
    """A target that vibrates about a centre, which may drift."""

    frequency: float  # Hz; with ``highest`` the lower end of the range to search
    damping: float  # damping ratio, 0 to below 1
    drive: float  # growth of the variance of each velocity by the random force, pixels² per second³
    drift: float = 1e-4  # growth of the variance of the centre, squared pixels per second
    # Upper end of the range; the most likely frequency in the range is used. Above half the frame rate the centroids
    # are aliased, and the second moments tell the aliases apart.
    highest: float | None = None

    def __post_init__(self) -> None:
        _check_positive(frequency=self.frequency, drive=self.drive, drift=self.drift)
        require(0 <= self.damping < 1, f"damping: expected 0 to below 1, found {self.damping}")
        require(
            self.highest is None or self.frequency < self.highest < np.inf,
            f"highest: expected a frequency above {self.frequency:g} Hz, found {self.highest}",
        )

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of position, velocity and centre."""
        omega = 2 * np.pi * self.frequency
        A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * self.damping * omega, omega**2], [0.0, 0.0, 0.0]])
        return A, np.diag([0.0, self.drive, self.drift])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance of an oscillation of the size of the displacements, at any phase."""
        return np.diag([step**2, (2 * np.pi * self.frequency * step) ** 2, step**2])

    def smear(self, exposure: float) -> float:
        """Variance that the random force adds within an exposure: negligible."""
        return 0.0


TargetMotion = RandomWalk | ConstantVelocity | Oscillation


def lift_motion(motion: TargetMotion, timing: ExposureTiming) -> LiftedSystem:
    """Lift the motion of one axis to the rate of the frames.

    The output is taken in the middle of the fast steps. The random force of a frame period is added at its end, with
    the covariance ``∫ expm(A t) q expm(Aᵀ t) dt`` (Van Loan 1978).
    """
    A, intensity = motion.dynamics()
    n = len(A)
    joint = expm(np.block([[-A, intensity], [np.zeros((n, n)), A.T]]) * timing.frame_period)
    Q = joint[n:, n:].T @ joint[:n, n:]
    fast = FastSystem(expm(A * timing.fast_period), np.zeros(n), expm(A * timing.fast_period / 2)[0])
    return lift(fast, timing, 0.5 * (Q + Q.T))


@dataclass(frozen=True, eq=False)
class PlaneModel:
    """A motion that both axes follow independently, and the pixels that record it."""

    axis: LiftedSystem  # motion of one axis
    sigma: float  # σ of the round Gaussian image of the still target, pixels
    columns: PixelGrid
    rows: PixelGrid
    noise: float  # V, density of the white noise, above 0
    total: float = 1.0  # known total intensity of an exposure, above 0
    centre: tuple[float, float] = (0.0, 0.0)  # position of the origin of the pixels

    def __post_init__(self) -> None:
        _check_positive(noise=self.noise, total=self.total)

    def advance(self, state: Gaussian) -> Gaussian:
        """Predict the state, shape (n,), at the start of the next exposure."""
        A = block_diag(self.axis.A, self.axis.A)
        return Gaussian(A @ state.mean, A @ state.cov @ A.T + block_diag(self.axis.Q, self.axis.Q))

    def outputs(self, steps: int) -> Float64Array:
        """Return the derivatives of (x, y) with respect to the state at the first fast steps, shape (steps, 2, n)."""
        return np.asarray(np.kron(np.eye(2), self.axis.free[:steps, None, :]), np.float64)


@dataclass(frozen=True)
class PlaneMomentFilter:
    """Kalman filter on the moments of a frame, exact in the mean and covariance of the moments."""

    order: int = 2  # highest order: 1 is the linear Kalman filter on centroids
    basis: str = "legendre"

    def __post_init__(self) -> None:
        require(self.order in _ORDERS, f"order: expected 1 or 2, found {self.order}")
        require(self.basis in BASES, f"basis: expected one of {', '.join(BASES)}, found {self.basis!r}")

    def step(self, model: PlaneModel, state: Gaussian, frame: ArrayLike) -> tuple[Gaussian, Innovation]:
        """Correct the predicted state at the start of an exposure by its frame.

        ``frame`` (rows, columns).
        """
        measure, _, R = self._tables(model)
        image = np.asarray(frame, np.float64)
        shape = (model.rows.count, model.columns.count)
        if image.shape != shape or not np.isfinite(image).all():
            raise DataError(f"frame: expected finite values of shape {shape}, found shape {image.shape}")
        expected, H, spread = self.predicted(model, state)
        return update(state, measure @ image.ravel(), H, R + spread, expected)

    def predicted(self, model: PlaneModel, state: Gaussian) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Mean of the moments, their derivative, and the covariance that their curvature adds.

        Returns ``mean`` (m,), ``H`` (m, n), ``spread`` (m, m).
        """
        _, of_path, _ = self._tables(model)
        f = model.outputs(model.axis.timing.exposure_steps)
        x, y = (f @ state.mean - np.asarray(model.centre)).T
        fx, fy = f[:, 0], f[:, 1]
        steps, n = len(f), len(state.mean)
        raw = np.array([1.0, x.mean(), y.mean(), x @ x / steps, x @ y / steps, y @ y / steps])
        derivatives = [np.zeros(n), fx.sum(0), fy.sum(0), 2 * x @ fx, x @ fy + y @ fx, 2 * y @ fy]
        slope = np.stack(derivatives) / steps
        mixed = fx.T @ fy
        MP = np.stack([2 * fx.T @ fx, mixed + mixed.T, 2 * fy.T @ fy]) / steps @ state.cov
        raw[3:] += np.trace(MP, axis1=1, axis2=2) / 2
        curved = of_path[:, 3:]
        return of_path @ raw, of_path @ slope, curved @ (np.einsum("iab,jba->ij", MP, MP) / 2) @ curved.T

    def _tables(self, model: PlaneModel) -> tuple[Float64Array, Float64Array, Float64Array]:
        return _moment_tables(model.sigma, model.columns, model.rows, model.noise, model.total, self.order, self.basis)


@functools.lru_cache(maxsize=8)
def _moment_tables(
    sigma: float, columns: PixelGrid, rows: PixelGrid, noise: float, total: float, order: int, basis: str
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Matrices from pixels to moments, from raw moments of the path to moments, and covariance R of their noise."""
    p, q = np.transpose(_ORDERS[order])
    along_x, along_y = basis_functions(columns, order, basis), basis_functions(rows, order, basis)
    cell = columns.width * rows.width
    measure = (along_y.T[q][:, :, None] * along_x.T[p][:, None, :]).reshape(len(p), -1) * cell / total
    kernel = GaussianKernel(sigma)
    of_x, of_y = (basis_change(grid, 2, basis) @ kernel_relation(kernel, grid, 2) for grid in (columns, rows))
    i, j = np.transpose(((0, 0), *_ORDERS[2]))
    of_path = of_x[p[:, None], i] * of_y[q[:, None], j]
    return measure, of_path, noise / cell * measure @ measure.T


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        require(0 < value < np.inf, f"{name}: expected a number above 0, found {value}")

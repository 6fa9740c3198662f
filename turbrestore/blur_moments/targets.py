"""Tip-tilt: two linear motions behind a sensor of the plane, and the Kalman filter on the moments of its frames.

Symbols (paper 1, sections III to V, for two outputs)
-----------------------------------------------------
x, y : outputs, columns and rows.
z : state, that of x followed by that of y.
f_i : derivative of an output with respect to the state at fast step i of the exposure.
h(z) : moments of the frame, of the orders (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), Legendre or monomial.
H, M : derivative of h, and second derivatives, ``M = 2/N_e Σ f_i f_iᵀ`` for the second moments.
V, R : density of the pixel noise, covariance of the moments' noise.

Departures from the papers
--------------------------
The papers use one axis; here the mixed moment (1, 1) joins two, which is what tells a streak along one diagonal from
one along the other.  Paths are linear in the state and the moments of order 2 quadratic, so mean and variance of
the predicted moments are exact: ``h(ẑ) + ½ tr M P`` and ``H P Hᵀ + ½ tr M P M P``.  The extended filter of the papers
leaves the traces out, which matters as long as the velocity is unknown.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from ..core.errors import DataError, require
from ..filtering.kalman import Gaussian, Innovation, update
from .kernels import Float64Array, Kernel, PixelGrid, check_kernel
from .lifting import LiftedSystem
from .moment_algebra import compose_moments, plane_kernel_moments
from .moments import BASES, basis_change, basis_functions
from .sensor import ExposureTiming

# (p, q) of the moments, x^p y^q; the path has one more, that of order 0.
_ORDERS = {1: ((1, 0), (0, 1)), 2: ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}


@dataclass(frozen=True, eq=False)
class PlaneSensor:
    """Pixels in the plane that watch one target.

    Parameters
    ----------
    kernel : Kernel
        Of the plane.
    columns, rows : PixelGrid
    noise : float
        V, density of the white noise, above 0.
    total : float
        Total intensity of an exposure, known.

    Raises
    ------
    ConfigurationError
        Kernel of a line; noise or total not above 0.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import gaussian_kernel
    >>> PlaneSensor(gaussian_kernel([1.0, 1.0]), PixelGrid(-8, 8, 16), PixelGrid(-8, 8, 16), noise=0.01).total
    1.0
    """

    kernel: Kernel
    columns: PixelGrid
    rows: PixelGrid
    noise: float
    total: float = 1.0

    def __post_init__(self) -> None:
        check_kernel(self.kernel, 2)
        require(0 < self.noise < np.inf, f"noise: expected a density above 0, found {self.noise:g} (singular R)")
        require(0 < self.total < np.inf, f"total: expected an intensity above 0, found {self.total:g}")


@dataclass(frozen=True, eq=False)
class PlaneModel:
    """Two linear motions, one for each axis, and the sensor that watches them.

    Parameters
    ----------
    along_x, along_y : LiftedSystem
    sensor : PlaneSensor
    centre : tuple of two floats
        Where x = y = 0 of the sensor lies.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import gaussian_kernel
    >>> from turbrestore.blur_moments.lifting import FastSystem, lift
    >>> timing = ExposureTiming(fast_period=0.25, exposure=0.5, readout=0.0, frame_period=1.0)
    >>> motion = lift(FastSystem([[1.0]], [0.0], [1.0]), timing, [[0.1]])
    >>> pixels = PixelGrid(-8, 8, 16)
    >>> model = PlaneModel(motion, motion, PlaneSensor(gaussian_kernel([1.0, 1.0]), pixels, pixels, noise=0.01))
    >>> model.advance(Gaussian(np.zeros(2), np.eye(2))).cov
    array([[1.1, 0. ],
           [0. , 1.1]])
    """

    along_x: LiftedSystem
    along_y: LiftedSystem
    sensor: PlaneSensor
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def motion(self) -> PlaneModel:
        """Itself: what :func:`~turbrestore.blur_moments.observers.run_observer` asks for timing and advance."""
        return self

    @property
    def timing(self) -> ExposureTiming:
        """When the sensor looks."""
        return self.along_x.timing

    def advance(self, state: Gaussian, inputs: Float64Array | None = None) -> Gaussian:
        """From the start of an exposure to the start of the next.

        Parameters
        ----------
        state : Gaussian
            Shape (n,).
        inputs : None
            Not used: noise alone drives targets.

        Returns
        -------
        Gaussian
        """
        A = block_diag(self.along_x.A, self.along_y.A)
        return Gaussian(A @ state.mean, A @ state.cov @ A.T + block_diag(self.along_x.Q, self.along_y.Q))

    def outputs(self, steps: int) -> Float64Array:
        """Differentiate (x, y) with respect to the state at the first fast steps.

        Parameters
        ----------
        steps : int

        Returns
        -------
        ndarray, float64, shape (steps, 2, n)
        """
        n = self.along_x.order
        result = np.zeros((steps, 2, n + self.along_y.order))
        result[:, 0, :n] = self.along_x.free[:steps]
        result[:, 1, n:] = self.along_y.free[:steps]
        return result


@dataclass(frozen=True)
class PlaneMomentFilter:
    """Kalman filter on the moments of a frame of the plane, exact in the mean and variance of the moments.

    Parameters
    ----------
    order : {1, 2}
        Highest order: 1 is the linear Kalman filter on centroids.
    basis : {"legendre", "monomial"}

    Raises
    ------
    ConfigurationError
        Unknown order or basis.

    Examples
    --------
    >>> PlaneMomentFilter().order
    2
    """

    order: int = 2
    basis: str = "legendre"

    def __post_init__(self) -> None:
        require(self.order in _ORDERS, f"order: expected 1 or 2, found {self.order}")
        require(self.basis in BASES, f"basis: expected one of {', '.join(BASES)}, found {self.basis!r}")

    def step(
        self, model: PlaneModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike | None = None
    ) -> tuple[Gaussian, Innovation]:
        """Correct the state at the start of an exposure by its frame.

        Parameters
        ----------
        model : PlaneModel
        state : Gaussian
            Prediction, shape (n,).
        frame : array_like, shape (rows, columns)
            Without background.
        inputs : None
            Taken for the sake of the common interface: targets are driven by noise alone.

        Returns
        -------
        state : Gaussian
        innovation : Innovation

        Raises
        ------
        DataError
            Shapes do not agree or values are not finite.
        """
        measure, _, R = _moment_tables(model.sensor, self.order, self.basis)
        image = np.asarray(frame, np.float64)
        shape = (model.sensor.rows.count, model.sensor.columns.count)
        if image.shape != shape or not np.isfinite(image).all():
            raise DataError(f"frame: expected finite values of shape {shape}, found shape {image.shape}")
        expected, H, spread = self.predicted(model, state)
        return update(state, measure @ image.ravel(), H, R + spread, expected)

    def predicted(self, model: PlaneModel, state: Gaussian) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Mean of the moments, their derivative, and the covariance that their curvature adds.

        Parameters
        ----------
        model : PlaneModel
        state : Gaussian
            Shape (n,).

        Returns
        -------
        mean : ndarray, float64, shape (m,)
        H : ndarray, float64, shape (m, n)
        spread : ndarray, float64, shape (m, m)
        """
        _, of_path, _ = _moment_tables(model.sensor, self.order, self.basis)
        f = model.outputs(model.timing.exposure_steps)
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


@functools.lru_cache(maxsize=8)
def _moment_tables(sensor: PlaneSensor, order: int, basis: str) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Matrices from pixels to moments, from raw moments of the path to moments, and covariance R of their noise."""
    grids = (sensor.columns, sensor.rows)
    p, q = np.transpose(_ORDERS[order])
    along_x, along_y = (basis_functions(grid, order, basis) for grid in grids)
    cell = sensor.columns.width * sensor.rows.width
    measure = (along_y.T[q][:, :, None] * along_x.T[p][:, None, :]).reshape(len(p), -1) * cell / sensor.total
    raw = np.zeros((6, 3, 3))
    for index, entry in enumerate(((0, 0), *_ORDERS[2])):
        raw[index][entry] = 1.0
    kernel = plane_kernel_moments(sensor.kernel, 2, *grids)
    change = [basis_change(grid, 2, basis) for grid in grids]
    of_path = (change[0] @ compose_moments(raw, kernel, dimensions=2) @ change[1].T)[:, p, q].T
    return measure, of_path, sensor.noise / cell * measure @ measure.T

"""A motion and the sensor that watches it, and the moments that they lead one to expect.

Symbols (paper 1, section V; paper 2, section IV)
-------------------------------------------------
x̂ : state at the start of an exposure.
h, H : moments that a state leads to and their derivative, :func:`predicted_moments`.
V, R : density of the pixel noise, covariance of the moments' noise.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..core.errors import require
from ..filtering.kalman import Gaussian
from .exposure_table import ExposureTable, tabulate
from .kernels import Float64Array
from .moment_algebra import compose_moments, kernel_moments, path_moments, powers
from .moments import basis_change, basis_functions, moment_noise
from .sensor import ExposureTiming, LineSensor


class Motion(Protocol):
    """What an observer needs to know of a system: a :class:`~.lifted.LiftedSystem` or one like it."""

    @property
    def order(self) -> int:
        """Number n of states."""
        ...

    @property
    def timing(self) -> ExposureTiming:
        """When the sensor looks."""
        ...

    def path(self, mean: Float64Array, inputs: Float64Array) -> Float64Array:
        """Output at the fast steps of the exposure."""
        ...

    def path_and_jacobian(self, mean: Float64Array, inputs: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Output at the fast steps of the exposure, and its derivative."""
        ...

    def advance(self, state: Gaussian, inputs: Float64Array) -> Gaussian:
        """From the start of an exposure to the start of the next."""
        ...

    def fast_output(self, state: Gaussian, inputs: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Mean and variance of the output at every fast step until the next exposure."""
        ...


@dataclass(frozen=True, eq=False)
class BlurModel:
    """A motion and the sensor that watches it.

    Parameters
    ----------
    motion : Motion
    sensor : LineSensor

    Examples
    --------
    >>> from turbrestore.blur_moments.experiments.scenarios import wavefront_model
    >>> wavefront_model().motion.order
    2
    """

    motion: Motion
    sensor: LineSensor

    @functools.cached_property
    def table(self) -> ExposureTable:
        """Exposure operator of the sensor as a table."""
        return tabulate(self.sensor)


def predicted_moments(
    model: BlurModel,
    mean: Float64Array,
    inputs: Float64Array,
    orders: tuple[int, ...],
    basis: str = "monomial",
    table: ExposureTable | None = None,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Moments h(x̂) that a state leads to, their derivative, and the covariance of their noise.

    Parameters
    ----------
    model : BlurModel
    mean : ndarray, float64, shape (..., n)
        State at the start of the exposure.
    inputs : ndarray, float64, shape (..., N)
    orders : tuple of int
        Which moments.
    basis : {"monomial", "legendre"}
    table : ExposureTable, optional
        Moments of the image as it falls on the pixels. Without it they follow from those of path and kernel by the
        binomial relation, and nothing falls beside.

    Returns
    -------
    moments : ndarray, float64, shape (..., m)
    H : ndarray, float64, shape (..., m, n)
    R : ndarray, float64, shape (m, m) or (..., m, m)

    Raises
    ------
    ConfigurationError
        As many moments as pixels: R would be singular.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.kernels import PixelGrid, gaussian_kernel
    >>> from turbrestore.blur_moments.lifting import FastSystem, lift
    >>> timing = ExposureTiming(fast_period=1.0, exposure=2.0, readout=0.0, frame_period=2.0)
    >>> motion = lift(FastSystem([[0.5]], [1.0], [1.0]), timing, [[0.1]])
    >>> sensor = LineSensor(gaussian_kernel(0.1), PixelGrid(-1.0, 1.0, 20, integrating=False), noise=0.1)
    >>> h, H, _ = predicted_moments(BlurModel(motion, sensor), np.array([0.4]), np.zeros(2), (1, 2))
    >>> h.round(3), H.round(3)
    (array([0.3 , 0.11]), array([[0.75],
           [0.5 ]]))
    """
    sensor, order, chosen = model.sensor, max(orders), list(orders)
    count = sensor.pixels.count
    require(order < count, f"orders: expected below the number of pixels, {count}, found {order} (singular R)")
    path, slopes = model.motion.path_and_jacobian(mean, inputs)
    image = None
    if table is None:
        # Powers of the path, then their time averages, then kernel and basis, both of which act linearly.
        of_path = np.arange(1, order + 1)[:, None] * (powers(path, order - 1) @ slopes) / path.shape[-1]
        change = basis_change(sensor.pixels, order, basis) @ _kernel_relation(sensor, order)
        moments = path_moments(path, order) @ change.T
        H = change[:, 1:] @ of_path
    else:
        image, derivative = table.image_and_jacobian(path, slopes)
        weights = basis_functions(sensor.pixels, order, basis) * sensor.pixels.width / sensor.total
        moments, H = image @ weights, np.swapaxes(derivative @ weights, -1, -2)
    if sensor.photons is not None and image is None:
        image = model.table.image(path)
    R = moment_noise(sensor.pixels, order, sensor.noise, basis, image, sensor.photons) / sensor.total**2
    return moments[..., chosen], H[..., chosen, :], R[..., chosen, :][..., chosen]


def _kernel_relation(sensor: LineSensor, order: int) -> Float64Array:
    """Matrix from path moments to image moments, order 0 included."""
    kernel = kernel_moments(sensor.kernel, order, sensor.pixels)
    return compose_moments(np.eye(order + 1), kernel).T

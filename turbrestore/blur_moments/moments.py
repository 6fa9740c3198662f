"""Moments of images: what they measure, how noisy they are, and what a model of the motion predicts for them.

Symbols (paper 1, eqs. 7 to 11; paper 2, eqs. 2 to 4)
-----------------------------------------------------
y^(p) : raw moment ``∫ η^p Y dη / T_e`` of the image, :func:`image_moments`.
y_δ^(p), y_Ψ^(p) : time average of y^p over the exposure; raw moment of the kernel.
x̂ : state at the start of an exposure.
h, H : predicted moments and their derivative with respect to the state, :func:`predicted_moments`.
V, R : density of the pixel noise; covariance of the noise of the moments, :func:`moment_noise`.

Departures from the papers
--------------------------
The denominator of a moment is the known total intensity, not the measured one of paper 1, eq. 7: under strong noise the
measured total can be near zero or negative, and the ratio has no useful variance.

The binomial relation ``y^(p) = Σ_i binom(p, i) y_Ψ^(p−i) y_δ^(i)`` (paper 2, eq. 3) holds for *raw* moments on both
sides.  Equation 4 of paper 2 centres the kernel at η₀ but not the image, which loses the offset; it is not used.

The Legendre basis is monic and belongs to the interval of the pixels; on [−1, 1] its second moment is
``y^(2) − y^(0) / 3``.  Under white noise its moments are uncorrelated and have the least variance of all bases of
that order: 8V/45 for the second, against 2V/5 for y^(2).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import comb

from ..core.errors import ConfigurationError, DataError, require
from ..filtering.estimates import Gaussian
from .sensor import ExposureTable, Float64Array, GaussianKernel, LineSensor, PixelGrid, tabulate
from .state_estimation.augmented import OscillatorMotion
from .state_estimation.lifting import LiftedSystem

BASES = ("monomial", "legendre")
Motion = LiftedSystem | OscillatorMotion


@dataclass(frozen=True, eq=False)
class BlurModel:
    """A motion and the sensor that records it."""

    motion: Motion
    sensor: LineSensor

    @functools.cached_property
    def table(self) -> ExposureTable:
        """Exposure operator of the sensor as a table."""
        return tabulate(self.sensor)

    def image_and_jacobian(self, mean: Float64Array, inputs: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Predict the image from a state.

        ``mean`` (..., n); ``inputs`` (..., N); returns ``image`` (..., count), ``derivative`` (..., n, count).
        """
        return self.table.image_and_jacobian(*self.motion.path_and_jacobian(mean, inputs))

    def check_inputs(self, state: Gaussian, inputs: ArrayLike) -> Float64Array:
        """Return the inputs of a frame period as float64, after checking that state and inputs belong to the motion."""
        order, steps = self.motion.order, self.motion.timing.frame_steps
        if state.mean.shape[-1] != order:
            raise DataError(f"state: expected a mean of shape (..., {order}), found {state.mean.shape}")
        values = np.asarray(inputs, np.float64)
        if values.ndim < 1 or values.shape[-1] != steps or not np.isfinite(values).all():
            raise DataError(f"input: expected finite values of shape (..., {steps}), found shape {values.shape}")
        return values


def predicted_moments(
    model: BlurModel, mean: Float64Array, inputs: Float64Array, orders: tuple[int, ...], basis: str = "monomial"
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Predict the moments h(x̂) from a state, with their derivative and the covariance of their noise.

    They follow from the moments of path and kernel by the binomial relation, as if all light fell on the pixels.
    ``mean`` (..., n); ``inputs`` (..., N); returns ``moments`` (..., m), ``H`` (..., m, n), ``R`` (m, m).
    """
    sensor, order, chosen = model.sensor, max(orders), list(orders)
    pixels = sensor.pixels
    require(
        order < pixels.count, f"orders: expected below the number of pixels, {pixels.count}, found {order} (singular R)"
    )
    path, slopes = model.motion.path_and_jacobian(mean, inputs)
    powers = _powers(path, order)
    change = basis_change(pixels, order, basis) @ kernel_relation(sensor.kernel, pixels, order)
    moments = powers.mean(-1) @ change.T
    H = change[:, 1:] @ (np.arange(1, order + 1)[:, None] * (powers[..., :-1, :] @ slopes) / path.shape[-1])
    R = moment_noise(pixels, order, sensor.noise, basis) / sensor.total**2
    return moments[..., chosen], H[..., chosen, :], R[chosen][:, chosen]


def image_moments(
    image: ArrayLike, pixels: PixelGrid, order: int, basis: str = "monomial", total: float = 1.0
) -> Float64Array:
    """Moments of images of a line.

    ``image`` (..., count); returns (..., order + 1).
    """
    values = np.asarray(image, np.float64)
    if values.ndim < 1 or values.shape[-1] != pixels.count or not np.isfinite(values).all():
        raise DataError(f"image: expected finite values of shape (..., {pixels.count}), found shape {values.shape}")
    require(0 < total < np.inf, f"total: expected an intensity above 0, found {total:g}")
    return values @ basis_functions(pixels, order, basis) * pixels.width / total


def moment_noise(pixels: PixelGrid, order: int, density: float, basis: str = "monomial") -> Float64Array:
    """Covariance of the noise of the moments, ``V ∫ b_p b_q dη``.

    On [−1, 1] with fine pixels: 2V, 2V/3 and 2V/5 for orders 0, 1, 2; 2V/3 between 0 and 2; 0 between 1 and 2. Paper 1,
    eq. 11, in the text available, has 3V for the second.
    Returns (order + 1, order + 1).
    """
    require(0 <= density < np.inf, f"density: expected noise of at least 0, found {density:g}")
    functions = basis_functions(pixels, order, basis)
    return density * pixels.width * functions.T @ functions


def kernel_relation(kernel: GaussianKernel, pixels: PixelGrid, order: int) -> Float64Array:
    """Matrix from the moments of a path to those of its image: the binomial relation (paper 2, eq. 3).

    The moments of kernel and pixel are those of offset, Gaussian and pixel one after the other; an integrating pixel of
    width Δ adds Δ²/12 to the variance.
    Returns (order + 1, order + 1).
    """
    p = _orders(order)
    odd_product = np.array([np.prod(np.arange(k - 1, 0, -2, dtype=np.float64)) for k in p])
    gaussian = np.where(p % 2 == 0, kernel.sigma**p * odd_product, 0.0)
    relation = _binomial_matrix(kernel.offset**p) @ _binomial_matrix(gaussian)
    if pixels.integrating:
        relation = relation @ _binomial_matrix(np.where(p % 2 == 0, (pixels.width / 2) ** p / (p + 1), 0.0))
    return relation


def basis_functions(pixels: PixelGrid, order: int, basis: str = "monomial") -> Float64Array:
    """Functions on which images are projected, at the centres of the pixels.

    Returns (count, order + 1).
    """
    return pixels.centres[:, None] ** _orders(order) @ basis_change(pixels, order, basis).T


def basis_change(pixels: PixelGrid, order: int, basis: str) -> Float64Array:
    """Matrix from monomial moments to those of another basis.

    Returns (order + 1, order + 1).
    """
    if basis not in BASES:
        raise ConfigurationError(f"basis: expected one of {', '.join(BASES)}, found {basis!r}")
    size = len(_orders(order))
    if basis == "monomial":
        return np.eye(size)
    middle, half = (pixels.start + pixels.stop) / 2, (pixels.stop - pixels.start) / 2
    matrix = np.zeros((size, size))
    matrix[0, 0] = 1.0
    for n in range(size - 1):
        # Bonnet's recursion for the monic polynomials of the interval.
        matrix[n + 1, 1:] = matrix[n, :-1]
        matrix[n + 1] -= middle * matrix[n] + half**2 * n**2 / (4 * n**2 - 1) * matrix[n - 1]
    return matrix


def _orders(order: int) -> np.ndarray:
    require(order >= 0, f"order: expected at least 0, found {order}")
    return np.arange(order + 1)


def _powers(values: Float64Array, order: int) -> Float64Array:
    """Powers 0 … order, shape (..., order + 1, N_e); repeated products are many times faster than ``**``."""
    result = np.ones((*values.shape[:-1], order + 1, values.shape[-1]))
    for p in range(order):
        result[..., p + 1, :] = result[..., p, :] * values
    return result


def _binomial_matrix(moments: Float64Array) -> Float64Array:
    """Matrix that adds an independent position with these raw moments: entry (p, i) is binom(p, i) m_(p−i)."""
    p = np.arange(len(moments))
    lag = np.subtract.outer(p, p)
    return comb(p[:, None], p) * np.where(lag >= 0, moments[np.maximum(lag, 0)], 0.0)

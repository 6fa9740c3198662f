"""Posterior Cramér–Rao bounds: what no observer of moments, or of the whole image, can beat.

Symbols (Tichavský, Muravchik & Nehorai, 1998)
----------------------------------------------
J : Bayesian information about the state; J⁻¹ bounds the mean squared error of any estimate.
A_s, Q : motion from one exposure to the next, and its disturbance.

For a linear motion with Gaussian disturbance ``J⁺ = (Q + A_s J⁻¹ A_sᵀ)⁻¹ + E[Hᵀ R⁻¹ H]``, where the expectation is over
the states that occur, H being the derivative of what is measured at the true state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DataError
from ..blur_model import BlurModel, predicted_moments
from ..kernels import Float64Array
from ..sensor import noise_variance


def moment_information(
    model: BlurModel,
    states: ArrayLike,
    inputs: ArrayLike,
    orders: tuple[int, ...],
    basis: str = "monomial",
) -> Float64Array:
    """Information that moments of a frame carry about the state.

    Parameters
    ----------
    model : BlurModel
    states : array_like, shape (..., n)
        At the start of the exposure.
    inputs : array_like, shape (..., N)
    orders : tuple of int
        Which moments.
    basis : {"monomial", "legendre"}

    Returns
    -------
    ndarray, float64, shape (..., n, n)
        ``Hᵀ R⁻¹ H``.

    Examples
    --------
    >>> from turbrestore.blur_moments.experiments.scenarios import wavefront_model
    >>> moment_information(wavefront_model(), np.zeros(2), np.zeros(200), (1,)).shape
    (2, 2)
    """
    _, H, R = predicted_moments(model, np.asarray(states, np.float64), np.asarray(inputs, np.float64), orders, basis)
    return np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H)


def image_information(model: BlurModel, states: ArrayLike, inputs: ArrayLike) -> Float64Array:
    """Information that the whole frame carries about the state.

    Parameters
    ----------
    model : BlurModel
    states : array_like, shape (..., n)
        At the start of the exposure.
    inputs : array_like, shape (..., N)

    Returns
    -------
    ndarray, float64, shape (..., n, n)

    Examples
    --------
    >>> from turbrestore.blur_moments.experiments.scenarios import wavefront_model
    >>> first = moment_information(wavefront_model(), np.zeros(2), np.zeros(200), (1,))
    >>> bool(np.trace(image_information(wavefront_model(), np.zeros(2), np.zeros(200))) > 10 * np.trace(first))
    True
    """
    sensor = model.sensor
    path, slopes = model.motion.path_and_jacobian(np.asarray(states, np.float64), np.asarray(inputs, np.float64))
    image, derivative = model.table.image_and_jacobian(path, slopes)
    variance = noise_variance(image, sensor.pixels.width, sensor.noise, sensor.photons)
    return (derivative / variance[..., None, :]) @ np.swapaxes(derivative, -1, -2)


def posterior_bound(A: ArrayLike, Q: ArrayLike, start: ArrayLike, information: ArrayLike) -> Float64Array:
    """Bound on the covariance of the estimation error after every frame.

    Parameters
    ----------
    A, Q : array_like, shape (n, n)
        Motion from one exposure to the next, covariance of its disturbance.
    start : array_like, shape (n, n)
        Covariance of the state before the first frame.
    information : array_like, shape (T, n, n)
        Mean information of every frame.

    Returns
    -------
    ndarray, float64, shape (T, n, n)

    Raises
    ------
    DataError
        The prediction has a singular covariance.

    Examples
    --------
    >>> posterior_bound([[1.0]], [[0.5]], [[1.0]], [[[1.0]], [[1.0]]])
    array([[[0.5]],
    <BLANKLINE>
           [[0.5]]])
    """
    A, Q = np.asarray(A, np.float64), np.asarray(Q, np.float64)
    before, bounds = np.asarray(start, np.float64), []
    for gained in np.asarray(information, np.float64):
        try:
            after = np.linalg.inv(np.linalg.inv(before) + gained)
        except np.linalg.LinAlgError as error:
            raise DataError("start: expected covariances that can be inverted, found a singular one") from error
        bounds.append(after)
        before = A @ after @ A.T + Q
    return np.array(bounds)

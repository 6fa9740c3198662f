"""Posterior Cramér–Rao bounds: limits for every observer of moments, or of the whole image.

Symbols (Tichavský, Muravchik & Nehorai, 1998)
----------------------------------------------
J : Bayesian information about the state; J⁻¹ bounds the mean squared error of any estimate.
A_s, Q : motion from one exposure to the next, and covariance of its disturbance.

For a linear motion with Gaussian disturbance ``J⁺ = (Q + A_s J⁻¹ A_sᵀ)⁻¹ + E[Hᵀ R⁻¹ H]``, where the expectation is over
the states that occur, and H is the derivative of the measurement at the true state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DataError
from ..moments import BlurModel, predicted_moments
from ..sensor import Float64Array
from ..state_estimation.lifting import LiftedSystem
from .scenarios import Recording


def moment_information(
    model: BlurModel, states: Float64Array, inputs: Float64Array, orders: tuple[int, ...]
) -> Float64Array:
    """Information that Legendre moments of a frame carry about the state, ``Hᵀ R⁻¹ H``."""
    _, H, R = predicted_moments(model, states, inputs, orders, "legendre")
    return np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H)


def image_information(model: BlurModel, states: Float64Array, inputs: Float64Array) -> Float64Array:
    """Information that the whole frame carries about the state."""
    _, derivative = model.image_and_jacobian(states, inputs)
    scaled = derivative / model.sensor.deviation
    return scaled @ np.swapaxes(scaled, -1, -2)


def posterior_bound(A: Float64Array, Q: Float64Array, start: Float64Array, information: ArrayLike) -> Float64Array:
    """Bound on the covariance of the estimation error after every frame.

    ``A, Q`` (n, n); ``start`` (n, n); ``information`` (T, n, n); returns (T, n, n).
    """
    before, bounds = start, []
    for gained in np.asarray(information, np.float64):
        try:
            after = np.linalg.inv(np.linalg.inv(before) + gained)
        except np.linalg.LinAlgError as error:
            raise DataError("start: expected covariances that can be inverted, found a singular one") from error
        bounds.append(after)
        before = A @ after @ A.T + Q
    return np.array(bounds)


def recorded_information(model: BlurModel, recording: Recording) -> dict[str, Float64Array]:
    """Information of every frame about the states of a known motion, mean over the seeds, by what is measured."""
    states, inputs = recording.states[..., : model.motion.order], recording.inputs
    return {
        "moments": moment_information(model, states, inputs, (1, 2)).mean(1),
        "moments_1_to_4": moment_information(model, states, inputs, (1, 2, 3, 4)).mean(1),
        "image": image_information(model, states, inputs).mean(1),
    }


def error_bound(model: BlurModel, cov: Float64Array, information: ArrayLike, burn_in: int, of_state: bool) -> float:
    """Bound on the root mean square error of the state, or of the output within the exposure, after the burn-in."""
    motion = model.motion
    assert isinstance(motion, LiftedSystem)
    covariances = posterior_bound(motion.A, motion.Q, cov, information)[burn_in:]
    free = motion.free[: motion.timing.exposure_steps]
    weight = np.eye(motion.order) if of_state else free.T @ free / len(free)
    return float(np.sqrt(np.einsum("ab,tba->t", weight, covariances).mean()))

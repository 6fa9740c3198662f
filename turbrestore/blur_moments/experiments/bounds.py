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

from ..moments import BlurModel, predicted_moments
from ..sensor import Float64Array
from ..state_estimation.lifting import LiftedSystem

MOMENTS = {"moments": (1, 2), "moments_1_to_4": (1, 2, 3, 4)}


def information(model: BlurModel, states: Float64Array, inputs: Float64Array) -> dict[str, Float64Array]:
    """Information ``Hᵀ R⁻¹ H`` of a frame about the state, by what is measured: two or four moments, or the image.

    ``states`` (..., n); ``inputs`` (..., N); returns (..., n, n) each.
    """
    found = {}
    for name, orders in MOMENTS.items():
        _, H, R = predicted_moments(model, states, inputs, orders, "legendre")
        found[name] = np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H)
    _, derivative = model.image_and_jacobian(states, inputs)
    scaled = derivative / model.sensor.deviation
    return {**found, "image": scaled @ np.swapaxes(scaled, -1, -2)}


def posterior_bound(A: Float64Array, Q: Float64Array, start: Float64Array, gained: Float64Array) -> Float64Array:
    """Bound on the covariance of the estimation error after every frame.

    ``A, Q, start`` (n, n); ``gained`` (T, n, n), the information of the frames; returns (T, n, n).
    """
    before, bounds = start, []
    for frame in gained:
        after = np.linalg.inv(np.linalg.inv(before) + frame)
        bounds.append(after)
        before = A @ after @ A.T + Q
    return np.array(bounds)


def error_bound(motion: LiftedSystem, start: Float64Array, gained: Float64Array, burn_in: int, of_state: bool) -> float:
    """Bound on the root mean square error of the state, or of the output within the exposure, after the burn-in."""
    covariances = posterior_bound(motion.A, motion.Q, start, gained)[burn_in:]
    free = motion.free[: motion.timing.exposure_steps]
    weight = np.eye(motion.order) if of_state else free.T @ free / len(free)
    return float(np.sqrt(np.einsum("ab,tba->t", weight, covariances).mean()))

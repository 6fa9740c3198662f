"""The state of the flow: its prediction, and its update by a measured flow (paper 3, section 4).

::

    ξ̂ ← A ξ̂                                                   (14b)
    P ← A P Aᵀ + Q                                            (14d)
    W^meas = W̄ + C ξ + r,  r ~ N(0, R)                        (17)
    ξ̂ ← ξ̂ + M (W^meas − W̄ − C ξ̂),  P ← (I − M C) P            (18, 19)
    M = P Cᵀ (C P Cᵀ + R)⁻¹                                   (18)
    M = (CᵀR⁻¹C + P⁻¹)⁻¹ CᵀR⁻¹                                (19)

Symbols
-------
ξ̂, P : mean and covariance of the state
A, C, Q, R, W̄ : flow model of :mod:`turbrestore.dynamics.flow_model`
W^meas : flow measured from the image to a frame, :mod:`turbrestore.filtering.frame_pass`
M : gain

The paper measures the flow by C ξ alone (17); here W̄ is added, as the states are identified around the mean flow.
(18) and (19) are the same gain.  As CᵀC = I and R is one number, (19) reads ``M = (I/R + P⁻¹)⁻¹ Cᵀ/R``: a measured flow
enters the update only through ``z = Cᵀ(W^meas − W̄)``, which is a measurement of ξ itself with noise R I.  So each flow
is projected once, which is the expensive part and needs no state, and predictions and updates have the size n.
"""

from __future__ import annotations

import numpy as np

from ..dynamics.flow_model import FlowDynamics, ProjectedFlow
from .estimates import Gaussian
from .kalman import predict, update

# Smallest variance of the flow, so that noise-free synthetic data keep every gain defined: (0.001 px)².
_FLOW_NOISE_FLOOR = 1e-6


def flow_noise(dynamics: FlowDynamics) -> float:
    """R, squared pixels, with a floor for flows that lie in the subspace of the model as a whole."""
    return max(dynamics.R, _FLOW_NOISE_FLOOR)


def advance_flow_state(
    state: Gaussian, measured: ProjectedFlow | None, dynamics: FlowDynamics
) -> tuple[Gaussian, float]:
    """Predict the state one frame ahead, and update it by a measured flow if there is one.

    Returns the state, and the root mean square of W^meas − W̄ − C ξ̂ before the update, pixels; NaN without a flow.
    """
    predicted = predict(state, dynamics.A, dynamics.Q)  # (14b), (14d)
    return (predicted, np.nan) if measured is None else update_flow_state(predicted, measured, dynamics)


def update_flow_state(predicted: Gaussian, measured: ProjectedFlow, dynamics: FlowDynamics) -> tuple[Gaussian, float]:
    """Update the predicted state by a measured flow (17, 19); returns what :func:`advance_flow_state` does."""
    # Cᵀ(W^meas − W̄) = ξ + noise of covariance R I, by CᵀC = I.
    state = update(predicted, measured.state, np.eye(len(measured.state)), flow_noise(dynamics))
    # |W − W̄ − C ξ̂|² without the product C ξ̂.
    squared = measured.squared - float(predicted.mean @ (2 * measured.state - predicted.mean))
    return state, (max(squared, 0.0) / measured.size) ** 0.5

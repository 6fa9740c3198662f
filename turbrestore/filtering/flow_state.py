"""Flow update of the alternating filter (paper 3, eqs. 14b, 14d, 17 and 19).

Symbols
-------
ξ̂, P : state of the flow and its covariance, :class:`turbrestore.filtering.kalman.Gaussian`
A, C, Q, R, W̄ : flow model of :mod:`turbrestore.dynamics.flow_model` (eqs. 10, 13b)
W^meas : measured flow (eq. 17)
M : gain (eq. 19)
z : Cᵀ(W^meas − W̄)

As CᵀC = I and R is one number, (19) reads ``M = (I/R + P⁻¹)⁻¹ Cᵀ/R``: a measured flow enters the update only through
z, which is a measurement of ξ itself with noise R I.  So each flow is projected once, which is the expensive part and
needs no state, and predictions and updates have the size n.  Eqs. 14 and 19 themselves are in :mod:`.kalman`.

The paper measures the flow by C ξ alone (eq. 17); here ``W^meas = W̄ + C ξ + r``, as the states are identified around
the mean flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import FloatArray
from ..dynamics.flow_model import Float64Array, FlowDynamics, project_deviation
from .kalman import Gaussian, predict, update_information

# Smallest variance of the flow, so that noise-free synthetic data keep every gain defined: (0.001 px)².
_FLOW_NOISE_FLOOR = 1e-6


@dataclass(frozen=True, eq=False)
class ProjectedFlow:
    """A measured flow, as far as the update of the state needs it."""

    state: Float64Array  # (n,): z
    squared: float  # sum of squares of W^meas − W̄, squared pixels
    size: int  # components of the flow, 2 H W


def project_measured(measured: FloatArray, dynamics: FlowDynamics) -> ProjectedFlow:
    """Project a measured flow on the subspace of the model.

    ``measured`` (H, W, 2).
    """
    deviation = measured - dynamics.mean_flow
    state = project_deviation(dynamics, deviation)
    return ProjectedFlow(state, float(np.square(deviation, out=deviation).sum(dtype=np.float64)), deviation.size)


def flow_noise(dynamics: FlowDynamics) -> float:
    """R, squared pixels, with a floor for flows that lie in the subspace of the model as a whole."""
    return max(dynamics.R, _FLOW_NOISE_FLOOR)


def predict_state(state: Gaussian, dynamics: FlowDynamics) -> Gaussian:
    """Predict the state of the flow one frame ahead (paper 3, eqs. 14b and 14d)."""
    return predict(state, dynamics.A, dynamics.Q)


def update_state(predicted: Gaussian, measured: ProjectedFlow, dynamics: FlowDynamics) -> tuple[Gaussian, float]:
    """Update the state of the flow by a measured flow (paper 3, eqs. 17 and 19)."""
    # Cᵀ(W^meas − W̄) = ξ + noise of covariance R I, by CᵀC = I.
    state, _ = update_information(predicted, measured.state, np.eye(len(measured.state)), flow_noise(dynamics))
    # |W − W̄ − C ξ̂|² without the product C ξ̂.
    squared = measured.squared - float(predicted.mean @ (2 * measured.state - predicted.mean))
    return state, (max(squared, 0.0) / measured.size) ** 0.5

"""One-step prediction of the flow, and how its error depends on τ and n (paper 3, Figures 7 and 8).

Symbols as in :mod:`turbrestore.dynamics.flow_model`: τ flows train n states, and the flow after W_k is predicted as
``Ŵ_{k+1} = W̄ + C A Cᵀ (W_k − W̄)``.

The paper shows the eigenvalues of A for several τ and n, and one predicted frame.  Eigenvalues alone do not tell a good
model from one that repeats its training flows; the error on flows that have not trained does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import iter_frames
from .dynamic_texture import DynamicsParams, identify
from .flow_model import Float64Array, FlowDynamics, project_deviation

# Share of the flows, the last ones, that no model is trained on, chosen.
_HELD_OUT = 0.25
# Training lengths and numbers of states that are compared, as shares of the largest, chosen.
_LENGTHS, _RANKS = (1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0), (1 / 8, 1 / 4, 1 / 2, 1.0)


@dataclass(frozen=True, eq=False)
class PredictionStudy:
    """Models of several τ and n, and how well they predict the same flows, which none of them was trained on."""

    lengths: NDArray[np.int64]  # (a,): τ; the flows right before the predicted ones train
    ranks: NDArray[np.int64]  # (b,): n
    # (a, b): root mean square error of the predicted flow, pixels for each component; NaN where n ≥ τ.
    errors: Float64Array
    eigenvalues: tuple[tuple[NDArray[np.complex128], ...], ...]  # of A, by τ and n; none where n ≥ τ
    # Errors of repeating the flow before, and of the mean of all training flows, pixels.
    repeated: float
    mean: float
    count: int  # number of predicted flows


def study_prediction(
    flows: ArrayLike, params: DynamicsParams | None = None, runtime: Runtime = DEFAULT
) -> PredictionStudy:
    """Train models of several τ and n, and predict the last quarter of the flows (T, H, W, 2) by each."""
    params, stack = params or DynamicsParams(), check_flow(flows, "flows")
    if stack.ndim != 4 or len(stack) < 5:
        raise DataError(f"flows: expected at least 5, shape (T, H, W, 2), found {stack.shape}")
    split = len(stack) - max(2, int(_HELD_OUT * len(stack)))
    largest = min(params.max_rank, split // 3) if params.rank is None else min(params.rank, split - 1)
    lengths = np.unique([max(3, round(share * split)) for share in _LENGTHS])
    ranks = np.unique([max(1, round(share * largest)) for share in _RANKS])
    errors, eigenvalues = np.full((len(lengths), len(ranks)), np.nan), []
    for row, length in enumerate(lengths):
        of_length = []
        for column, rank in enumerate(ranks):
            if rank < length:
                model = identify(stack[split - length : split], replace(params, rank=int(rank)), runtime)
                errors[row, column] = prediction_error(model, stack[split - 1 :])
                of_length.append(model.eigenvalues)
        eigenvalues.append(tuple(of_length))
    held, before, mean = stack[split:], stack[split - 1 : -1], stack[:split].mean(axis=0)
    return PredictionStudy(
        lengths=lengths,
        ranks=ranks,
        errors=errors,
        eigenvalues=tuple(eigenvalues),
        repeated=flow_error(before, held),
        mean=flow_error(mean[None], held),
        count=len(held),
    )


def prediction_error(dynamics: FlowDynamics, flows: FloatArray) -> float:
    """Error of predicting each of the flows (T, H, W, 2) but the first from the one before."""
    squared, predicted = 0.0, None
    for flow in iter_frames(flows):
        deviation = flow - dynamics.mean_flow
        state = project_deviation(dynamics, deviation)
        if predicted is not None:
            # |W − W̄ − C ξ̂|² without the product C ξ̂, by CᵀC = I.
            missed = float(np.square(deviation, dtype=np.float64).sum()) - predicted @ (2 * state - predicted)
            squared += max(float(missed), 0.0)
        predicted = dynamics.A @ state
    return float(np.sqrt(squared / (flows[0].size * (len(flows) - 1))))


def flow_error(found: FloatArray, expected: FloatArray) -> float:
    """Root mean square difference of flows, pixels for each component."""
    return float(np.sqrt(np.mean(np.square(found - expected), dtype=np.float64)))

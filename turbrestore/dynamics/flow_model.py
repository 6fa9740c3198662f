"""Dynamic texture model of the flow: a linear system with a small state (paper 3, eq. 10).

The model is ``ξ_{k+1} = A ξ_k + q_k``, ``W_k = W̄ + C ξ_k + r_k`` with ``q ~ N(0, Q)`` and ``r ~ N(0, R)``; the paper
leaves the mean flow W̄ out of its notation.  :mod:`turbrestore.dynamics.dynamic_texture` identifies it.

Symbols (paper 3, section 3.2)
------------------------------
τ, n : number of flows, number of states
W, W̄ : flow and its mean over time
ξ, Ξ : state; states of the training flows, one in each column
A, Q : transition of the state and covariance of its noise q
C : flows that span the subspace, one in each column with rows in the order of ``flow.reshape(-1)``; CᵀC = I (eq. 9)
R : variance of r, the flow outside the subspace
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import PART, ROUNDING, FloatArray
from ..core.errors import DataError
from ..display.preview import preview, summary
from ..display.spectra import plot_dynamics
from ..runtime.jit import jit
from ..runtime.scratch import iter_parts, iter_slices

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Float64Array = NDArray[np.float64]

# Products that are summed in single precision before their sum is added in double; they fit into the first cache.
SUMMED = 2048


@dataclass(frozen=True, eq=False)
class FlowDynamics:
    """Identified dynamic texture model of the flow (paper 3, eq. 10).

    Parameters
    ----------
    A : ndarray, float64, shape (n, n)
        Transition of the state as fitted; eigenvalues may lie on the unit circle or outside.
    C : ndarray, float32, shape (2 H W, n)
        Orthonormal columns; ``C[:, i].reshape(H, W, 2)`` is the flow of state i.
    Q : ndarray, float64, shape (n, n)
        Covariance of the process noise, in squared units of the states.
    R : float
        Variance of the flow outside the subspace of C, per component, in squared pixels; mean of
        ``residual_variance``. It is zero if C holds everything, so a filter needs a floor for it.
    residual_variance : ndarray, float32, shape (H, W)
        The same at every pixel, mean of the two components.
    mean_flow : ndarray, float32, shape (H, W, 2)
        W̄, pixels.
    states : ndarray, float64, shape (n, τ)
        Ξ; the squared length of a column is that of its flow, summed over the grid.
    singular_values : ndarray, float64, shape (τ,)
        All τ of them, in descending order.
    energy_share : float
        Share of the variance of the flows that lies in the subspace of C; 1 when nothing moves.
    overfitted : bool
        Whether there are fewer flows for each state than asked for. At n = τ − 1, the largest possible n, A only
        repeats the flows: its eigenvalues are the τ-th roots of unity other than 1 (paper 3, Figure 7a), and Q is
        meaningless.
    notes : tuple of str
        Warnings about this fit, one line each.
    """

    A: Float64Array
    C: FloatArray
    Q: Float64Array
    R: float
    residual_variance: FloatArray
    mean_flow: FloatArray
    states: Float64Array
    singular_values: Float64Array
    energy_share: float
    overfitted: bool
    notes: tuple[str, ...]

    def plot(self) -> Figure:
        """Draw the singular values of the flows and the eigenvalues of A; ConfigurationError without Matplotlib."""
        return plot_dynamics(self.singular_values, self.eigenvalues)

    def __repr__(self) -> str:
        return summary("FlowDynamics", [*self._facts(), *(("note", note) for note in self.notes)], self.shape)

    def _repr_html_(self) -> str:
        spread = np.sqrt(self.flow_variance).astype(np.float32)
        return preview("Flow dynamics", self._facts(), spread / max(float(spread.max()), ROUNDING))

    def _facts(self) -> list[tuple[str, str]]:
        spread = np.sqrt(self.flow_variance)
        return [
            ("states", f"{self.rank}, from {self.frame_count} flows"),
            ("share of the motion", f"{100 * self.energy_share:.1f} %"),
            ("largest eigenvalue", f"{np.abs(self.eigenvalues).max(initial=0.0):.3f}"),
            ("motion", f"{spread.mean():.2f} pixels a component, largest {spread.max():.2f}"),
        ]

    @property
    def rank(self) -> int:
        """Number of states n; 0 when the flows do not move."""
        return self.A.shape[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the flows."""
        return self.mean_flow.shape[0], self.mean_flow.shape[1]

    @property
    def frame_count(self) -> int:
        """Number of flows τ that the system was fitted to."""
        return self.states.shape[1]

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A, largest modulus first (paper 3, Figure 7)."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def last_state(self) -> Float64Array:
        """State of the last flow, shape (n,)."""
        return self.states[:, -1]

    @property
    def flow_variance(self) -> FloatArray:
        """Variance of the measured flows, mean of the two components, shape (H, W), squared pixels."""
        free = self.frame_count - 1
        states = self.singular_values[: self.rank] ** 2 / free
        weights = states.astype(np.float32)
        modelled = np.concatenate([np.einsum("pi,pi,i->p", part, part, weights) for part in iter_parts(self.C)])
        # The residual variance is divided by fewer degrees of freedom than the variance of the flows.
        residual = np.float32(max(free - self.rank, 1) / free) * self.residual_variance
        return modelled.reshape(self.mean_flow.shape).mean(axis=-1) + residual

    @property
    def state_covariance(self) -> Float64Array:
        """Covariance of the states over the training flows; shape (n, n), diagonal."""
        return np.diag(self.singular_values[: self.rank] ** 2 / (self.frame_count - 1))


def mean_flow_error(dynamics: FlowDynamics, count: int) -> float:
    """Compute the standard error of the mean of consecutive flows, that of the mean geometry of so many frames.

    Successive flows are alike, so they are worth fewer independent ones. State i, with a correlation ρ_i from one frame
    to the next, averages out as ``count (1 − ρ_i) / (1 + ρ_i)`` independent states do, and at least as one. As the
    states of the training flows are uncorrelated, ρ_i is ``A_ii``.
    """
    correlation = np.clip(np.diag(dynamics.A), 0, max(1 - 2 / count, 0))
    independent = np.maximum(count * (1 - correlation) / (1 + correlation), 1)
    modelled = float(np.sum(np.diag(dynamics.state_covariance) / independent)) / dynamics.mean_flow[..., 0].size
    return float(np.sqrt(modelled + 2 * dynamics.R / count))


@dataclass(frozen=True, eq=False)
class ProjectedFlow:
    """A measured flow, reduced to what the update of the state needs."""

    state: Float64Array  # (n,): z
    squared: float  # sum of squares of W^meas − W̄, squared pixels
    size: int  # components of the flow, 2 H W


def project_measured(measured: FloatArray, dynamics: FlowDynamics) -> ProjectedFlow:
    """Project a measured flow (H, W, 2) on the subspace of the model."""
    deviation = measured - dynamics.mean_flow
    state = project_deviation(dynamics, deviation)
    return ProjectedFlow(state, float(np.square(deviation, out=deviation).sum(dtype=np.float64)), deviation.size)


def project_deviation(dynamics: FlowDynamics, deviation: FloatArray) -> Float64Array:
    """State of a flow: Cᵀ (W − W̄), the least-squares solution of eq. 10 since Cᵀ C = I (paper 3, eq. 9).

    The arguments are not checked.
    ``deviation`` (H, W, 2); returns (n,).
    """
    # C is stored column by column.
    modes, flat, state = dynamics.C.T, deviation.reshape(-1), np.zeros(dynamics.C.shape[1])
    step = SUMMED * max(1, PART // (SUMMED * max(1, len(modes))))
    for rows in iter_slices(flat.size, step, modes):
        # NumPy's product of a matrix and a vector would keep the interpreter lock.
        add_products(modes, flat, rows.start, rows.stop, state)
    return state


@jit
def add_products(modes: FloatArray, deviation: FloatArray, first: int, end: int, state: Float64Array) -> None:
    """Add the inner products of flows (n, P) and one flow (P,) over a range of pixels to ``state`` (n,)."""
    for start in range(first, end, SUMMED):
        stop = min(start + SUMMED, end)
        for mode in range(modes.shape[0]):
            total = np.float32(0)
            for place in range(np.uintp(start), np.uintp(stop)):
                total += modes[mode, place] * deviation[place]
            state[mode] += total


def flow_of(dynamics: FlowDynamics, state: ArrayLike) -> FloatArray:
    """Flow (H, W, 2) of a state (n,): W̄ + C ξ (paper 3, eq. 10, without the residual r)."""
    state = check_state(dynamics, state).astype(np.float32)
    moved, done = np.empty(len(dynamics.C), np.float32), 0
    for part in iter_parts(dynamics.C):
        np.matmul(part, state, out=moved[done : done + len(part)])
        done += len(part)
    flow = moved.reshape(dynamics.mean_flow.shape)
    flow += dynamics.mean_flow
    return flow


def predict_flow(dynamics: FlowDynamics, state: ArrayLike) -> FloatArray:
    """Flow of the next frame: W̄ + C A ξ (paper 3, Figure 8).

    Parameters
    ----------
    dynamics : FlowDynamics
    state : array_like, shape (n,)
        State of the present frame, for example ``dynamics.last_state``.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)
        Pixels.

    Raises
    ------
    DataError
        The state has another shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> flows = np.zeros((6, 2, 2, 2), np.float32); flows[::2, ..., 0], flows[1::2, ..., 0] = 1, -1
    >>> dynamics = identify(flows)
    >>> predict_flow(dynamics, dynamics.last_state)[0, 0]
    array([1., 0.], dtype=float32)
    """
    return flow_of(dynamics, dynamics.A @ check_state(dynamics, state))


def check_state(dynamics: FlowDynamics, state: ArrayLike) -> Float64Array:
    """Return ``state`` as a finite float64 array of shape (n,)."""
    array = np.asarray(state, np.float64)
    if array.shape != (dynamics.rank,):
        raise DataError(f"state: expected shape ({dynamics.rank},), found {array.shape}")
    if not np.isfinite(array).all():
        raise DataError("state: expected finite values, found NaN or infinite ones")
    return array

"""Identification of the dynamic texture model of the flow (paper 3, sections 3.1 and 3.2).

The model of :mod:`turbrestore.dynamics.flow_model` is eq. 10, which is eq. 7 for flows.  The maximum likelihood
estimate (eq. 8) is replaced by the paper's closed form:

1. C and Ξ minimise ``|X − C Ξ|`` under CᵀC = I (eq. 9): C is the first n columns of U, Ξ the first n rows of Σ Vᵀ;
2. A minimises ``|Ξ_{2:τ} − A Ξ_{1:τ−1}|``: ``A = Ξ_{2:τ} Ξ_{1:τ−1}⁺``;
3. Q is the covariance of e, and R the variance of X − C Ξ.

Symbols as in :mod:`turbrestore.dynamics.flow_model`, and

X : matrix of W − W̄, 2HW × τ, one flow in each column; U Σ Vᵀ its singular value decomposition
e : residuals of the one-step prediction, ξ_{k+1} − A ξ_k

Departures from the paper
-------------------------
- Ξ is Σ Vᵀ, where the paper prints Σ V.
- Q is divided by τ − 2 − n, where the paper divides by τ − 2. Each of the n regressors takes one degree of freedom,
  as the mean does; divided by τ − 2, Q is a third too small at τ = 3n.
- R is one number, where the paper has an m×m matrix and advises a multiple of the identity. There is also a map of the
  variance at each pixel. Both are divided by τ − 1 − n, for the same reason.
- A may be damped (``ridge``).

Method of snapshots
-------------------
U is never formed: the Gram matrix G = Xᵀ X = V Σ² Vᵀ is summed over strips of image rows, and C = X V Σ⁻¹ is computed
strip by strip. The sums are float64: rounding in float32 would hide the small singular values.

"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError, require_between, settings_of
from ..core.remarks import counted
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import iter_slices, new_stack, to_scratch
from ..runtime.threads import map_ahead, one_thread_each, sum_in_threads
from .flow_model import Float64Array, FlowDynamics

# Flows are float32, so singular values below this share of the norm of all flows are rounding errors.
_ROUNDING = 1e-6
# Bytes of the strips of all threads and of the arrays computed from them, and bytes for each pixel of each flow if all
# flows fit into one strip.
_STRIPS, _STRIP_NUMBER = 140e6, 70.0
# Bytes of a float64 strip of all flows, of which each thread has one in memory.  Flows that are computed on the fly are
# computed again for every strip, so their strips are larger.
_STRIP_BYTES, _STRIP_BYTES_MADE = 2**22, 2**25


@dataclass(frozen=True)
class DynamicsParams:
    """How the system is identified.

    Parameters
    ----------
    rank : int or None
        Number of states n. By default the smallest number of modes that hold the share ``energy`` of the variance,
        but at most the number of singular values above the optimal hard threshold for white noise of unknown level
        (Gavish and Donoho, 2014), at most ``max_rank``, and at most one for every ``frames_per_state`` flows.
    energy : float
        Share of the variance that the automatic choice keeps, in (0, 1].
    max_rank : int
        Largest automatic n.
    frames_per_state : float
        Smallest number of flows for each state, at least 1. A system with fewer is marked as overfitted (paper 3,
        Figure 7a).
    ridge : float
        Damping of A: this share of the mean variance of the states is added to the variance of each state in the
        least-squares fit. 0 is the pseudo-inverse of the paper.

    Raises
    ------
    ConfigurationError
        A value is out of range.

    Examples
    --------
    >>> DynamicsParams(rank=40).energy
    0.95
    """

    rank: int | None = None
    energy: float = 0.95
    max_rank: int = 100
    frames_per_state: float = 3.0
    ridge: float = 0.0

    def __post_init__(self) -> None:
        if self.rank is not None:
            require_between("rank", self.rank, 0, 10_000, "states")
        require_between("energy", self.energy, 1e-6, 1)
        require_between("max_rank", self.max_rank, 0, 10_000, "states")
        require_between("frames_per_state", self.frames_per_state, 1, 1000)
        require_between("ridge", self.ridge, 0, 1e12)


@one_thread_each()
def identify(
    flows: FloatArray | Iterable[FloatArray], params: DynamicsParams | None = None, runtime: Runtime = DEFAULT
) -> FlowDynamics:
    """Identify the dynamic texture model from a training sequence of flows (paper 3, sections 3.1 and 3.2).

    Parameters
    ----------
    flows : ndarray of shape (τ, H, W, 2), or iterable of arrays of shape (H, W, 2)
        Flows from the reference to successive frames, in pixels. A memory-mapped array is read strip by strip and is
        never in memory as a whole. An iterable is iterated once for the shapes, and twice for every 32 MB that its
        flows take as float64. For a list of arrays this costs nothing, but it is slow if the flows are computed during
        the iteration.
    params : DynamicsParams, optional
    runtime : Runtime
        Threads, and the scratch folder for C and the maps, which stay in memory if there is none.

    Returns
    -------
    FlowDynamics
        Of rank 0 when nothing moves.

    Raises
    ------
    DataError
        Fewer than two flows, shapes that differ, values that are not finite, or an iterator that can be iterated
        only once.
    ConfigurationError
        Settings are of another type.

    Examples
    --------
    >>> import numpy as np
    >>> angle = 2 * np.pi * np.arange(24) / 12
    >>> flows = np.zeros((24, 4, 4, 2), np.float32)
    >>> flows[..., 0], flows[..., 1] = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    >>> dynamics = identify(flows)
    >>> dynamics.rank, np.abs(dynamics.eigenvalues).round(3)
    (2, array([1., 1.]))
    """
    params = settings_of(DynamicsParams, params)
    strips = FlowStrips.of(flows, runtime.threads)
    mean, gram, norm = gram_matrix(strips)
    singular_values, V = singular_vectors(gram)
    pixels = 2 * strips.height * strips.width
    present = int(np.count_nonzero(singular_values > _ROUNDING * norm))
    n = _rank(singular_values, present, pixels, params)
    states = singular_values[:n, None] * V[:, :n].T  # Ξ
    C, residual_energy = spatial_modes(strips, mean, singular_values[:n], V[:, :n], runtime.scratch)
    residual_variance = np.divide(residual_energy, max(strips.count - 1 - n, 1), out=residual_energy)
    A, Q = _transition(states, params.ridge)
    energy = float(np.sum(singular_values[:present] ** 2))
    overfitted = strips.count < params.frames_per_state * n
    return FlowDynamics(
        A=A,
        C=C,
        Q=Q,
        R=float(residual_variance.mean()),
        residual_variance=to_scratch(residual_variance.astype(np.float32), runtime.scratch),
        mean_flow=to_scratch(mean, runtime.scratch),
        states=states,
        singular_values=singular_values,
        energy_share=float(np.sum(singular_values[:n] ** 2)) / energy if energy else 1.0,
        overfitted=overfitted,
        notes=_notes(A, strips.count, n, present, overfitted, params),
    )


def identify_memory(shape: tuple[int, ...], train: int) -> float:
    """Bytes that identification takes in addition to the flows and to the model itself (:func:`modes_memory`).

    The constants were measured by ``benchmarks/memory.py --stages`` at 1280×720, grey and in colour, with one, two and
    four threads, and rounded up by at least a twentieth.
    """
    return min(_STRIPS, _STRIP_NUMBER * shape[1] * shape[2] * train)


def modes_memory(shape: tuple[int, ...], train: int, params: DynamicsParams | None = None) -> float:
    """Largest size of C, bytes: 8 for each pixel and state."""
    params = params or DynamicsParams()
    automatic = min(params.max_rank, int(train / params.frames_per_state))
    return 8.0 * shape[1] * shape[2] * min(automatic if params.rank is None else params.rank, train - 1)


def _rank(singular_values: Float64Array, present: int, pixels: int, params: DynamicsParams) -> int:
    if params.rank is not None:
        return min(params.rank, present)
    if present == 0:
        return 0
    energy = np.cumsum(singular_values[:present] ** 2)
    enough = int(np.searchsorted(energy, params.energy * energy[-1])) + 1
    above_noise = int(np.count_nonzero(singular_values[:present] > _noise_threshold(singular_values, pixels)))
    return min(enough, above_noise, params.max_rank, int(len(singular_values) / params.frames_per_state))


def _noise_threshold(singular_values: Float64Array, pixels: int) -> float:
    """Optimal hard threshold for white noise of unknown level (Gavish and Donoho, 2014, eq. 5)."""
    # Subtracting the mean makes one singular value zero, as if the matrix had one column less.
    columns = len(singular_values) - 1
    beta = min(pixels, columns) / max(pixels, columns)
    omega = 0.56 * beta**3 - 0.95 * beta**2 + 1.82 * beta + 1.43
    return omega * float(np.median(singular_values[: min(pixels, columns)]))


def _transition(states: Float64Array, ridge: float) -> tuple[Float64Array, Float64Array]:
    """Fit A = Ξ_{2:τ} Ξ_{1:τ−1}⁺, damped by ``ridge``, and the unbiased Q."""
    n, count = states.shape
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, 0))
    before, after = states[:, :-1], states[:, 1:]
    u, s, vt = np.linalg.svd(before, full_matrices=False)
    # The states sum to zero over time, so Ξ_{1:τ−1} has full rank too and no s is zero.
    inverse = s / (s**2 + ridge * np.sum(s**2) / n)
    A = after @ (vt.T * inverse) @ u.T
    residual = after - A @ before
    # A damped regressor takes less than one degree of freedom.
    used = float(np.sum(s * inverse))
    return A, residual @ residual.T / max(count - 2 - used, 1.0)


def _notes(
    A: Float64Array, count: int, n: int, present: int, overfitted: bool, params: DynamicsParams
) -> tuple[str, ...]:
    notes = []
    if present == 0:
        notes.append("the flows do not change over time: no states")
    if params.rank is not None and n < params.rank:
        notes.append(f"{counted(params.rank, 'state')} asked for, {counted(n, 'independent flow')} found")
    if overfitted:
        notes.append(
            f"{count} flows are few for {counted(n, 'state')}: the system repeats them rather than describes them"
        )
    if n == 0 and present > 0 and params.rank is None:
        notes.append(f"{count} flows are too few, or too noisy, for a state")
    largest = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    if largest >= 1:
        notes.append(f"largest eigenvalue of A has modulus {largest:.4f}: predictions far ahead do not fade")
    return tuple(notes)


@dataclass(frozen=True)
class FlowStrips:
    """Reads all flows strip by strip of image rows, whatever container the flows are in."""

    flows: FloatArray | Iterable[FloatArray]  # (τ, H, W, 2), or iterable of arrays of shape (H, W, 2)
    # τ, H and W.
    count: int
    height: int
    width: int
    # Strips of an array that are worked on side by side, 0 for one per available core; flows in other containers may be
    # computed on the fly and are read by one thread.
    threads: int = 0

    @classmethod
    def of(cls, flows: FloatArray | Iterable[FloatArray], threads: int = 0) -> FlowStrips:
        """Check the shapes of flows, an array (τ, H, W, 2) or an iterable of arrays (H, W, 2)."""
        if isinstance(flows, np.ndarray):
            shapes = [flows.shape[1:]] * len(flows) if flows.ndim else []
        elif isinstance(flows, str | os.PathLike):
            raise DataError(f"flows: expected flows (T, H, W, 2), found the path {flows}; read it with numpy.load")
        elif hasattr(flows, "flows"):
            raise DataError(f"flows: expected flows (T, H, W, 2), found {type(flows).__name__}; use its .flows")
        elif not isinstance(flows, Iterable) or iter(flows) is flows:
            raise DataError(
                f"flows: expected an array or an iterable that can be iterated again, "
                f"found {type(flows).__name__}; make a list of it"
            )
        else:
            shapes = [np.shape(flow) for flow in flows]
        if len(shapes) < 2:
            raise DataError(f"flows: expected at least 2 flows, found {len(shapes)}")
        for shape in shapes:
            if len(shape) != 3 or shape[2] != 2 or 0 in shape:
                raise DataError(f"flows: expected flows (T, H, W, 2), found {(len(shapes), *shape)}")
            if shape != shapes[0]:
                raise DataError(f"flows: expected all of one shape (H, W, 2), found {shape} beside {shapes[0]}")
        height, width = shapes[0][:2]
        return cls(flows, len(shapes), height, width, threads if isinstance(flows, np.ndarray) else 1)

    def rows(self, *written: object) -> Iterator[slice]:
        """Rows of each strip."""
        size = _STRIP_BYTES if isinstance(self.flows, np.ndarray) else _STRIP_BYTES_MADE
        step = max(size // (16 * self.count * max(self.width, 1)), 1)
        return iter_slices(self.height, step, self.flows, *written)

    def read(self, rows: slice) -> Float64Array:
        """Flows of these rows, (τ, numbers)."""
        flows = self.flows
        strip = flows[:, rows] if isinstance(flows, np.ndarray) else np.stack([np.asarray(f)[rows] for f in flows])
        return check_flow(strip, "flows").astype(np.float64).reshape(self.count, -1)


def gram_matrix(strips: FlowStrips) -> tuple[FloatArray, Float64Array, float]:
    """Mean flow (H, W, 2), Gram matrix (τ, τ) of the flows without it, strip by strip, and norm of the flows."""
    mean = np.empty((strips.height, strips.width, 2), np.float32)

    def add(batch: list[slice]) -> tuple[Float64Array, ...]:
        gram, energy = np.zeros((strips.count, strips.count)), np.zeros(())
        for rows in batch:
            strip = strips.read(rows)
            energy += np.vdot(strip, strip)
            flat = strip.mean(0).astype(np.float32)
            mean[rows] = flat.reshape(mean[rows].shape)
            strip -= flat
            gram += strip @ strip.T
        return gram, energy

    gram, energy = sum_in_threads(add, strips.rows(), strips.threads)
    return mean, gram, float(np.sqrt(energy))


def singular_vectors(gram: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Singular values (τ,) of X, and V (τ, τ), from the Gram matrix."""
    values, V = np.linalg.eigh(gram)
    values, V = np.sqrt(np.maximum(values[::-1], 0.0)), V[:, ::-1]
    largest = V[np.abs(V).argmax(0), np.arange(len(V))]
    return values, V * np.where(largest < 0, -1.0, 1.0)


def spatial_modes(
    strips: FlowStrips, mean: FloatArray, singular_values: Float64Array, V: Float64Array, scratch: Path | None = None
) -> tuple[FloatArray, Float64Array]:
    """C = X V Σ⁻¹ and the energy outside its subspace, strip by strip.

    ``mean`` (H, W, 2); ``singular_values`` (n,); ``V`` (τ, n); returns ``C`` (2 H W, n), ``energy`` (H, W).
    """
    # Stored mode after mode: products with C and with Cᵀ are then twice as fast.
    C = new_stack((len(singular_values), *mean.shape), scratch)
    energy = np.empty(mean.shape[:2])

    def fill(rows: slice) -> None:
        strip = strips.read(rows)
        strip -= mean[rows].reshape(-1)
        modes = strip.T @ V
        # V has orthonormal columns, so the energies of modes and residual add up.
        left = np.einsum("tx,tx->x", strip, strip) - np.einsum("xi,xi->x", modes, modes)
        energy[rows] = np.maximum(left, 0.0).reshape(mean[rows].shape).mean(-1)
        C[:, rows] = (modes / singular_values).T.reshape(C[:, rows].shape)

    for _ in map_ahead(fill, strips.rows(C), strips.threads):
        pass
    return C.reshape(len(singular_values), mean.size).T, energy

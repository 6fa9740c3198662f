"""Dynamic texture of the flow: identify a small linear system from flows, predict with it and simulate it.

The model is ``ξ_{k+1} = A ξ_k + q_k``, ``W_k = W̄ + C ξ_k + r_k`` (paper 3, eqs. 7 to 10, written for flows).

Symbols (paper 3, sections 3.1 and 3.2)
---------------------------------------
τ, n : number of flows, number of states.
W, W̄ : flow and its mean over time. X : matrix of W − W̄, one column of 2HW numbers a flow.
U Σ Vᵀ : singular value decomposition of X. G : Gram matrix Xᵀ X = V Σ² Vᵀ, τ×τ.
C : first n columns of U, rows in the order of ``flow.reshape(-1)``. Ξ : states, first n rows of Σ Vᵀ.
A : transition. Q, R : covariances of q and r. e : residuals of the one-step prediction, ξ_{k+1} − A ξ_k.

Departures from the paper
-------------------------
- Ξ is Σ Vᵀ, where the paper prints Σ V.
- U is never formed: G is summed over strips of rows, C = X V Σ⁻¹ follows strip by strip. The sums are float64: in
  float32 the small singular values drown in rounding, to save less than a tenth of a second at τ = 100, 256².
- Q is divided by τ − 2 − n, the paper by τ − 2. Each of the n regressors takes one degree of freedom, as the mean
  takes one; without the n, Q is a third too small at τ = 3n.
- R is one number (the paper says m×m and advises a multiple of the identity), with a map per pixel beside it,
  divided by τ − 1 − n for the same reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from .arrays import FloatArray, check_flow
from .errors import ConfigurationError, DataError, require_between
from .parallel import one_thread_each
from .plots import plot_dynamics
from .preview import preview

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Float64Array = NDArray[np.float64]

# Size of the float64 strip of all flows that is in memory at once. Smaller strips would save little memory and
# hand the linear algebra pieces too small to be worth a second thread.
_STRIP_BYTES = 2**25
# Standard deviation of the variance of measured flows about that of the motion, and error of a displacement variance
# besides its deviation, as shares of each.
_FLOW_ERROR, _CUE_ERROR = 0.3, 0.15
# What moves by more than this in variance, squared pixels, leaves the tiles that a displacement variance is seen in.
_LARGEST_VARIANCE = 20.0
# Standard deviation of the square of a Hann window of 64 pixels, through which a displacement variance is seen; pixels.
_TILE_WINDOW = 9.0
# Variance of flows below which nothing moves, squared pixels.
_LEAST_VARIANCE = 1e-12
# A model without motion would never follow a frame.
_LEAST_FACTOR = 0.05
# Flows are float32, so singular values below this share of the norm of all flows are rounding.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class DynamicsParams:
    """How the system is identified.

    Parameters
    ----------
    rank : int or None
        Number of states n. None chooses the smallest n that holds ``energy``, but never singular values below
        the optimal hard threshold for white noise of unknown level (Gavish and Donoho, 2014), never more than
        ``max_rank``, and never more than one state for every ``frames_per_state`` flows.
    energy : float
        Share of the variance that the automatic choice keeps, in (0, 1].
    max_rank : int
        Largest automatic n.
    frames_per_state : float
        At least 1. With fewer flows a state the system is flagged as overfitted (paper 3, Figure 7a).
    ridge : float
        Damping of A: this share of the mean state variance is added to each state's own in the least squares. 0
        is the pseudo-inverse of the paper.

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


@dataclass(frozen=True, eq=False)
class FlowDynamics:
    """Linear system that the flows follow.

    Parameters
    ----------
    A : ndarray, float64, shape (n, n)
        Transition of the state, as fitted: its eigenvalues may reach or leave the unit circle.
    C : ndarray, float32, shape (2 H W, n)
        Orthonormal columns; ``C[:, i].reshape(H, W, 2)`` is the flow of state i.
    Q : ndarray, float64, shape (n, n)
        Covariance of the process noise, in squared units of the states.
    R : float
        Variance of what C leaves out, per component, in squared pixels; mean of ``residual_variance``. Zero when
        C holds everything, so a filter needs a floor for it.
    residual_variance : ndarray, float32, shape (H, W)
        The same at every pixel, mean of the two components.
    mean_flow : ndarray, float32, shape (H, W, 2)
        W̄, pixels.
    states : ndarray, float64, shape (n, τ)
        Ξ, one column a flow; the squared length of a column is that of its flow, summed over the grid.
    singular_values : ndarray, float64, shape (τ,)
        All of them, falling.
    energy_share : float
        Share of the flows' variance that C holds; 1 when nothing moves.
    overfitted : bool
        Fewer flows a state than asked for. At n = τ − 1, the largest n there is, A only repeats the flows: its
        eigenvalues are the τ-th roots of unity other than 1 (paper 3, Figure 7a), and Q is meaningless.
    notes : tuple of str
        What a person should know about this fit, one line each.
    motion_factor : ndarray, float32, shape (H, W)
        Variance of the motion over that of the measured flows; 1 unless :func:`with_displacement` found another. Q and
        ``state_covariance`` hold its mean; states, singular values and R are those of the flows as measured.
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
    motion_factor: FloatArray

    def plot(self) -> Figure:
        """Draw the singular values of the flows and the eigenvalues of A.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_dynamics(self.singular_values, self.eigenvalues)

    def _repr_html_(self) -> str:
        spread = np.sqrt(self.flow_variance).astype(np.float32)
        facts = [
            ("states", f"{self.rank}, from {self.frame_count} flows"),
            ("share of the motion", f"{100 * self.energy_share:.1f} %"),
            ("largest eigenvalue", f"{np.abs(self.eigenvalues).max(initial=0.0):.3f}"),
            ("motion", f"{spread.mean():.2f} pixels a component, brightest {spread.max():.2f}"),
        ]
        return preview("Flow dynamics", facts, spread / max(float(spread.max()), 1e-6))

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
    def initial_state(self) -> Float64Array:
        """State of the first flow, shape (n,)."""
        return self.states[:, 0]

    @property
    def last_state(self) -> Float64Array:
        """State of the last flow, shape (n,)."""
        return self.states[:, -1]

    @property
    def flow_variance(self) -> FloatArray:
        """Variance of the measured flows, mean of the two components, shape (H, W), squared pixels."""
        free = self.frame_count - 1
        states = self.singular_values[: self.rank] ** 2 / free
        modelled = np.einsum("pi,pi,i->p", self.C, self.C, states.astype(np.float32))
        # The residual has been divided by its own degrees of freedom.
        residual = np.float32(max(free - self.rank, 1) / free) * self.residual_variance
        return modelled.reshape(self.mean_flow.shape).mean(axis=-1) + residual

    @property
    def state_covariance(self) -> Float64Array:
        """Covariance of the states over the training flows, times the mean motion factor; shape (n, n), diagonal."""
        measured = self.singular_values[: self.rank] ** 2 / (self.frame_count - 1)
        return np.diag(float(self.motion_factor.mean()) * measured)


@dataclass(frozen=True, eq=False)
class SimulatedFlows:
    """Sequence of simulated flows; each is computed when it is asked for.

    Parameters
    ----------
    dynamics : FlowDynamics
        Where C and W̄ come from.
    states : ndarray, float64, shape (n, length)
        One column a flow.
    """

    dynamics: FlowDynamics
    states: Float64Array

    def __len__(self) -> int:
        return self.states.shape[1]

    def __getitem__(self, index: int) -> FloatArray:
        return flow_of(self.dynamics, self.states[:, index])

    def __iter__(self) -> Iterator[FloatArray]:
        return (self[k] for k in range(len(self)))


@one_thread_each()
def identify(flows: FloatArray | Iterable[FloatArray], params: DynamicsParams | None = None) -> FlowDynamics:
    """Fit the dynamic texture to a training sequence of flows (paper 3, sections 3.1 and 3.2).

    Parameters
    ----------
    flows : ndarray of shape (τ, H, W, 2), or iterable of arrays of shape (H, W, 2)
        Flows from the reference to successive frames, in pixels. A memory map is read strip by strip and never
        held as a whole. An iterable is run through once for the shapes and twice for every 32 MB that its flows
        take as float64, which is free for a list of arrays and dear for flows made on the fly.
    params : DynamicsParams, optional

    Returns
    -------
    FlowDynamics
        Of rank 0 when nothing moves.

    Raises
    ------
    DataError
        Fewer than two flows, shapes that differ, values that are not finite, or an iterator that can be run
        through only once.

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
    params = params or DynamicsParams()
    strips = _Strips.of(flows)
    mean, gram, norm = _gram(strips)
    singular_values, V = _singular(gram)
    pixels = 2 * strips.height * strips.width
    present = int(np.count_nonzero(singular_values > _ROUNDING * norm))
    n = _rank(singular_values, present, pixels, params)
    states = singular_values[:n, None] * V[:, :n].T
    C, residual_energy = _modes(strips, mean, singular_values[:n], V[:, :n])
    residual_variance = residual_energy / max(strips.count - 1 - n, 1)
    A, Q = _transition(states, params.ridge)
    energy = float(np.sum(singular_values[:present] ** 2))
    overfitted = strips.count < params.frames_per_state * n
    return FlowDynamics(
        A=A,
        C=C,
        Q=Q,
        R=float(residual_variance.mean()),
        residual_variance=residual_variance.astype(np.float32),
        mean_flow=mean,
        states=states,
        singular_values=singular_values,
        energy_share=float(np.sum(singular_values[:n] ** 2)) / energy if energy else 1.0,
        overfitted=overfitted,
        notes=_notes(A, strips.count, n, present, overfitted, params),
        motion_factor=np.ones(mean.shape[:2], np.float32),
    )


def with_displacement(dynamics: FlowDynamics, variance: ArrayLike, deviation: ArrayLike) -> FlowDynamics:
    """Draw the size of the motion towards a displacement variance that was found without the flows.

    Measured flows hold noise besides motion, and smooth some of the motion away: their variance, seen through the
    window of a tile, is taken to be that of the motion within 30 %.  The displacement variance is taken to be right
    within its deviation and 15 %; and as structure leaves the tiles that large motion is seen in (of 34 squared pixels
    a third to a half was missing, of 5 to 13 up to 30 %), the square of the larger variance over 20 squared pixels adds
    to its error.

    The mean of both, weighted by inverse variance, over the variance of the flows is ``motion_factor``.  Q and the
    stationary covariance of the state change by its mean: noise and motion are thought to share the directions of the
    flow alike.  A filter takes at most this share of what C leaves out to be motion.

    Parameters
    ----------
    dynamics : FlowDynamics
    variance : float or array_like, shape (H, W)
        Variance of the displacement per axis, squared pixels, as of
        :func:`turbrestore.blur_moments.cues.displacement_variance`.
    deviation : float or array_like, shape (H, W)
        Its standard deviation, squared pixels; infinite where nothing is known.

    Returns
    -------
    FlowDynamics
        With another ``motion_factor``, at least 0.05, and Q scaled by the change of its mean.

    Raises
    ------
    DataError
        Shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> flows = np.zeros((6, 2, 2, 2), np.float32); flows[::2], flows[1::2] = 1, -1
    >>> dynamics = identify(flows)
    >>> with_displacement(dynamics, variance=0.6, deviation=0.0).motion_factor.round(2)[0]
    array([0.55, 0.55], dtype=float32)
    >>> with_displacement(dynamics, variance=0.6, deviation=np.inf).motion_factor[0]
    array([1., 1.], dtype=float32)
    """
    cue, error = np.asarray(variance, np.float64), np.asarray(deviation, np.float64)
    for name, given in (("variance", cue), ("deviation", error)):
        if given.shape not in ((), dynamics.shape):
            raise DataError(f"{name}: expected one number or shape {dynamics.shape}, found {given.shape}")
    measured = np.maximum(cv2.GaussianBlur(dynamics.flow_variance, (0, 0), _TILE_WINDOW), _LEAST_VARIANCE)
    lost = np.maximum(measured, cue) ** 2 / _LARGEST_VARIANCE
    own, other = (_FLOW_ERROR * measured) ** -2, 1 / (error**2 + (_CUE_ERROR * cue) ** 2 + lost**2)
    motion = (own * measured + other * cue) / (own + other)
    factor = np.maximum(motion / measured, _LEAST_FACTOR).astype(np.float32)
    change = float(factor.mean() / dynamics.motion_factor.mean())
    return replace(dynamics, Q=dynamics.Q * change, motion_factor=factor)


def project(dynamics: FlowDynamics, flow: ArrayLike) -> Float64Array:
    """State of a flow: Cᵀ (W − W̄), the least-squares solution since Cᵀ C = I (paper 3, eq. 9).

    Parameters
    ----------
    dynamics : FlowDynamics
    flow : array_like, shape (H, W, 2)
        Pixels.

    Returns
    -------
    ndarray, float64, shape (n,)

    Raises
    ------
    DataError
        The flow has another shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> flows = np.zeros((4, 2, 2, 2), np.float32); flows[..., 0] = np.array([1, -1, 1, -1])[:, None, None]
    >>> dynamics = identify(flows)
    >>> np.abs(project(dynamics, flows[0])).round(3)
    array([2.])
    """
    flow = check_flow(flow)
    if flow.shape != dynamics.mean_flow.shape:
        raise DataError(f"flow: expected shape {dynamics.mean_flow.shape}, found {flow.shape}")
    return ((flow - dynamics.mean_flow).reshape(-1) @ dynamics.C).astype(np.float64)


def flow_of(dynamics: FlowDynamics, state: ArrayLike) -> FloatArray:
    """Flow of a state: W̄ + C ξ (paper 3, eq. 10, without the residual r).

    Parameters
    ----------
    dynamics : FlowDynamics
    state : array_like, shape (n,)

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
    >>> dynamics = identify(np.full((3, 2, 2, 2), 0.5, np.float32))
    >>> flow_of(dynamics, np.zeros(dynamics.rank))[0, 0]
    array([0.5, 0.5], dtype=float32)
    """
    moved = dynamics.C @ _check_state(dynamics, state).astype(np.float32)
    return dynamics.mean_flow + moved.reshape(dynamics.mean_flow.shape)


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
    >>> flows = np.zeros((6, 2, 2, 2), np.float32); flows[::2, ..., 0], flows[1::2, ..., 0] = 1, -1
    >>> dynamics = identify(flows)
    >>> predict_flow(dynamics, dynamics.last_state)[0, 0]
    array([1., 0.], dtype=float32)
    """
    return flow_of(dynamics, dynamics.A @ _check_state(dynamics, state))


def stable_system(dynamics: FlowDynamics, largest_modulus: float = 0.99) -> tuple[Float64Array, Float64Array]:
    """Return A and Q of a stationary process: A inside the unit circle, P = A P Aᵀ + Q for the training P.

    Eigenvalues of larger modulus are shortened to ``largest_modulus`` and keep their angle, all others stay: the
    blocks on the diagonal of A's real Schur form are scaled, which is well conditioned even where A has no basis
    of eigenvectors. Q is ``P − A P Aᵀ`` with its negative eigenvalues set to zero. Where that cuts something off,
    a change of coordinates (the symmetric map that carries the resulting stationary covariance to P) restores
    P exactly and leaves the eigenvalues alone. States are measured in units of their own deviation throughout.

    Parameters
    ----------
    dynamics : FlowDynamics
    largest_modulus : float
        Below 1. At 0.99 a state forgets in a hundred frames, about what training sequences can tell apart from
        never.

    Returns
    -------
    A, Q : ndarray, float64, shape (n, n)

    Raises
    ------
    ConfigurationError
        ``largest_modulus`` is not between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> flows = np.zeros((6, 2, 2, 2), np.float32); flows[::2, ..., 0], flows[1::2, ..., 0] = 1, -1
    >>> dynamics = identify(flows)
    >>> A, Q = stable_system(dynamics, 0.9)
    >>> A.round(3), bool(np.isclose(A**2 * dynamics.state_covariance + Q, dynamics.state_covariance).all())
    (array([[-0.9]]), True)
    """
    if not 0 < largest_modulus < 1:
        raise ConfigurationError(f"largest_modulus: expected above 0 and below 1, found {largest_modulus}")
    if dynamics.rank == 0:
        return dynamics.A, dynamics.Q
    deviation = np.sqrt(np.diag(dynamics.state_covariance))
    A = _pull_inside(dynamics.A * deviation / deviation[:, None], largest_modulus)
    values, vectors = np.linalg.eigh(np.eye(len(A)) - A @ A.T)
    Q = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # The stationary covariance is at least the identity, because cutting off only added to Q.
    stationary, vectors = np.linalg.eigh(linalg.solve_discrete_lyapunov(A, Q))
    shrink = (vectors / np.sqrt(stationary)) @ vectors.T
    grow = (vectors * np.sqrt(stationary)) @ vectors.T
    A, Q = shrink @ A @ grow, shrink @ Q @ shrink
    return A * deviation[:, None] / deviation, 0.5 * (Q + Q.T) * np.outer(deviation, deviation)


def simulate(
    dynamics: FlowDynamics,
    length: int,
    rng: np.random.Generator,
    initial: ArrayLike | None = None,
    largest_modulus: float = 0.99,
) -> SimulatedFlows:
    """Synthesise flows that move like the training flows (paper 3, section 3.2 and Figure 6).

    The system is that of :func:`stable_system`, so that the simulation neither grows nor fades, where the paper
    runs A and Q as fitted. Like the paper's, the flows are W̄ + C ξ, without the residual r.

    Parameters
    ----------
    dynamics : FlowDynamics
    length : int
        Number of flows, at least 1.
    rng : numpy.random.Generator
        Source of q; the same state of it gives the same flows.
    initial : array_like, shape (n,), optional
        State of the first flow. By default drawn from the stationary distribution.
    largest_modulus : float
        As in :func:`stable_system`.

    Returns
    -------
    SimulatedFlows

    Raises
    ------
    ConfigurationError
        ``length`` or ``largest_modulus`` is out of range.
    DataError
        ``initial`` has another shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> dynamics = identify(np.random.default_rng(0).standard_normal((9, 4, 4, 2)).astype(np.float32))
    >>> flows = simulate(dynamics, 50, np.random.default_rng(1))
    >>> len(flows), flows[49].shape
    (50, (4, 4, 2))
    """
    if length < 1:
        raise ConfigurationError(f"length: expected at least 1 flow, found {length}")
    A, Q = stable_system(dynamics, largest_modulus)
    values, vectors = np.linalg.eigh(Q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    states = np.empty((dynamics.rank, length))
    if initial is None:
        states[:, 0] = np.sqrt(np.diag(dynamics.state_covariance)) * rng.standard_normal(dynamics.rank)
    else:
        states[:, 0] = _check_state(dynamics, initial)
    noise = root @ rng.standard_normal((dynamics.rank, length - 1))
    for k in range(length - 1):
        states[:, k + 1] = A @ states[:, k] + noise[:, k]
    return SimulatedFlows(dynamics, states)


@dataclass(frozen=True)
class _Strips:
    """All flows of a few image rows at a time, whatever the flows are kept in."""

    flows: FloatArray | Iterable[FloatArray]
    count: int
    height: int
    width: int

    @classmethod
    def of(cls, flows: FloatArray | Iterable[FloatArray]) -> _Strips:
        if isinstance(flows, np.ndarray):
            shapes = [flows.shape[1:]] * len(flows) if flows.ndim else []
        elif not isinstance(flows, Iterable) or iter(flows) is flows:
            raise DataError(
                f"flows: expected an array or an iterable that can be run through again, "
                f"found {type(flows).__name__}; make a list of it"
            )
        else:
            shapes = [np.shape(flow) for flow in flows]
        if len(shapes) < 2:
            raise DataError(f"flows: expected at least 2 flows, found {len(shapes)}")
        for shape in shapes:
            if len(shape) != 3 or shape[2] != 2 or 0 in shape or shape != shapes[0]:
                raise DataError(f"flows: expected all of one shape (H, W, 2), found {shape} beside {shapes[0]}")
        return cls(flows, len(shapes), *shapes[0][:2])

    def rows(self) -> list[slice]:
        step = max(_STRIP_BYTES // (16 * self.count * max(self.width, 1)), 1)
        return [slice(start, start + step) for start in range(0, self.height, step)]

    def read(self, rows: slice) -> FloatArray:
        """Flows of these rows, shape (τ, numbers)."""
        flows = self.flows
        strip = flows[:, rows] if isinstance(flows, np.ndarray) else np.stack([np.asarray(f)[rows] for f in flows])
        return check_flow(strip, "flows").reshape(self.count, -1)


def _gram(strips: _Strips) -> tuple[FloatArray, Float64Array, float]:
    """Mean flow, Gram matrix of the flows without it, norm of all flows with it."""
    mean = np.empty((strips.height, strips.width, 2), np.float32)
    gram, energy = np.zeros((strips.count, strips.count)), 0.0
    for rows in strips.rows():
        strip = strips.read(rows).astype(np.float64)
        energy += float(np.vdot(strip, strip))
        flat = strip.mean(0).astype(np.float32)
        mean[rows] = flat.reshape(mean[rows].shape)
        strip -= flat
        gram += strip @ strip.T
    return mean, gram, float(np.sqrt(energy))


def _singular(gram: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Singular values, falling, and V with the largest entry of every column positive."""
    values, V = np.linalg.eigh(gram)
    values, V = np.sqrt(np.maximum(values[::-1], 0.0)), V[:, ::-1]
    largest = V[np.abs(V).argmax(0), np.arange(len(V))]
    return values, V * np.where(largest < 0, -1.0, 1.0)


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
    # Taking off the mean makes one singular value zero: the matrix is as good as one column narrower.
    columns = len(singular_values) - 1
    beta = min(pixels, columns) / max(pixels, columns)
    omega = 0.56 * beta**3 - 0.95 * beta**2 + 1.82 * beta + 1.43
    return omega * float(np.median(singular_values[: min(pixels, columns)]))


def _modes(
    strips: _Strips, mean: FloatArray, singular_values: Float64Array, V: Float64Array
) -> tuple[FloatArray, Float64Array]:
    """C = X V Σ⁻¹, and the energy over time of X − C Ξ at every pixel, mean of the two components."""
    C = np.empty((*mean.shape, len(singular_values)), np.float32)
    energy = np.empty(mean.shape[:2])
    for rows in strips.rows():
        strip = np.subtract(strips.read(rows), mean[rows].reshape(-1), dtype=np.float64)
        modes = strip.T @ V
        # V has orthonormal columns: what the modes hold over time is what the residual does not.
        left = np.einsum("tx,tx->x", strip, strip) - np.einsum("xi,xi->x", modes, modes)
        energy[rows] = np.maximum(left, 0.0).reshape(mean[rows].shape).mean(-1)
        C[rows] = (modes / singular_values).reshape(C[rows].shape)
    return C.reshape(mean.size, len(singular_values)), energy


def _transition(states: Float64Array, ridge: float) -> tuple[Float64Array, Float64Array]:
    """Fit A = Ξ_{2:τ} Ξ_{1:τ−1}⁺, damped by ``ridge``, and Q without bias."""
    n, count = states.shape
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, 0))
    before, after = states[:, :-1], states[:, 1:]
    u, s, vt = np.linalg.svd(before, full_matrices=False)
    # The states sum to zero over time, so those before the last have full rank too: no s is zero.
    inverse = s / (s**2 + ridge * np.sum(s**2) / n)
    A = after @ (vt.T * inverse) @ u.T
    residual = after - A @ before
    # Damped regressors count for less than one degree of freedom each.
    used = float(np.sum(s * inverse))
    return A, residual @ residual.T / max(count - 2 - used, 1.0)


def _pull_inside(A: Float64Array, largest: float) -> Float64Array:
    """Shorten the eigenvalues of A to the modulus ``largest`` where they exceed it."""
    T, Z = linalg.schur(A, output="real")
    start = 0
    while start < len(T):
        size = 2 if start + 1 < len(T) and T[start + 1, start] != 0 else 1
        block = slice(start, start + size)
        modulus = np.abs(np.linalg.eigvals(T[block, block])).max()
        if modulus > largest:
            T[block, block] *= largest / modulus
        start += size
    return Z @ T @ Z.T


def _check_state(dynamics: FlowDynamics, state: ArrayLike) -> Float64Array:
    array = np.asarray(state, np.float64)
    if array.shape != (dynamics.rank,):
        raise DataError(f"state: expected shape ({dynamics.rank},), found {array.shape}")
    if not np.isfinite(array).all():
        raise DataError("state: expected finite values, found NaN or infinite ones")
    return array


def _notes(
    A: Float64Array, count: int, n: int, present: int, overfitted: bool, params: DynamicsParams
) -> tuple[str, ...]:
    notes = []
    if present == 0:
        notes.append("the flows do not change over time: no states")
    if params.rank is not None and n < params.rank:
        notes.append(f"{params.rank} states asked for, {n} independent flows found")
    if overfitted:
        notes.append(f"{count} flows are few for {n} states: the system repeats them rather than describes them")
    if n == 0 and present > 0 and params.rank is None:
        notes.append(f"{count} flows are too few, or too noisy, for a state")
    largest = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    if largest >= 1:
        notes.append(f"largest eigenvalue of A has modulus {largest:.4f}: predictions far ahead do not fade")
    return tuple(notes)

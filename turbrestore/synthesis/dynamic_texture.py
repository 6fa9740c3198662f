"""Dynamic-texture synthesis: new turbulence that moves like a given clip (paper 3, section 3.2 and Figure 6).

The flows of the clip are measured from its centroid, a linear system is identified from them, and the system is run
with new noise.  The new flows distort the centroid, or any other scene.

Symbols
-------
W : flow; C, ξ, A, Q, Ξ, R : modes, state, transition, process noise, training states and residual variance of
:mod:`turbrestore.dynamics.dynamic_texture`, for n states and τ training flows.
r : residual of a flow outside the n modes; D, η : its modes and their states, ``r = D η``.
φ : correlation of a residual state with itself one frame later.

Departures from the paper
-------------------------
- ``W = C ξ + r``, where the paper simulates ``C ξ`` alone (``residual="drop"``).  On real clips the n modes contain 70
  to 98 % of the variance, and r is mostly motion, so without it the new flows are too short.  r is drawn from the
  covariance of the training residuals: its modes are those after the n-th of the same singular value decomposition,
  each driven by an autoregression of order one with the variance and φ of the training.  The expected variance of the
  displacement at every pixel is then that of the training flows.  The modes of r are orthogonal to C, so identification
  from a synthetic sequence returns the original system.
- A and Q are those of :func:`turbrestore.dynamics.simulate.stable_system`: the sequence neither grows nor fades.
- The mean flow W̄, which vanishes at the centroid except for the bias of the flow method, is left out, so the scene has
  the mean geometry of the synthetic sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError, require
from ..dynamics.dynamic_texture import DynamicsParams, identify
from ..dynamics.flow_model import FlowDynamics
from ..dynamics.simulate import simulate, stable_system
from ..registration.centroid import CentroidParams, CentroidState, centroid_steps
from ..registration.flow import FlowParams
from ..runtime.steps import finish
from .sequence import check_scene

Float64Array = NDArray[np.float64]

RESIDUALS = ("keep", "drop")
FITS = ("mirror", "stretch")
# Largest number of modes that identify() accepts.
_MOST_MODES = 10_000


@dataclass(frozen=True)
class DynamicTextureParams:
    """Settings of the identification and continuation of the flows of a clip.

    Parameters
    ----------
    residual : {"keep", "drop"}
        Whether motion outside the modes of the dynamics is added; ``"drop"`` is the paper's ``W = C ξ``.
    fit : {"mirror", "stretch"}
        How flows are fitted to the size of another scene.  ``"mirror"`` keeps the pixel scale: the flow is cropped to
        its centre along a shorter side, and continued by reflection along a longer one.  ``"stretch"`` keeps the field
        of view: the flow is interpolated over the scene, and displacements scale with it.
    largest_modulus : float
        Limit of the moduli of the eigenvalues of A and of φ, above 0 and below 1.
    flow : FlowParams
        Optical flow.
    centroid : CentroidParams
        Centroid iteration.
    dynamics : DynamicsParams
        Dynamic texture of the flow.
    """

    residual: Literal["keep", "drop"] = "keep"
    fit: Literal["mirror", "stretch"] = "mirror"
    largest_modulus: float = 0.99
    flow: FlowParams = field(default_factory=FlowParams)
    centroid: CentroidParams = field(default_factory=CentroidParams)
    dynamics: DynamicsParams = field(default_factory=DynamicsParams)

    def __post_init__(self) -> None:
        require(
            self.residual in RESIDUALS, f"residual: expected one of {', '.join(RESIDUALS)}, found {self.residual!r}"
        )
        require(self.fit in FITS, f"fit: expected one of {', '.join(FITS)}, found {self.fit!r}")
        require(
            0 < self.largest_modulus < 1, f"largest_modulus: expected above 0 and below 1, found {self.largest_modulus}"
        )


@dataclass(frozen=True, eq=False)
class TextureFlows:
    """Sequence of synthetic flows, each computed when it is requested."""

    modes: FloatArray  # (2 h w, m): C and D: orthonormal columns, one for each state, on the grid of the training flows
    states: Float64Array  # (m, count): ξ and η, one column for each flow
    grid: tuple[int, int]  # height h and width w of the training flows
    size: tuple[int, int]  # height H and width W of the resulting flows
    fit: str  # how a flow is fitted from the grid to that size

    def __len__(self) -> int:
        return self.states.shape[1]

    def __getitem__(self, index: int) -> FloatArray:
        flow = self.modes @ self.states[:, index].astype(np.float32)
        return _FITTERS[self.fit](flow.reshape(*self.grid, 2), *self.size)

    def __iter__(self) -> Iterator[FloatArray]:
        return (self[k] for k in range(len(self)))


@dataclass(frozen=True, eq=False)
class DynamicTexture:
    """A scene and synthetic flows that distort it.

    Attributes
    ----------
    scene : ndarray, float32, shape (H, W) or (H, W, 3)
        Truth of the synthetic sequence, at its mean geometry: the centroid of the clip, or the scene given.
    flows : TextureFlows
        From the scene to each frame, each of shape (H, W, 2), pixels.
    dynamics : FlowDynamics
        System identified from the clip, before its stabilisation.
    eigenvalues : ndarray, complex128, shape (n,)
        Eigenvalues of the stabilised A, largest modulus first.
    """

    scene: FloatArray
    flows: TextureFlows
    dynamics: FlowDynamics
    eigenvalues: NDArray[np.complex128]


def synthesize_like(
    frames: ArrayLike,
    count: int,
    rng: np.random.Generator,
    params: DynamicTextureParams | None = None,
    scene: ArrayLike | None = None,
    observe: Callable[[CentroidState], None] | None = None,
) -> DynamicTexture:
    """Learn the motion of a clip and continue it.

    Parameters
    ----------
    frames : array_like, shape (T, h, w) or (T, h, w, 3)
        Training clip of a static scene, at least three frames; some hundred are needed to describe the motion well.
    count : int
        Number of new flows.
    rng : numpy.random.Generator
        Source of randomness; the same state gives the same bytes.
    params : DynamicTextureParams, optional
        Settings.
    scene : array_like, shape (H, W) or (H, W, 3), optional
        Scene to distort, of any size; by default the centroid of the clip.
    observe : callable, optional
        Called with the state of the centroid after each flow that is measured.

    Returns
    -------
    DynamicTexture
        The memory of its flows is that of the flows of the clip, for any ``count``.

    Raises
    ------
    DataError
        Too few frames, wrong shapes, values that are not finite, or a scene that is small, of one colour or not in
        [0, 1].
    ConfigurationError
        ``count`` is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> from turbrestore.synthesis.smooth_flow import distort, smooth_flows
    >>> rng = np.random.default_rng(0)
    >>> clip = distort(resolution_chart(64, 64), smooth_flows(12, 64, 64, rng), rng, blur=1.0)
    >>> texture = synthesize_like(clip, 300, np.random.default_rng(1), scene=resolution_chart(80, 96))
    >>> len(texture.flows), texture.flows[299].shape
    (300, (80, 96, 2))
    """
    params = params or DynamicTextureParams()
    _check_count(count)
    given = None if scene is None else check_scene(scene)
    centroid = finish(centroid_steps(frames, params.centroid, params.flow), observe)
    image = centroid.image if given is None else given
    flows, dynamics = continue_flows(centroid.flows, count, rng, params, image.shape[:2])
    A, _ = stable_system(dynamics, params.largest_modulus)
    values = np.linalg.eigvals(A).astype(np.complex128)
    return DynamicTexture(image, flows, dynamics, values[np.argsort(-np.abs(values), kind="stable")])


def continue_flows(
    flows: ArrayLike,
    count: int,
    rng: np.random.Generator,
    params: DynamicTextureParams | None = None,
    size: tuple[int, ...] | None = None,
) -> tuple[TextureFlows, FlowDynamics]:
    """Synthesise flows that move like given ones.

    ``flows`` (τ, h, w, 2).
    """
    params = params or DynamicTextureParams()
    _check_count(count)
    training = check_flow(flows, "flows")
    if training.ndim != 4 or len(training) < 3:
        raise DataError(f"flows: expected shape (τ, H, W, 2) with at least 3 flows, found {training.shape}")
    dynamics = identify(training, params.dynamics)
    states = simulate(dynamics, count, rng, largest_modulus=params.largest_modulus).states
    modes = dynamics.C
    if params.residual == "keep":
        every = identify(training, replace(params.dynamics, rank=min(len(training), _MOST_MODES)))
        modes = every.C
        rest = every.states[dynamics.rank :]
        states = np.vstack([states, _autoregressions(rest, count, rng, params.largest_modulus)])
    grid = dynamics.shape
    height, width = grid if size is None else size[:2]
    return TextureFlows(modes, states, grid, (height, width), params.fit), dynamics


def _check_count(count: int) -> None:
    require(count >= 1, f"count: expected at least 1 frame, found {count}")


def _autoregressions(training: Float64Array, count: int, rng: np.random.Generator, largest: float) -> Float64Array:
    """Series with the variance and the lag-one correlation φ of each training series, drawn stationary."""
    energy = np.einsum("it,it->i", training, training)
    phi = np.clip(np.einsum("it,it->i", training[:, 1:], training[:, :-1]) / energy, -largest, largest)
    series = rng.standard_normal((len(training), count))
    fresh = np.sqrt(1 - phi**2)
    for k in range(1, count):
        series[:, k] = phi * series[:, k - 1] + fresh * series[:, k]
    return series * np.sqrt(energy / (training.shape[1] - 1))[:, None]


def _mirrored(flow: FloatArray, height: int, width: int) -> FloatArray:
    """Crop to the centre, or continue by reflection, to the given size."""
    edges = []
    for have, want in zip(flow.shape[:2], (height, width), strict=True):
        before = (want - have) // 2
        edges.append((before, want - have - before))
    cut = tuple(
        slice(max(-before, 0), have - max(-after, 0))
        for (before, after), have in zip(edges, flow.shape[:2], strict=True)
    )
    return np.pad(flow[cut], [*((max(b, 0), max(a, 0)) for b, a in edges), (0, 0)], mode="symmetric")


def _stretched(flow: FloatArray, height: int, width: int) -> FloatArray:
    """Interpolate to the given size; displacements scale with it."""
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR) * scale


_FITTERS: dict[str, Callable[[FloatArray, int, int], FloatArray]] = {"mirror": _mirrored, "stretch": _stretched}

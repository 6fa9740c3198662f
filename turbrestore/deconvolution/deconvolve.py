"""Deconvolution by nonlocal TV, TV, Wiener or Tikhonov regularisation, one problem statement (paper 3, section 5).

``min_u λ/2 ‖M(k∗u − f)‖² + J(u)``, the energy of which paper 3 gives the gradient flow (eqs. 21, 22, 24).

Symbols
-------
f : observed image; u : image that is sought.
k : point spread function; B : convolution with k, Bᵀ its adjoint (convolution with k*).
M : 1 where a pixel was seen, 0 in the margin.
λ : fidelity, the weight of the data. The paper's μ is 1 here, and 1/λ for its linear methods.
J : ``Σ|∇_w u|`` ("nltv"), ``Σ|∇u|`` ("tv"), ``½‖∇u‖²`` ("wiener"), ``½‖u − mean f‖²`` ("tikhonov").

Boundary
--------
Pixels near the border of f saw light from beyond it. The unknown u therefore has a margin of at least 4σ on each
side, in which M is 0, and the convolution is periodic on that larger domain: where its two sides meet nothing was
seen. Local differences are periodic too.

Algorithms
----------
nltv and tv: :mod:`turbrestore.deconvolution.primal_dual`; wiener and tikhonov:
:mod:`turbrestore.deconvolution.conjugate_gradient`.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.estimation import BlurEstimate
from ..blur.psf import (
    GAUSSIAN,
    Spectrum,
    blur_otf,
    check_exponent,
    check_psf,
    laplacian_symbol,
    psf_to_otf,
    wiener_fidelity,
)
from ..core.arrays import FloatArray, check_image
from ..core.errors import require, require_between
from ..core.noise import estimate_noise
from ..display.plots import plot_objective
from ..display.preview import preview
from ..runtime.device import PROCESSOR, find_device
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import drop_pages, new_stack, to_scratch
from ..runtime.threads import ThreadTeam, one_thread_each
from .conjugate_gradient import ConjugateGradients
from .deconvolution_memory import DeconvolutionWork, Room
from .nonlocal_penalty import NonlocalPenalty
from .nonlocal_tv import NonlocalParams, nonlocal_weights
from .planes import join_planes, margin_widths, padded_guide, split_planes
from .primal_dual import Penalty, PrimalDual
from .problem import Problem
from .stopping import TILE, relative_change, still_to_come, tile_sums
from .strip_grid import StripGrid
from .torch_deconvolution import SolverSettings, solve_on_device
from .tv import LocalPenalty

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("nltv", "tv", "wiener", "tikhonov")
BOUNDARIES = ("unknown", "periodic")
CHANNELS = ("luminance", "each")

# Least margin, in widths of the blur.
MARGIN_SIGMAS = 4.0
# Steps to the Wiener solution that is started from: from the first on only what lies near the border changes.
_START_STEPS = 40
# Smaller images go there one after the other: their transforms are shorter than a wait for the interpreter lock.
_SIDE_BY_SIDE = 1 << 15
# A multiple of the iterations that solvers have judged together.
_RECORD_EVERY = 10


@dataclass(frozen=True)
class DeconvolutionParams:
    """How an image is deblurred.

    Parameters
    ----------
    method : {"nltv", "tv", "wiener", "tikhonov"}
        Penalty: nonlocal TV, TV, squared gradient, squared deviation from the mean.
    sigma : float, optional
        Width of the blur, pixels, for callers that ask here; by default it is to be estimated.
    exponent : float, optional
        Shape of a blur that is known by its width: 2 is a Gaussian, 5/3 turbulence; see
        ``turbrestore.blur.psf.blur_otf``.  By default 2 for a given width, and 5/3 for one that is estimated.
    fidelity : float, optional
        λ: more is sharper and noisier; by default from the noise of the image, see ``automatic_fidelity``.
    iterations : int
        Largest number of iterations.
    tolerance : float
        Stop when no tile of 64×64 pixels is foreseen to change by this any more, relative to the brightest tile; see
        ``turbrestore.deconvolution.stopping``.  Of nltv and tv, whose images swing about the one that they approach,
        ten
        iterations are judged together, else two, and they stop too when for fifty iterations no tile has been further
        than this from what it is.
    boundary : {"unknown", "periodic"}
        What lies beyond the border: pixels to be found, or the image itself.
    channels : {"luminance", "each"}
        Of a colour image, deblur luminance and keep chroma, or deblur every channel.
    sharpen_guide : bool
        Compare patches of the guide after a Wiener deconvolution, not of the blurred guide as in the paper: sharp
        patches tell more about which pixels belong together (0.2 to 4 dB on photographs, brick and text).
    weights : NonlocalParams
        Nonlocal weights.
    """

    method: Literal["nltv", "tv", "wiener", "tikhonov"] = "nltv"
    sigma: float | None = None
    exponent: float | None = None
    fidelity: float | None = None
    iterations: int = 400
    tolerance: float = 3e-3
    boundary: Literal["unknown", "periodic"] = "unknown"
    channels: Literal["luminance", "each"] = "luminance"
    sharpen_guide: bool = True
    weights: NonlocalParams = field(default_factory=NonlocalParams)

    def __post_init__(self) -> None:
        for name, value, known in (
            ("method", self.method, METHODS),
            ("boundary", self.boundary, BOUNDARIES),
            ("channels", self.channels, CHANNELS),
        ):
            require(value in known, f"{name}: expected one of {', '.join(known)}, found {value!r}")
        if self.sigma is not None:
            require_between("sigma", self.sigma, 0, 1000, "pixels")
        if self.exponent is not None:
            check_exponent(self.exponent)
        if self.fidelity is not None:
            require_between("fidelity", self.fidelity, 1e-6, 1e9)
        require_between("iterations", self.iterations, 1, 100_000)
        require_between("tolerance", self.tolerance, 0, 1)


@dataclass(frozen=True, eq=False)
class Deconvolution:
    """A deblurred image and how it came about.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Clipped to [0, 1]; of a file without a name where memory was limited to less than it takes.
    sigma : float
        Standard deviation of the blur that was removed, pixels (root mean square over x and y of a given PSF).
    fidelity : float
        λ that was used.
    noise : float
        Standard deviation of the noise that was found in the blurred image, intensity.
    iterations : int
        Iterations that were run.
    converged : bool
        Whether less than the tolerance was still to come, or the image rested.
    recorded : ndarray, int64, shape (n,)
        Iterations at which the next two were recorded.
    objective : ndarray, float64, shape (n,)
        Value of the minimised energy, summed over channels.
    changes : ndarray, float64, shape (n,)
        Change of the tile that changes most over the iterations that are judged together, divided by their number, and
        relative to the brightest tile.  Of nltv and tv with an unknown boundary the outermost pixels do not count, as
        many as the blur is wide.
    """

    image: FloatArray
    sigma: float
    fidelity: float
    noise: float
    iterations: int
    converged: bool
    recorded: NDArray[np.int64]
    objective: NDArray[np.float64]
    changes: NDArray[np.float64]

    def plot(self) -> Figure:
        """Draw the energy over the iterations.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_objective(self.recorded, self.objective)

    def _repr_html_(self) -> str:
        facts = [
            ("blur removed", f"{self.sigma:.2f} pixels" if self.sigma > 0 else "none"),
            ("noise before", f"{100 * self.noise:.2f} % of full scale"),
            ("iterations", f"{self.iterations}, {'' if self.converged else 'not '}converged"),
        ]
        return preview("Deblurred image", facts, self.image)


class _State(Protocol):
    @property
    def image(self) -> FloatArray: ...


State = TypeVar("State", bound=_State)


def deconvolve(
    image: ArrayLike,
    sigma_or_psf: float | BlurEstimate | ArrayLike,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    progress: Callable[[int], None] | None = None,
) -> Deconvolution:
    """Deblur an image.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        f.
    sigma_or_psf : float, BlurEstimate, or array_like of shape (h, w) with odd sizes
        Width of a blur of shape ``params.exponent``, pixels; an estimate, of which the removable width and, unless
        ``params.exponent`` is given, the shape are taken; or a sampled point spread function. Without blur (0, or a
        single pixel) the image comes back as it is: an image that is not blurred is best left alone.
    params : DeconvolutionParams, optional
        Method and settings. ``params.sigma`` is not used here.
    guide : array_like, shape (H, W) or (H, W, 3), optional
        Image that nonlocal weights are taken from, as blurred as ``image``; by default ``image``. The paper takes
        the centroid.
    runtime : Runtime
        Threads, device and the most memory to take.
    progress : callable, optional
        Called with 1 after each iteration. Channels are solved side by side.

    Returns
    -------
    Deconvolution

    Raises
    ------
    DataError
        Wrong shapes, values that are not finite, or an unusable PSF.
    ConfigurationError
        ``sigma_or_psf`` is negative or not finite.
    StorageError
        There is no room for the file.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> square = np.zeros((48, 48), np.float32); square[16:32, 16:32] = 0.8
    >>> blurred = cv2.GaussianBlur(square, (0, 0), 1.5)
    >>> result = deconvolve(blurred, 1.5, DeconvolutionParams(method="tv", fidelity=1000.0))
    >>> bool(np.abs(result.image - square).mean() < 0.3 * np.abs(blurred - square).mean())
    True
    """
    params = params or DeconvolutionParams()
    pixels = check_image(image)
    if isinstance(sigma_or_psf, BlurEstimate):
        params = dataclasses.replace(params, exponent=params.exponent or sigma_or_psf.exponent)
        sigma_or_psf = sigma_or_psf.removable
    psf, sigma, margin = _read_blur(sigma_or_psf)
    planes = split_planes(pixels, params.channels)
    noise, fidelity = _noise_and_fidelity(planes, params)
    nothing = np.zeros(0)
    if sigma == 0:
        return Deconvolution(pixels, 0.0, fidelity, noise, 0, True, nothing.astype(np.int64), nothing, nothing)
    size = planes[0].shape
    widths = margin_widths(size, margin if params.boundary == "unknown" else None)
    shape = size[0] + sum(widths[0]), size[1] + sum(widths[1])
    inside = tuple(slice(before, before + length) for (before, _), length in zip(widths, size, strict=True))
    otf = blur_otf(shape, sigma, params.exponent or GAUSSIAN) if psf is None else psf_to_otf(psf, shape)
    memory = runtime.memory_limit if find_device(runtime.device) == PROCESSOR else None
    room = DeconvolutionWork(shape, len(planes), params.method, params.weights).room(memory, runtime.workers)
    folder = runtime.scratch or Path(tempfile.gettempdir())
    with one_thread_each(), ThreadTeam(room.threads) as team:
        grid = StripGrid(shape, team, folder if room.images_in_file else None)
        swings = params.boundary == "unknown" and params.method in ("nltv", "tv")
        rim = min(int(np.ceil(sigma)), min(size) // 4) if swings else 0
        problems = _pose(planes, widths, inside, rim, grid, otf, fidelity)
        around = padded_guide(guide, size, widths)
        around = None if around is None else to_scratch(around, grid.folder)
        for array in (pixels, guide):
            drop_pages(array)
        result = _solve(problems, params, around, progress, _Workshop(team, room, folder, runtime.device))
    restored = new_stack(pixels.shape, grid.folder)

    def join(rows: slice) -> None:
        found = join_planes(pixels[rows], [u[inside][rows] for u in result.images], params.channels)
        np.clip(found, 0, 1, out=restored[rows])

    StripGrid(size, None, grid.folder).over_rows(join, pixels, restored, *result.images)
    return Deconvolution(restored, sigma, fidelity, noise, *result[1:])


def automatic_fidelity(method: str, image: FloatArray, noise: float) -> float:
    """Weight λ of the data from the noise of the blurred image.

    Parameters
    ----------
    method : {"nltv", "tv", "wiener", "tikhonov"}
        Penalty.
    image : ndarray, float32, shape (H, W)
        Blurred image.
    noise : float
        Standard deviation n of its noise, intensity.

    Returns
    -------
    float
        nltv ``20/√(n² + .004²)``, tv ``12/√(n² + .003²)``; wiener as :func:`turbrestore.blur.psf.wiener_fidelity`,
        tikhonov half of that.

    Notes
    -----
    Total variation has the unit of intensity and the data term its square, hence 1/n. For nltv and tv on
    photographs, brick and text blurred with σ 1–3 the result is within 0.4 dB of the best λ for n = .01–.02. Below,
    a perfectly known blur would bear 3 to 10 times more (0.1–3 dB, 5 dB on thin text). The floors keep λ
    where a slightly wrong σ does little harm: a registered average is less sharp than its noise promises. On
    registered averages of simulated turbulence, with σ within 0.2 px, 3λ gains 0.3 dB at most and loses up to 1.7.

    Examples
    --------
    >>> import numpy as np
    >>> round(automatic_fidelity("nltv", np.zeros((2, 2), np.float32), 0.003))
    4000
    """
    if method == "nltv":
        return 20.0 / float(np.hypot(noise, 0.004))
    if method == "tv":
        return 12.0 / float(np.hypot(noise, 0.003))
    fidelity = wiener_fidelity(image, noise)
    return fidelity if method == "wiener" else fidelity / 2


class _Solution(NamedTuple):
    images: list[FloatArray]
    iterations: int
    converged: bool
    recorded: NDArray[np.int64]
    objective: NDArray[np.float64]
    changes: NDArray[np.float64]


def _pose(
    planes: list[FloatArray],
    widths: list[tuple[int, int]],
    inside: tuple[slice, ...],
    rim: int,
    grid: StripGrid,
    otf: Spectrum,
    fidelity: float,
) -> list[Problem]:
    """Continue planes into the margin, one after the other: none is left in the list."""
    transfer, seen, problems = grid.in_blocks(otf), grid.image(), list[Problem]()
    seen[:], seen[inside] = 0, 1
    drop_pages(seen)
    judged = tuple(np.zeros(length, np.float32) for length in grid.shape)
    for axis, part in zip(judged, inside, strict=True):
        axis[part.start + rim : part.stop - rim] = 1
    while planes:
        observed = to_scratch(np.pad(planes.pop(0), widths, mode="symmetric"), grid.folder)
        problems.append(Problem(observed, seen, transfer, fidelity, grid, (judged[0], judged[1])))
    return problems


class _Workshop(NamedTuple):
    """Threads, what there is room for, and the folder for the rest."""

    team: ThreadTeam
    room: Room
    folder: Path
    device: str


def _solve(
    problems: list[Problem],
    params: DeconvolutionParams,
    guide: FloatArray | None,
    progress: Callable[[int], None] | None,
    workshop: _Workshop,
) -> _Solution:
    if find_device(workshop.device) != PROCESSOR:
        return _solve_on_device(problems, params, guide, progress, find_device(workshop.device))
    if params.method in ("wiener", "tikhonov"):
        quadratic = _quadratic_solver(problems[0].grid, params.method)
        return _iterate(quadratic, problems, [quadratic.start(p) for p in problems], params, progress)
    starts, guide = _sharpened(problems, guide, params, workshop)
    penalty: Penalty = LocalPenalty(problems[0].grid)
    if params.method == "nltv":
        folder = workshop.folder if workshop.room.in_file else None
        graph = nonlocal_weights(guide, params.weights, folder, workshop.room.threads)
        penalty = NonlocalPenalty(graph, problems[0].grid, folder)
    del guide
    solver = PrimalDual(penalty)
    states = [solver.start(problem, u) for problem, u in zip(problems, starts, strict=True)]
    del starts
    return _iterate(solver, problems, states, params, progress)


def _solve_on_device(
    problems: list[Problem],
    params: DeconvolutionParams,
    guide: FloatArray | None,
    progress: Callable[[int], None] | None,
    device: str,
) -> _Solution:
    settings = SolverSettings(
        params.method,
        params.iterations,
        params.tolerance,
        _RECORD_EVERY,
        _START_STEPS,
        params.sharpen_guide,
        params.weights,
    )
    found = solve_on_device(problems, guide, settings, device, progress)
    recorded, objective, changes = zip(*found.records, strict=True)
    figures = np.array(recorded), np.array(objective), np.array(changes)
    return _Solution(found.images, found.iterations, found.converged, *figures)


class _Solver(Protocol[State]):
    window: ClassVar[int]
    rest: ClassVar[int]

    def step(self, problem: Problem, state: State) -> State: ...
    def penalty(self, problem: Problem, u: FloatArray) -> float: ...


def _iterate(
    solver: _Solver[State],
    problems: list[Problem],
    states: list[State],
    params: DeconvolutionParams,
    progress: Callable[[int], None] | None,
) -> _Solution:
    """Step all channels side by side until none changes any more."""
    records: list[tuple[int, float, float]] = []
    grid, images = problems[0].grid, [state.image for state in states]
    # Of the last windows: a step changes images in place.
    earlier = deque([[grid.copied(u) for u in images]], max(solver.rest, 1))
    moved, begun, converged = list[float](), 0, False
    for iteration in range(1, params.iterations + 1):
        states = [solver.step(problem, state) for problem, state in zip(problems, states, strict=True)]
        last = iteration == params.iterations
        if last or iteration % solver.window == 0:
            images = [state.image for state in states]
            moved.append(_change(earlier[-1], images, problems[0]) * solver.window / (iteration - begun))
            converged = still_to_come(moved) <= params.tolerance
            if not converged and len(earlier) == solver.rest and iteration % solver.window == 0:
                converged = all(_change(old, images, problems[0]) <= params.tolerance for old in earlier)
            last |= converged
            begun = iteration
            if not last:
                if len(earlier) == earlier.maxlen:
                    # Its memory is free for the next.
                    earlier.popleft()
                earlier.append([grid.copied(u) for u in images])
        if last or iteration % _RECORD_EVERY == 0:
            energies = (p.misfit(u) + solver.penalty(p, u) for p, u in zip(problems, images, strict=True))
            records.append((iteration, sum(energies), moved[-1] / solver.window))
        if progress is not None:
            progress(1)
        if last:
            break
    recorded, objective, changes = zip(*records, strict=True)
    return _Solution(images, iteration, converged, np.array(recorded), np.array(objective), np.array(changes))


def _quadratic_solver(grid: StripGrid, method: str) -> ConjugateGradients:
    if method == "wiener":
        return ConjugateGradients(grid.in_blocks(laplacian_symbol(*grid.shape)))
    one = grid.multiplier()
    one[:] = 1
    drop_pages(one)
    return ConjugateGradients(one)


def _wiener_image(problem: Problem) -> FloatArray:
    """Wiener solution with its own fidelity."""
    problem = dataclasses.replace(problem, fidelity=wiener_fidelity(problem.observed, estimate_noise(problem.observed)))
    solver = _quadratic_solver(problem.grid, "wiener")
    state = solver.start(problem)
    for _ in range(_START_STEPS):
        state = solver.step(problem, state)
    return state.image


def _sharpened(
    problems: list[Problem], guide: FloatArray | None, params: DeconvolutionParams, workshop: _Workshop
) -> tuple[list[FloatArray], FloatArray]:
    """Wiener solutions to start from, and the guide of the weights: by default the mean of what is deblurred."""
    blurred, grid = list(problems), problems[0].grid
    if params.method == "nltv" and params.sharpen_guide and guide is not None:
        blurred.append(dataclasses.replace(problems[0], observed=guide))
    pays = grid.shape[0] * grid.shape[1] >= _SIDE_BY_SIDE
    if pays and (grid.one_strip or (grid.folder is None and len(blurred) >= workshop.room.threads)):
        # Side by side, each with what it works with.
        apart = [dataclasses.replace(problem, grid=StripGrid(grid.shape)) for problem in blurred]
        sharp = list(workshop.team.map(_wiener_image, apart))
    else:
        sharp = [_wiener_image(problem) for problem in blurred]
    starts, further = sharp[: len(problems)], sharp[len(problems) :]
    if further:
        guide = further[0]
    elif guide is None:
        guide = _mean_image(starts if params.sharpen_guide else [p.observed for p in problems], grid)
    return starts, guide


def _mean_image(images: list[FloatArray], grid: StripGrid) -> FloatArray:
    mean = grid.image()

    def put(rows: slice) -> None:
        np.mean([image[rows] for image in images], axis=0, dtype=np.float32, out=mean[rows])

    grid.over_rows(put, mean, *images)
    return mean


def _noise_and_fidelity(planes: list[FloatArray], params: DeconvolutionParams) -> tuple[float, float]:
    noise = float(np.sqrt(np.mean([estimate_noise(plane) ** 2 for plane in planes])))
    return noise, params.fidelity or automatic_fidelity(params.method, planes[0], noise)


def _read_blur(sigma_or_psf: float | ArrayLike) -> tuple[NDArray[np.float64] | None, float, int]:
    """PSF (None for a Gaussian), its standard deviation, and how many pixels it reaches."""
    if np.ndim(sigma_or_psf) == 0:
        sigma: Any = sigma_or_psf
        require(
            np.isfinite(sigma) and sigma >= 0,
            f"sigma_or_psf: expected a finite number of 0 or more pixels, found {sigma}",
        )
        return None, float(sigma), int(np.ceil(MARGIN_SIGMAS * sigma))
    psf = check_psf(sigma_or_psf)
    y, x = (np.arange(size) - size // 2 for size in psf.shape)
    squares = psf.sum(axis=1) @ y**2 + psf.sum(axis=0) @ x**2
    return psf, float(np.sqrt(squares / 2)), max(psf.shape) // 2


def _change(before: list[FloatArray], after: list[FloatArray], problem: Problem) -> float:
    """Of what is shown: the margin, which is cut off, drifts for long, and so may what is clipped."""
    grid = problem.grid
    sums = np.zeros((2, *(-(-length // TILE) for length in grid.shape)))

    def squares(rows: slice, old: FloatArray, new: FloatArray) -> tuple[int, NDArray[np.float64]]:
        then, now = (np.clip(image[rows], 0, 1) for image in (old, new))
        weight = problem.weight(rows)
        both = (tile_sums(weight * np.square(part), rows.start) for part in (now - then, now))
        return rows.start // TILE, np.array(list(both))

    for old, new in zip(before, after, strict=True):
        for first, found in grid.over_rows(partial(squares, old=old, new=new), old, new):
            sums[:, first : first + found.shape[1]] += found
    return relative_change(*sums)

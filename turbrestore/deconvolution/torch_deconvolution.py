"""The solvers of deconvolution in torch: primal-dual splitting (nltv, tv) and conjugate gradients (wiener, tikhonov).

Symbols, problems, steps and stopping as in :mod:`turbrestore.deconvolution.deconvolve`,
:mod:`turbrestore.deconvolution.primal_dual` and
:mod:`turbrestore.deconvolution.conjugate_gradient`; nothing leaves the device between iterations but the sums that
they stop by. Sums that decide are taken in double precision, as they are there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from ..blur.psf import laplacian_symbol, wiener_fidelity
from ..core.arrays import FloatArray
from ..core.noise import estimate_noise
from ..runtime.device import memory_of
from .conjugate_gradient import ROUNDING, ConjugateGradients
from .nonlocal_tv import NonlocalParams
from .primal_dual import LEAST_DATA_STEP, PRIMAL_STEP, RELAXATION, REST, WINDOW
from .problem import Problem
from .stopping import TILE, relative_change, still_to_come
from .torch_weights import (
    device_divergence,
    device_gradient,
    device_magnitude,
    device_norm_squared,
    device_projection,
    weights_on_device,
)

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class SolverSettings:
    """When the solvers stop, and what the penalty is.

    Parameters
    ----------
    method : {"nltv", "tv", "wiener", "tikhonov"}
    iterations : int
        Most iterations.
    tolerance : float
        They stop when less than this is still to come, or the image rests (:mod:`turbrestore.deconvolution.stopping`).
    record_every : int
        Iterations from one record of the energy to the next, a multiple of those that are judged together.
    start_steps : int
        Of the Wiener solution that nltv and tv start from.
    sharpen_guide : bool
        Compare patches of the guide after a Wiener deconvolution.
    weights : NonlocalParams
    """

    method: str
    iterations: int
    tolerance: float
    record_every: int
    start_steps: int
    sharpen_guide: bool
    weights: NonlocalParams


class DeviceSolution(NamedTuple):
    """Images, iterations, whether they converged, and a record (iteration, energy, change) every so often."""

    images: list[FloatArray]
    iterations: int
    converged: bool
    records: list[tuple[int, float, float]]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Data term ``λ/2 ‖M(k∗u − f)‖²`` on a device; see :class:`turbrestore.deconvolution.problem.Problem`."""

    observed: Tensor
    seen: Tensor
    otf: Tensor
    fidelity: float
    weight: Tensor

    def gradient_spectrum(self, spectrum: Tensor) -> Tensor:
        return self.fidelity * self.otf.conj() * _forward(self.residual(spectrum))

    def blurred(self, spectrum: Tensor) -> Tensor:
        return _back(self.otf * spectrum, self.observed)

    def residual(self, spectrum: Tensor) -> Tensor:
        return self.seen * (self.blurred(spectrum) - self.observed)

    def misfit(self, u: Tensor) -> float:
        residual = self.residual(_forward(u))
        return self.fidelity / 2 * _inner(residual, residual)

    def mean(self) -> float:
        return _inner(self.seen, self.observed) / _total(self.seen)


class _Penalty(NamedTuple):
    gradient: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]
    project: Callable[[Tensor], Tensor]
    value: Callable[[Tensor], float]
    norm_squared: float


class _DualState(NamedTuple):
    image: Tensor
    blurred: Tensor
    pressure: Tensor
    dual: Tensor
    number: int


class _GradientState(NamedTuple):
    image: Tensor
    residual: Tensor
    direction: Tensor
    decrease: float
    enough: float


def solve_on_device(
    problems: list[Problem],
    guide: FloatArray | None,
    settings: SolverSettings,
    device: str,
    progress: Callable[[int], None] | None = None,
) -> DeviceSolution:
    """Solve the problems of all channels side by side.

    Parameters
    ----------
    problems : list of Problem
        One for each channel.
    guide : ndarray, float32, shape of the images, or None
        What nonlocal weights are taken from; None for the images themselves.
    settings : SolverSettings
    device : str
        Name that torch gives it.
    progress : callable, optional
        Called with 1 after each iteration.

    Returns
    -------
    DeviceSolution

    Raises
    ------
    ConfigurationError
        The memory of the device is not enough.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.deconvolution.strip_grid import StripGrid
    >>> flat = np.full((16, 16), 0.5, np.float32)
    >>> problem = Problem(flat, np.ones_like(flat), np.ones((1, 16, 9), np.float32), 100.0, StripGrid((16, 16)))
    >>> settings = SolverSettings("tv", 50, 1e-4, 10, 40, True, NonlocalParams())
    >>> solution = solve_on_device([problem], None, settings, "cpu")
    >>> solution.converged, bool(np.allclose(solution.images[0], 0.5, atol=1e-5))
    (True, True)
    """
    with memory_of(device, "take a smaller --roi"):
        return _solve(problems, guide, settings, device, progress)


def _solve(
    problems: list[Problem],
    guide: FloatArray | None,
    settings: SolverSettings,
    device: str,
    progress: Callable[[int], None] | None,
) -> DeviceSolution:
    loaded = [_load(problem, device) for problem in problems]
    if settings.method in ("wiener", "tikhonov"):
        symbol = np.ones((1, 1), np.float32) if settings.method == "tikhonov" else _laplacian(problems[0])
        quadratic = _Quadratic(_tensor(symbol, device))
        return _iterate(quadratic, loaded, [quadratic.start(p) for p in loaded], settings, progress)
    starts = [_wiener_image(problem, settings, device) for problem in problems]
    penalty = _local_tv() if settings.method == "tv" else _nonlocal_tv(problems, starts, guide, settings, device)
    solver = _PrimalDual(penalty)
    states = [solver.start(problem, u) for problem, u in zip(loaded, starts, strict=True)]
    return _iterate(solver, loaded, states, settings, progress)


def _iterate(
    solver: _PrimalDual | _Quadratic,
    problems: list[_Problem],
    states: list,
    settings: SolverSettings,
    progress: Callable[[int], None] | None,
) -> DeviceSolution:
    records: list[tuple[int, float, float]] = []
    images = [state.image for state in states]
    earlier, moved, begun, converged = deque([images], max(solver.rest, 1)), list[float](), 0, False
    for iteration in range(1, settings.iterations + 1):
        states = [solver.step(problem, state) for problem, state in zip(problems, states, strict=True)]
        last = iteration == settings.iterations
        if last or iteration % solver.window == 0:
            images = [state.image for state in states]
            moved.append(_change(earlier[-1], images, problems[0].weight) * solver.window / (iteration - begun))
            converged = still_to_come(moved) <= settings.tolerance
            if not converged and len(earlier) == solver.rest and iteration % solver.window == 0:
                converged = all(_change(old, images, problems[0].weight) <= settings.tolerance for old in earlier)
            last |= converged
            begun = iteration
            earlier.append(images)
        if last or iteration % settings.record_every == 0:
            energies = (p.misfit(u) + solver.penalty(p, u) for p, u in zip(problems, images, strict=True))
            records.append((iteration, sum(energies), moved[-1] / solver.window))
        if progress is not None:
            progress(1)
        if last:
            break
    return DeviceSolution([u.cpu().numpy() for u in images], iteration, converged, records)


@dataclass(frozen=True, eq=False)
class _PrimalDual:
    """See :class:`turbrestore.deconvolution.primal_dual.PrimalDual`."""

    regulariser: _Penalty
    window: ClassVar[int] = WINDOW
    rest: ClassVar[int] = REST

    def start(self, problem: _Problem, u: Tensor) -> _DualState:
        blurred = problem.blurred(_forward(u))
        p = self.regulariser.project(self.regulariser.gradient(u) * self._steps[1])
        return _DualState(u, blurred, problem.fidelity * problem.seen * (blurred - problem.observed), p, 1)

    def step(self, problem: _Problem, state: _DualState) -> _DualState:
        tau, s = self._steps
        u, blurred, q, p, number = state
        share = max(1 / number, LEAST_DATA_STEP)
        metric = 1 / tau + share * problem.fidelity * problem.otf.abs() ** 2
        down = (_forward(self.regulariser.adjoint(p)) + problem.otf.conj() * _forward(q)) / metric
        moved, drop = _back(down, u), problem.blurred(down)
        ascent = self.regulariser.gradient(u - 2 * moved).mul_(s).add_(p)
        forward, raised = self.regulariser.project(ascent), _raised(problem, q, blurred - 2 * drop, share)
        u, blurred = u - RELAXATION * moved, blurred - RELAXATION * drop
        return _DualState(u, blurred, q + RELAXATION * (raised - q), p + RELAXATION * (forward - p), number + 1)

    def penalty(self, problem: _Problem, u: Tensor) -> float:
        return self.regulariser.value(u)

    @property
    def _steps(self) -> tuple[float, float]:
        norm = self.regulariser.norm_squared**0.5
        return PRIMAL_STEP / norm, 1 / (PRIMAL_STEP * norm)


def _raised(problem: _Problem, q: Tensor, ahead: Tensor, share: float) -> Tensor:
    """Step of q where Bu is ``ahead``; ``share`` is t/λ."""
    return problem.seen * (q + share * problem.fidelity * (ahead - problem.observed)) / (1 + share)


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """See :class:`turbrestore.deconvolution.conjugate_gradient.ConjugateGradients`."""

    symbol: Tensor
    window: ClassVar[int] = ConjugateGradients.window
    rest: ClassVar[int] = ConjugateGradients.rest

    def start(self, problem: _Problem) -> _GradientState:
        m = problem.mean()
        u = m + self._precondition(problem, _forward(problem.observed - m) * problem.otf.conj() * problem.fidelity)
        residual = -_back(problem.gradient_spectrum(_forward(u)) + self.symbol * _forward(u - m), u)
        direction = self._precondition(problem, _forward(residual))
        enough = ROUNDING * problem.fidelity * _inner(problem.observed, problem.observed)
        return _GradientState(u, residual, direction, _inner(residual, direction), enough)

    def step(self, problem: _Problem, state: _GradientState) -> _GradientState:
        if state.decrease <= state.enough:
            return state
        spectrum = _forward(state.direction)
        blurred = problem.seen * _back(problem.otf * spectrum, state.image)
        data = problem.fidelity * problem.otf.conj() * _forward(blurred)
        image = _back(data + self.symbol * spectrum, state.image)
        length = state.decrease / _inner(state.direction, image)
        residual = state.residual - length * image
        preconditioned = self._precondition(problem, _forward(residual))
        decrease = _inner(residual, preconditioned)
        direction = preconditioned + (decrease / state.decrease) * state.direction
        return _GradientState(state.image + length * state.direction, residual, direction, decrease, state.enough)

    def penalty(self, problem: _Problem, u: Tensor) -> float:
        deviation = u - problem.mean()
        return _inner(deviation, _back(self.symbol * _forward(deviation), u)) / 2

    def _precondition(self, problem: _Problem, spectrum: Tensor) -> Tensor:
        denominator = problem.fidelity * problem.otf.abs() ** 2 + self.symbol
        return _back(spectrum / denominator, problem.observed)


def _wiener_image(problem: Problem, settings: SolverSettings, device: str) -> Tensor:
    """Wiener solution with its own fidelity."""
    fidelity = wiener_fidelity(problem.observed, estimate_noise(problem.observed))
    loaded = _load(replace(problem, fidelity=fidelity), device)
    solver = _Quadratic(_tensor(_laplacian(problem), device))
    state = solver.start(loaded)
    for _ in range(settings.start_steps):
        state = solver.step(loaded, state)
    return state.image


def _nonlocal_tv(
    problems: list[Problem], starts: list[Tensor], guide: FloatArray | None, settings: SolverSettings, device: str
) -> _Penalty:
    """Penalty whose weights come from the guide, or from the image itself (the mean of its channels)."""
    if guide is not None and settings.sharpen_guide:
        guide = _wiener_image(replace(problems[0], observed=guide), settings, device).cpu().numpy()
    elif guide is None:
        own = [u.cpu().numpy() for u in starts] if settings.sharpen_guide else [p.observed for p in problems]
        guide = np.mean(own, axis=0, dtype=np.float32)
    graph = weights_on_device(guide, settings.weights, device)
    return _Penalty(
        gradient=lambda u: device_gradient(graph, u),
        adjoint=lambda p: -device_divergence(graph, p),
        project=lambda p: device_projection(graph, p),
        value=lambda u: _total(device_magnitude(graph, device_gradient(graph, u))),
        norm_squared=device_norm_squared(graph),
    )


def _local_tv() -> _Penalty:
    """See :mod:`turbrestore.deconvolution.tv`."""
    import torch

    def gradient(u: Tensor) -> Tensor:
        return torch.stack([u.roll(-1, 0) - u, u.roll(-1, 1) - u])

    def length(p: Tensor) -> Tensor:
        return p.square().sum(0).sqrt()

    return _Penalty(
        gradient=gradient,
        adjoint=lambda p: p[0].roll(1, 0) - p[0] + p[1].roll(1, 1) - p[1],
        project=lambda p: p / length(p).clamp(min=1),
        value=lambda u: _total(length(gradient(u))),
        norm_squared=8.0,
    )


def _laplacian(problem: Problem) -> FloatArray:
    return laplacian_symbol(problem.seen.shape[0], problem.seen.shape[1])


def _load(problem: Problem, device: str) -> _Problem:
    whole = np.concatenate(problem.transfer, axis=1)[:, : problem.seen.shape[1] // 2 + 1]
    arrays = problem.observed, problem.seen, whole, problem.weight(slice(None))
    observed, seen, otf, weight = (_tensor(array, device) for array in arrays)
    return _Problem(observed, seen, otf, problem.fidelity, weight)


def _tensor(array: np.ndarray, device: str) -> Tensor:
    import torch

    return torch.from_numpy(np.require(array, requirements=["C", "W"])).to(device)


def _forward(u: Tensor) -> Tensor:
    import torch

    return torch.fft.rfft2(u)


def _back(spectrum: Tensor, like: Tensor) -> Tensor:
    import torch

    return torch.fft.irfft2(spectrum, s=like.shape)


def _inner(a: Tensor, b: Tensor) -> float:
    return _total(a * b)


def _total(values: Tensor) -> float:
    import torch

    return float(values.sum(dtype=torch.float64))


def _change(before: list[Tensor], after: list[Tensor], weight: Tensor) -> float:
    import torch

    sums = []
    for old, new in zip(before, after, strict=True):
        then, now = old.clamp(0, 1), new.clamp(0, 1)
        sums.append(torch.stack([_tile_sums(weight * part.square()) for part in (now - then, now)]))
    moved, size = torch.stack(sums).sum(0).cpu().numpy()
    return relative_change(moved, size)


def _tile_sums(image: Tensor) -> Tensor:
    """Sum the whole image over tiles."""
    import torch

    down, right = (-(-length // TILE) for length in image.shape)
    room = image.new_zeros((down * TILE, right * TILE))
    room[: image.shape[0], : image.shape[1]] = image
    return room.view(down, TILE, right, TILE).sum((1, 3), dtype=torch.float64)

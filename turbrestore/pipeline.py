"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .blind.remove_blur import Deblurred, remove_blur_steps
from .core.arrays import FloatArray
from .core.decision import Decision
from .core.errors import DataError, require
from .dynamics.dynamic_texture import identify
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import Filtered, FilterStep, filter_steps
from .footage.frame_selection import best_frames, frame_quality
from .io.output import check_space
from .io.source import FrameSource
from .memory_plan import MemoryPlan, plan_memory
from .registration.centroid import Centroid, centroid_steps
from .registration.coverage import Rectangle, coverage, well_seen
from .registration.flow import MIN_SIDE
from .results import NoStore, Restoration, Store
from .runtime.allocator import returning_freed_memory
from .runtime.device import explain_device
from .runtime.runtime import DEFAULT, Runtime
from .runtime.scratch import fill_stack, iter_frames, mean_of
from .runtime.steps import finish
from .runtime.tiling import HaloTile, cut_tile, halo_tiles
from .settings import RestoreParams
from .tiled_stages import join_filtered, tiled_centroid_steps
from .wording import (
    explain_border,
    explain_camera,
    explain_centroid,
    explain_dynamics,
    explain_frames,
    explain_input,
    explain_motion,
    explain_training,
)

# Share of the training frames that show every pixel of a cropped image.
_SEEN = 0.9
# A contrast below one grey level of an 8-bit camera is no scene.
_LEAST_CONTRAST = 1 / 255
# A blur wider than this share of the image leaves nothing to restore.
_SIGMAS_A_SIDE = 8

Progress = Callable[[str, int, int], None]
Result = TypeVar("Result")


def restore(
    frames: FrameSource | ArrayLike,
    params: RestoreParams | None = None,
    runtime: Runtime = DEFAULT,
    store: Store | None = None,
    progress: Progress | None = None,
    on_decision: Callable[[Decision], None] | None = None,
) -> Restoration:
    """Restore one image from frames of a static scene.

    Frames are read in order.  Only the training frames stay in memory, or in a scratch file where they do not fit.

    Parameters
    ----------
    frames : FrameSource or array_like, shape (T, H, W) or (T, H, W, 3)
        At least two frames of at least 16×16 pixels.
    params : RestoreParams, optional
        Settings of every stage.
    runtime : Runtime
        What the restoration may use of the machine.
    store : Store, optional
        Keeps the results of the stages and knows those of an earlier run of the same frames and settings, which are
        taken over as they are; the image is then the same, bit for bit.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    on_decision : callable, optional
        Called with every :class:`turbrestore.Decision` when it is made.

    Returns
    -------
    Restoration

    Raises
    ------
    DataError
        Too few, too small, damaged or constant frames.
    ConfigurationError
        More training frames than frames, a device that is not there, or a memory limit that cannot be kept.
    StorageError
        There is no room for a scratch file.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> from turbrestore.synthesis.smooth_flow import distort, smooth_flows
    >>> rng = np.random.default_rng(0)
    >>> frames = distort(resolution_chart(64, 64), smooth_flows(6, 64, 64, rng), rng, blur=1.0, noise=0.01)
    >>> restoration = restore(frames)
    >>> restoration.image.shape, restoration.train
    ((64, 64), 6)
    """
    params = params or RestoreParams()
    source = frames if isinstance(frames, FrameSource) else FrameSource.from_array(frames)
    plan = plan_memory(source.shape, params, runtime)
    _check_sigma(params.deconvolution.sigma, source.shape)
    if plan.runtime.scratch is not None:
        check_space(plan.runtime.scratch / "scratch file", plan.scratch_bytes)
    size = source.shape[1], source.shape[2]
    tiles = () if plan.tile is None else halo_tiles(size, plan.tile)
    run = _Run(source, params, plan, tiles, store or NoStore(), progress, on_decision)
    run.decide(*plan.decisions, *explain_device(runtime.device, plan.runtime.device, params.flow.method))
    with returning_freed_memory(runtime.memory_limit is not None):
        return _restored(run)


@dataclass(frozen=True)
class _Run:
    """What every stage needs, what was decided, and the time that each stage has taken."""

    source: FrameSource
    params: RestoreParams
    plan: MemoryPlan
    tiles: tuple[HaloTile, ...]
    store: Store
    progress: Progress | None
    on_decision: Callable[[Decision], None] | None
    decisions: list[Decision] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def decide(self, *decisions: Decision) -> None:
        """Record decisions, and tell whoever listens."""
        self.decisions.extend(decisions)
        if self.on_decision is not None:
            for decision in decisions:
                self.on_decision(decision)

    def stage(self, stage: str, name: str, compute: Callable[[], Result]) -> Result:
        """Take the result of that name from the store, or compute it; the time counts as that of the stage."""
        begun = time.perf_counter()
        result = self.store.get(name, compute)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begun
        return result

    def counter(self, stage: str, total: int) -> Callable[[object], None]:
        """Return the observer of the steps of one stage, which reports progress."""
        return step_counter(self.progress, stage, total)


def step_counter(progress: Progress | None, stage: str, total: int) -> Callable[[object], None]:
    """Turn ``progress(stage, done, total)`` into an observer of the states of one stage, which counts them.

    Parameters
    ----------
    progress : callable or None
    stage : str
        Name of the stage.
    total : int
        Largest number of steps.

    Returns
    -------
    callable
        Takes a state, for :func:`turbrestore.runtime.steps.finish`.

    Examples
    --------
    >>> observe = step_counter(lambda stage, done, total: print(stage, done, total), "filter", 5)
    >>> observe("any state")
    filter 1 5
    """
    done = 0

    def observe(_: object) -> None:
        nonlocal done
        done = min(done + 1, total)
        if progress is not None:
            progress(stage, done, total)

    return observe


def _restored(run: _Run) -> Restoration:
    """Fuse the frames, deblur the image and crop it."""
    params = run.params
    fused = _fuse(run)
    image, centroid, deblurred = fused.image, fused.centroid, None
    if params.runs("deconvolve"):
        deblurred = run.stage("deconvolve", "deblurred", lambda: _deblur(run, fused.image, centroid.image))
        run.decide(*deblurred.decisions)
        image = deblurred.deconvolution.image
    crop, on_border = _crop(image, centroid.flows, params.border, deblurred)
    run.decide(on_border)
    x, y, width, height = crop
    return Restoration(
        image=image if params.border == "keep" else image[y : y + height, x : x + width],
        crop=crop,
        mean=fused.mean,
        centroid=centroid,
        dynamics=fused.dynamics,
        filtered=fused.filtered,
        blur=None if deblurred is None else deblurred.blur,
        deconvolution=None if deblurred is None else deblurred.deconvolution,
        guard_readings=() if deblurred is None else deblurred.readings,
        decisions=tuple(run.decisions),
        train=run.plan.train,
        frame_count=len(run.source) if params.runs("filter") else run.plan.train,
        seconds=run.seconds,
    )


@dataclass(frozen=True)
class _Fused:
    """What the stages before the deconvolution have found."""

    image: FloatArray
    mean: FloatArray
    centroid: Centroid
    dynamics: FlowDynamics | None = None
    filtered: Filtered | None = None


def _fuse(run: _Run) -> _Fused:
    """Run the stages up to the filter; the training frames are gone when they are done."""
    params, train, stream = run.params, run.plan.train, iter(run.source)
    begun = time.perf_counter()
    training = _read_training(stream, train, run.source.shape, run.plan.runtime)
    run.seconds["read"] = time.perf_counter() - begun
    run.decide(explain_training(train, len(run.source), params.train), *explain_input(training))

    centroid = run.stage("centroid", "centroid", lambda: _find_centroid(run, training))
    run.decide(explain_centroid(centroid), *explain_camera(centroid.flows), *explain_motion(centroid.flows))
    if not params.runs("identify"):
        return _Fused(centroid.image, mean_of(training), centroid)

    dynamics = run.stage("identify", "dynamics", lambda: identify(centroid.flows, params.dynamics, run.plan.runtime))
    run.decide(*explain_dynamics(dynamics))
    if not params.runs("filter"):
        return _Fused(centroid.image, mean_of(training), centroid, dynamics)

    filtered = run.stage("filter", "filtered", lambda: _filter(run, centroid, dynamics, training, stream))
    mean = run.stage("filter", "mean", lambda: _temporal_mean(run.source))
    # The sharpness of frames that do not count is not measured.
    chosen = int(np.isfinite(filtered.sharpness).sum())
    run.decide(explain_frames(filtered, None if params.keep_best == 1 else chosen))
    return _Fused(filtered.image, mean, centroid, dynamics, filtered)


def _find_centroid(run: _Run, training: FloatArray) -> Centroid:
    params, runtime = run.params, run.plan.runtime
    count = max(len(run.tiles), 1) * len(training) * params.centroid.iterations
    if run.tiles:
        steps = tiled_centroid_steps(training, run.tiles, params.centroid, params.flow, runtime)
    else:
        steps = centroid_steps(training, params.centroid, params.flow, runtime)
    return finish(steps, run.counter("centroid", count))


def _filter(
    run: _Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> Filtered:
    params, source = run.params, run.source
    counted = np.ones(len(source), bool)
    if params.keep_best < 1:
        counted = best_frames(frame_quality(source), params.keep_best)
    if run.tiles:
        parts = (
            run.store.get(f"filtered_tile_{number}", partial(_filter_tile, run, centroid, training, counted, number))
            for number in range(len(run.tiles))
        )
        return join_filtered(parts, run.tiles, source.shape[1:], run.plan.runtime.scratch)
    frames, start = _counted(chain(iter_frames(training), rest), counted), run.store.filter_start()
    runtime, flows = run.plan.runtime, centroid.flows
    steps = filter_steps(frames, centroid.image, dynamics, params.filter, params.flow, flows, runtime, start)
    return finish(steps, partial(_observe_filter, run, 0))


def _filter_tile(run: _Run, centroid: Centroid, training: FloatArray, counted: np.ndarray, number: int) -> Filtered:
    """Identify the motion of a tile and filter it."""
    tile = run.tiles[number]
    params, runtime = run.params, run.plan.runtime
    frames, flows = (cut_tile(stack, tile, runtime.scratch) for stack in (training, centroid.flows))
    image = centroid.image[tile.rows, tile.columns].copy()
    dynamics = identify(flows, params.dynamics, runtime)
    rest = iter(run.source.select(frames=(len(frames), None), roi=tile.roi)) if len(frames) < len(run.source) else ()
    every = _counted(chain(iter_frames(frames), rest), counted)
    steps = filter_steps(every, image, dynamics, params.filter, params.flow, flows, runtime)
    return finish(steps, partial(_observe_filter, run, number))


def _observe_filter(run: _Run, tile: int, step: FilterStep) -> None:
    """Report progress, and keep checkpoints of whole frames."""
    flows = len(run.source) * run.params.filter.inner_iterations - run.plan.train
    if run.progress is not None:
        run.progress("filter", tile * flows + step.flows_measured, max(len(run.tiles), 1) * flows)
    if step.checkpoint is not None and not run.tiles:
        run.store.checkpoint(step.checkpoint)


def _counted(frames: Iterator[FloatArray], counted: np.ndarray) -> Iterator[FloatArray | None]:
    """Put None in the place of frames that do not count."""
    return (frame if counts else None for frame, counts in zip(frames, counted, strict=True))


def _temporal_mean(source: FrameSource) -> FloatArray:
    total = np.zeros(source.shape[1:])
    for frame in source:
        total += frame
    return (total / len(source)).astype(np.float32)


def _deblur(run: _Run, image: FloatArray, guide: FloatArray) -> Deblurred:
    params = run.params
    plan = run.plan
    steps = remove_blur_steps(image, guide, params.deconvolution, params.guards, plan.runtime, plan.deconvolution_side)
    return finish(steps, run.counter("deconvolve", params.deconvolution.iterations))


def _crop(image: FloatArray, flows: FloatArray, border: str, deblurred: Deblurred | None) -> tuple[Rectangle, Decision]:
    """Return the rectangle of the image that is the result."""
    seen = coverage(flows)
    whole = (0, 0, image.shape[1], image.shape[0])
    if border == "keep":
        return whole, explain_border(float(seen.min()), None)
    # Pixels within one width of the border are deblurred from light that fell beyond it.
    sigma = 0.0 if deblurred is None else deblurred.deconvolution.sigma
    crop = well_seen(seen, _SEEN, int(np.ceil(sigma)), MIN_SIDE)
    return crop, explain_border(float(seen.min()), None if crop == whole else crop)


def _check_sigma(sigma: float | None, shape: tuple[int, ...]) -> None:
    largest = min(shape[1:3]) / _SIGMAS_A_SIDE
    require(
        sigma is None or sigma <= largest,
        f"sigma: expected at most {largest:g} pixels for frames of {shape[2]}×{shape[1]}, found {sigma}",
    )


def _read_training(stream: Iterator[FloatArray], train: int, shape: tuple[int, ...], runtime: Runtime) -> FloatArray:
    training = fill_stack((train, *shape[1:]), stream, runtime.scratch)
    contrast = float(np.ptp(mean_of(training)))
    if contrast < _LEAST_CONTRAST:
        raise DataError(
            f"frames: expected a scene with some contrast, found one intensity within {contrast:.1g} of full scale"
        )
    return training

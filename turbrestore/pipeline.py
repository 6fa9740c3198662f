"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .blind.remove_blur import Deblurred, remove_blur
from .blur.blur_cues import bound_blur, displacement_maps
from .blur.psf import KOLMOGOROV
from .core.arrays import FloatArray
from .core.decision import Decision
from .core.errors import DataError, require
from .dynamics.displacement import with_displacement
from .dynamics.dynamic_texture import identify
from .dynamics.flow_model import FlowDynamics
from .explanation import (
    explain_border,
    explain_camera,
    explain_centroid,
    explain_dynamics,
    explain_frames,
    explain_input,
    explain_motion,
    explain_training,
)
from .filtering.alternating import Filtered, filter_frames
from .footage.frame_selection import best_frames, frame_quality
from .io.output import check_space
from .io.source import FrameSource
from .memory_plan import MemoryPlan, plan_memory
from .registration.centroid import Centroid, find_centroid
from .registration.coverage import Rectangle, coverage, well_seen
from .registration.flow import MIN_SIDE, FlowFrame
from .runtime.device import needs_torch
from .runtime.memory_size import DeconvolutionMemory
from .runtime.scratch import drop_pages, iter_frames, keeping_freed, mean_of, new_stack, returning_freed, to_scratch
from .runtime.tiling import HaloTile, cut_tile, halo_tiles
from .settings import STAGES, Restoration, RestoreParams, StageResults, explain_devices, place_stages
from .tiled_stages import FilteredTiles, filter_tiles, find_tiled_centroid

# Share of the training frames that show every pixel of a cropped image.
_SEEN = 0.9
# Contrast below one grey level of an 8-bit camera is no scene.
_LEAST_CONTRAST = 1 / 255
# A blur wider than this share of the image leaves nothing to restore.
_SIGMAS_A_SIDE = 8

Progress = Callable[[str, int, int], None]


def restore(
    frames: FrameSource | ArrayLike,
    params: RestoreParams | None = None,
    progress: Progress | None = None,
    done: StageResults | None = None,
    on_result: Callable[[StageResults], None] | None = None,
    scratch: Path | None = None,
) -> Restoration:
    """Restore one image from frames of a static scene.

    The frames are read from the first to the last, once (twice where only the best are kept, and those after the
    training frames once for every tile where whole frames are too large for a memory limit); only the training frames
    stay in memory, or in a file where they do not fit.

    Parameters
    ----------
    frames : FrameSource or array_like, shape (T, H, W) or (T, H, W, 3)
        At least two frames of at least 16×16 pixels.
    params : RestoreParams, optional
        Settings of every stage.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    done : StageResults, optional
        What an earlier run of the same frames and settings has done already; the result is the same, bit for bit.
        Nothing is checked: :mod:`turbrestore.runs.resumption` keeps results on disk and tells which still hold.
    on_result : callable, optional
        Called with all that is done after each stage, and in the filter after each block of frames, or each tile.
    scratch : Path, optional
        Folder of the file for what memory does not hold; by default that of temporary files.

    Returns
    -------
    Restoration

    Raises
    ------
    DataError
        Too few, too small, damaged or constant frames.
    ConfigurationError
        More training frames than frames, or a memory limit that cannot be kept.
    StorageError
        There is no room for the file.

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
    params = place_stages(params or RestoreParams())
    source = frames if isinstance(frames, FrameSource) else FrameSource.from_array(frames)
    plan = memory_plan(source, params)
    _check_sigma(params.deconvolution.sigma, source.shape)
    folder = scratch or Path(tempfile.gettempdir())
    if plan.file_bytes:
        check_space(folder / "what memory does not hold", plan.file_bytes)
    run = _Run(source, _within(plan, params), progress, done or StageResults(), on_result, folder, plan)
    with returning_freed(plan.tight):
        return _restored(run, plan)


def memory_plan(source: FrameSource, params: RestoreParams) -> MemoryPlan:
    """Plan what a restoration does to keep within its memory limit.

    Parameters
    ----------
    source : FrameSource
    params : RestoreParams

    Returns
    -------
    MemoryPlan

    Raises
    ------
    DataError
        Too few or too small frames.
    ConfigurationError
        More training frames than frames, or a limit that cannot be kept.

    Examples
    --------
    >>> plan = memory_plan(FrameSource.from_array(np.zeros((9, 64, 64))), RestoreParams())
    >>> plan.train, plan.in_file
    (9, False)
    """
    params = place_stages(params)
    placed = params.flow.device, params.filter.device, params.deconvolution.device
    return plan_memory(
        source.shape,
        params.memory_limit,
        params.train,
        params.flow,
        params.filter,
        params.dynamics,
        params.deconvolution,
        params.until,
        blur_bounds=params.blur_bounds,
        on_device=any(map(needs_torch, (params.device, *placed))),
    )


def stage_counter(progress: Progress | None, stage: str, total: int) -> Callable[[int], None] | None:
    """Turn ``progress(stage, done, total)`` into the callback of one stage, which is told of single steps.

    Parameters
    ----------
    progress : callable or None
    stage : str
        Name of the stage.
    total : int
        Largest number of steps.

    Returns
    -------
    callable or None
        Takes a number of steps; None if ``progress`` is.

    Examples
    --------
    >>> step = stage_counter(lambda stage, done, total: print(stage, done, total), "filter", 5)
    >>> step(2)
    filter 2 5
    """
    if progress is None:
        return None
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(stage, done, total)

    return advance


class _Clock:
    """Wall time between laps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


class _Sum:
    """Frames passed on, and their sum kept, so that the mean of all costs no second reading."""

    def __init__(self, training: FloatArray, rest: Iterable[FloatArray]) -> None:
        self._training, self._rest = training, rest
        self._total = np.zeros(training.shape[1:])
        self._count = 0

    def __iter__(self) -> Iterator[FloatArray]:
        for frames in (iter_frames(self._training), self._rest):
            for frame in frames:
                self._total += frame
                self._count += 1
                yield frame

    def mean(self) -> FloatArray:
        return (self._total / self._count).astype(np.float32)


class _Run:
    """What every stage needs, and what is done so far."""

    def __init__(
        self,
        source: FrameSource,
        params: RestoreParams,
        progress: Progress | None,
        done: StageResults,
        on_result: Callable[[StageResults], None] | None,
        folder: Path,
        plan: MemoryPlan,
    ) -> None:
        self.source, self.params, self.progress = source, params, progress
        self.done = done
        self.clock = _Clock()
        self.folder, self.scratch = folder, folder if plan.in_file else None
        # Where even the frames are in a file, what is prepared of them is not kept.
        self.prepared: dict[int, FlowFrame] | None = None if plan.in_file else {}
        height, width = source.shape[1:3]
        self.tiles: tuple[HaloTile, ...] = ()
        if plan.tile is not None:
            self.tiles = halo_tiles((height, width), plan.tile)
        self._on_result = on_result

    def finish(self, done: StageResults, stage: str | None = None) -> None:
        self.done = done
        if stage is not None:
            self.clock.lap(stage)
        if self._on_result is not None:
            self._on_result(done)


def _restored(run: _Run, plan: MemoryPlan) -> Restoration:
    """Run the stages."""
    params, source = run.params, run.source
    stages = STAGES[: STAGES.index(params.until) + 1]
    stream = iter(source)
    training = _read_training(stream, plan.train, source.shape, run.scratch)
    if run.tiles:
        # Tiles read for themselves; nothing but this holds the decoder.
        stream = iter(())
    run.clock.lap("read")
    dynamics = filtered = deblurred = None
    # Every frame takes the same memory again; the deconvolution takes its own once, and would only find less room.
    with keeping_freed(params.memory_limit is None):
        centroid = _find_centroid(run, training)
        image = centroid.image
        if "identify" in stages:
            dynamics = _identify(run, centroid, training)
        if "filter" in stages and dynamics is not None:
            filtered, mean = _filter(run, centroid, dynamics, training, stream)
            image = filtered.image
        else:
            mean = to_scratch(mean_of(training), run.scratch)
    if "deconvolve" in stages:
        deblurred = _deblur(run, image, mean, centroid, training)
        image = deblurred.deconvolution.image
    crop, on_border = _crop(image, centroid.flows, params.border, deblurred)
    x, y, width, height = crop
    return Restoration(
        image=image if params.border == "keep" else image[y : y + height, x : x + width],
        crop=crop,
        mean=mean,
        centroid=centroid,
        dynamics=dynamics,
        filtered=filtered,
        blur=None if deblurred is None else deblurred.blur,
        blur_bounds=run.done.blur_bounds,
        deconvolution=None if deblurred is None else deblurred.deconvolution,
        guard_readings=() if deblurred is None else deblurred.readings,
        decisions=(
            *plan.decisions,
            *_decisions(run, training, centroid, dynamics, filtered, deblurred),
            on_border,
        ),
        train=plan.train,
        frame_count=len(source) if filtered is not None else plan.train,
        seconds=run.clock.seconds,
    )


def _find_centroid(run: _Run, training: FloatArray) -> Centroid:
    if run.done.centroid is not None:
        return run.done.centroid
    params = run.params
    steps = len(training) * params.centroid.iterations
    if run.tiles:
        counter = stage_counter(run.progress, "centroid", len(run.tiles) * steps)
        centroid = find_tiled_centroid(training, run.tiles, params.centroid, params.flow, counter, run.scratch)
    else:
        counter = stage_counter(run.progress, "centroid", steps)
        centroid = find_centroid(training, params.centroid, params.flow, counter, run.scratch, run.prepared)
    run.finish(replace(run.done, centroid=centroid), "centroid")
    return centroid


def _identify(run: _Run, centroid: Centroid, training: FloatArray) -> FlowDynamics:
    if run.done.dynamics is not None:
        return run.done.dynamics
    if run.tiles:
        # Every tile has a model of its own; that of the whole is for the record.
        dynamics = identify(centroid.flows, run.params.dynamics, run.scratch, run.params.flow.threads)
    else:
        dynamics = _flow_model(run, centroid.flows, training)
    run.finish(replace(run.done, dynamics=dynamics), "identify")
    return dynamics


def _flow_model(run: _Run, flows: FloatArray, training: FloatArray) -> FlowDynamics:
    dynamics = identify(flows, run.params.dynamics, run.scratch, run.params.flow.threads)
    return with_displacement(dynamics, *displacement_maps(training)) if run.params.displacement_cue else dynamics


def _filter(
    run: _Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> tuple[Filtered, FloatArray]:
    """Return the filtered image, and the mean of all frames."""
    if run.done.filtered is not None and run.done.mean is not None:
        return run.done.filtered, run.done.mean
    params, source = run.params, run.source
    counted = None if params.keep_best == 1 else best_frames(frame_quality(source), params.keep_best)
    steps = len(source) * params.filter.inner_iterations - len(training)
    counter = stage_counter(run.progress, "filter", max(len(run.tiles), 1) * steps)
    if run.done.tiles is not None and counter is not None:
        counter(len(run.done.tiles.parts) * steps)
    if run.tiles:
        filtered, mean = _filter_in_tiles(run, centroid, training, counted, counter)
    else:
        summed = _Sum(training, rest)
        filtered = filter_frames(
            summed,
            centroid.image,
            dynamics,
            params.filter,
            params.flow,
            centroid.flows,
            counter,
            counted,
            run.done.checkpoint,
            lambda checkpoint: run.finish(replace(run.done, checkpoint=checkpoint)),
            run.prepared,
        )
        mean = summed.mean()
    run.finish(replace(run.done, checkpoint=None, tiles=None, filtered=filtered, mean=mean), "filter")
    return filtered, mean


def _filter_in_tiles(
    run: _Run,
    centroid: Centroid,
    training: FloatArray,
    counted: NDArray[np.bool_] | None,
    counter: Callable[[int], None] | None,
) -> tuple[Filtered, FloatArray]:
    params, source = run.params, run.source

    def filter_part(tile: HaloTile) -> tuple[Filtered, FloatArray]:
        frames, flows = (cut_tile(stack, tile, run.scratch) for stack in (training, centroid.flows))
        summed = _Sum(frames, _rest_of(source, len(training), tile))
        image = centroid.image[tile.rows, tile.columns].copy()
        drop_pages(centroid.image)
        model = _flow_model(run, flows, frames)
        filtered = filter_frames(summed, image, model, params.filter, params.flow, flows, counter, counted)
        return filtered, summed.mean()

    def keep(tiles: FilteredTiles) -> None:
        run.finish(replace(run.done, tiles=tiles))

    return filter_tiles(filter_part, run.tiles, source.shape[1:], run.scratch, run.done.tiles, keep)


def _rest_of(source: FrameSource, start: int, tile: HaloTile) -> Iterator[FloatArray]:
    """Frames from a number on, cropped to a tile."""
    return iter(source.select(frames=(start, None), roi=tile.roi)) if start < len(source) else iter(())


def _deblur(run: _Run, image: FloatArray, mean: FloatArray, centroid: Centroid, training: FloatArray) -> Deblurred:
    if run.done.deblurred is not None:
        return run.done.deblurred
    params, bounds = run.params, None
    if params.blur_bounds:
        exponent = params.deconvolution.exponent or KOLMOGOROV
        bounds = bound_blur(image, mean, training, len(run.source), exponent)
    counter = stage_counter(run.progress, "deconvolve", params.deconvolution.iterations)
    deblurred = remove_blur(
        image, centroid.image, params.deconvolution, params.guards, bounds, counter, run.folder, bool(run.tiles)
    )
    run.finish(replace(run.done, blur_bounds=bounds, deblurred=deblurred), "deconvolve")
    return deblurred


def _decisions(
    run: _Run,
    training: FloatArray,
    centroid: Centroid,
    dynamics: FlowDynamics | None,
    filtered: Filtered | None,
    deblurred: Deblurred | None,
) -> Iterator[Decision]:
    """Put what was chosen into words, in the order of the stages."""
    yield from explain_devices(run.params)
    yield explain_training(len(training), len(run.source), run.params.train)
    yield from explain_input(training)
    yield explain_centroid(centroid)
    yield from explain_camera(centroid.flows)
    yield from explain_motion(centroid.flows)
    if dynamics is not None:
        yield from explain_dynamics(dynamics)
    if filtered is not None:
        # The sharpness of frames that do not count is not measured.
        chosen = int(np.isfinite(filtered.sharpness).sum())
        yield explain_frames(filtered, None if run.params.keep_best == 1 else chosen)
    if deblurred is not None:
        yield from deblurred.decisions


def _crop(image: FloatArray, flows: FloatArray, border: str, deblurred: Deblurred | None) -> tuple[Rectangle, Decision]:
    """Rectangle of the image that is the result."""
    seen = coverage(flows)
    whole = (0, 0, image.shape[1], image.shape[0])
    if border == "keep":
        return whole, explain_border(float(seen.min()), None)
    # Pixels within a width of the border are deblurred from light that fell beyond it.
    sigma = 0.0 if deblurred is None else deblurred.deconvolution.sigma
    crop = well_seen(seen, _SEEN, int(np.ceil(sigma)), MIN_SIDE)
    if crop == whole:
        return whole, explain_border(float(seen.min()), None)
    return crop, explain_border(float(seen.min()), crop)


def _within(plan: MemoryPlan, params: RestoreParams) -> RestoreParams:
    """Change the settings that the plan needs, and that change nothing of the result."""
    if params.memory_limit is None:
        return params
    memory = params.deconvolution.memory if plan.deconvolution is None else DeconvolutionMemory(plan.deconvolution)
    return replace(
        params,
        flow=replace(params.flow, threads=plan.threads),
        deconvolution=replace(params.deconvolution, memory=memory),
    )


def _check_sigma(sigma: float | None, shape: tuple[int, ...]) -> None:
    largest = min(shape[1:3]) / _SIGMAS_A_SIDE
    require(
        sigma is None or sigma <= largest,
        f"sigma: expected at most {largest:g} pixels for frames of {shape[2]}×{shape[1]}, found {sigma}",
    )


def _read_training(stream: Iterator[FloatArray], train: int, shape: tuple[int, ...], folder: Path | None) -> FloatArray:
    training = new_stack((train, *shape[1:]), folder)
    for index in range(train):
        # In a loop over frames, one would stay while the next is read.
        training[index] = next(stream)
        drop_pages(training)
    contrast = float(np.ptp(mean_of(training)))
    if contrast < _LEAST_CONTRAST:
        raise DataError(
            f"frames: expected a scene with some contrast, found one intensity within {contrast:.1g} of full scale"
        )
    return training

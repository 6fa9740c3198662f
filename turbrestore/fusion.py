"""Centroid and filter of the frames: of whole frames, or in tiles that overlap, here or in other processes.

Each tile is a clip of its own that passes through the same functions as a whole frame; images and flows of the tiles
are blended by :mod:`turbrestore.runtime.tiling`.  The result is close to that of whole frames but not the same, because
what is estimated from all pixels at once (the flow model, the noise of the frames) is estimated from those of the tile.
Frames that are shifted by more than the halo of 96 pixels leave a part of a tile unseen.

What is done with a tile is described by a task, which another process can be handed: it has the frames of the tile as
a source that reads them there.  Where a tile is worked on changes nothing in the result, bit for bit.
"""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .core.decision import Decision
from .core.noise import estimate_noise
from .dynamics.dynamic_texture import identify
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import Filtered, FilterStep, filter_steps
from .footage.frame_selection import best_frames, frame_quality
from .io.source import FrameSource
from .memory_plan import MemoryPlan
from .preparation import Prepared
from .registration.centroid import Centroid, centroid_steps
from .results import Store
from .runtime.runtime import Runtime
from .runtime.scratch import drop_pages, fill_stack, iter_frames, new_stack
from .runtime.steps import Progress, finish, step_counter
from .runtime.tiling import HaloTile, add_tile, cut_tile, halo_tiles, new_mosaic
from .settings import RestoreParams
from .stacking.placement import centroid_of_known_flows, onto_reference
from .verification.pixel_deviation import SATURATED, saturation_level
from .wording import explain_input, explain_training

# As ``map`` does, applies a function to every task and yields the results in order; it may do so in other processes,
# to which it has to pickle closures too.  The tasks should be taken as they are needed, because those of the filter
# hold arrays.
TileMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
# Files of floating point are taken for those of 16 bits.
_MOST_BITS = 16
# Figures of a filtered tile that are joined or averaged.
_RECORDED = (
    "flow_states",
    "gains",
    "innovations",
    "sharpness",
    "shares",
    "image_noise",
    "sharpness_weight",
    "noise_gain",
)

# Stages that take a while and have no steps to count.
_WITHOUT_STEPS = ("witnesses", "width")

Result = TypeVar("Result")


@dataclass(frozen=True)
class Run:
    """Arguments that every stage shares, what was decided, and the wall time of the stages that have run."""

    prepared: Prepared
    params: RestoreParams  # at the levels of the prepared frames
    plan: MemoryPlan
    store: Store | None
    progress: Progress | None
    on_decision: Callable[[Decision], None] | None
    map_tiles: TileMap | None = None
    decisions: list[Decision] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def source(self) -> FrameSource:
        """Frames as the stages take them."""
        return self.prepared.source

    @property
    def tiles(self) -> tuple[HaloTile, ...]:
        """Tiles in which frames are processed; none for whole frames."""
        _, height, width = self.source.shape[:3]
        return () if self.plan.tile is None else halo_tiles((height, width), self.plan.tile)

    def decide(self, *decisions: Decision) -> None:
        """Record decisions, and call ``on_decision``."""
        self.decisions.extend(decisions)
        if self.on_decision is not None:
            for decision in decisions:
                self.on_decision(decision)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time that something takes to that of a stage."""
        begun, told = time.perf_counter(), self.progress if stage in _WITHOUT_STEPS else None
        if told is not None:
            told(stage, 0, 1)
        yield
        if told is not None:
            told(stage, 1, 1)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begun

    def stage(self, stage: str, name: str, compute: Callable[[], Result]) -> Result:
        """Return a result from the store, or compute it."""
        with self.timed(stage):
            return self.from_store(name, compute)

    def from_store(self, name: str, compute: Callable[[], Result]) -> Result:
        """Like :meth:`stage`, untimed."""
        return compute() if self.store is None else self.store.get(name, compute)

    def counter(self, stage: str, total: int) -> Callable[[object], None]:
        """Return the observer of the steps of one stage, which reports progress."""
        return step_counter(self.progress, stage, total)


@dataclass(frozen=True, eq=False)
class CentroidTask:
    """The centroid of a tile, to be found in another process."""

    source: FrameSource  # all frames of the tile
    train: int  # number of training frames
    params: RestoreParams
    runtime: Runtime  # a scratch folder is replaced by the worker's folder of temporary files


@dataclass(frozen=True, eq=False)
class FilterTask:
    """The filter of a tile, to be run here or in another process."""

    source: FrameSource  # all frames of the tile
    # Centroid of the tile, and flows to the training frames.
    image: FloatArray
    flows: FloatArray
    counted: NDArray[np.bool_]  # (T,): frames that count
    params: RestoreParams
    runtime: Runtime  # in another process, a scratch folder is replaced by its folder of temporary files


def read_training(run: Run, stream: Iterator[FloatArray]) -> tuple[FloatArray, float]:
    """Read the training frames; also the intensity from which their mean is saturated."""
    levels, count, bits = run.prepared.levels, run.plan.train, min(run.source.bit_depth, _MOST_BITS)
    least, share, brightest = levels.full_scale[1] - levels.gain * (1 - SATURATED), 0.0, 0.0
    with run.timed("read"):
        training = new_stack((count, *run.source.shape[1:]), run.plan.runtime.scratch)
        for place in training:
            # In a loop over the stream, one frame would stay in memory while the next is made.
            place[...] = next(stream)
            share += float(np.mean(place >= least)) / count
            brightest = max(brightest, float(place.max()))
            drop_pages(training)
    run.decide(explain_training(count, len(run.source), run.params.train), *explain_input(share))
    return training, saturation_level(brightest, estimate_noise(training[0]), levels.gain / (2**bits - 1), least)


def centroid_stage(run: Run, training: FloatArray) -> Centroid:
    """Find the centroid of the training frames, in the geometry that was asked for.

    ``training`` (K, H, W) or (K, H, W, 3).
    """
    params, runtime = run.params, run.plan.runtime
    if params.like is not None:
        return centroid_of_known_flows(training, run.source, params.like, runtime)
    steps = len(training) * params.centroid.iterations
    if not run.tiles:
        stage = centroid_steps(training, params.centroid, params.flow, runtime)
        found = finish(stage, run.counter("centroid", steps))
    else:
        parts = _centroids_here(run, training, steps) if run.map_tiles is None else _centroids_elsewhere(run)
        found = join_centroids(parts, run.tiles, training.shape, runtime.scratch)
    if params.reference is None:
        return found
    placed, reference_decision = onto_reference(found, training, params.reference, runtime)
    run.decide(reference_decision)
    return placed


def _centroids_here(run: Run, training: FloatArray, steps: int) -> Iterator[Centroid]:
    params, runtime, count = run.params, run.plan.runtime, run.counter("centroid", len(run.tiles) * steps)
    for tile in run.tiles:
        frames = cut_tile(training, tile, runtime.scratch)
        yield finish(centroid_steps(frames, params.centroid, params.flow, runtime), count)


def _centroids_elsewhere(run: Run) -> Iterator[Centroid]:
    assert run.map_tiles is not None
    count, settings = run.counter("centroid", len(run.tiles)), (run.plan.train, run.params, run.plan.runtime)
    tasks = (CentroidTask(run.source.select(roi=tile.roi), *settings) for tile in run.tiles)
    for part in run.map_tiles(_run_centroid_task, tasks):
        count(part)
        yield part


def _run_centroid_task(task: CentroidTask) -> Centroid:
    """Find the centroid of a tile whose frames are read here."""
    runtime = _here(task.runtime)
    frames = fill_stack((task.train, *task.source.shape[1:]), iter(task.source), runtime.scratch)
    found = finish(centroid_steps(frames, task.params.centroid, task.params.flow, runtime))
    return replace(found, image=np.array(found.image), flows=np.array(found.flows))


def filter_stage(
    run: Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> Filtered:
    """Filter the training frames and those after them, and move the image onto the mean geometry of all frames.

    With ``reference`` or ``like`` it stays in the geometry of the other clip.
    ``training`` (K, H, W) or (K, H, W, 3).
    """
    params, source = run.params, run.source
    counted = np.ones(len(source), bool)
    if params.keep_best < 1:
        counted = best_frames(frame_quality(source), params.keep_best)
    if run.tiles:
        parts = _filtered_tiles(run, centroid, training, counted)
        filtered = join_filtered(parts, run.tiles, source.shape[1:], run.plan.runtime.scratch)
    else:
        frames = _only_counted(chain(iter_frames(training), rest), counted)
        start = None if run.store is None else run.store.filter_start()
        settings = params.filter, params.flow, centroid.flows, run.plan.runtime
        steps = filter_steps(frames, centroid.image, dynamics, *settings, start)
        filtered = finish(steps, partial(_observe_filter, run, 0))
    if params.reference is None and params.like is None:
        return filtered.recentred()
    return replace(filtered, mean_flow=np.zeros_like(filtered.mean_flow))


def _filtered_tiles(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray) -> Iterator[Filtered]:
    """Filter those tiles that the store does not have."""
    names = [f"filtered_tile_{number}" for number in range(len(run.tiles))]
    if run.map_tiles is None:
        for number, name in enumerate(names):
            yield run.from_store(name, partial(_filter_tile, run, centroid, training, counted, number))
        return
    missing = [
        tile for name, tile in zip(names, run.tiles, strict=True) if run.store is None or not run.store.has(name)
    ]
    tasks = (_filter_task(run, tile, centroid, counted) for tile in missing)
    results = iter(run.map_tiles(_run_filter_task, tasks))
    for number, name in enumerate(names):
        part = run.from_store(name, lambda: next(results))
        if run.progress is not None:
            run.progress("filter", number + 1, len(names))
        yield part


def _filter_task(
    run: Run, tile: HaloTile, centroid: Centroid, counted: np.ndarray, folder: Path | None = None
) -> FilterTask:
    image, flows = centroid.image[tile.rows, tile.columns].copy(), cut_tile(centroid.flows, tile, folder)
    return FilterTask(run.source.select(roi=tile.roi), image, flows, counted, run.params, run.plan.runtime)


def _filter_tile(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray, number: int) -> Filtered:
    """Filter a tile in this process, whose training frames need not be read again."""
    tile, folder = run.tiles[number], run.plan.runtime.scratch
    frames = cut_tile(training, tile, folder)
    return _filter_part(
        _filter_task(run, tile, centroid, counted, folder), frames, partial(_observe_filter, run, number)
    )


def _run_filter_task(task: FilterTask) -> Filtered:
    """Filter a tile whose frames are read here."""
    runtime = _here(task.runtime)
    frames = fill_stack((len(task.flows), *task.source.shape[1:]), iter(task.source), runtime.scratch)
    return _filter_part(replace(task, runtime=runtime), frames)


def _filter_part(task: FilterTask, frames: FloatArray, observe: Callable[[FilterStep], None] | None = None) -> Filtered:
    """Identify the motion of a tile and filter it; ``frames`` (K, h, w) or (K, h, w, 3) are its training frames."""
    dynamics = identify(task.flows, task.params.dynamics, task.runtime)
    source, trained = task.source, len(frames)
    rest = iter(source.select(frames=(trained, None))) if trained < len(source) else ()
    every = _only_counted(chain(iter_frames(frames), rest), task.counted)
    settings = task.params.filter, task.params.flow, task.flows, task.runtime
    return finish(filter_steps(every, task.image, dynamics, *settings), observe)


def _observe_filter(run: Run, tile: int, step: FilterStep) -> None:
    """Report progress, and give the store the checkpoints, unless the frames are filtered in tiles."""
    flows = len(run.source) * run.params.filter.inner_iterations - run.plan.train
    if run.progress is not None:
        run.progress("filter", tile * flows + step.flows_measured, max(len(run.tiles), 1) * flows)
    if run.store is not None and step.checkpoint is not None and not run.tiles:
        run.store.checkpoint(step.checkpoint)


def _only_counted(frames: Iterable[FloatArray], counted: NDArray[np.bool_]) -> Iterator[FloatArray | None]:
    """Replace frames that do not count by None."""
    return (frame if counts else None for frame, counts in zip(frames, counted, strict=True))


def join_centroids(
    parts: Iterable[Centroid], tiles: Sequence[HaloTile], shape: tuple[int, ...], scratch: Path | None = None
) -> Centroid:
    """Blend the centroids of all tiles and the flows from them."""
    image, flows = new_mosaic(shape[1:], scratch), new_mosaic((*shape[:3], 2), scratch)
    sizes, converged, remaining = list[NDArray[np.float64]](), True, iter(parts)
    for tile in tiles:
        part = next(remaining)
        add_tile(image, tile, part.image)
        for whole, flow in zip(flows, iter_frames(part.flows), strict=True):
            add_tile(whole, tile, flow)
        sizes.append(part.mean_flow_sizes)
        converged &= part.converged
        # The flows of a tile must be gone before those of the next are measured.
        del part, flow
    longest = max(map(len, sizes))
    lasting = [np.pad(found, (0, longest - len(found)), mode="edge") for found in sizes]
    return Centroid(image, flows, np.average(lasting, axis=0, weights=_areas(tiles)), converged)


def join_filtered(
    parts: Iterable[Filtered], tiles: Sequence[HaloTile], shape: tuple[int, ...], scratch: Path | None = None
) -> Filtered:
    """Blend the filtered images of all tiles, and join their records."""
    image, variance = new_mosaic(shape, scratch), new_mosaic(shape[:2], scratch)
    mean_flow = new_mosaic((*shape[:2], 2), scratch)
    records: dict[str, list[np.ndarray]] = {}
    for tile, part in zip(tiles, parts, strict=True):
        add_tile(image, tile, part.image)
        add_tile(variance, tile, part.variance)
        add_tile(mean_flow, tile, part.mean_flow)
        for name in _RECORDED:
            records.setdefault(name, []).append(np.asarray(getattr(part, name)))
    areas = _areas(tiles)

    def average(name: str) -> np.ndarray:
        return np.average(records[name], axis=0, weights=areas)

    return Filtered(
        image=image,
        variance=variance,
        flow_states=np.concatenate(records["flow_states"], axis=1),
        gains=average("gains"),
        innovations=np.sqrt(np.average(np.square(records["innovations"]), axis=0, weights=areas)),
        sharpness=average("sharpness"),
        shares=average("shares"),
        image_noise=float(average("image_noise")),
        sharpness_weight=float(average("sharpness_weight")),
        noise_gain=float(average("noise_gain")),
        mean_flow=mean_flow,
    )


def _here(runtime: Runtime) -> Runtime:
    """Replace a scratch folder by the folder of temporary files of this process."""
    return runtime if runtime.scratch is None else replace(runtime, scratch=Path(tempfile.gettempdir()))


def _areas(tiles: Sequence[HaloTile]) -> NDArray[np.float64]:
    """Weight of each tile, in pixels."""
    return np.array([tile.row_weights.sum(dtype=np.float64) * tile.column_weights.sum() for tile in tiles])


def temporal_mean(source: FrameSource) -> FloatArray:
    """Mean of the frames, read one after the other."""
    total = np.zeros(source.shape[1:])
    return finish_mean(added_up(source, total), total, len(source))


def added_up(frames: Iterable[FloatArray], total: NDArray[np.float64]) -> Iterator[FloatArray]:
    """Pass frames on, and add them to ``total``, (H, W) or (H, W, 3)."""
    for frame in frames:
        total += frame
        yield frame


def finish_mean(unread: Iterator[FloatArray], total: NDArray[np.float64], count: int) -> FloatArray:
    """Return the mean of frames that are added up in ``total``: those not yet read are read, which adds them up."""
    deque(unread, 0)
    return (total / count).astype(np.float32)

"""Fusion of the frames into one image: the stages from the frames to the alternating filter, whole or in tiles."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .agreement.last_guard import FEWEST, Halves, registered_halves
from .blind.structure import StructureReading, compare_structure
from .blur.posterior import BlurWitnesses, measure_witnesses
from .blur.witnesses.short_exposure import displacement_variance
from .core.arrays import FloatArray, luminance
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
from .registration.flow_algebra import invert_flow
from .registration.recentring import recentre, recentring_flow
from .registration.warp import warp
from .results import Store
from .runtime.scratch import drop_pages, iter_frames, mean_of, new_stack
from .runtime.steps import Progress, finish, step_counter
from .runtime.tiling import HaloTile, cut_tile
from .seeing.displacement import LEAST_FRAMES
from .seeing.strength import Seeing, seeing_of_picture
from .settings import RestoreParams
from .stacking.placement import centroid_of_known_flows, onto_reference
from .tiled_stages import (
    TileMap,
    centroid_tasks,
    filter_tasks,
    join_centroids,
    join_filtered,
    only_counted,
    run_centroid_task,
    run_filter_task,
    tile_filter_steps,
)
from .uncertainty.pixel_deviation import SATURATED, saturation_level
from .wording import (
    explain_dynamics,
    explain_filter,
    explain_input,
    explain_registration,
    explain_seeing,
    explain_structure,
    explain_training,
)

# Files of floating point are taken for those of 16 bits.
_MOST_BITS = 16
# Least standard deviation of ln V by a measured D/r0: theory and simulated clips agree no better.
_LEAST_SPREAD = 0.2

Result = TypeVar("Result")


@dataclass(frozen=True)
class Run:
    """Arguments that every stage shares, what was decided, and the wall time of the stages that have run."""

    prepared: Prepared
    params: RestoreParams
    plan: MemoryPlan
    tiles: tuple[HaloTile, ...]
    store: Store
    progress: Progress | None
    on_decision: Callable[[Decision], None] | None
    map_tiles: TileMap | None = None
    psf: NDArray[np.float64] | None = None
    decisions: list[Decision] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def source(self) -> FrameSource:
        """Frames as the stages take them."""
        return self.prepared.source

    def decide(self, *decisions: Decision) -> None:
        """Record decisions, and tell whoever listens."""
        self.decisions.extend(decisions)
        if self.on_decision is not None:
            for decision in decisions:
                self.on_decision(decision)

    def stage(self, stage: str, name: str, compute: Callable[[], Result]) -> Result:
        """Return a result from the store, or compute it, and add the time that this takes to that of the stage."""
        begun = time.perf_counter()
        result = self.store.get(name, compute)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begun
        return result

    def counter(self, stage: str, total: int) -> Callable[[object], None]:
        """Return the observer of the steps of one stage, which reports progress."""
        return step_counter(self.progress, stage, total)


@dataclass(frozen=True)
class Fused:
    """Results of the stages before the deconvolution.

    ``is_mean`` says that the image is the mean of the frames, because the filtered one has structure that they lack;
    ``halves`` is None for few frames.
    """

    image: FloatArray
    mean: FloatArray
    centroid: Centroid
    seeing: Seeing | None
    saturation: float
    dynamics: FlowDynamics | None = None
    filtered: Filtered | None = None
    is_mean: bool = False
    witnesses: BlurWitnesses | None = None
    halves: Halves | None = None


def fuse(run: Run) -> Fused:
    """Run the stages up to the filter; the training frames are freed when this function returns."""
    params, train = run.params, run.plan.train
    total = np.zeros(run.source.shape[1:])
    # Tiles read their parts of the frames themselves.
    stream = iter(run.source) if run.tiles else _added_up(run.source, total)
    begun = time.perf_counter()
    training, saturated, brightest = _read_training(run, stream)
    run.seconds["read"] += time.perf_counter() - begun
    run.decide(explain_training(train, len(run.source), params.train), *explain_input(saturated))

    centroid = run.stage("centroid", "centroid", lambda: _find_centroid(run, training))
    run.decide(*explain_registration(centroid))
    seeing, saturation = _measure_seeing(run, training, centroid), _find_saturation(run, training[0], brightest)
    if not params.runs("identify"):
        return Fused(centroid.image, mean_of(training), centroid, seeing, saturation)

    dynamics = run.stage("identify", "dynamics", lambda: identify(centroid.flows, params.dynamics, run.plan.runtime))
    run.decide(*explain_dynamics(dynamics, params.filter.residual == "drop"))
    if not params.runs("filter"):
        return Fused(centroid.image, mean_of(training), centroid, seeing, saturation, dynamics)

    filtered = run.stage("filter", "filtered", lambda: _placed(run, _filter(run, centroid, dynamics, training, stream)))
    unread = _added_up(run.source, total) if run.tiles else stream
    mean = run.stage("filter", "mean", lambda: _mean(unread, total, len(run.source)))
    # The sharpness is NaN for frames that do not count.
    chosen = int(np.isfinite(filtered.sharpness).sum())
    run.decide(*explain_filter(filtered, dynamics, None if params.keep_best == 1 else chosen))
    structure = _compare_structure(filtered.image, training, centroid, filtered.mean_flow)
    run.decide(*explain_structure(structure))
    image = filtered.image if structure.passed else mean
    witnesses = _find_witnesses(run, training, centroid, seeing) if structure.passed else None
    halves = _halves(run, training, centroid, filtered.mean_flow)
    found = mean, centroid, seeing, saturation, dynamics, filtered
    return Fused(image, *found, not structure.passed, witnesses, halves)


def _read_training(run: Run, stream: Iterator[FloatArray]) -> tuple[FloatArray, float, float]:
    """Read the training frames; also the share of their pixels that are saturated, and the greatest intensity."""
    training = new_stack((run.plan.train, *run.source.shape[1:]), run.plan.runtime.scratch)
    saturated, brightest = 0.0, 0.0
    for place in training:
        # In a loop over the stream, one frame would stay in memory while the next is made.
        place[...] = next(stream)
        saturated += float(np.mean(place >= _saturated(run))) / len(training)
        brightest = max(brightest, float(place.max()))
        drop_pages(training)
    return training, saturated, brightest


def _find_centroid(run: Run, training: FloatArray) -> Centroid:
    params, runtime = run.params, run.plan.runtime
    if params.like is not None:
        return centroid_of_known_flows(training, run.source, params.like, runtime)
    found = _own_centroid(run, training)
    if params.reference is None:
        return found
    placed, on_reference = onto_reference(found, training, params.reference, runtime)
    run.decide(on_reference)
    return placed


def _own_centroid(run: Run, training: FloatArray) -> Centroid:
    params, runtime, train = run.params, run.plan.runtime, len(training)
    if run.tiles:
        parts = _centroids_here(run, training) if run.map_tiles is None else _centroids_elsewhere(run, train)
        return join_centroids(parts, run.tiles, training.shape, runtime.scratch)
    steps = centroid_steps(training, params.centroid, params.flow, runtime)
    return finish(steps, run.counter("centroid", train * params.centroid.iterations))


def _centroids_here(run: Run, training: FloatArray) -> Iterator[Centroid]:
    params, runtime = run.params, run.plan.runtime
    count = run.counter("centroid", len(run.tiles) * len(training) * params.centroid.iterations)
    for tile in run.tiles:
        yield finish(
            centroid_steps(cut_tile(training, tile, runtime.scratch), params.centroid, params.flow, runtime), count
        )


def _centroids_elsewhere(run: Run, train: int) -> Iterator[Centroid]:
    params, count = run.params, run.counter("centroid", len(run.tiles))
    assert run.map_tiles is not None
    tasks = centroid_tasks(run.source, run.tiles, train, params.centroid, params.flow, run.plan.runtime)
    for part in run.map_tiles(run_centroid_task, tasks):
        count(part)
        yield part


def _compare_structure(
    image: FloatArray, training: FloatArray, centroid: Centroid, mean_flow: FloatArray
) -> StructureReading:
    """Compare a recentred image with the training frames, in the geometry of the centroid."""
    image = luminance(image)
    if mean_flow.any():
        image = warp(image, invert_flow(recentring_flow(mean_flow)))
    return compare_structure(image, training, centroid.flows)


def _halves(run: Run, training: FloatArray, centroid: Centroid, mean_flow: FloatArray) -> Halves | None:
    """Average two halves of the training frames, in the geometry of the filtered image."""
    # No guard overrides a width that was asked for.
    if len(training) < FEWEST or not run.params.finds_blur:
        return None
    found = registered_halves(training, centroid.flows, training.shape[1:], len(training), run.plan.runtime.threads)
    return Halves(recentre(found.first, mean_flow), recentre(found.second, mean_flow))


def _measure_seeing(run: Run, training: FloatArray, centroid: Centroid) -> Seeing | None:
    """Measure the strength of the turbulence, unless there are too few frames."""
    if len(training) < LEAST_FRAMES:
        return None
    begun, picture = time.perf_counter(), run.prepared.picture
    seeing = seeing_of_picture(picture, training, centroid, run.params.optics, run.plan.runtime.threads)
    run.seconds["seeing"] = time.perf_counter() - begun
    run.decide(*explain_seeing(seeing))
    return seeing


def _find_witnesses(run: Run, training: FloatArray, centroid: Centroid, seeing: Seeing | None) -> BlurWitnesses | None:
    """Measure what the frames say about their blur, if it is to be estimated."""
    if not run.params.finds_blur:
        return None
    begun, known = time.perf_counter(), None if seeing is None else seeing.displacement_variance
    rows, columns = picture = run.prepared.picture
    seen, flows = training[:, rows, columns], centroid.flows[:, rows, columns]
    if seeing is not None and known is not None:
        displacement, frames = known.value, seeing.independent_frames
    else:
        # Without a displacement that can be measured, that of the flow stands for it, less what the camera adds.
        about = [np.square(flow - np.median(flow, axis=(0, 1))).mean() for flow in iter_frames(flows)]
        displacement, frames = float(np.mean(about)), float(len(training))
    witnesses = measure_witnesses(seen, flows, _of_optics(BlurWitnesses(displacement, frames, picture), run, seeing))
    run.seconds["witnesses"] = time.perf_counter() - begun
    return witnesses


def _of_optics(known: BlurWitnesses, run: Run, seeing: Seeing | None) -> BlurWitnesses:
    """Add what is known of the optics, and of D/r0 by them."""
    optics = run.params.optics
    if optics is None:
        return known
    strength, diffraction = None if seeing is None else seeing.d_over_r0, optics.diffraction
    if optics.distance is None or strength is None or not np.isfinite(strength.high):
        return replace(known, diffraction=diffraction)
    made = float(displacement_variance(np.array(strength.value), np.array(diffraction)))
    # V grows as the power 5/3 of D/r0, and a 95 % interval has four standard deviations.
    spread = max(5 / 3 * np.log(strength.high / strength.low) / 4, _LEAST_SPREAD)
    return replace(known, displacement=made, diffraction=diffraction, spread=float(spread))


def _find_saturation(run: Run, frame: FloatArray, brightest: float) -> float:
    """Return the intensity from which the mean is saturated."""
    step = run.prepared.levels.gain / (2 ** min(run.source.bit_depth, _MOST_BITS) - 1)
    return saturation_level(brightest, estimate_noise(frame), step, _saturated(run))


def _saturated(run: Run) -> float:
    """Return the intensity from which a frame is saturated."""
    levels = run.prepared.levels
    return levels.full_scale[1] - levels.gain * (1 - SATURATED)


def _placed(run: Run, filtered: Filtered) -> Filtered:
    """Move a filtered image onto the mean geometry of its frames, unless its geometry is that of another clip."""
    if run.params.reference is None and run.params.like is None:
        return filtered.recentred()
    return replace(filtered, mean_flow=np.zeros_like(filtered.mean_flow))


def _filter(
    run: Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> Filtered:
    params, source = run.params, run.source
    counted = np.ones(len(source), bool)
    if params.keep_best < 1:
        counted = best_frames(frame_quality(source), params.keep_best)
    if run.tiles:
        parts = (_tiles_here if run.map_tiles is None else _tiles_elsewhere)(run, centroid, training, counted)
        return join_filtered(parts, run.tiles, source.shape[1:], run.plan.runtime.scratch)
    frames, start = only_counted(chain(iter_frames(training), rest), counted), run.store.filter_start()
    runtime, flows = run.plan.runtime, centroid.flows
    steps = filter_steps(frames, centroid.image, dynamics, params.filter, params.flow, flows, runtime, start)
    return finish(steps, partial(_observe_filter, run, 0))


def _tiles_here(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray) -> Iterator[Filtered]:
    for number in range(len(run.tiles)):
        yield run.store.get(_tile_name(number), partial(_filter_tile, run, centroid, training, counted, number))


def _tiles_elsewhere(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray) -> Iterator[Filtered]:
    """Filter those tiles in other processes that the store does not have."""
    params, total = run.params, len(run.tiles)
    assert run.map_tiles is not None
    missing = [tile for number, tile in enumerate(run.tiles) if f"{_tile_name(number)}.npz" not in run.store.stored]
    settings = params.dynamics, params.filter, params.flow, run.plan.runtime
    tasks = filter_tasks(run.source, missing, centroid, counted, *settings)
    results = iter(run.map_tiles(run_filter_task, tasks))
    for number in range(total):
        part = run.store.get(_tile_name(number), lambda: next(results))
        if run.progress is not None:
            run.progress("filter", number + 1, total)
        yield part


def _tile_name(number: int) -> str:
    return f"filtered_tile_{number}"


def _filter_tile(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray, number: int) -> Filtered:
    """Filter a tile in this process."""
    tile, params, runtime = run.tiles[number], run.params, run.plan.runtime
    frames, flows = (cut_tile(stack, tile, runtime.scratch) for stack in (training, centroid.flows))
    image, source = centroid.image[tile.rows, tile.columns].copy(), run.source.select(roi=tile.roi)
    settings = params.dynamics, params.filter, params.flow, runtime
    return finish(
        tile_filter_steps(source, frames, image, flows, counted, *settings), partial(_observe_filter, run, number)
    )


def _observe_filter(run: Run, tile: int, step: FilterStep) -> None:
    """Report progress, and give the store the checkpoints, unless the frames are filtered in tiles."""
    flows = len(run.source) * run.params.filter.inner_iterations - run.plan.train
    if run.progress is not None:
        run.progress("filter", tile * flows + step.flows_measured, max(len(run.tiles), 1) * flows)
    if step.checkpoint is not None and not run.tiles:
        run.store.checkpoint(step.checkpoint)


def temporal_mean(source: FrameSource) -> FloatArray:
    """Mean of the frames, read one after the other."""
    total = np.zeros(source.shape[1:])
    return _mean(_added_up(source, total), total, len(source))


def _added_up(frames: Iterable[FloatArray], total: NDArray[np.float64]) -> Iterator[FloatArray]:
    """Pass frames on, and add them to ``total``, (H, W) or (H, W, 3)."""
    for frame in frames:
        total += frame
        yield frame


def _mean(unread: Iterator[FloatArray], total: NDArray[np.float64], count: int) -> FloatArray:
    """Mean of frames that have been added up but for those that nobody has read yet."""
    deque(unread, 0)
    return (total / count).astype(np.float32)

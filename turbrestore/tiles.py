"""Centroid and filter of the frames in tiles that overlap, here or in other processes.

Each tile is a clip of its own that passes through the same functions as a whole frame; images and flows of the tiles
are blended by :mod:`turbrestore.runtime.tiling`.  The result is close to that of whole frames but not the same, because
what is estimated from all pixels at once (the flow model, the noise of the frames) is estimated from those of the tile.
Frames that are shifted by more than the halo of 96 pixels leave a part of a tile unseen.

What is done with a tile is described by a task, which another process can be handed: it has the frames of the tile as
a source that reads them there.  Where a tile is worked on changes nothing in the result, bit for bit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .dynamics.dynamic_texture import identify
from .filtering.alternating import Filtered, FilterStep, filter_steps
from .footage.frame_selection import only_counted
from .io.source import FrameSource
from .registration.centroid import Centroid, centroid_steps
from .restoration_run import Run
from .runtime.runtime import Runtime
from .runtime.scratch import fill_stack, iter_frames
from .runtime.steps import finish
from .runtime.tiling import HaloTile, add_tile, cut_tile, new_mosaic
from .settings import RestoreParams

# Figures of filtered tiles of which the mean is taken.
_AVERAGED = ("gains", "sharpness", "shares", "image_noise", "sharpness_weight", "noise_gain")


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


def centroids_of_tiles(run: Run, training: FloatArray) -> Iterator[Centroid]:
    """Find the centroid of every tile; ``training`` (K, H, W) or (K, H, W, 3)."""
    params, runtime, tiles = run.params, run.plan.runtime, run.tiles
    if run.map_tiles is None:
        count = run.counter("centroid", len(tiles) * len(training) * params.centroid.iterations)
        for tile in tiles:
            frames = cut_tile(training, tile, runtime.scratch)
            yield finish(centroid_steps(frames, params.centroid, params.flow, runtime), count)
        return
    count = run.counter("centroid", len(tiles))
    tasks = (CentroidTask(run.source.select(roi=tile.roi), run.plan.train, params, runtime) for tile in tiles)
    for part in run.map_tiles(_run_centroid_task, tasks):
        count(part)
        yield part


def _run_centroid_task(task: CentroidTask) -> Centroid:
    """Find the centroid of a tile whose frames are read here."""
    runtime = _here(task.runtime)
    frames = fill_stack((task.train, *task.source.shape[1:]), iter(task.source), runtime.scratch)
    found = finish(centroid_steps(frames, task.params.centroid, task.params.flow, runtime))
    return replace(found, image=np.array(found.image), flows=np.array(found.flows))


def filtered_tiles(run: Run, centroid: Centroid, training: FloatArray, counted: np.ndarray) -> Iterator[Filtered]:
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
    return _filter_part(_filter_task(run, tile, centroid, counted, folder), frames, partial(run.observe_filter, number))


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
    every = only_counted(chain(iter_frames(frames), rest), task.counted)
    settings = task.params.filter, task.params.flow, task.flows, task.runtime
    return finish(filter_steps(every, task.image, dynamics, *settings), observe)


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
        for name in (*_AVERAGED, "flow_states", "innovations"):
            records.setdefault(name, []).append(np.asarray(getattr(part, name)))
    areas = _areas(tiles)
    averages: dict[str, Any] = {name: np.average(records[name], axis=0, weights=areas) for name in _AVERAGED}
    return Filtered(
        image=image,
        variance=variance,
        flow_states=np.concatenate(records["flow_states"], axis=1),
        innovations=np.sqrt(np.average(np.square(records["innovations"]), axis=0, weights=areas)),
        mean_flow=mean_flow,
        **averages,
    )


def _here(runtime: Runtime) -> Runtime:
    """Replace a scratch folder by the folder of temporary files of this process."""
    return runtime if runtime.scratch is None else replace(runtime, scratch=Path(tempfile.gettempdir()))


def _areas(tiles: Sequence[HaloTile]) -> NDArray[np.float64]:
    """Weight of each tile, in pixels."""
    return np.array([tile.row_weights.sum(dtype=np.float64) * tile.column_weights.sum() for tile in tiles])

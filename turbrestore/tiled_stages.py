"""Centroid and filter of frames that are processed in tiles that overlap, one after the other or in other processes.

Each tile is a clip of its own that passes through the same functions as a whole frame; images and flows of the tiles
are blended by :mod:`turbrestore.runtime.tiling`.  The result is close to that of whole frames but not the same, because
what is estimated from all pixels at once (the flow model, the noise of the frames) is estimated from those of the tile.
Frames that are shifted by more than the halo of 96 pixels leave a part of a tile unseen.

What is done with a tile is described by a task, which another process can be handed: it has the frames of the tile as
a source that reads them there.  Where a tile is worked on changes nothing in the result, bit for bit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .dynamics.dynamic_texture import DynamicsParams, identify
from .filtering.alternating import Filtered, FilterParams, FilterStep, filter_steps
from .io.source import FrameSource
from .registration.centroid import Centroid, CentroidParams, find_centroid
from .registration.flow import FlowParams
from .runtime.runtime import Runtime
from .runtime.scratch import fill_stack, iter_frames
from .runtime.steps import finish
from .runtime.tiling import HaloTile, add_tile, cut_tile, new_mosaic

# As ``map`` does, applies a function to every task and yields the results in order; it may do so in other processes,
# to which it has to pickle closures too.  The tasks should be taken as they are needed, because those of the filter
# hold arrays.
TileMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
# Figures of a filtered tile that are joined or averaged.
_RECORDED = (
    *("flow_states", "gains", "innovations", "sharpness", "shares"),
    *("image_noise", "sharpness_weight"),
)


@dataclass(frozen=True, eq=False)
class CentroidTask:
    """The centroid of a tile, to be found in another process."""

    source: FrameSource  # all frames of the tile
    train: int  # number of training frames
    params: CentroidParams
    flow_params: FlowParams
    runtime: Runtime  # where it has a scratch folder, that of temporary files is used


@dataclass(frozen=True, eq=False)
class FilterTask:
    """The filter of a tile, to be run in another process."""

    source: FrameSource  # all frames of the tile
    # Centroid of the tile, and flows to the training frames.
    image: FloatArray
    flows: FloatArray
    counted: NDArray[np.bool_]  # (T,): frames that count
    dynamics_params: DynamicsParams
    params: FilterParams
    flow_params: FlowParams
    runtime: Runtime  # where it has a scratch folder, that of temporary files is used


def centroid_tasks(
    source: FrameSource,
    tiles: Iterable[HaloTile],
    train: int,
    params: CentroidParams,
    flow_params: FlowParams,
    runtime: Runtime,
) -> Iterator[CentroidTask]:
    """Describe the centroids of all tiles."""
    return (CentroidTask(source.select(roi=tile.roi), train, params, flow_params, runtime) for tile in tiles)


def run_centroid_task(task: CentroidTask) -> Centroid:
    """Find the centroid of a tile whose frames are read here."""
    runtime = _here(task.runtime)
    frames = fill_stack((task.train, *task.source.shape[1:]), iter(task.source), runtime.scratch)
    found = find_centroid(frames, task.params, task.flow_params, runtime)
    return replace(found, image=np.array(found.image), flows=np.array(found.flows))


def filter_tasks(
    source: FrameSource,
    tiles: Iterable[HaloTile],
    centroid: Centroid,
    counted: NDArray[np.bool_],
    dynamics_params: DynamicsParams,
    params: FilterParams,
    flow_params: FlowParams,
    runtime: Runtime,
) -> Iterator[FilterTask]:
    """Describe the filters of tiles."""
    settings = counted, dynamics_params, params, flow_params, runtime
    for tile in tiles:
        image, flows = centroid.image[tile.rows, tile.columns].copy(), cut_tile(centroid.flows, tile)
        yield FilterTask(source.select(roi=tile.roi), image, flows, *settings)


def run_filter_task(task: FilterTask) -> Filtered:
    """Filter a tile whose frames are read here."""
    runtime = _here(task.runtime)
    frames = fill_stack((len(task.flows), *task.source.shape[1:]), iter(task.source), runtime.scratch)
    settings = task.dynamics_params, task.params, task.flow_params, runtime
    return finish(tile_filter_steps(task.source, frames, task.image, task.flows, task.counted, *settings))


def tile_filter_steps(
    source: FrameSource,
    frames: FloatArray,
    image: FloatArray,
    flows: FloatArray,
    counted: NDArray[np.bool_],
    dynamics_params: DynamicsParams,
    params: FilterParams,
    flow_params: FlowParams,
    runtime: Runtime,
) -> Generator[FilterStep, None, Filtered]:
    """Identify the motion of a tile and filter it.

    ``frames`` (K, h, w) or (K, h, w, 3); ``image`` (h, w) or (h, w, 3); ``flows`` (K, h, w, 2); ``counted`` (T,).
    """
    dynamics = identify(flows, dynamics_params, runtime)
    rest = iter(source.select(frames=(len(frames), None))) if len(frames) < len(source) else ()
    every = only_counted(chain(iter_frames(frames), rest), counted)
    return (yield from filter_steps(every, image, dynamics, params, flow_params, flows, runtime))


def only_counted(frames: Iterable[FloatArray], counted: NDArray[np.bool_]) -> Iterator[FloatArray | None]:
    """Replace frames that do not count by None.

    ``counted`` (T,).
    """
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
        mean_flow=mean_flow,
    )


def _here(runtime: Runtime) -> Runtime:
    """Use the folder of temporary files of this process."""
    return runtime if runtime.scratch is None else replace(runtime, scratch=Path(tempfile.gettempdir()))


def _areas(tiles: Sequence[HaloTile]) -> NDArray[np.float64]:
    """Weight of each tile, in pixels."""
    return np.array([tile.row_weights.sum(dtype=np.float64) * tile.column_weights.sum() for tile in tiles])

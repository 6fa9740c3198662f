"""Centroid and filter of frames that are too large for memory, in tiles that overlap.

Each tile is a clip of its own that passes through the same functions as a whole frame; images and flows of the tiles
are blended by :mod:`turbrestore.runtime.tiling`.  The result is close to that of whole frames but not the same, because
what is estimated from all pixels at once (the flow model, the noise of the frames) is estimated from those of the tile.
Frames that are shifted by more than the halo of 96 pixels leave a part of a tile unseen.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .filtering.alternating import Filtered
from .registration.centroid import Centroid, CentroidParams, CentroidState, centroid_steps
from .registration.flow import FlowParams
from .runtime.runtime import Runtime
from .runtime.scratch import iter_frames
from .runtime.tiling import HaloTile, add_tile, cut_tile, new_mosaic


def tiled_centroid_steps(
    frames: FloatArray, tiles: Sequence[HaloTile], params: CentroidParams, flow_params: FlowParams, runtime: Runtime
) -> Generator[CentroidState, None, Centroid]:
    """Find the centroid of every tile, and blend their images and flows.

    Parameters
    ----------
    frames : ndarray, float32, shape (T, H, W) or (T, H, W, 3)
        At least two frames, in memory or in a scratch file.
    tiles : sequence of HaloTile
        Tiles of these frames.
    params : CentroidParams
    flow_params : FlowParams
    runtime : Runtime
        Its scratch folder holds images and flows; without one they stay in memory.

    Yields
    ------
    CentroidState
        After each flow to each tile.

    Returns
    -------
    Centroid
        It has converged if all tiles have.  The mean flow of an iteration is the mean over the tiles, of which those
        that have stopped count with their last.

    Raises
    ------
    DataError, ConfigurationError
        As :func:`turbrestore.registration.centroid.find_centroid`.

    Examples
    --------
    >>> from turbrestore.runtime.steps import finish
    >>> from turbrestore.runtime.tiling import halo_tiles
    >>> tiles = halo_tiles((40, 64), side=44, halo=8)
    >>> frames = np.ones((2, 40, 64), np.float32)
    >>> centroid = finish(tiled_centroid_steps(frames, tiles, CentroidParams(), FlowParams(), Runtime()))
    >>> len(tiles), centroid.flows.shape
    (2, (2, 40, 64, 2))
    """
    image = new_mosaic(frames.shape[1:], runtime.scratch)
    flows = new_mosaic((*frames.shape[:3], 2), runtime.scratch)
    sizes, converged = list[NDArray[np.float64]](), True
    for tile in tiles:
        part = yield from centroid_steps(cut_tile(frames, tile, runtime.scratch), params, flow_params, runtime)
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
    """Blend the filtered images of all tiles, and join their records.

    Parameters
    ----------
    parts : iterable of Filtered
        One for each tile; consumed lazily, so that the images of one tile at a time are in memory.
    tiles : sequence of HaloTile
    shape : tuple of int
        Shape of a frame, (H, W) or (H, W, 3).
    scratch : Path, optional
        Folder of the files that hold the images; without one they stay in memory.

    Returns
    -------
    Filtered
        Its flow states are those of all tiles, one tile after the other; other figures are means over the tiles,
        weighted by their areas.

    Examples
    --------
    >>> from turbrestore.runtime.tiling import halo_tiles
    >>> one, tiles = np.ones(2), halo_tiles((40, 64), side=44, halo=8)
    >>> images = (np.ones(tile.shape, np.float32) for tile in tiles)
    >>> parts = (
    ...     Filtered(image, image, one[:, None], one, one, one, one / 2, 1e-4, 1.0, np.dstack([image, image]))
    ...     for image in images
    ... )
    >>> joined = join_filtered(parts, tiles, (40, 64))
    >>> joined.image.shape, joined.flow_states.shape, joined.shares
    ((40, 64), (2, 2), array([0.5, 0.5]))
    """
    image, variance = new_mosaic(shape, scratch), new_mosaic(shape[:2], scratch)
    mean_flow = new_mosaic((*shape[:2], 2), scratch)
    records: dict[str, list[np.ndarray]] = {}
    for tile, part in zip(tiles, parts, strict=True):
        add_tile(image, tile, part.image)
        add_tile(variance, tile, part.variance)
        add_tile(mean_flow, tile, part.mean_flow)
        for name in ("flow_states", "gains", "innovations", "sharpness", "shares", "image_noise", "motion_share"):
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
        motion_share=float(average("motion_share")),
        mean_flow=mean_flow,
    )


def _areas(tiles: Sequence[HaloTile]) -> NDArray[np.float64]:
    """Weight of each tile, in pixels."""
    return np.array([tile.row_weights.sum(dtype=np.float64) * tile.column_weights.sum() for tile in tiles])

"""Stages of a restoration whose frames are too large for memory, in tiles (:mod:`turbrestore.runtime.tiling`).

A tile is a clip of its own: it has its own centroid iterations, flow model and filter, and what they leave fades into
what the neighbours leave.  That is not the result of the whole frame, though close to it: what is taken from all pixels
at once, such as the flow model, the noise of the frames and the motion of flat regions far from any texture, is taken
from those of the tile.  The deconvolution needs no tiles: it works in strips of files, to the same result.

A frame that is shifted by more than the halo, 96 pixels, leaves a part of its tile unseen, as at the border of a frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .filtering.alternating import Filtered
from .registration.centroid import Centroid, CentroidParams, find_centroid
from .registration.flow import FlowParams
from .runtime.scratch import drop_pages, iter_frames, to_scratch
from .runtime.tiling import HaloTile, add_tile, cut_tile, new_mosaic

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class FilteredTiles:
    """What the filter has made of the first tiles of several; it goes on with the next one.

    Attributes
    ----------
    parts : tuple of Filtered
        One of each tile.
    means : tuple of ndarray, float32, shape (h, w) or (h, w, 3)
        Means of its frames.
    """

    parts: tuple[Filtered, ...] = ()
    means: tuple[FloatArray, ...] = ()


def find_tiled_centroid(
    frames: FloatArray,
    tiles: Sequence[HaloTile],
    params: CentroidParams | None = None,
    flow_params: FlowParams | None = None,
    progress: Callable[[int], None] | None = None,
    scratch: Path | None = None,
) -> Centroid:
    """Iterate to the centroid of every tile.

    Parameters
    ----------
    frames : ndarray, float32, shape (T, H, W) or (T, H, W, 3)
        At least two frames, in memory or in a mapped file.
    tiles : sequence of HaloTile
        Of these frames.
    params : CentroidParams, optional
    flow_params : FlowParams, optional
    progress : callable, optional
        Called with 1 after each flow of each tile.
    scratch : Path, optional
        Folder of files that hold images and flows; by default they are in memory.

    Returns
    -------
    Centroid
        It has converged if all tiles have; the mean flow of an iteration is the mean over the tiles, of which those
        that have stopped keep their last.

    Raises
    ------
    DataError, ConfigurationError
        As :func:`turbrestore.registration.centroid.find_centroid`.

    Examples
    --------
    >>> from turbrestore.runtime.tiling import halo_tiles
    >>> tiles = halo_tiles((40, 64), side=44, halo=8)
    >>> centroid = find_tiled_centroid(np.ones((2, 40, 64), np.float32), tiles)
    >>> len(tiles), centroid.flows.shape
    (2, (2, 40, 64, 2))
    """
    image = new_mosaic(frames.shape[1:], scratch)
    flows = new_mosaic((*frames.shape[:3], 2), scratch)
    sizes, converged = list[Float64Array](), True
    for tile in tiles:
        part = find_centroid(cut_tile(frames, tile, scratch), params, flow_params, progress, scratch)
        add_tile(image, tile, part.image)
        for whole, flow in zip(flows, iter_frames(part.flows), strict=True):
            add_tile(whole, tile, flow)
        sizes.append(part.mean_flow_sizes)
        converged &= part.converged
        # Its flows would stay while the next tile has its own.
        del part, flow
    longest = max(map(len, sizes))
    lasting = [np.pad(found, (0, longest - len(found)), mode="edge") for found in sizes]
    return Centroid(image, flows, np.average(lasting, axis=0, weights=_areas(tiles)), converged)


def filter_tiles(
    filter_tile: Callable[[HaloTile], tuple[Filtered, FloatArray]],
    tiles: Sequence[HaloTile],
    shape: tuple[int, ...],
    scratch: Path | None = None,
    start: FilteredTiles | None = None,
    on_tile: Callable[[FilteredTiles], None] | None = None,
) -> tuple[Filtered, FloatArray]:
    """Filter tile after tile, and put their images and records together.

    Parameters
    ----------
    filter_tile : callable
        Gives what the filter makes of a tile, and the mean of its frames.
    tiles : sequence of HaloTile
    shape : tuple of int
        Of a frame, (H, W) or (H, W, 3).
    scratch : Path, optional
        Folder of files that hold the images; by default they are in memory.
    start : FilteredTiles, optional
        What an earlier run has made of the first tiles; they are passed over, and the result is that of one run, bit
        for bit.
    on_tile : callable, optional
        Called with what there is after each tile.

    Returns
    -------
    filtered : Filtered
        Flow states are those of all tiles, one tile after the other; the other figures are means over the tiles by
        their areas.
    mean : ndarray, float32, shape of a frame

    Examples
    --------
    >>> from turbrestore.runtime.tiling import halo_tiles
    >>> def stand_still(tile):
    ...     one, image = np.ones(2), np.ones(tile.shape, np.float32)
    ...     return Filtered(image, image, one[:, None], one, one, one, one / 2, 1e-4, 1.0), image
    >>> filtered, _ = filter_tiles(stand_still, halo_tiles((40, 64), side=44, halo=8), (40, 64))
    >>> filtered.image.shape, filtered.flow_states.shape, filtered.shares
    ((40, 64), (2, 2), array([0.5, 0.5]))
    """
    done = start or FilteredTiles()
    for tile in tiles[len(done.parts) :]:
        part, usual = filter_tile(tile)
        image, variance = to_scratch(part.image, scratch), to_scratch(part.variance, scratch)
        part = dataclasses.replace(part, image=image, variance=variance)
        done = FilteredTiles((*done.parts, part), (*done.means, to_scratch(usual, scratch)))
        if on_tile is not None:
            on_tile(done)
    image, mean, variance = (new_mosaic(size, scratch) for size in (shape, shape, shape[:2]))
    for tile, part, usual in zip(tiles, done.parts, done.means, strict=True):
        for whole, found in ((image, part.image), (mean, usual), (variance, part.variance)):
            add_tile(whole, tile, found)
            drop_pages(found)
    return _joined(image, variance, done.parts, _areas(tiles)), mean


def _joined(image: FloatArray, variance: FloatArray, parts: Sequence[Filtered], areas: Float64Array) -> Filtered:
    """Put the records of all tiles together."""

    def average(name: str) -> Float64Array:
        return np.average([getattr(part, name) for part in parts], axis=0, weights=areas)

    return Filtered(
        image=image,
        variance=variance,
        flow_states=np.concatenate([part.flow_states for part in parts], axis=1),
        gains=average("gains"),
        innovations=np.sqrt(np.average([part.innovations**2 for part in parts], axis=0, weights=areas)),
        sharpness=average("sharpness"),
        shares=average("shares"),
        image_noise=float(average("image_noise")),
        motion_share=float(average("motion_share")),
    )


def _areas(tiles: Sequence[HaloTile]) -> Float64Array:
    """Weight of each tile, in pixels."""
    return np.array([tile.row_weights.sum(dtype=np.float64) * tile.column_weights.sum() for tile in tiles])

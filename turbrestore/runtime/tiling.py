"""Frames cut into tiles that overlap, and images put together from what was made of the tiles.

Every pixel belongs to one core; a tile is a core with a halo around it, which gives what is computed near the edge of
the core its neighbourhood.  Around the edges between cores the results fade into each other: there the weights of the
tiles rise and fall linearly over half of the halo on either side, and sum to one.  What lies further out is
discarded, so the edge of a tile is invisible.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..core.arrays import FloatArray
from ..core.errors import require
from .scratch import drop_pages, new_stack

# Width of the halo, pixels, chosen: 7680×4320 in 45 tiles ends 0.005 dB above the whole (benchmarks/big_frames.py).
HALO = 96


@dataclass(frozen=True, eq=False)
class HaloTile:
    """A part of the frames."""

    # Its pixels, with the halo.
    rows: slice
    columns: slice
    row_weights: FloatArray  # (h,)
    column_weights: FloatArray  # (w,): what the tile counts in the whole is the product of both

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.row_weights.size, self.column_weights.size

    @property
    def roi(self) -> tuple[int, int, int, int]:
        """x, y, width and height in the frames, pixels."""
        return self.columns.start, self.rows.start, self.shape[1], self.shape[0]


def halo_tiles(shape: tuple[int, int], side: int, halo: int = HALO) -> tuple[HaloTile, ...]:
    """Cut frames into as few tiles as there can be of cores of equal size."""
    require(halo >= 1, f"halo: expected at least 1 pixel, found {halo}")
    require(side >= 4 * halo, f"side: expected at least four halos ({4 * halo} pixels), found {side}")
    rows, columns = (_spans(length, side, halo) for length in shape)
    return tuple(HaloTile(row, column, down, across) for row, down in rows for column, across in columns)


def largest_tile(shape: tuple[int, int], side: int, halo: int = HALO) -> tuple[int, int]:
    """Height and width that no tile exceeds."""
    counts = [_count(length, side, halo) for length in shape]
    tallest, widest = (
        length if count == 1 else min(-(-length // count) + (1 if count == 2 else 2) * halo, length)
        for length, count in zip(shape, counts, strict=True)
    )
    return tallest, widest


def cut_tile(stack: FloatArray, tile: HaloTile, folder: Path | None = None) -> FloatArray:
    """Copy a tile (T, h, w, ...) of every frame or flow (T, H, W, ...)."""
    part = new_stack((len(stack), *tile.shape, *stack.shape[3:]), folder)
    for index, frame in enumerate(stack):
        part[index] = frame[tile.rows, tile.columns]
        drop_pages(stack)
        drop_pages(part)
    return part


def new_mosaic(shape: tuple[int, ...], folder: Path | None = None) -> FloatArray:
    """Return zeros that tiles can be added to."""
    mosaic = new_stack(shape, folder)
    # A new file has zeros already.
    if folder is None:
        mosaic[...] = 0
    return mosaic


def add_tile(mosaic: FloatArray, tile: HaloTile, part: FloatArray) -> None:
    """Add what was made of a tile (h, w, ...) to the whole (H, W, ...), by the weight of the tile."""
    weights = np.outer(tile.row_weights, tile.column_weights)
    mosaic[tile.rows, tile.columns] += part * weights.reshape(*weights.shape, *[1] * (part.ndim - 2))
    drop_pages(mosaic)


def _spans(length: int, side: int, halo: int) -> list[tuple[slice, FloatArray]]:
    """Stretches of one axis with their weights."""
    count = _count(length, side, halo)
    edges = [length * number // count for number in range(count + 1)]
    places, spans = np.arange(length) + 0.5, []
    for start, stop in pairwise(edges):
        span = slice(max(start - halo, 0), min(stop + halo, length))
        rise = 1.0 if start == 0 else _rise(places[span], start, halo)
        fall = 0.0 if stop == length else _rise(places[span], stop, halo)
        spans.append((span, np.broadcast_to(rise - fall, places[span].shape).astype(np.float32)))
    return spans


def _count(length: int, side: int, halo: int) -> int:
    if length <= side:
        return 1
    # Of two tiles each has one halo.
    return 2 if -(-length // 2) + halo <= side else -(-length // (side - 2 * halo))


def _rise(places: np.ndarray, edge: int, halo: int) -> np.ndarray:
    return np.clip((places - edge) / halo + 0.5, 0.0, 1.0)

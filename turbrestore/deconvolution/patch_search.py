"""Search for the most similar patches around every pixel.

Symbols
-------
g : guide; G_a : Gaussian window over a patch.
d(x, y) : ``Σ_z G_a(z) [g(x + z) − g(y + z)]²``, the same for (y, x): one plane of distances serves an offset and its
opposite.

A choice is one integer: the bits of the distance, whose last ones hold the rank of the offset.  Floats of 0 or more
sort like the integers of the same bits, so one partial sort finds both the distances and where they were; it is ten
times faster than a partial sort of indices.  Distances lose the last bits of their mantissa to the rank (relative error
6e-5 for 21×21), and ties go to the nearer offset.

Compiled, distances are put into their places among the best as soon as they are known, so that none is kept: two at a
time change places with each of the best that they are less than.  There is nothing to decide about in that, so that the
compiler makes it of many pixels at once.  Where many are to be chosen, a partial sort of all is faster.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..runtime.jit import compiled
from ..runtime.threads import map_ahead

# Rows of a band, and columns of a tile of it: the distances of 64×192 pixels to 440 offsets are 22 MB.  A band has more
# rows than an offset reaches, so that pairs span two bands at most.  Where there are more offsets a tile has fewer
# columns, but not so few that most of a plane of distances lies outside the tile.
BAND_ROWS = 64
_TILE_COLUMNS, _FEWEST_COLUMNS = 192, 24
_TILE_DISTANCES = BAND_ROWS * _TILE_COLUMNS * 440
# Pixels whose distances are sorted at once, so that they stay in the cache.
_SORTED_PIXELS = 512
# Bits of a distance that is infinite, because the pixel lies outside the image; and a number larger than all bits.
OUTSIDE = int(np.float32(np.inf).view(np.int32))
_NO_CHOICE = int(np.iinfo(np.int32).max)
# Most choices by distance that the compiled loop makes, and places among them that it goes through at a time: it knows
# how many, so that what changes places stays in registers.
_MOST_INSERTED, _PLACES = 100, 5

Keys = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class PatchSearch:
    """What is compared with what.

    Attributes
    ----------
    window : ndarray, float32, shape (patch, 1)
        G_a along one axis.
    offsets : ndarray, int32, shape (n, 2)
        (dy, dx) of the pixels that are compared, nearest first; with each its opposite.
    nearest : int
        Offsets from the first on that are chosen whatever their distance.
    best : int
        Offsets with the least distances that are chosen.
    """

    window: FloatArray
    offsets: NDArray[np.int32]
    nearest: int
    best: int

    @property
    def rank_mask(self) -> int:
        """Bits of a choice that hold the rank."""
        return (1 << len(self.offsets).bit_length()) - 1

    @property
    def reach(self) -> int:
        """Largest offset along an axis, pixels."""
        return int(self.offsets.max())


def tile_columns(offsets: int) -> int:
    """Columns of pixels that a thread works on at a time.

    Parameters
    ----------
    offsets : int
        Pixels that each is compared with.

    Returns
    -------
    int

    Examples
    --------
    >>> [tile_columns(search**2 - 1) for search in (5, 21, 41, 101)]
    [192, 192, 50, 24]
    """
    return max(_FEWEST_COLUMNS, min(_TILE_COLUMNS, _TILE_DISTANCES // (BAND_ROWS * max(offsets, 1))))


def search_bands(guide: FloatArray, search: PatchSearch, threads: int = 0) -> Iterator[tuple[int, Keys]]:
    """Choices of all pixels, band by band.

    Parameters
    ----------
    guide : ndarray, float32, shape (H, W)
        g; reflected beyond the border.
    search : PatchSearch
    threads : int
        Tiles worked on side by side; 0 means one per available core.

    Yields
    ------
    top : int
        First row of the band.
    keys : ndarray, int32, shape (rows · W, nearest + best)
        Choices of every pixel: the nearest offsets in their order, then the best in any.

    Examples
    --------
    >>> search = PatchSearch(np.ones((1, 1), np.float32), np.array([[0, -1], [0, 1]], np.int32), nearest=0, best=1)
    >>> for top, keys in search_bands(np.float32([[0, 0, 1]]), search):
    ...     print(top, search.offsets[keys[:, 0] & search.rank_mask, 1])
    0 [ 1 -1 -1]
    """
    height, width = guide.shape
    margin = search.reach + len(search.window) // 2
    padded = cv2.copyMakeBorder(guide, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    across = tile_columns(len(search.offsets))
    columns, loops = range(0, width, across), compiled(choose_offsets) if search.best <= _MOST_INSERTED else None

    def choose(corner: tuple[int, int]) -> NDArray[np.int32]:
        top, left = corner
        rows, wide = min(BAND_ROWS, height - top), min(across, width - left)
        block = padded[top : top + rows + 2 * margin, left : left + wide + 2 * margin]
        if loops is not None:
            # The compiler makes faster loops of rows whose pixels it knows to be side by side.
            block = np.ascontiguousarray(block)
            places = search.nearest + -(-search.best // _PLACES) * _PLACES
            found = np.full((rows, places, wide), _NO_CHOICE, np.int32)
            edges = np.array([-top, height - top, -left, width - left])
            loops(block, search.window.ravel(), search.offsets, edges, search.nearest, search.rank_mask, found)
            return found[:, : search.nearest + search.best].transpose(0, 2, 1)
        keys = _keys(block, search)
        _exclude_outside(keys, search.offsets, corner, (height, width))
        return _best(keys.reshape(len(keys), -1), search).reshape(rows, wide, -1)

    corners = ((top, left) for top in range(0, height, BAND_ROWS) for left in columns)
    tiles: list[NDArray[np.int32]] = []
    for (top, _), tile in map_ahead(choose, corners, threads):
        tiles.append(tile)
        if len(tiles) == len(columns):
            band = np.concatenate(tiles, axis=1)
            yield top, band.reshape(-1, band.shape[2])
            tiles = []


def choose_offsets(
    block: FloatArray,
    window: FloatArray,
    offsets: NDArray[np.int32],
    edges: NDArray[np.int64],
    nearest: int,
    rank_mask: int,
    found: Keys,
) -> None:
    """Choices of every pixel of a tile; to be compiled.

    Parameters
    ----------
    block : ndarray, float32, shape (rows + 2 margin, columns + 2 margin)
        g of the tile, and around it as far as patches reach.
    window : ndarray, float32, shape (patch,)
        G_a along one axis.
    offsets : ndarray, int32, shape (n, 2)
        (dy, dx), nearest first; with each its opposite, so that n is even.
    edges : ndarray, int64, shape (4,)
        First row of the image and the one after its last, and the same of columns, counted from those of the tile.
    nearest, rank_mask : int
        See :class:`PatchSearch`.
    found : ndarray, int32, shape (rows, nearest + best or more, columns)
        Full of what is more than all choices.  Becomes the nearest and the best, in order; the best are looked for in
        fives.

    Examples
    --------
    >>> offsets, found = np.array([[0, -1], [0, 1]], np.int32), np.full((1, 5, 3), _NO_CHOICE, np.int32)
    >>> block = np.repeat(np.float32([[0, 0, 0, 1, 1]]), 3, axis=0)
    >>> choose_offsets(block, np.ones(1, np.float32), offsets, np.array([0, 1, 0, 3]), 0, 3, found)
    >>> offsets[found[0, 0] & 3, 1]
    array([ 1, -1, -1], dtype=int32)
    """
    rows, places, columns = found.shape
    patch, nothing, far = window.size, np.float32(0), np.float32(np.inf)
    margin = (block.shape[1] - columns) // 2 - patch // 2
    down, along = np.empty(columns + patch - 1, np.float32), np.empty((2, columns), np.float32)
    keys = along.view(np.int32)
    for row in range(rows):
        best = found[row]
        for first in range(0, len(offsets), 2):
            for rank in range(first, first + 2):
                (dy, dx), part, key = offsets[rank], along[rank - first], keys[rank - first]
                down[:], part[:] = nothing, nothing
                for k in range(patch):
                    here = block[margin + row + k, margin : margin + down.size]
                    there, share = block[margin + row + k + dy, margin + dx : margin + dx + down.size], window[k]
                    for x in range(down.size):
                        down[x] += (here[x] - there[x]) * (here[x] - there[x]) * share
                for k in range(patch):
                    ahead, share = down[k : k + columns], window[k]
                    for x in range(columns):
                        part[x] += ahead[x] * share
                inside = edges[3] - dx if edges[0] <= row + dy < edges[1] else 0
                part[: max(edges[2] - dx, 0)], part[max(inside, 0) :] = far, far
                for x in range(columns):
                    key[x] = key[x] & ~rank_mask | rank
                    if rank < nearest:
                        best[rank, x] = key[x]
            for start in range(nearest, places, _PLACES):
                for x in range(columns):
                    one, other = keys[0, x], keys[1, x]
                    for place in range(start, start + _PLACES):
                        held = best[place, x]
                        held, one = min(held, one), max(held, one)
                        best[place, x], other = min(held, other), max(held, other)
                    keys[0, x], keys[1, x] = one, other


def _keys(block: FloatArray, search: PatchSearch) -> Keys:
    """Distance and rank of every offset for the inner pixels of ``block``; shape (offsets, rows, columns)."""
    window, half = search.window, len(search.window) // 2
    margin = search.reach + half
    rows, columns = (size - 2 * margin for size in block.shape)
    rank_of = {(int(dy), int(dx)): rank for rank, (dy, dx) in enumerate(search.offsets)}
    keys = np.empty((len(search.offsets), rows, columns), np.int32)
    kept = np.int32(~search.rank_mask)
    for (dy, dx), rank in rank_of.items():
        if (dy, dx) < (0, 0):
            continue
        # Rows and columns from which the offset or its opposite starts: the tile, and the tile moved back.
        before, after = max(dx, 0), max(-dx, 0)
        y, x = slice(margin - dy - half, margin + rows + half), margin - before - half
        stop = margin + columns + after + half
        squares = block[y, x:stop] - block[y.start + dy : y.stop + dy, x + dx : stop + dx]
        np.multiply(squares, squares, out=squares)
        smooth = cv2.sepFilter2D(squares, cv2.CV_32F, window, window)
        bits = smooth.view(np.int32)[half : half + dy + rows, half : half + before + columns + after]
        bits &= kept
        np.bitwise_or(bits[dy:, before : before + columns], np.int32(rank), out=keys[rank])
        opposite = rank_of[-dy, -dx]
        np.bitwise_or(bits[:rows, after : after + columns], np.int32(opposite), out=keys[opposite])
    return keys


def _exclude_outside(keys: Keys, offsets: NDArray[np.int32], corner: tuple[int, int], shape: tuple[int, int]) -> None:
    """Make the distance to pixels outside the image infinite."""
    (top, left), (height, width) = corner, shape
    rows, columns = keys.shape[1:]
    reach = int(offsets.max())
    if top >= reach and left >= reach and top + rows + reach <= height and left + columns + reach <= width:
        return
    for rank, (plane, (dy, dx)) in enumerate(zip(keys, offsets.tolist(), strict=True)):
        far = OUTSIDE | rank
        plane[: max(-dy - top, 0)] = far
        plane[max(height - dy - top, 0) :] = far
        plane[:, : max(-dx - left, 0)] = far
        plane[:, max(width - dx - left, 0) :] = far


def _best(keys: Keys, search: PatchSearch) -> Keys:
    """Choices of every pixel; shape (pixels, nearest + best)."""
    found = np.empty((keys.shape[1], search.nearest + search.best), np.int32)
    for start in range(0, keys.shape[1], _SORTED_PIXELS):
        part = slice(start, start + _SORTED_PIXELS)
        by_pixel = cv2.transpose(keys[:, part])
        found[part, : search.nearest] = by_pixel[:, : search.nearest]
        if search.best:
            by_pixel.partition(search.best - 1, axis=1)
            found[part, search.nearest :] = by_pixel[:, : search.best]
    return found

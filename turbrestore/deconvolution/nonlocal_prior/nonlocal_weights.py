"""Weights between pixels with similar patches: the graph of nonlocal TV (paper 3, section 5).

Symbols
-------
g : guide; G_a : Gaussian window of standard deviation a over a patch; sums to 1.
d(x, y) : distance of two patches, ``Σ_z G_a(z) [g(x + z) − g(y + z)]²``.
h : filtering parameter, intensity.
w(x, y) : weight of the pair of pixels x, y, ``exp(−d(x, y)/h²)``; 0 for pairs outside the graph (eq. 23).
tail, head : the pixels x < y of a pair, in the order of the image.

key : bits of a distance d, the last of which hold the rank of the offset, nearest first.

Floats of 0 or more sort like the integers of the same bits, so that a key sorts by distance and tells where it was
found.  A distance loses the last bits of its mantissa that way (relative error 6e-5 for a search of 21×21), and of
equal distances the nearer offset comes first.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import FloatArray, check_grey
from ...core.errors import DataError, require
from ...core.noise import estimate_noise
from ...runtime.jit import jit
from ...runtime.threads import map_ahead

# A weight must be positive for its pair to stay in the graph; chosen.
SMALLEST_WEIGHT = 1e-6
# Powers of the graph for the bound of its norm, which is then two per cent above that after many.
POWERS = 4
# Rows and columns of a tile of the search, for their cost.
_TILE_ROWS, _TILE_COLUMNS = 64, 192
# Sorts after all keys.
_NO_KEY = int(np.iinfo(np.int32).max)
# The search goes through this many of the best at a time, so that they stay in registers.
_PLACES = 5
# Bits of an infinite distance: that of a pixel outside the image.
_OUTSIDE = int(np.float32(np.inf).view(np.int32))

Keys = NDArray[np.int32]


@dataclass(frozen=True)
class NonlocalParams:
    """Which pixels are joined to a pixel, and how strongly.

    Parameters
    ----------
    patch : int
        Width of the compared patches, pixels, odd.
    patch_sigma : float
        Standard deviation a of their Gaussian window, pixels.
    search : int
        Width of the window around a pixel in which its neighbours lie, pixels, odd.
    best : int
        Number of neighbours with the most similar patches.
    nearest : {0, 4, 8}
        Number of adjacent pixels that are neighbours whatever their patches.
    h : float, optional
        Filtering parameter, intensity; by default from the contrast and the noise of the guide, see
        :func:`automatic_h`.
    """

    patch: int = 5
    patch_sigma: float = 1.2
    search: int = 21
    best: int = 10
    nearest: int = 4
    h: float | None = None

    def __post_init__(self) -> None:
        for name, size in (("patch", self.patch), ("search", self.search)):
            require(size >= 1 and size % 2 == 1, f"{name}: expected an odd number of pixels, found {size}")
        require(self.search <= 101, f"search: expected at most 101 pixels, found {self.search}")
        require(self.patch_sigma > 0, f"patch_sigma: expected a positive number of pixels, found {self.patch_sigma}")
        require(self.nearest in (0, 4, 8), f"nearest: expected 0, 4 or 8, found {self.nearest}")
        there = self.search**2 - 1
        require(self.nearest <= there, f"search: expected 3 or more pixels for {self.nearest} nearest neighbours")
        require(
            0 <= self.best <= there and self.best + self.nearest > 0,
            f"best: expected 1 to {there} neighbours in a search window of {self.search} pixels, found {self.best}",
        )
        require(self.h is None or self.h > 0, f"h: expected a positive intensity, found {self.h}")

    @property
    def offsets(self) -> NDArray[np.int32]:
        """All (dy, dx) of the search window but (0, 0), nearest first; shape (search² − 1, 2)."""
        axis = np.arange(-(self.search // 2), self.search // 2 + 1, dtype=np.int32)
        grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        order = np.argsort((grid**2).sum(axis=1), kind="stable")
        return grid[order[1:]]

    @property
    def rank_mask(self) -> int:
        """Bits of a key that hold the rank of its offset."""
        return (1 << (self.search**2 - 1).bit_length()) - 1

    @property
    def window(self) -> FloatArray:
        """G_a along one axis; shape (patch,)."""
        return cv2.getGaussianKernel(self.patch, self.patch_sigma, cv2.CV_32F).ravel()


@dataclass(frozen=True, eq=False)
class NonlocalGraph:
    """Symmetric weighted graph over the pixels of an image; each pair is stored once, by its tail."""

    shape: tuple[int, int]  # rows and columns of the image
    starts: NDArray[np.int32]  # (H · W + 1,): where the pairs of each tail start, and where the last end
    heads: NDArray[np.int32]  # (E,): pixel (row · W + column) at which each pair ends
    roots: FloatArray  # (E,): √w of each pair
    reach: int  # largest number of rows from a tail to its heads
    h: float  # filtering parameter that was used, intensity

    def norm_squared(self) -> float:
        """Upper bound of ‖∇_w‖² = 2‖D‖², with D the differences of pairs.

        ``‖D‖² = ρ(DᵀD) ≤ ρ(|D|ᵀ|D|)``, and for a non-negative matrix A and any positive x, ``ρ(A) ≤ max_i (Ax)_i/x_i``
        (Collatz–Wielandt).  The bound falls with each power of A that is applied to x.
        """
        x, bound = np.ones(self.shape[0] * self.shape[1], np.float32), np.inf
        degrees = np.zeros_like(x)
        add_neighbours(x, self.starts, self.heads, self.roots, degrees)
        for _ in range(POWERS):
            # Pixels without pairs do not take part.
            x = np.maximum(x / x.max(), np.float32(1e-6))
            product = degrees * x
            add_neighbours(x, self.starts, self.heads, self.roots, product)
            bound = min(bound, float((product / x).max()))
            x = product
        return 2 * bound


@jit
def add_neighbours(
    x: FloatArray, starts: NDArray[np.int32], heads: NDArray[np.int32], roots: FloatArray, sums: FloatArray
) -> None:
    """Add, to each pixel, the values x of the pixels that it makes a pair with, times their weights.

    ``x, sums`` (H · W,); ``starts, heads, roots`` as of the graph.
    """
    for tail in range(x.size):
        own, total = x[tail], np.float32(0)
        for pair in range(np.uintp(starts[tail]), np.uintp(starts[tail + 1])):
            head, weight = np.uintp(heads[pair]), roots[pair] * roots[pair]
            total += weight * x[head]
            sums[head] += weight * own
        sums[tail] += total


def nonlocal_weights(guide: ArrayLike, params: NonlocalParams | None = None, threads: int = 0) -> NonlocalGraph:
    """Weights of the pairs of pixels of an image (paper 3, eq. 23, as the module writes it).

    The printed equation has the absolute difference instead of its square, which does not fit the unit of h²; the
    square is that of the nonlocal means that the paper cites. Beyond the border the guide is reflected.
    """
    params = params or NonlocalParams()
    grey = check_grey(guide, "guide")
    if grey.size < 2:
        raise DataError(f"guide: expected two pixels or more, found shape {grey.shape}")
    h = params.h if params.h is not None else automatic_h(grey)
    starts, heads, keys = join_pairs(search_patches(grey, params, threads), grey.shape[1], params)
    keys &= ~np.int32(params.rank_mask)
    roots = keys.view(np.float32)
    np.exp(np.divide(roots, -np.float32(h**2), out=roots), out=roots)
    np.sqrt(np.maximum(roots, np.float32(SMALLEST_WEIGHT), out=roots), out=roots)
    return NonlocalGraph((grey.shape[0], grey.shape[1]), starts, heads, roots, params.search // 2, h)


def automatic_h(grey: FloatArray) -> float:
    """Choose the filtering parameter h: an eighth of the contrast of the guide (H, W), or 4 times its noise if more.

    Contrast is the range from the 1st to the 99th percentile. The paper takes h equal to the noise: a fused image has
    so little that almost every weight would vanish, and with them the regularisation. At 4 times the noise n, patches
    that differ by noise alone (d = 2 n²) keep the weight .88, so that flat regions hold together.
    """
    low, high = np.percentile(grey, (1, 99))
    # The last term only keeps h positive for an image of one colour, where all distances are 0.
    return float(max((high - low) / 8, 4 * estimate_noise(grey), 1e-3))


def search_patches(grey: FloatArray, params: NonlocalParams, threads: int = 0) -> Keys:
    """Keys (H · W, nearest + best) of the neighbours that every pixel of an image (H, W) chooses."""
    (height, width), offsets, window = grey.shape, params.offsets, params.window
    margin = params.search // 2 + params.patch // 2
    padded = cv2.copyMakeBorder(grey, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    keys = np.empty((height, width, params.nearest + params.best), np.int32)
    places = params.nearest + -(-params.best // _PLACES) * _PLACES

    def search(corner: tuple[int, int]) -> None:
        top, left = corner
        rows, columns = min(_TILE_ROWS, height - top), min(_TILE_COLUMNS, width - left)
        block = np.ascontiguousarray(padded[top : top + rows + 2 * margin, left : left + columns + 2 * margin])
        found = np.full((rows, places, columns), _NO_KEY, np.int32)
        edges = np.array([-top, height - top, -left, width - left])
        search_tile(block, window, offsets, edges, params.nearest, params.rank_mask, found)
        keys[top : top + rows, left : left + columns] = found[:, : keys.shape[2]].transpose(0, 2, 1)

    corners = ((top, left) for top in range(0, height, _TILE_ROWS) for left in range(0, width, _TILE_COLUMNS))
    for _ in map_ahead(search, corners, threads):
        pass
    return keys.reshape(-1, keys.shape[2])


@jit
def search_tile(
    block: FloatArray,
    window: FloatArray,
    offsets: NDArray[np.int32],
    edges: NDArray[np.int64],
    nearest: int,
    rank_mask: int,
    found: Keys,
) -> None:
    """Choose neighbours of every pixel of a tile.

    Two distances at a time pass the sorted keys of the best and change places with those that they are less than. There
    is no branch in that, so that the compiler works on many pixels at once.
    ``block`` (rows + 2 margin, columns + 2 margin); ``window`` (patch,); ``offsets`` (n, 2); ``edges`` (4,); ``found``
    (rows, nearest + best or more, columns).
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
                (dy, dx), distance, key = offsets[rank], along[rank - first], keys[rank - first]
                # The window is separable: weighted sums of squares along y, then along x.
                down[:], distance[:] = nothing, nothing
                for k in range(patch):
                    here = block[margin + row + k, margin : margin + down.size]
                    there, share = block[margin + row + k + dy, margin + dx : margin + dx + down.size], window[k]
                    for x in range(down.size):
                        down[x] += (here[x] - there[x]) * (here[x] - there[x]) * share
                for k in range(patch):
                    ahead, share = down[k : k + columns], window[k]
                    for x in range(columns):
                        distance[x] += ahead[x] * share
                inside = edges[3] - dx if edges[0] <= row + dy < edges[1] else 0
                distance[: max(edges[2] - dx, 0)], distance[max(inside, 0) :] = far, far
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


def join_pairs(keys: Keys, width: int, params: NonlocalParams) -> tuple[NDArray[np.int32], NDArray[np.int32], Keys]:
    """Pairs from the keys (H · W, nearest + best) of every pixel; a pair that both choose counts once."""
    offsets, radius = params.offsets, params.search // 2
    steps = offsets @ np.array([width, 1])
    rank_of = np.zeros((params.search, params.search), np.int64)
    rank_of[tuple((offsets + radius).T)] = np.arange(len(offsets))
    opposite = rank_of[tuple((radius - offsets).T)]
    starts = np.zeros(len(keys) + 1, np.int32)
    mark_pairs(keys, steps, opposite, params.nearest, params.rank_mask, starts)
    np.cumsum(starts, out=starts)
    heads, of_pairs = np.empty((2, starts[-1]), np.int32)
    place_pairs(keys, steps, params.rank_mask, starts[:-1].copy(), heads, of_pairs)
    return starts, heads, of_pairs


@jit
def mark_pairs(
    keys: Keys,
    steps: NDArray[np.int64],
    opposite: NDArray[np.int64],
    nearest: int,
    rank_mask: int,
    starts: NDArray[np.int32],
) -> None:
    """Overwrite keys that make no new pair by −1, and count the pairs of tail x in ``starts[x + 1]``.

    ``steps`` are the offsets on the flattened image, and ``opposite`` the rank of the opposite of each offset.
    """
    for pixel in range(keys.shape[0]):
        for place in range(keys.shape[1]):
            rank = keys[pixel, place] & rank_mask
            other = pixel + steps[rank]
            new = keys[pixel, place] < _OUTSIDE and (place < nearest or rank >= nearest)
            if new and other < pixel:
                for key in keys[other]:
                    if key >= 0 and key & rank_mask == opposite[rank]:
                        new = False
            if new:
                starts[min(pixel, other) + 1] += 1
            else:
                keys[pixel, place] = -1


@jit
def place_pairs(
    keys: Keys,
    steps: NDArray[np.int64],
    rank_mask: int,
    ends: NDArray[np.int32],
    heads: NDArray[np.int32],
    of_pairs: Keys,
) -> None:
    """Write the pairs that :func:`mark_pairs` left to where those of their tail end."""
    for pixel in range(keys.shape[0]):
        for key in keys[pixel]:
            if key >= 0:
                other = pixel + steps[key & rank_mask]
                tail = min(pixel, other)
                heads[ends[tail]], of_pairs[ends[tail]] = max(pixel, other), key
                ends[tail] += 1

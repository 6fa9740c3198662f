"""The compiled search for the most similar patches around every pixel of a tile.

Symbols as in :mod:`.nonlocal_weights`, and

key : bits of a distance d, the last of which hold the rank of the offset, nearest first.

Floats of 0 or more sort like the integers of the same bits, so that a key sorts by distance and tells where it was
found.  A distance loses the last bits of its mantissa that way (relative error 6e-5 for a search of 21×21), and of
equal distances the nearer offset comes first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...runtime.jit import jit

# Sorts after all keys.
NO_KEY = int(np.iinfo(np.int32).max)
# The search goes through this many of the best at a time, so that they stay in registers.
PLACES = 5

Keys = NDArray[np.int32]


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
            for start in range(nearest, places, PLACES):
                for x in range(columns):
                    one, other = keys[0, x], keys[1, x]
                    for place in range(start, start + PLACES):
                        held = best[place, x]
                        held, one = min(held, one), max(held, one)
                        best[place, x], other = min(held, other), max(held, other)
                    keys[0, x], keys[1, x] = one, other

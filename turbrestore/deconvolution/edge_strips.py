"""Edges of a graph over the pixels of an image, in strips of rows that stay in the cache of a processor.

Symbols
-------
w(x, y) : weight of the pair of pixels x, y.  Each pair is stored once, with the strip of its tail x < y.
∇_w u, div_w v : as in :mod:`turbrestore.deconvolution.nonlocal_tv`.
window : the pixels from the first of a strip to the last that its edges reach, in the order of the image.

A strip knows nothing of the others.  What it adds to pixels is an array over its window; windows overlap, and are
added up in the order of the strips, so that the sum does not depend on which thread came first.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..core.arrays import FloatArray
from ..runtime.scratch import drop_pages
from ..runtime.threads import ThreadTeam


@dataclass(frozen=True, eq=False)
class EdgeStrip:
    """Pairs whose tails are in some rows of the image.

    Attributes
    ----------
    first : int
        First pixel, row · W + column.
    window : int
        Pixels of the window.
    degrees : ndarray, int32, shape (n,)
        Pairs of each of the n pixels of the strip, of which it is the tail.
    heads : ndarray, int32, shape (e,)
        Where each pair ends, pixels from the first on; ordered by tail, then by head.
    roots : ndarray, float32, shape (e,)
        √w.
    order : ndarray, int32, shape (e + 1 or more,)
        0, 1, 2 and so on; strips share it.
    """

    first: int
    window: int
    degrees: NDArray[np.int32]
    heads: NDArray[np.int32]
    roots: FloatArray
    order: NDArray[np.int32]

    def view(self, image: FloatArray) -> FloatArray:
        """Part of a flattened image that the edges reach."""
        return image[self.first : self.first + self.window]

    def differences(self, image: FloatArray) -> FloatArray:
        """``[u(y) − u(x)] √w`` of a flattened image u."""
        values = self.view(image)
        found = np.take(values, self.heads, mode="clip")
        found -= self.at_tails(values)
        found *= self.roots
        return found

    def at_tails(self, values: FloatArray) -> FloatArray:
        """Values over the window, for the tail of each pair."""
        return np.repeat(values[: len(self.degrees)], self.degrees)

    def at_heads(self, values: FloatArray) -> FloatArray:
        """Values over the window, for the head of each pair."""
        return np.take(values, self.heads, mode="clip")

    def gather(
        self, tails: tuple[FloatArray, FloatArray], heads: tuple[FloatArray, FloatArray], subtract: bool = False
    ) -> FloatArray:
        """Sum products of two functions on edges, one pair of them at the tails and one at the heads.

        Parameters
        ----------
        tails, heads : tuple of two ndarrays, float32, shape (e,)
        subtract : bool
            Whether sums at the heads count as negative.

        Returns
        -------
        ndarray, float32, shape (window,)
        """
        # Shallow copies hold what is summed for this call alone: it is freed, and no other thread sees it.
        at_tails, at_heads = (copy.copy(matrix) for matrix in self._sums)
        # A product with a matrix adds up products without an array of them.
        at_tails.data, at_heads.data = tails[0], heads[0]
        total: FloatArray = at_heads @ heads[1]
        if subtract:
            np.negative(total, out=total)
        total[: len(self.degrees)] += at_tails @ tails[1]
        return total

    @cached_property
    def starts(self) -> NDArray[np.int32]:
        """Where the pairs of each pixel of the strip begin, and where the last end; int32, shape (n + 1,)."""
        starts = np.zeros(len(self.degrees) + 1, np.int32)
        np.cumsum(self.degrees, out=starts[1:])
        return starts

    @cached_property
    def _sums(self) -> tuple[sparse.csr_array, sparse.csc_array]:
        """Matrices that add up edges at tails and at heads; their constructor would copy what it is given."""
        count, own = len(self.heads), len(self.degrees)
        at_tails = sparse.csr_array((own, count), dtype=np.float32)
        at_heads = sparse.csc_array((self.window, count), dtype=np.float32)
        at_tails.indices, at_tails.indptr = self.order[:count], self.starts
        at_heads.indices, at_heads.indptr = self.heads, self.order[: count + 1]
        return at_tails, at_heads


def sum_strips(
    strips: Sequence[EdgeStrip],
    part: Callable[[int, EdgeStrip], FloatArray],
    total: FloatArray,
    team: ThreadTeam | None = None,
) -> None:
    """Add up what every strip gives its window.

    Parameters
    ----------
    strips : sequence of EdgeStrip
    part : callable
        From the number of a strip and the strip to values over its window.
    total : ndarray, float32, shape (H · W,)
        Becomes the sum.
    team : ThreadTeam, optional
        Threads that work on strips side by side.

    Examples
    --------
    >>> strip = EdgeStrip(1, 2, np.array([1]), np.array([1], np.int32), np.ones(1, np.float32), np.arange(2))
    >>> total = np.ones(3, np.float32)
    >>> sum_strips([strip], lambda number, strip: np.float32([5, 7]), total)
    >>> total
    array([0., 5., 7.], dtype=float32)
    """

    def work(number: int) -> FloatArray:
        values = part(number, strips[number])
        drop_pages(strips[number].roots)
        return values

    numbers, clear = range(len(strips)), 0
    for strip, values in zip(strips, map(work, numbers) if team is None else team.map(work, numbers), strict=True):
        stop = strip.first + strip.window
        # What no strip before has reached.
        total[clear:stop] = 0
        clear = max(clear, stop)
        total[strip.first : stop] += values
        drop_pages(total)
    total[clear:] = 0

"""Nonlocal total variation as a penalty of the primal-dual splitting, strip by strip.

Symbols as in :mod:`turbrestore.deconvolution.primal_dual`: ``K = ∇_w``, ``Kᵀ = −div_w``.

An iteration goes through the values on the edges in two passes: what is added to p decides |p| everywhere, and |p| how
far each value is drawn back.  Within a pass a strip stays in the cache of its processor.  With ``a = p + sKū`` and the
factor ``f = 1 / max(|a|, 1)`` of the projection, the over-relaxed update is

    p + ρ(fa − p) = ga + Kl,  g = 1 − ρ + ρf,  l = (ρ − 1)sū.

So a is kept in place of p, and g and l, which are images: the second pass writes nothing, and the first of the next
iteration finds ``a = ga + K(l + sū)``.  Images are changed in place: between the passes l has ``l + sū``, and the image
that is to be Kᵀp has |a|².
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..runtime.jit import compiled
from ..runtime.scratch import drop_pages, new_stack
from .edge_strips import EdgeStrip, sum_strips
from .nonlocal_tv import NonlocalGraph
from .strip_grid import StripGrid


@dataclass(frozen=True, eq=False)
class EdgeDual:
    """p of one image, ``ga + Kl``.

    Attributes
    ----------
    values : ndarray, float32, shape (2, E)
        a from tail to head, and from head to tail.
    factor, lagged : ndarray, float32, shape (H, W)
        g and l.
    parts : tuple of slice
        Edges of each strip.
    """

    values: FloatArray
    factor: FloatArray
    lagged: FloatArray
    parts: tuple[slice, ...]


@dataclass(frozen=True, eq=False)
class NonlocalPenalty:
    """J[u] with the weights of a graph.

    Attributes
    ----------
    graph : NonlocalGraph
    grid : StripGrid
        Of its images; its threads work on strips side by side.
    folder : Path, optional
        Where a is kept in a file; without it it is in memory.
    """

    graph: NonlocalGraph
    grid: StripGrid
    folder: Path | None = None

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        return self.graph.norm_squared

    def dual(self, image: FloatArray) -> EdgeDual:
        """Start from p = 0 for an image of this size."""
        ends = np.cumsum([0] + [len(strip.heads) for strip in self.graph.strips])
        # A new file is full of zeros; in memory no page is touched before the threads do.
        size = 2, int(ends[-1])
        values = np.zeros(size, np.float32) if self.folder is None else np.asarray(new_stack(size, self.folder))
        factor, lagged = self._images(2)

        def begin(rows: slice) -> None:
            factor[rows], lagged[rows] = 1, 0

        self.grid.over_rows(begin, factor, lagged)
        return EdgeDual(values, factor, lagged, tuple(map(slice, ends[:-1], ends[1:])))

    def ascend(self, dual: EdgeDual, image: FloatArray, step: float, relaxation: float, pull: FloatArray) -> None:
        """Add ``step`` times K of the image to p, project and over-relax, in place; ``pull`` becomes Kᵀp.

        What is in the image is lost.
        """
        loops, factor, change = compiled(add_differences), dual.factor.ravel(), dual.lagged.ravel()
        shares = np.array([step, relaxation], np.float32)
        rise, project = compiled(rise_loops) or _rise, compiled(project_loops) or _project

        def add(number: int, strip: EdgeStrip) -> FloatArray:
            own, (there, back) = strip.view(factor), dual.values[:, dual.parts[number]]
            if loops is not None:
                squares = np.zeros(strip.window, np.float32)
                loops(strip.view(change), own, strip.starts, strip.heads, strip.roots, there, back, squares)
            else:
                more = strip.differences(change)
                there *= strip.at_tails(own)
                there += more
                back *= strip.at_heads(own)
                back -= more
                squares = strip.gather((there, there), (back, back))
            for array in (dual.values, factor, change):
                drop_pages(array)
            return squares

        def over_rows(loops: Callable[..., None], *images: FloatArray) -> None:
            self.grid.over_rows(lambda rows: loops(*(each[rows].reshape(-1) for each in images), shares), *images)

        over_rows(rise, image, dual.lagged)
        sum_strips(self.graph.strips, add, pull.ravel(), self.grid.team)
        over_rows(project, image, pull, dual.factor, dual.lagged)
        self._pull(dual, pull.ravel())

    def _pull(self, dual: EdgeDual, pull: FloatArray) -> None:
        """Kᵀp."""
        loops, factor, lagged = compiled(draw_back), dual.factor.ravel(), dual.lagged.ravel()

        def draw(number: int, strip: EdgeStrip) -> FloatArray:
            own, (there, back) = strip.view(factor), dual.values[:, dual.parts[number]]
            if loops is not None:
                found = np.zeros(strip.window, np.float32)
                loops(own, strip.view(lagged), strip.starts, strip.heads, strip.roots, there, back, found)
            else:
                net, heads, tails = strip.differences(lagged), strip.at_heads(own), strip.at_tails(own)
                net *= -2
                net += np.multiply(heads, back, out=heads)
                net -= np.multiply(tails, there, out=tails)
                found = strip.gather((net, strip.roots), (net, strip.roots), subtract=True)
            for array in (dual.values, factor, lagged):
                drop_pages(array)
            return found

        sum_strips(self.graph.strips, draw, pull, self.grid.team)

    def value(self, image: FloatArray) -> float:
        """J[u]."""
        flat, loops, (total,) = image.ravel(), compiled(add_squares), self._images(1)

        def squares(_: int, strip: EdgeStrip) -> FloatArray:
            if loops is not None:
                found = np.zeros(strip.window, np.float32)
                loops(strip.view(flat), strip.starts, strip.heads, strip.roots, found)
            else:
                differences = strip.differences(flat)
                found = strip.gather((differences, differences), (differences, differences))
            drop_pages(flat)
            return found

        sum_strips(self.graph.strips, squares, total.ravel(), self.grid.team)
        return sum(self.grid.over_rows(lambda rows: float(np.sqrt(total[rows]).sum(dtype=np.float64)), total))

    def _images(self, count: int) -> list[FloatArray]:
        return [self.grid.image() for _ in range(count)]


def _rise(image: FloatArray, lagged: FloatArray, shares: FloatArray) -> None:
    """:func:`rise_loops` by NumPy."""
    image *= shares[0]
    lagged += image


def rise_loops(image: FloatArray, lagged: FloatArray, shares: FloatArray) -> None:
    """From ū to sū, and from l to l + sū; to be compiled.

    Parameters
    ----------
    image, lagged : ndarray, float32, shape (n,)
        ū and l; changed.
    shares : ndarray, float32, shape (2,)
        s and ρ.

    Examples
    --------
    >>> image, lagged = np.float32([4]), np.float32([3])
    >>> rise_loops(image, lagged, np.float32([0.5, 1.8]))
    >>> image, lagged
    (array([2.], dtype=float32), array([5.], dtype=float32))
    """
    for pixel in range(image.size):
        more = image[pixel] * shares[0]
        image[pixel] = more
        lagged[pixel] += more


def _project(
    image: FloatArray, squares: FloatArray, factor: FloatArray, lagged: FloatArray, shares: FloatArray
) -> None:
    """:func:`project_loops` by NumPy."""
    relaxation = shares[1]
    np.sqrt(squares, out=factor)
    np.maximum(factor, 1, out=factor)
    np.divide(relaxation, factor, out=factor)
    factor -= relaxation - 1
    np.multiply(image, relaxation - 1, out=lagged)


def project_loops(
    image: FloatArray, squares: FloatArray, factor: FloatArray, lagged: FloatArray, shares: FloatArray
) -> None:
    """From |a|² to g, and from sū to l; to be compiled.

    Parameters
    ----------
    image, squares : ndarray, float32, shape (n,)
        sū and |a|².
    factor, lagged : ndarray, float32, shape (n,)
        Become g and l.
    shares : ndarray, float32, shape (2,)
        s and ρ.

    Examples
    --------
    >>> factor, lagged = np.zeros((2, 1), np.float32)
    >>> project_loops(np.float32([2]), np.float32([4]), factor, lagged, np.float32([0.5, 1.5]))
    >>> factor, lagged
    (array([0.25], dtype=float32), array([1.], dtype=float32))
    """
    for pixel in range(image.size):
        length = max(np.sqrt(squares[pixel]), np.float32(1))
        factor[pixel] = shares[1] / length - (shares[1] - np.float32(1))
        lagged[pixel] = image[pixel] * (shares[1] - np.float32(1))


def add_differences(
    change: FloatArray,
    factor: FloatArray,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    there: FloatArray,
    back: FloatArray,
    squares: FloatArray,
) -> None:
    """From a to ga + K of an image along the edges of a strip, and the square of it to its pixels; to be compiled.

    Parameters
    ----------
    change : ndarray, float32, shape (window,)
        Image that K is applied to.
    factor : ndarray, float32, shape (window,)
        g.
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.deconvolution.edge_strips.EdgeStrip`.
    there, back : ndarray, float32, shape (e,)
        a from tail to head, and from head to tail; changed.
    squares : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge = np.array([0, 1, 1], np.int32), np.array([1], np.int32), np.ones(1, np.float32)
    >>> there, back, squares = np.ones(1), np.ones(1), np.zeros(2)
    >>> add_differences(np.array([3.0, 5.0]), np.array([0.5, 1.0]), *edge, there, back, squares)
    >>> there, back, squares
    (array([2.5]), array([-1.]), array([6.25, 1.  ]))
    """
    for tail in range(starts.size - 1):
        own, share, total = change[tail], factor[tail], np.float32(0)
        for edge in range(np.uintp(starts[tail]), np.uintp(starts[tail + 1])):
            head = np.uintp(heads[edge])
            more = (change[head] - own) * roots[edge]
            forward, backward = there[edge] * share + more, back[edge] * factor[head] - more
            there[edge], back[edge] = forward, backward
            total += forward * forward
            squares[head] += backward * backward
        squares[tail] += total


def add_squares(
    image: FloatArray, starts: NDArray[np.int32], heads: NDArray[np.int32], roots: FloatArray, squares: FloatArray
) -> None:
    """Add the square of K of an image along the edges of a strip to its pixels; to be compiled.

    Parameters
    ----------
    image : ndarray, float32, shape (window,)
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.deconvolution.edge_strips.EdgeStrip`.
    squares : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge, squares = (np.array([0, 1, 1]), np.array([1]), np.array([0.5])), np.zeros(2)
    >>> add_squares(np.array([3.0, 5.0]), *edge, squares)
    >>> squares
    array([1., 1.])
    """
    for tail in range(starts.size - 1):
        own, total = image[tail], np.float32(0)
        for edge in range(np.uintp(starts[tail]), np.uintp(starts[tail + 1])):
            head = np.uintp(heads[edge])
            more = (image[head] - own) * roots[edge]
            total += more * more
            squares[head] += more * more
        squares[tail] += total


def draw_back(
    factor: FloatArray,
    lagged: FloatArray,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    there: FloatArray,
    back: FloatArray,
    pull: FloatArray,
) -> None:
    """Kᵀp of the edges of a strip to its pixels, with p = ga + Kl; to be compiled.

    Parameters
    ----------
    factor, lagged : ndarray, float32, shape (window,)
        g and l.
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.deconvolution.edge_strips.EdgeStrip`.
    there, back : ndarray, float32, shape (e,)
        a from tail to head, and from head to tail.
    pull : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge = np.array([0, 1, 1], np.int32), np.array([1], np.int32), np.ones(1, np.float32)
    >>> there, back, pull = np.full(1, 20.0), np.full(1, -20.0), np.zeros(2)
    >>> draw_back(np.array([0.05, 0.05]), np.array([0.0, 0.5]), *edge, there, back, pull)
    >>> pull
    array([-3.,  3.])
    """
    for tail in range(starts.size - 1):
        own, share, total = lagged[tail], factor[tail], np.float32(0)
        for edge in range(np.uintp(starts[tail]), np.uintp(starts[tail + 1])):
            head, root = np.uintp(heads[edge]), roots[edge]
            more = (lagged[head] - own) * root
            net = (back[edge] * factor[head] - there[edge] * share - (more + more)) * root
            total += net
            pull[head] -= net
        pull[tail] += total

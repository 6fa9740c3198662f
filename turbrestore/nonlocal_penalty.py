"""Nonlocal total variation as a penalty of the primal-dual splitting, strip by strip.

Symbols as in :mod:`turbrestore.primal_dual`: ``K = ∇_w``, ``Kᵀ = −div_w``.

An iteration reads and writes every value on the edges in two passes: what has been added to p decides |p| everywhere,
and |p| how far each value is drawn back.  Within a pass a strip stays in the cache of its processor.  With
``a = p + sKū`` and the factor ``f = 1 / max(|a|, 1)`` of the projection, the over-relaxed update is

    p + ρ(fa − p) = (1 − ρ + ρf) a + (ρ − 1) sKū.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray
from .compiled import compiled
from .edge_strips import EdgeStrip, sum_strips
from .nonlocal_tv import NonlocalGraph
from .scratch import new_stack, release


@dataclass(frozen=True, eq=False)
class EdgeDual:
    """p of one image.

    Attributes
    ----------
    values : ndarray, float32, shape (3, E)
        p from tail to head, from head to tail, and what the last iteration added.
    parts : tuple of slice
        Edges of each strip.
    """

    values: FloatArray
    parts: tuple[slice, ...]


@dataclass(frozen=True, eq=False)
class NonlocalPenalty:
    """J[u] with the weights of a graph.

    Attributes
    ----------
    graph : NonlocalGraph
    pool : Executor, optional
        Threads that work on strips side by side.
    folder : Path, optional
        Where p is kept in a file; without it it is in memory.
    """

    graph: NonlocalGraph
    pool: Executor | None = None
    folder: Path | None = None

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        return self.graph.norm_squared

    def dual(self, image: FloatArray) -> EdgeDual:
        """Start from p = 0 for an image of this size."""
        ends = np.cumsum([0] + [len(strip.heads) for strip in self.graph.strips])
        values = np.asarray(new_stack((3, int(ends[-1])), self.folder))
        for part in (parts := tuple(map(slice, ends[:-1], ends[1:]))):
            values[:, part] = 0
            release(values)
        return EdgeDual(values, parts)

    def ascend(self, dual: EdgeDual, image: FloatArray, step: float, relaxation: float) -> FloatArray:
        """Add ``step`` times K of the image to p, project and over-relax, in place; return Kᵀp."""
        flat, values = image.ravel(), dual.values
        root_step, drawn = np.float32(step), np.float32(relaxation - 1)

        add_loops, draw_loops = compiled(add_differences), compiled(draw_back)

        def add(number: int, strip: EdgeStrip) -> FloatArray:
            part = dual.parts[number]
            there, back, added = values[0, part], values[1, part], values[2, part]
            if add_loops is not None:
                squares = np.zeros(strip.window, np.float32)
                edges = strip.starts, strip.heads, strip.roots
                add_loops(strip.view(flat), root_step, *edges, there, back, added, squares)
                release(values)
                return squares
            np.multiply(strip.differences(flat), root_step, out=added)
            there += added
            back -= added
            squares = strip.gather((there, there), (back, back))
            release(values)
            return squares

        factor = np.sqrt(sum_strips(self.graph.strips, add, flat.size, self.pool))
        np.maximum(factor, 1, out=factor)
        np.divide(np.float32(relaxation), factor, out=factor)
        factor -= drawn

        def draw(number: int, strip: EdgeStrip) -> FloatArray:
            part, own = dual.parts[number], strip.view(factor)
            there, back, added = values[0, part], values[1, part], values[2, part]
            if draw_loops is not None:
                pull = np.zeros(strip.window, np.float32)
                draw_loops(own, drawn, strip.starts, strip.heads, strip.roots, there, back, added, pull)
                release(values)
                return pull
            there *= strip.at_tails(own)
            back *= strip.at_heads(own)
            added *= drawn
            there += added
            back -= added
            net = np.subtract(back, there, out=added)
            pull = strip.gather((net, strip.roots), (net, strip.roots), subtract=True)
            release(values)
            return pull

        return sum_strips(self.graph.strips, draw, flat.size, self.pool).reshape(image.shape)

    def value(self, image: FloatArray) -> float:
        """J[u]."""
        flat = image.ravel()

        def squares(_: int, strip: EdgeStrip) -> FloatArray:
            along = strip.differences(flat)
            return strip.gather((along, along), (along, along))

        total = sum_strips(self.graph.strips, squares, flat.size, self.pool)
        return float(np.sqrt(total).sum(dtype=np.float64))


def add_differences(
    image: FloatArray,
    step: np.float32,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    there: FloatArray,
    back: FloatArray,
    added: FloatArray,
    squares: FloatArray,
) -> None:
    """Add K of an image to p along the edges of a strip, and the square of |p| to its pixels; to be compiled.

    Parameters
    ----------
    image : ndarray, float32, shape (window,)
    step : float32
        s.
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.edge_strips.EdgeStrip`.
    there, back, added : ndarray, float32, shape (e,)
        p from tail to head, from head to tail, and what is added; changed.
    squares : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge = np.array([0, 1, 1], np.int32), np.array([1], np.int32), np.ones(1, np.float32)
    >>> there, back, added, squares = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(2)
    >>> add_differences(np.array([3.0, 5.0]), np.float32(10), *edge, there, back, added, squares)
    >>> there, back, squares
    (array([20.]), array([-20.]), array([400., 400.]))
    """
    for tail in range(starts.size - 1):
        own, total = image[tail], np.float32(0)
        for edge in range(starts[tail], starts[tail + 1]):
            head = heads[edge]
            more = (image[head] - own) * roots[edge] * step
            forward, backward = there[edge] + more, back[edge] - more
            there[edge], back[edge], added[edge] = forward, backward, more
            total += forward * forward
            squares[head] += backward * backward
        squares[tail] += total


def draw_back(
    factor: FloatArray,
    drawn: np.float32,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    there: FloatArray,
    back: FloatArray,
    added: FloatArray,
    pull: FloatArray,
) -> None:
    """Project and over-relax p on the edges of a strip, and add Kᵀp to its pixels; to be compiled.

    Parameters
    ----------
    factor : ndarray, float32, shape (window,)
        (1 − ρ + ρf) of each pixel.
    drawn : float32
        ρ − 1.
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.edge_strips.EdgeStrip`.
    there, back, added : ndarray, float32, shape (e,)
        p from tail to head, from head to tail, and what has been added; the first two are changed.
    pull : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge = np.array([0, 1, 1], np.int32), np.array([1], np.int32), np.ones(1, np.float32)
    >>> there, back, added, pull = np.full(1, 20.0), np.full(1, -20.0), np.full(1, 20.0), np.zeros(2)
    >>> draw_back(np.array([0.05, 0.05]), np.float32(0), *edge, there, back, added, pull)
    >>> there, back, pull
    (array([1.]), array([-1.]), array([-2.,  2.]))
    """
    for tail in range(starts.size - 1):
        own, total = factor[tail], np.float32(0)
        for edge in range(starts[tail], starts[tail + 1]):
            head = heads[edge]
            forward = there[edge] * own + added[edge] * drawn
            backward = back[edge] * factor[head] - added[edge] * drawn
            there[edge], back[edge] = forward, backward
            net = (backward - forward) * roots[edge]
            total += net
            pull[head] -= net
        pull[tail] += total

"""Nonlocal total variation as a penalty of the primal-dual splitting (paper 3, section 5).

Symbols as in :mod:`turbrestore.deconvolution.primal_dual` and :mod:`.nonlocal_weights`, and

∇_w u : nonlocal gradient, ``(∇_w u)(x, y) = [u(y) − u(x)] √w(x, y)``; it is K.
div_w v : nonlocal divergence, ``(div_w v)(x) = Σ_y [v(x, y) − v(y, x)] √w(x, y)``; Kᵀ = −div_w.
J(u) : nonlocal total variation, ``Σ_x |∇_w u|(x)`` with ``|v|(x)² = Σ_y v(x, y)²``.

The paper descends the gradient of ``λ/2 ∫ (f − k∗u)² + μ J(u)``,

    ∂u/∂t = λ k*∗(f − k∗u) + μ div_w(∇_w u / |∇_w u|),    (24)

which comes to rest at the minimum that the splitting finds; μ is 1.

A function on pairs is an array of shape (2, E): row 0 is its value from the tail to the head of each pair, row 1 from
the head to the tail.

An iteration goes over the pairs twice, because |a| of ``a = p + sKu`` at a pixel needs all of its pairs.  With
``f = 1 / max(|a|, 1)`` the over-relaxed projection is

    p + ρ(fa − p) = ga + Kl,  g = 1 − ρ + ρf,  l = (ρ − 1)su.

So a is stored in place of p, together with the images g and l.  The first pass of the next iteration computes
``p + sKu = ga + K(l + su)``; the second pass computes Kᵀp and changes nothing on the pairs.

The pairs are processed in bands of rows.  A pair of one band reaches at most into the next band.  Therefore every
second band can be processed in parallel, and the result does not depend on the threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...runtime.jit import jit
from ...runtime.threads import ThreadTeam
from .nonlocal_weights import NonlocalGraph

# Bands of an image, which have at least so many rows; and pixels from which on threads share them.
_BANDS, _LEAST_ROWS, PARALLEL_PIXELS = 16, 32, 1 << 15


class PairDual(NamedTuple):
    """``p = ga + Kl``: a (2, E), which is overwritten, and g and l, of shape (H · W,)."""

    values: FloatArray
    factor: FloatArray
    lag: FloatArray


@dataclass(frozen=True, eq=False)
class NonlocalPenalty:
    """J(u) with the weights of a graph."""

    graph: NonlocalGraph
    team: ThreadTeam | None = None  # threads that work on bands side by side

    @cached_property
    def norm_squared(self) -> float:
        """Upper bound of ‖∇_w‖²."""
        return self.graph.norm_squared()

    def ascend(self, p: PairDual | None, u: FloatArray, step: float, relaxation: float) -> tuple[PairDual, FloatArray]:
        """``p + ρ(p' − p)`` with p' the projection of ``p + s∇_w u`` on |p|(x) ≤ 1, and −div_w of it."""
        graph, scaled = self.graph, step * u.ravel()
        given = p or PairDual(np.zeros((2, len(graph.heads)), np.float32), *np.zeros((2, u.size), np.float32))
        pairs, (squares, adjoint) = (graph.starts, graph.heads, graph.roots), np.zeros((2, u.size), np.float32)
        change = given.lag + scaled
        self._over_bands(lambda band: add_gradient(given.factor, change, *pairs, band, given.values, squares))
        factor = np.asarray(1 - relaxation + relaxation / np.sqrt(squares).clip(1), np.float32)
        new = PairDual(given.values, factor, (relaxation - 1) * scaled)
        self._over_bands(lambda band: add_adjoint(new.factor, new.lag, *pairs, band, new.values, adjoint))
        return new, adjoint.reshape(u.shape)

    def value(self, u: FloatArray) -> float:
        """J(u)."""
        graph, squares = self.graph, np.zeros(u.size, np.float32)
        self._over_bands(lambda band: add_squares(u.ravel(), graph.starts, graph.heads, graph.roots, band, squares))
        return float(np.sqrt(squares).sum(dtype=np.float64))

    def _over_bands(self, work: Callable[[NDArray[np.int64]], None]) -> None:
        """Work on the first and last tail of every band; on even bands first, then on odd ones."""
        height, width = self.graph.shape
        rows = max(self.graph.reach, -(-height // _BANDS), _LEAST_ROWS)
        bands = [np.array([top, min(top + rows, height)]) * width for top in range(0, height, rows)]
        parallel = self.team is not None and height * width >= PARALLEL_PIXELS
        for half in (bands[::2], bands[1::2]):
            for _ in self.team.map(work, half) if self.team is not None and parallel else map(work, half):
                pass


@jit
def add_gradient(
    factor: FloatArray,
    change: FloatArray,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    band: NDArray[np.int64],
    values: FloatArray,
    squares: FloatArray,
) -> None:
    """Replace a by ``ga + K change`` on the pairs of a band, and add |a|² to their pixels.

    ``factor, change, squares`` (H · W,); ``band`` (2,); ``values`` (2, E).
    """
    there, back = values[0], values[1]
    for tail in range(np.uintp(band[0]), np.uintp(band[1])):
        own, share, total = change[tail], factor[tail], np.float32(0)
        for pair in range(np.uintp(starts[tail]), np.uintp(starts[tail + np.uintp(1)])):
            head = np.uintp(heads[pair])
            more = (change[head] - own) * roots[pair]
            forward, backward = share * there[pair] + more, factor[head] * back[pair] - more
            there[pair], back[pair] = forward, backward
            total += forward * forward
            squares[head] += backward * backward
        squares[tail] += total


@jit
def add_adjoint(
    factor: FloatArray,
    lag: FloatArray,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    band: NDArray[np.int64],
    values: FloatArray,
    adjoint: FloatArray,
) -> None:
    """Add ``Kᵀ(ga + Kl)`` of the pairs of a band to their pixels; ``factor, lag, adjoint`` (H · W,)."""
    there, back = values[0], values[1]
    for tail in range(np.uintp(band[0]), np.uintp(band[1])):
        own, share, total = lag[tail], factor[tail], np.float32(0)
        for pair in range(np.uintp(starts[tail]), np.uintp(starts[tail + np.uintp(1)])):
            head, root = np.uintp(heads[pair]), roots[pair]
            more = (lag[head] - own) * root
            net = (factor[head] * back[pair] - share * there[pair] - (more + more)) * root
            total += net
            adjoint[head] -= net
        adjoint[tail] += total


@jit
def add_squares(
    u: FloatArray,
    starts: NDArray[np.int32],
    heads: NDArray[np.int32],
    roots: FloatArray,
    band: NDArray[np.int64],
    squares: FloatArray,
) -> None:
    """Add |∇_w u|² on the pairs of a band to their pixels; arguments as of :func:`add_gradient`."""
    for tail in range(np.uintp(band[0]), np.uintp(band[1])):
        own, total = u[tail], np.float32(0)
        for pair in range(np.uintp(starts[tail]), np.uintp(starts[tail + np.uintp(1)])):
            head = np.uintp(heads[pair])
            difference = (u[head] - own) * roots[pair]
            total += difference * difference
            squares[head] += difference * difference
        squares[tail] += total

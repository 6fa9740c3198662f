"""Nonlocal weights and nonlocal TV in torch.

Symbols and definitions as in :mod:`.nonlocal_weights`, which finds the same graph on the CPU,
and :mod:`.nonlocal_tv`.

All patches of a strip of rows are compared with all of their neighbours at once, and the best are found by one partial
sort of integers that hold distance and offset.  Sums over the pairs of a pixel are gathers: the numbers of the pairs of
pixels of similar degree form a table, whose rows are summed.  Adding pairs to pixels would be shorter, but on a GPU the
order of such additions, and with it the last digits, changes from run to run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from ...core.arrays import FloatArray
from ...runtime.image_stacks import Stack, correlate, load, namespace
from ..problem import total
from .nonlocal_weights import POWERS, SMALLEST_WEIGHT, NonlocalParams, automatic_h

# Bytes of the distances of a strip: little on a CPU, and what keeps a GPU busy.
_STRIP_BYTES_CPU, _STRIP_BYTES_GPU = 1.6e7, 2.5e8
# Sorts last: the pixel itself, which is no neighbour.
_LAST = np.iinfo(np.int32).max


@dataclass(frozen=True, eq=False)
class TorchNonlocalPenalty:
    """J(u) with the weights of a graph whose arrays are on a device."""

    shape: tuple[int, int]  # rows and columns of the image
    # (E,): pixel (row · W + column) at which each pair starts and ends.
    tails: Stack
    heads: Stack
    root: Stack  # (E,): √w
    # (n, degree): which of the 2E values on pairs leave each pixel, for pixels of similar degree; 2E where there is
    # none.
    tables: tuple[Stack, ...]
    places: Stack  # (H · W,): row of each pixel in the tables, one below the other

    def gradient(self, u: Stack) -> Stack:
        """``(∇_w u)(x, y) = [u(y) − u(x)] √w(x, y)``, shape (2, E)."""
        flat = u.reshape(-1)
        along = (flat.index_select(0, self.heads) - flat.index_select(0, self.tails)) * self.root
        return namespace(u).stack([along, -along])

    def adjoint(self, p: Stack) -> Stack:
        """``−div_w p``, the adjoint of the gradient, shape (H, W)."""
        along = (p[1] - p[0]) * self.root
        return self._sum_of_pairs(namespace(p).cat([along, -along]))

    def magnitude(self, p: Stack) -> Stack:
        """``|p|(x) = √Σ_y p(x, y)²``, shape (H, W)."""
        return self._sum_of_pairs((p * p).reshape(-1)).sqrt()

    def project(self, p: Stack) -> Stack:
        """Nearest function on pairs with ``|p|(x) ≤ 1``."""
        factor = 1 / self.magnitude(p).clamp(min=1).reshape(-1)
        return p * namespace(p).stack([factor.index_select(0, self.tails), factor.index_select(0, self.heads)])

    def ascend(self, p: Stack | None, u: Stack, step: float, relaxation: float) -> tuple[Stack, Stack]:
        """``p + ρ(p' − p)`` with p' the projection of ``p + s∇_w u`` on |p|(x) ≤ 1, and −div_w of it."""
        p = u.new_zeros((2, len(self.root))) if p is None else p
        p = p + relaxation * (self.project(self.gradient(u).mul_(step).add_(p)) - p)
        return p, self.adjoint(p)

    def value(self, u: Stack) -> float:
        """J(u)."""
        return total(self.magnitude(self.gradient(u)))

    @cached_property
    def norm_squared(self) -> float:
        """Upper bound of ‖∇_w‖², as of :class:`.nonlocal_weights.NonlocalGraph`."""
        x, bound = self.root.new_ones(self.shape[0] * self.shape[1]), np.inf
        for _ in range(POWERS):
            x = (x / x.max()).clamp(min=1e-6)
            along = (x.index_select(0, self.tails) + x.index_select(0, self.heads)) * self.root**2
            product = self._sum_of_pairs(along.repeat(2)).reshape(-1)
            bound = min(bound, float((product / x).max()))
            x = product
        return 2 * bound

    def _sum_of_pairs(self, values: Stack) -> Stack:
        """Sum of 2E values over those that leave each pixel."""
        xp = namespace(values)
        padded = xp.cat([values, values.new_zeros(1)])
        parts = [padded.index_select(0, table.reshape(-1)).reshape(table.shape).sum(1) for table in self.tables]
        return xp.cat(parts).index_select(0, self.places).reshape(self.shape)


def torch_nonlocal_penalty(guide: FloatArray, params: NonlocalParams, device: str) -> TorchNonlocalPenalty:
    """Nonlocal TV with weights between the similar patches of a guide (H, W)."""
    h = params.h if params.h is not None else automatic_h(guide)
    pixels, neighbours, distances = _neighbours(guide, params, device)
    xp = namespace(pixels)
    weights = xp.exp(-distances / float(np.float32(h**2))).clamp(min=SMALLEST_WEIGHT)
    # Sorted by pair, the two directions of a pair are adjacent, and the larger weight counts.
    pairs, order = xp.sort(xp.minimum(pixels, neighbours) * guide.size + xp.maximum(pixels, neighbours))
    weights = weights[order]
    again = pairs[1:] == pairs[:-1]
    weights[:-1] = xp.where(again, xp.maximum(weights[:-1], weights[1:]), weights[:-1])
    first = xp.ones_like(pairs, dtype=xp.bool)
    first[1:] = ~again
    tails, heads = (pairs[first] // guide.size).int(), (pairs[first] % guide.size).int()
    tables, places = _pair_tables(xp.cat([tails, heads]), guide.size)
    return TorchNonlocalPenalty((guide.shape[0], guide.shape[1]), tails, heads, xp.sqrt(weights[first]), tables, places)


def _pair_tables(owners: Stack, pixels: int) -> tuple[tuple[Stack, ...], Stack]:
    """Tables of which values belong to which pixel, each for degrees that differ by an eighth at most."""
    xp = namespace(owners)
    sorted_owners, order = xp.sort(owners, stable=True)
    order = xp.cat([order, order.new_full((1,), len(owners))])
    starts = xp.searchsorted(sorted_owners, xp.arange(pixels + 1, device=owners.device, dtype=owners.dtype))
    degrees = starts[1:] - starts[:-1]
    tables, members = [], []
    low, largest = -1, int(degrees.max())
    while low < largest:
        high = max(low + 1, low + low // 8) if low >= 0 else 0
        of_degree = xp.nonzero((degrees > low) & (degrees <= high)).reshape(-1)
        if len(of_degree):
            columns = xp.arange(max(high, 1), device=owners.device)
            there = columns < degrees[of_degree, None]
            tables.append(order[xp.where(there, starts[of_degree, None] + columns, len(owners))].int())
            members.append(of_degree)
        low = high
    return tuple(tables), xp.argsort(xp.cat(members)).int()


def _neighbours(guide: FloatArray, params: NonlocalParams, device: str) -> tuple[Stack, Stack, Stack]:
    """Neighbours that pixels choose: pixel, neighbour and patch distance, each of shape (n,)."""
    height, width = guide.shape
    offsets = params.offsets
    bits = len(offsets).bit_length()
    margin = params.search // 2 + params.patch // 2
    around = cv2.copyMakeBorder(guide, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    padded = load(around, device)
    xp = namespace(padded)
    room = _STRIP_BYTES_CPU if padded.device.type == "cpu" else _STRIP_BYTES_GPU
    rows = max(1, int(room / (4 * params.search**2 * width)))
    strips = [_best_keys(padded, top, min(rows, height - top), height, params) for top in range(0, height, rows)]
    keys = xp.cat(strips)
    ranks = (keys & ((1 << bits) - 1)).long()
    distances = (keys & ~((1 << bits) - 1)).view(xp.float32)
    # The nearest offsets come first; where they are also among the best they would count twice.
    useful = xp.ones_like(keys, dtype=xp.bool)
    useful[:, params.nearest :] = ranks[:, params.nearest :] >= params.nearest
    steps = xp.from_numpy(offsets).long().to(device)
    pixels = xp.arange(height * width, device=device)[:, None]
    y, x = pixels // width + steps[ranks, 0], pixels % width + steps[ranks, 1]
    useful &= (y >= 0) & (y < height) & (x >= 0) & (x < width)
    return pixels.expand_as(ranks)[useful], (y * width + x)[useful], distances[useful]


def _best_keys(padded: Stack, top: int, rows: int, height: int, params: NonlocalParams) -> Stack:
    """Distance and rank of offset in one integer, for the nearest and the best offsets of the pixels of a strip.

    Integers as in :mod:`.nonlocal_weights`: of like distances the nearer offset comes first.
    """
    xp = namespace(padded)
    distances = _distances(padded, top, rows, params)
    width, reach = distances.shape[-1], params.search // 2
    axis = xp.arange(-reach, reach + 1, device=padded.device)
    y = xp.arange(top, top + rows, device=padded.device) + axis[:, None]
    x = xp.arange(width, device=padded.device) + axis[:, None]
    outside_y, outside_x = (y < 0) | (y >= height), (x < 0) | (x >= width)
    distances.masked_fill_(outside_y[:, None, :, None], np.inf).masked_fill_(outside_x[None, :, None, :], np.inf)
    offsets = params.offsets
    bits = len(offsets).bit_length()
    # Position of each offset, nearest first, among the rows and columns of the window.
    positions = xp.from_numpy((offsets[:, 0] + reach) * params.search + offsets[:, 1] + reach).long()
    ranks = xp.full((params.search**2,), (1 << bits) - 1, dtype=xp.int32)
    ranks[positions] = xp.arange(len(offsets), dtype=xp.int32)
    keys = distances.view(xp.int32).reshape(params.search**2, -1).T.contiguous()
    keys &= ~((1 << bits) - 1)
    keys |= ranks.to(keys.device)
    keys[:, (params.search**2) // 2] = _LAST
    nearest = keys[:, positions[: params.nearest].to(keys.device)]
    if params.best == 0:
        return nearest
    return xp.cat([nearest, keys.topk(params.best, dim=1, largest=False).values], dim=1)


def _distances(padded: Stack, top: int, rows: int, params: NonlocalParams) -> Stack:
    """Patch distances of a strip to every pixel of the window; shape (search, search, rows, W)."""
    reach, half = params.search // 2, params.patch // 2
    strip = padded[top : top + rows + 2 * (reach + half)]
    height, width = strip.shape[0] - 2 * reach, strip.shape[1] - 2 * reach
    moved = strip.unfold(0, height, 1).unfold(1, width, 1)
    window = params.window
    squares = (moved - strip[reach : reach + height, reach : reach + width]).square_()
    smooth = correlate(squares, window, window)
    return smooth[..., half : height - half, half : width - half].contiguous()

"""Nonlocal weights and the operators on their edges, in torch.

Symbols, definitions and defaults as in :mod:`turbrestore.deconvolution.nonlocal_tv`, which finds the same graph on the
processor.

All patches of a strip of rows are compared with all of their neighbours at once, and the best are found by one partial
sort of integers that hold distance and offset.  Sums over the edges of a pixel are gathers: pixels of like degree stand
in one table of edge numbers, whose rows are summed.  Adding edges to pixels would be shorter, but on a GPU the order of
such additions, and with it the last digits, changes from run to run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..runtime.image_stacks import torch_ops
from .nonlocal_tv import SMALLEST_WEIGHT, NonlocalParams, automatic_h, search_offsets

if TYPE_CHECKING:
    from torch import Tensor

# Bytes of the distances of a strip: little on a processor, and what keeps a GPU busy.
_STRIP_BYTES_CPU, _STRIP_BYTES_GPU = 1.6e7, 2.5e8
# Sorts last: the pixel itself, which is no neighbour.
_LAST = np.iinfo(np.int32).max


@dataclass(frozen=True, eq=False)
class DeviceGraph:
    """Symmetric weighted graph over the pixels of an image, on a device.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of the image.
    tails, heads : tensor, int32, shape (E,)
        Pixel (row · W + column) at which each pair starts and ends.
    root : tensor, float32, shape (E,)
        √w.
    tables : tuple of tensors, int32, shape (n, degree)
        Which of the 2E values on edges leave each pixel, for pixels of like degree; 2E where there is none.
    places : tensor, int32, shape (H·W,)
        Row of each pixel in the tables, one below the other.
    """

    shape: tuple[int, int]
    tails: Tensor
    heads: Tensor
    root: Tensor
    tables: tuple[Tensor, ...]
    places: Tensor


def weights_on_device(guide: FloatArray, params: NonlocalParams, device: str) -> DeviceGraph:
    """Weights between similar patches.

    Parameters
    ----------
    guide : ndarray, float32, shape (H, W)
        g.
    params : NonlocalParams
        Size of patches, search and neighbourhood.
    device : str
        Name that torch gives it.

    Returns
    -------
    DeviceGraph

    Examples
    --------
    >>> import numpy as np
    >>> params = NonlocalParams(patch=1, search=3, best=1, h=1.0)
    >>> graph = weights_on_device(np.float32([[0, 0, 1]]), params, "cpu")
    >>> graph.tails.tolist(), graph.heads.tolist(), (graph.root**2).numpy().round(3)
    ([0, 1], [1, 2], array([1.   , 0.368], dtype=float32))
    """
    import torch

    h = params.h if params.h is not None else automatic_h(guide)
    pixels, neighbours, distances = _neighbours(guide, params, device)
    weights = torch.exp(-distances / float(np.float32(h**2))).clamp(min=SMALLEST_WEIGHT)
    # Sorted by pair, the two directions of an edge stand side by side, and the larger weight counts.
    pairs, order = torch.sort(torch.minimum(pixels, neighbours) * guide.size + torch.maximum(pixels, neighbours))
    weights = weights[order]
    again = pairs[1:] == pairs[:-1]
    weights[:-1] = torch.where(again, torch.maximum(weights[:-1], weights[1:]), weights[:-1])
    first = torch.ones_like(pairs, dtype=torch.bool)
    first[1:] = ~again
    tails, heads = (pairs[first] // guide.size).int(), (pairs[first] % guide.size).int()
    tables, places = _edge_tables(torch.cat([tails, heads]), guide.size)
    return DeviceGraph((guide.shape[0], guide.shape[1]), tails, heads, torch.sqrt(weights[first]), tables, places)


def device_gradient(graph: DeviceGraph, u: Tensor) -> Tensor:
    """Nonlocal gradient ``[u(y) − u(x)] √w(x, y)`` on the edges.

    Parameters
    ----------
    graph : DeviceGraph
    u : tensor, float32, shape (H, W)

    Returns
    -------
    tensor, float32, shape (2, E)

    Examples
    --------
    >>> import torch
    >>> graph = weights_on_device(np.float32([[0, 0]]), NonlocalParams(search=3, best=1), "cpu")
    >>> device_gradient(graph, torch.tensor([[1.0, 3.0]])).tolist()
    [[2.0], [-2.0]]
    """
    import torch

    flat = u.reshape(-1)
    along = (flat.index_select(0, graph.heads) - flat.index_select(0, graph.tails)) * graph.root
    return torch.stack([along, -along])


def device_divergence(graph: DeviceGraph, v: Tensor) -> Tensor:
    """Nonlocal divergence, the negative adjoint of the gradient.

    Parameters
    ----------
    graph : DeviceGraph
    v : tensor, float32, shape (2, E)

    Returns
    -------
    tensor, float32, shape (H, W)

    Examples
    --------
    >>> import torch
    >>> graph = weights_on_device(np.float32([[0, 0]]), NonlocalParams(search=3, best=1), "cpu")
    >>> device_divergence(graph, torch.tensor([[2.0], [0.0]])).tolist()
    [[2.0, -2.0]]
    """
    import torch

    along = (v[0] - v[1]) * graph.root
    return _sum_of_edges(graph, torch.cat([along, -along]))


def device_magnitude(graph: DeviceGraph, v: Tensor) -> Tensor:
    """Magnitude ``|v|(x) = √Σ_y v(x, y)²`` at every pixel.

    Parameters
    ----------
    graph : DeviceGraph
    v : tensor, float32, shape (2, E)

    Returns
    -------
    tensor, float32, shape (H, W)

    Examples
    --------
    >>> import torch
    >>> graph = weights_on_device(np.float32([[0, 0]]), NonlocalParams(search=3, best=1), "cpu")
    >>> device_magnitude(graph, torch.tensor([[2.0], [-3.0]])).tolist()
    [[2.0, 3.0]]
    """
    return _sum_of_edges(graph, (v * v).reshape(-1)).sqrt()


def device_projection(graph: DeviceGraph, v: Tensor) -> Tensor:
    """Nearest function on edges with ``|v|(x) ≤ 1`` at every pixel.

    Parameters
    ----------
    graph : DeviceGraph
    v : tensor, float32, shape (2, E)

    Returns
    -------
    tensor, float32, shape (2, E)

    Examples
    --------
    >>> import torch
    >>> graph = weights_on_device(np.float32([[0, 0]]), NonlocalParams(search=3, best=1), "cpu")
    >>> device_projection(graph, torch.tensor([[2.0], [-0.5]])).tolist()
    [[1.0], [-0.5]]
    """
    import torch

    factor = 1 / device_magnitude(graph, v).clamp(min=1).reshape(-1)
    return v * torch.stack([factor.index_select(0, graph.tails), factor.index_select(0, graph.heads)])


def device_norm_squared(graph: DeviceGraph, iterations: int = 10) -> float:
    """Upper bound of ‖∇_w‖², found as that of :class:`turbrestore.deconvolution.nonlocal_tv.NonlocalGraph` is.

    Parameters
    ----------
    graph : DeviceGraph
    iterations : int
        Powers that sharpen it.

    Returns
    -------
    float

    Examples
    --------
    >>> graph = weights_on_device(np.float32([[0, 0]]), NonlocalParams(search=3, best=1), "cpu")
    >>> device_norm_squared(graph)
    4.0
    """
    x = graph.root.new_ones(graph.shape[0] * graph.shape[1])
    bound = np.inf
    for _ in range(iterations):
        x = (x / x.max()).clamp(min=1e-6)
        along = (x.index_select(0, graph.tails) + x.index_select(0, graph.heads)) * graph.root**2
        image = _sum_of_edges(graph, along.repeat(2)).reshape(-1)
        bound = min(bound, float((image / x).max()))
        x = image
    return 2 * bound


def _sum_of_edges(graph: DeviceGraph, values: Tensor) -> Tensor:
    """Sum of 2E values over those that leave each pixel."""
    import torch

    padded = torch.cat([values, values.new_zeros(1)])
    parts = [padded.index_select(0, table.reshape(-1)).reshape(table.shape).sum(1) for table in graph.tables]
    return torch.cat(parts).index_select(0, graph.places).reshape(graph.shape)


def _edge_tables(owners: Tensor, pixels: int) -> tuple[tuple[Tensor, ...], Tensor]:
    """Tables of which values belong to which pixel, each for degrees that differ by an eighth at most."""
    import torch

    sorted_owners, order = torch.sort(owners, stable=True)
    order = torch.cat([order, order.new_full((1,), len(owners))])
    starts = torch.searchsorted(sorted_owners, torch.arange(pixels + 1, device=owners.device, dtype=owners.dtype))
    degrees = starts[1:] - starts[:-1]
    tables, members = [], []
    low, largest = -1, int(degrees.max())
    while low < largest:
        high = max(low + 1, low + low // 8) if low >= 0 else 0
        of_degree = torch.nonzero((degrees > low) & (degrees <= high)).reshape(-1)
        if len(of_degree):
            columns = torch.arange(max(high, 1), device=owners.device)
            there = columns < degrees[of_degree, None]
            tables.append(order[torch.where(there, starts[of_degree, None] + columns, len(owners))].int())
            members.append(of_degree)
        low = high
    return tuple(tables), torch.argsort(torch.cat(members)).int()


def _neighbours(guide: FloatArray, params: NonlocalParams, device: str) -> tuple[Tensor, Tensor, Tensor]:
    """Directed edges: pixel, neighbour and patch distance, each of shape (edges,)."""
    import torch

    height, width = guide.shape
    offsets = search_offsets(params.search)
    bits = len(offsets).bit_length()
    margin = params.search // 2 + params.patch // 2
    around = cv2.copyMakeBorder(guide, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    padded = torch.from_numpy(around).to(device)
    room = _STRIP_BYTES_CPU if padded.device.type == "cpu" else _STRIP_BYTES_GPU
    rows = max(1, int(room / (4 * params.search**2 * width)))
    strips = [_best_keys(padded, top, min(rows, height - top), height, params) for top in range(0, height, rows)]
    keys = torch.cat(strips)
    ranks = (keys & ((1 << bits) - 1)).long()
    distances = (keys & ~((1 << bits) - 1)).view(torch.float32)
    # The nearest offsets come first; where they are also among the best they would count twice.
    useful = torch.ones_like(keys, dtype=torch.bool)
    useful[:, params.nearest :] = ranks[:, params.nearest :] >= params.nearest
    steps = torch.from_numpy(offsets).long().to(device)
    pixels = torch.arange(height * width, device=device)[:, None]
    y, x = pixels // width + steps[ranks, 0], pixels % width + steps[ranks, 1]
    useful &= (y >= 0) & (y < height) & (x >= 0) & (x < width)
    return pixels.expand_as(ranks)[useful], (y * width + x)[useful], distances[useful]


def _best_keys(padded: Tensor, top: int, rows: int, height: int, params: NonlocalParams) -> Tensor:
    """Distance and rank of offset in one integer, for the nearest and the best offsets of the pixels of a strip.

    Integers as in :mod:`turbrestore.deconvolution.patch_search`: of like distances the nearer offset comes first.
    """
    import torch

    distances = _distances(padded, top, rows, params)
    width, reach = distances.shape[-1], params.search // 2
    axis = torch.arange(-reach, reach + 1, device=padded.device)
    y = torch.arange(top, top + rows, device=padded.device) + axis[:, None]
    x = torch.arange(width, device=padded.device) + axis[:, None]
    outside_y, outside_x = (y < 0) | (y >= height), (x < 0) | (x >= width)
    distances.masked_fill_(outside_y[:, None, :, None], np.inf).masked_fill_(outside_x[None, :, None, :], np.inf)
    offsets = search_offsets(params.search)
    bits = len(offsets).bit_length()
    # Where each offset, nearest first, stands among the rows and columns of the window.
    stands = torch.from_numpy((offsets[:, 0] + reach) * params.search + offsets[:, 1] + reach).long()
    ranks = torch.full((params.search**2,), (1 << bits) - 1, dtype=torch.int32)
    ranks[stands] = torch.arange(len(offsets), dtype=torch.int32)
    keys = distances.view(torch.int32).reshape(params.search**2, -1).T.contiguous()
    keys &= ~((1 << bits) - 1)
    keys |= ranks.to(keys.device)
    keys[:, (params.search**2) // 2] = _LAST
    nearest = keys[:, stands[: params.nearest].to(keys.device)]
    if params.best == 0:
        return nearest
    return torch.cat([nearest, keys.topk(params.best, dim=1, largest=False).values], dim=1)


def _distances(padded: Tensor, top: int, rows: int, params: NonlocalParams) -> Tensor:
    """Patch distances of a strip to every pixel of the window; shape (search, search, rows, W)."""
    ops = torch_ops(str(padded.device))
    reach, half = params.search // 2, params.patch // 2
    strip = padded[top : top + rows + 2 * (reach + half)]
    height, width = strip.shape[0] - 2 * reach, strip.shape[1] - 2 * reach
    moved = strip.unfold(0, height, 1).unfold(1, width, 1)
    window = cv2.getGaussianKernel(params.patch, params.patch_sigma, cv2.CV_32F).ravel()
    squares = (moved - strip[reach : reach + height, reach : reach + width]).square_()
    smooth = ops.filter(squares, window, window)
    return smooth[..., half : height - half, half : width - half].contiguous()

"""Nonlocal total variation: weights between similar patches, nonlocal gradient and divergence (paper 3, section 5).

Symbols
-------
w(x, y) : weight of the pair of pixels x, y; symmetric, 0 for pairs that are no edge of the graph (eq. 23).
G_a : Gaussian window of standard deviation a over a patch; sums to 1.
h : filtering parameter, intensity.
∇_w u : nonlocal gradient, ``(∇_w u)(x, y) = [u(y) − u(x)] √w(x, y)``.
div_w v : nonlocal divergence, ``⟨div_w v, u⟩ = −⟨v, ∇_w u⟩``.
J[u] : nonlocal total variation, ``Σ_x |∇_w u|(x)`` with ``|v|(x)² = Σ_y v(x, y)²``.

The graph stores every pair once, in strips of rows (:mod:`turbrestore.deconvolution.edge_strips`). A function on edges
is an array of
shape (2, E): row 0 is its value from the tail to the head of each pair, row 1 from the head to the tail.  The operators
on such arrays, and the matrix ``difference``, are for reference: the solvers work on the strips, or on a device, and
are tested against them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..core.arrays import FloatArray, check_image, luminance
from ..core.errors import DataError, require
from ..core.noise import estimate_noise
from ..runtime.jit import compiled
from ..runtime.scratch import drop_pages, new_stack
from ..runtime.threads import ThreadTeam, available_cores, one_thread_each
from .edge_strips import EdgeStrip, sum_strips
from .patch_pairs import pairs_of_band
from .patch_search import BAND_ROWS, PatchSearch, search_bands

# Largest number of pixels of a strip, about: their edges fit in the cache of a processor, and work on them takes much
# longer than handing it to a thread.
STRIP_PIXELS = 40_000
# A weight must be positive for its edge to stay in the graph.
SMALLEST_WEIGHT = 1e-6


@dataclass(frozen=True)
class NonlocalParams:
    """Which pixels are tied together, and how strongly.

    Parameters
    ----------
    patch : int
        Width of the compared patches, pixels, odd.
    patch_sigma : float
        Standard deviation a of their Gaussian window, pixels.
    search : int
        Width of the window around a pixel in which its neighbours lie, pixels, odd.
    best : int
        Neighbours with the most similar patches.
    nearest : {0, 4, 8}
        Adjacent pixels that are neighbours whatever their patches.
    h : float, optional
        Filtering parameter, intensity; by default from the contrast and the noise of the guide, see
        ``nonlocal_weights``.
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


@dataclass(frozen=True, eq=False)
class NonlocalGraph:
    """Symmetric weighted graph over the pixels of an image.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of the image.
    strips : tuple of EdgeStrip
        The pairs, from the first row to the last.
    norm_squared : float
        Upper bound of ‖∇_w‖².
    h : float
        Filtering parameter that was used, intensity.
    """

    shape: tuple[int, int]
    strips: tuple[EdgeStrip, ...]
    norm_squared: float
    h: float

    @property
    def size(self) -> int:
        """Number of pairs, E."""
        return sum(len(strip.heads) for strip in self.strips)

    @property
    def tails(self) -> NDArray[np.int32]:
        """Pixel (row · W + column) at which each pair starts; below that at which it ends."""
        degrees = np.concatenate([strip.degrees for strip in self.strips])
        return np.repeat(np.arange(len(degrees), dtype=np.int32), degrees)

    @property
    def heads(self) -> NDArray[np.int32]:
        """Pixel (row · W + column) at which each pair ends."""
        return np.concatenate([strip.heads + np.int32(strip.first) for strip in self.strips])

    @property
    def weights(self) -> FloatArray:
        """Weight w of each pair, above 0 and up to 1."""
        return np.concatenate([strip.roots for strip in self.strips]) ** 2

    @cached_property
    def difference(self) -> sparse.csr_array:
        """∇_w as a matrix, float32, shape (E, H·W): one row per pair, −√w at its tail and +√w at its head."""
        root = np.sqrt(self.weights)
        both = np.stack([self.tails, self.heads], axis=1).ravel()
        rows = np.arange(0, len(both) + 1, 2, dtype=np.int32)
        values = np.stack([-root, root], axis=1).ravel()
        return sparse.csr_array((values, both, rows), shape=(self.size, self.shape[0] * self.shape[1]))


def nonlocal_weights(
    guide: ArrayLike, params: NonlocalParams | None = None, folder: Path | None = None, threads: int = 0
) -> NonlocalGraph:
    """Weights ``w(x, y) = exp(−d(x, y)/h²)``, ``d = Σ_z G_a(z) [g(x + z) − g(y + z)]²`` (paper 3, eq. 23).

    The printed equation has the absolute difference instead of its square, which does not fit the unit of h²; the
    square is that of the nonlocal means that the paper cites. Beyond the border the guide is reflected.

    A pixel is joined to the ``best`` most similar pixels of its search window and to its ``nearest`` ones, and they
    to it. By default h is an eighth of the contrast of the guide (its 1st to 99th percentile), or 4 times its noise
    if that is more. The paper takes h equal to the noise: a fused image has so little that almost every weight
    would vanish, and with them the regularisation. At 4 times the noise, patches that differ by noise alone
    (d = 2 n²) keep the weight .88, so flat regions hold together.

    Parameters
    ----------
    guide : array_like, shape (H, W) or (H, W, 3)
        g; colour is reduced to luminance.
    params : NonlocalParams, optional
        Size of patches, search and neighbourhood.
    folder : Path, optional
        Where the pairs are kept in files; without it they are in memory.
    threads : int
        Parts of the image worked on side by side; 0 means one per available core.

    Returns
    -------
    NonlocalGraph

    Raises
    ------
    DataError
        Wrong shape, values that are not finite, or fewer than two pixels.

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.array([[0.0, 0.0, 1.0]]), NonlocalParams(patch=1, search=3, best=1, h=1.0))
    >>> graph.tails, graph.heads, graph.weights.round(3)
    (array([0, 1], dtype=int32), array([1, 2], dtype=int32), array([1.   , 0.368], dtype=float32))
    """
    params = params or NonlocalParams()
    grey = luminance(check_image(guide, "guide"))
    if grey.size < 2:
        raise DataError(f"guide: expected two pixels or more, found shape {grey.shape}")
    h = params.h if params.h is not None else automatic_h(grey)
    threads = threads or available_cores()
    strips = tuple(_strips(grey, params, h, folder, threads))
    drop_pages(grey)
    order = np.arange(max(len(strip.heads) for strip in strips) + 1, dtype=np.int32)
    strips = tuple(replace(strip, order=order) for strip in strips)
    return NonlocalGraph(grey.shape, strips, _norm_squared_bound(strips, grey.size, threads), h)


def nonlocal_gradient(graph: NonlocalGraph, u: FloatArray) -> FloatArray:
    """Nonlocal gradient ``[u(y) − u(x)] √w(x, y)`` on the edges.

    Parameters
    ----------
    graph : NonlocalGraph
        Weights.
    u : ndarray, float32, shape (H, W)
        Image.

    Returns
    -------
    ndarray, float32, shape (2, E)

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.zeros((1, 2)), NonlocalParams(search=3, best=1))
    >>> nonlocal_gradient(graph, np.array([[1.0, 3.0]], np.float32))
    array([[ 2.],
           [-2.]], dtype=float32)
    """
    along = graph.difference @ u.ravel()
    return np.stack([along, -along])


def nonlocal_divergence(graph: NonlocalGraph, v: FloatArray) -> FloatArray:
    """Nonlocal divergence ``Σ_y [v(x, y) − v(y, x)] √w(x, y)``, the negative adjoint of the gradient.

    Parameters
    ----------
    graph : NonlocalGraph
        Weights.
    v : ndarray, float32, shape (2, E)
        Function on edges.

    Returns
    -------
    ndarray, float32, shape (H, W)

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.zeros((1, 2)), NonlocalParams(search=3, best=1))
    >>> nonlocal_divergence(graph, np.array([[2.0], [0.0]], np.float32))
    array([[ 2., -2.]], dtype=float32)
    """
    return (graph.difference.T @ (v[1] - v[0])).reshape(graph.shape)


def nonlocal_magnitude(graph: NonlocalGraph, v: FloatArray) -> FloatArray:
    """Magnitude ``|v|(x) = √Σ_y v(x, y)²`` at every pixel.

    Parameters
    ----------
    graph : NonlocalGraph
        Weights.
    v : ndarray, float32, shape (2, E)
        Function on edges.

    Returns
    -------
    ndarray, float32, shape (H, W)

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.zeros((1, 2)), NonlocalParams(search=3, best=1))
    >>> nonlocal_magnitude(graph, np.array([[2.0], [-3.0]], np.float32))
    array([[2., 3.]], dtype=float32)
    """
    return np.sqrt(np.bincount(_owners(graph), np.square(v).ravel())).astype(np.float32).reshape(graph.shape)


def project_to_unit(graph: NonlocalGraph, v: FloatArray) -> FloatArray:
    """Nearest function on edges with ``|v|(x) ≤ 1`` at every pixel.

    Parameters
    ----------
    graph : NonlocalGraph
        Weights.
    v : ndarray, float32, shape (2, E)
        Function on edges.

    Returns
    -------
    ndarray, float32, shape (2, E)

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.zeros((1, 2)), NonlocalParams(search=3, best=1))
    >>> project_to_unit(graph, np.array([[2.0], [-0.5]], np.float32))
    array([[ 1. ],
           [-0.5]], dtype=float32)
    """
    factor = np.reciprocal(np.maximum(nonlocal_magnitude(graph, v), np.float32(1))).ravel()
    return v * factor[_owners(graph)].reshape(v.shape)


def nonlocal_total_variation(graph: NonlocalGraph, u: FloatArray) -> float:
    """Nonlocal total variation ``J[u] = Σ_x |∇_w u|(x)``.

    Parameters
    ----------
    graph : NonlocalGraph
        Weights.
    u : ndarray, float32, shape (H, W)
        Image.

    Returns
    -------
    float

    Examples
    --------
    >>> import numpy as np
    >>> graph = nonlocal_weights(np.zeros((1, 2)), NonlocalParams(search=3, best=1))
    >>> nonlocal_total_variation(graph, np.array([[1.0, 3.0]], np.float32))
    4.0
    """
    return float(nonlocal_magnitude(graph, nonlocal_gradient(graph, u)).sum(dtype=np.float64))


def automatic_h(grey: FloatArray) -> float:
    """Find the filtering parameter from contrast and noise of the guide, see :func:`nonlocal_weights`.

    Parameters
    ----------
    grey : ndarray, float32, shape (H, W)
        g.

    Returns
    -------
    float
        Intensity.

    Examples
    --------
    >>> round(automatic_h(np.tile(np.linspace(0, 1, 101, dtype=np.float32), (9, 1))), 3)
    0.123
    """
    low, high = np.percentile(grey, (1, 99))
    # The last term only keeps h positive for an image of one colour, where all distances are 0.
    return float(max((high - low) / 8, 4 * estimate_noise(grey), 1e-3))


def _owners(graph: NonlocalGraph) -> NDArray[np.int32]:
    """Pixel that each value of a flattened function on edges leaves."""
    return np.concatenate([graph.tails, graph.heads])


def search_offsets(search: int) -> NDArray[np.int32]:
    """All (dy, dx) of the search window but (0, 0), nearest first.

    Parameters
    ----------
    search : int
        Width of the window, pixels, odd.

    Returns
    -------
    ndarray, int32, shape (search² - 1, 2)

    Examples
    --------
    >>> search_offsets(3)[:4].tolist()
    [[-1, 0], [0, -1], [0, 1], [1, 0]]
    """
    radius = search // 2
    axis = np.arange(-radius, radius + 1, dtype=np.int32)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.argsort((grid**2).sum(axis=1), kind="stable")
    return grid[order[1:]]


def _strips(
    grey: FloatArray, params: NonlocalParams, h: float, folder: Path | None, threads: int
) -> Iterator[EdgeStrip]:
    window = cv2.getGaussianKernel(params.patch, params.patch_sigma, cv2.CV_32F)
    search = PatchSearch(window, search_offsets(params.search), params.nearest, params.best)
    bands = search_bands(grey, search, threads)
    top, keys = next(bands)
    for following, below in chain(bands, [(grey.shape[0], keys[:0])]):
        degrees, heads, distances = pairs_of_band(keys, below, grey.shape[1], search)
        stack = np.asarray(new_stack((2, len(heads)), folder))
        np.exp(-distances / np.float32(h**2), out=stack[0])
        np.sqrt(np.maximum(stack[0], np.float32(SMALLEST_WEIGHT)), out=stack[0])
        stack[1].view(np.int32)[:] = heads
        yield from _cut(degrees, stack, (top, following), grey.shape, search.reach)
        drop_pages(stack)
        top, keys = following, below


def _cut(
    degrees: NDArray[np.intp], stack: FloatArray, rows: tuple[int, int], shape: tuple[int, int], reach: int
) -> Iterator[EdgeStrip]:
    """Cut a band into strips; ``stack`` holds √w of its pairs and, as integers, their heads from its first pixel on."""
    (top, stop), (height, width) = rows, shape
    # Strips of a band as equal as they can be: a short one at its end would cost as much as a long one.
    count = -(-(stop - top) // max(4, min(BAND_ROWS, STRIP_PIXELS // width)))
    step = -(-(stop - top) // count)
    # All strips share one order, once the longest of them is known.
    heads, end, none = stack[1].view(np.int32), 0, np.zeros(0, np.int32)
    for row in range(top, stop, step):
        first, own = (row - top) * width, (min(row + step, stop) - row) * width
        of_tails = degrees[first : first + own].astype(np.int32)
        part = slice(end, end := end + int(of_tails.sum()))
        heads[part] -= np.int32(first)
        window = min(own + reach * (width + 1), (height - row) * width)
        yield EdgeStrip(row * width, window, of_tails, heads[part], stack[0, part], none)


def _norm_squared_bound(strips: tuple[EdgeStrip, ...], pixels: int, threads: int, iterations: int = 10) -> float:
    """Upper bound of ‖∇_w‖² = 2‖D‖², D the differences.

    ``‖D‖² = ρ(DᵀD) ≤ ρ(|D|ᵀ|D|)``, and for a non-negative matrix A and any positive x, ``ρ(A) ≤ max_i (Ax)_i / x_i``
    (Collatz–Wielandt). The bound falls with each power of A that is applied to x.
    """
    x, bound, loops = np.ones(pixels, np.float32), np.inf, compiled(add_sums)

    def apply(_: int, strip: EdgeStrip) -> FloatArray:
        values = strip.view(x)
        if loops is not None:
            found = np.zeros(strip.window, np.float32)
            loops(values, strip.starts, strip.heads, strip.roots, found)
            return found
        sums = (strip.at_tails(values) + strip.at_heads(values)) * strip.roots
        return strip.gather((strip.roots, sums), (strip.roots, sums))

    with one_thread_each(), ThreadTeam(threads) as team:
        for _ in range(iterations):
            # Pixels without edges do not take part.
            x /= x.max()
            np.maximum(x, np.float32(1e-6), out=x)
            image = np.empty_like(x)
            sum_strips(strips, apply, image, team)
            bound = min(bound, float(np.divide(image, x, out=x).max()))
            x = image
    return 2 * bound


def add_sums(
    image: FloatArray, starts: NDArray[np.int32], heads: NDArray[np.int32], roots: FloatArray, sums: FloatArray
) -> None:
    """Add ``|D|ᵀ|D|`` of an image along the edges of a strip; to be compiled.

    Parameters
    ----------
    image : ndarray, float32, shape (window,)
    starts, heads, roots : ndarray
        Of the strip, see :class:`turbrestore.deconvolution.edge_strips.EdgeStrip`.
    sums : ndarray, float32, shape (window,)
        Added to.

    Examples
    --------
    >>> edge, sums = (np.array([0, 1, 1]), np.array([1]), np.array([0.5])), np.zeros(2)
    >>> add_sums(np.array([3.0, 5.0]), *edge, sums)
    >>> sums
    array([2., 2.])
    """
    for tail in range(starts.size - 1):
        own, total = image[tail], np.float32(0)
        for edge in range(np.uintp(starts[tail]), np.uintp(starts[tail + 1])):
            head = np.uintp(heads[edge])
            more = (own + image[head]) * roots[edge] * roots[edge]
            total += more
            sums[head] += more
        sums[tail] += total

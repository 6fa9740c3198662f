"""Nonlocal total variation: weights between similar patches, nonlocal gradient and divergence (paper 3, section 5).

Symbols
-------
w(x, y) : weight of the pair of pixels x, y; symmetric, 0 for pairs that are no edge of the graph (eq. 23).
G_a : Gaussian window of standard deviation a over a patch; sums to 1.
h : filtering parameter, intensity.
∇_w u : nonlocal gradient, ``(∇_w u)(x, y) = [u(y) − u(x)] √w(x, y)``.
div_w v : nonlocal divergence, ``⟨div_w v, u⟩ = −⟨v, ∇_w u⟩``.
J[u] : nonlocal total variation, ``Σ_x |∇_w u|(x)`` with ``|v|(x)² = Σ_y v(x, y)²``.

The graph stores every pair once. A function on edges is an array of shape (2, E): row 0 is its value from the tail
to the head of each pair, row 1 from the head to the tail.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from .arrays import FloatArray, check_image, luminance
from .errors import DataError, require
from .parallel import map_ahead
from .psf import estimate_noise

# Pixels whose distances to all offsets are held at once by a thread: 4096 × 440 float32 are 7 MB.
_STRIP_PIXELS = 4096
# A weight must be positive for its edge to stay in the graph.
_SMALLEST_WEIGHT = 1e-6


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
    difference : scipy.sparse.csr_array, float32, shape (E, H·W)
        One row per pair: −√w at its tail, +√w at its head.
    incidence : scipy.sparse.csc_array, float32, shape (H·W, 2E)
        Sums a flattened function on edges over the edges that leave each pixel.
    norm_squared : float
        Upper bound of ‖∇_w‖².
    h : float
        Filtering parameter that was used, intensity.
    """

    shape: tuple[int, int]
    difference: sparse.csr_array
    incidence: sparse.csc_array
    norm_squared: float
    h: float

    @property
    def tails(self) -> NDArray[np.int32]:
        """Pixel (row · W + column) at which each pair starts; below that at which it ends."""
        return self.difference.indices[0::2]

    @property
    def heads(self) -> NDArray[np.int32]:
        """Pixel (row · W + column) at which each pair ends."""
        return self.difference.indices[1::2]

    @property
    def weights(self) -> FloatArray:
        """Weight w of each pair, above 0 and up to 1."""
        return self.difference.data[1::2] ** 2


def nonlocal_weights(guide: ArrayLike, params: NonlocalParams | None = None) -> NonlocalGraph:
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
    h = params.h if params.h is not None else _automatic_h(grey)
    pixels, neighbours, distances = _neighbours(grey, params)
    weights = np.maximum(np.exp(-distances / np.float32(h**2)), np.float32(_SMALLEST_WEIGHT))
    directed = sparse.coo_array((weights, (pixels, neighbours)), shape=(grey.size, grey.size)).tocsr()
    pairs = sparse.triu(directed.maximum(directed.T.tocsr()), 1, format="csr").tocoo()
    return _graph(grey.shape, pairs.coords[0], pairs.coords[1], pairs.data, h)


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
    return np.sqrt(graph.incidence @ np.square(v).ravel()).reshape(graph.shape)


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
    factor = 1 / np.maximum(nonlocal_magnitude(graph, v), 1).ravel()
    return v * factor.take(graph.incidence.indices).reshape(v.shape)


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


def _automatic_h(grey: FloatArray) -> float:
    low, high = np.percentile(grey, (1, 99))
    # The last term only keeps h positive for an image of one colour, where all distances are 0.
    return float(max((high - low) / 8, 4 * estimate_noise(grey), 1e-3))


def _neighbours(grey: FloatArray, params: NonlocalParams) -> tuple[NDArray[np.int32], NDArray[np.int32], FloatArray]:
    """Directed edges: pixel, neighbour and patch distance, each of shape (edges,)."""
    height, width = grey.shape
    offsets = _offsets(params.search)
    bits = len(offsets).bit_length()
    strip_rows = max(1, _STRIP_PIXELS // width)
    margin = params.search // 2 + params.patch // 2
    padded = cv2.copyMakeBorder(grey, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)

    def best_of_strip(top: int) -> NDArray[np.int32]:
        rows = min(strip_rows, height - top)
        distances = _distances(padded[top : top + rows + 2 * margin], offsets, params)
        _exclude_outside(distances, offsets, top, height)
        return _best_keys(distances.reshape(len(offsets), -1), bits, params)

    strips = map_ahead(best_of_strip, range(0, height, strip_rows))
    keys = np.concatenate([part for _, part in strips])
    ranks = keys & ((1 << bits) - 1)
    distances = (keys - ranks).view(np.float32)
    # The nearest offsets come first; where they are also among the best they would count twice.
    useful = np.ones(keys.shape, bool)
    useful[:, params.nearest :] = ranks[:, params.nearest :] >= params.nearest
    y, x = np.divmod(np.arange(grey.size, dtype=np.int32)[:, None], np.int32(width))
    y, x = y + offsets[ranks, 0], x + offsets[ranks, 1]
    useful &= (y >= 0) & (y < height) & (x >= 0) & (x < width)
    pixels = np.broadcast_to(np.arange(grey.size, dtype=np.int32)[:, None], keys.shape)[useful]
    return pixels, (y * np.int32(width) + x)[useful], distances[useful]


def _offsets(search: int) -> NDArray[np.int32]:
    """All (dy, dx) of the search window but (0, 0), nearest first."""
    radius = search // 2
    axis = np.arange(-radius, radius + 1, dtype=np.int32)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.argsort((grid**2).sum(axis=1), kind="stable")
    return grid[order[1:]]


def _distances(strip: FloatArray, offsets: NDArray[np.int32], params: NonlocalParams) -> FloatArray:
    """Patch distances of the inner pixels of ``strip`` to each offset; shape (offsets, rows, columns)."""
    reach, half = params.search // 2, params.patch // 2
    rows, columns = strip.shape[0] - 2 * reach, strip.shape[1] - 2 * reach
    window = cv2.getGaussianKernel(params.patch, params.patch_sigma, cv2.CV_32F)
    centre = strip[reach : reach + rows, reach : reach + columns]
    distances = np.empty((len(offsets), rows - 2 * half, columns - 2 * half), np.float32)
    for index, (dy, dx) in enumerate(offsets):
        moved = strip[reach + dy : reach + dy + rows, reach + dx : reach + dx + columns]
        squares = np.square(centre - moved)
        smooth = cv2.sepFilter2D(squares, cv2.CV_32F, window, window)
        distances[index] = smooth[half : rows - half, half : columns - half]
    return distances


def _exclude_outside(distances: FloatArray, offsets: NDArray[np.int32], top: int, height: int) -> None:
    """Make the distance to pixels outside the image infinite; ``top`` is the first row of the strip."""
    columns = distances.shape[2]
    for plane, (dy, dx) in zip(distances, offsets, strict=True):
        plane[: max(-dy - top, 0)] = np.inf
        plane[max(height - dy - top, 0) :] = np.inf
        plane[:, : max(-dx, 0)] = np.inf
        plane[:, max(columns - dx, 0) :] = np.inf


def _best_keys(distances: FloatArray, bits: int, params: NonlocalParams) -> NDArray[np.int32]:
    """Distance and rank of offset in one integer, for the nearest and the best offsets of each pixel.

    Floats of 0 or more sort like the integers of the same bits, so one partial sort of integers finds both the
    distances and where they were; it is ten times faster than a partial sort of indices. Distances lose the last
    bits of their mantissa to the rank (relative error 6e-5 for 21×21), and ties go to the nearer offset.
    """
    keys = distances.view(np.int32)
    keys &= ~((1 << bits) - 1)
    keys |= np.arange(len(keys), dtype=np.int32)[:, None]
    by_pixel = np.ascontiguousarray(keys.T)
    nearest = by_pixel[:, : params.nearest].copy()
    if params.best == 0:
        return nearest
    by_pixel.partition(params.best - 1, axis=1)
    return np.concatenate([nearest, by_pixel[:, : params.best]], axis=1)


def _graph(
    shape: tuple[int, int], tails: NDArray[np.int32], heads: NDArray[np.int32], weights: FloatArray, h: float
) -> NonlocalGraph:
    count, pixels = len(weights), shape[0] * shape[1]
    root = np.sqrt(weights)
    both = np.stack([tails, heads], axis=1).astype(np.int32, copy=False)
    difference = sparse.csr_array(
        (np.stack([-root, root], axis=1).ravel(), both.ravel(), np.arange(0, 2 * count + 1, 2, dtype=np.int32)),
        shape=(count, pixels),
    )
    incidence = sparse.csc_array(
        (np.ones(2 * count, np.float32), both.T.ravel(), np.arange(2 * count + 1, dtype=np.int32)),
        shape=(pixels, 2 * count),
    )
    return NonlocalGraph(shape, difference, incidence, _norm_squared_bound(difference), h)


def _norm_squared_bound(difference: sparse.csr_array, iterations: int = 10) -> float:
    """Upper bound of ‖∇_w‖² = 2‖D‖², D the differences.

    ``‖D‖² = ρ(DᵀD) ≤ ρ(|D|ᵀ|D|)``, and for a non-negative matrix A and any positive x, ``ρ(A) ≤ max_i (Ax)_i / x_i``
    (Collatz–Wielandt). The bound falls with each power of A that is applied to x.
    """
    positive = sparse.csr_array(
        (np.abs(difference.data), difference.indices, difference.indptr), shape=difference.shape
    )
    x = np.ones(difference.shape[1], np.float32)
    bound = np.inf
    for _ in range(iterations):
        # Pixels without edges do not take part.
        x = np.maximum(x / x.max(), np.float32(1e-6))
        image = positive.T @ (positive @ x)
        bound = min(bound, float((image / x).max()))
        x = image
    return 2 * bound

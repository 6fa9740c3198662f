"""What moments of an image say about the motion: path, kernel and image tied by the binomial relation.

Symbols (paper 2, eqs. 2 to 4)
------------------------------
y_δ^(p) : time average of y^p over the exposure, :func:`path_moments`.
y_Ψ^(p) : raw moment of the kernel, :func:`kernel_moments`.
y^(p) : raw moment of the image, :func:`compose_moments` of the two.

The relation ``y^(p) = Σ_i binom(p, i) y_Ψ^(p−i) y_δ^(i)`` (paper 2, eq. 3) holds for *raw* moments on both sides.
Equation 4 of paper 2 centres the kernel at η₀ but not the image, which loses the offset; it is not followed.  For
covariances it says ``cov(image) = cov(Ψ) + cov(y over the exposure)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import comb

from ..core.errors import DataError, require
from .kernels import Float64Array, Kernel, PixelGrid, marginal_kernel


def path_moments(path: ArrayLike, order: int, dimensions: int = 1) -> Float64Array:
    """Time averages of the powers of the output over the exposure, y_δ^(p) (paper 2, eq. 2).

    Parameters
    ----------
    path : array_like, shape (..., N_e) or (..., N_e, 2)
        Output at the fast steps of the exposure.
    order : int
        Highest order.
    dimensions : int
        1 on a line, 2 in the plane.

    Returns
    -------
    ndarray, float64, shape (..., order + 1) or (..., order + 1, order + 1)

    Raises
    ------
    DataError
        Empty exposure.

    Examples
    --------
    >>> path_moments([0.0, 1.0, 2.0, 1.0], order=2)
    array([1. , 1. , 1.5])
    """
    positions = np.asarray(path, np.float64)
    if positions.ndim < dimensions or positions.size == 0:
        raise DataError(f"path: expected at least one step in the exposure, found shape {positions.shape}")
    if dimensions == 1:
        return powers(positions, order).mean(-1)
    along = powers(np.moveaxis(positions, -1, 0), order)
    return along[0] @ np.swapaxes(along[1], -1, -2) / positions.shape[-2]


def kernel_moments(kernel: Kernel, order: int, pixels: PixelGrid | None = None) -> Float64Array:
    """Raw moments of a kernel on a line, y_Ψ^(p), with the width of the pixels.

    Integrating pixels of width Δ add Δ²/12 to the variance σ² of a Gaussian or a delta.  Samples hold the width of
    the pixels already; taken as linear in between they add Δ²/6 of their own spacing, the mean over all positions
    of a point between pixels.

    Parameters
    ----------
    kernel : Kernel
        On a line.
    order : int
        Highest order.
    pixels : PixelGrid, optional
        The sensor; None leaves the pixels out.

    Returns
    -------
    ndarray, float64, shape (order + 1,)

    Raises
    ------
    ConfigurationError
        Kernel of the plane, or a negative order.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import gaussian_kernel
    >>> kernel_moments(gaussian_kernel(0.5, offset=1.0), order=2)
    array([1.  , 1.  , 1.25])
    """
    require(kernel.dimensions == 1, f"kernel: expected one of 1 dimension, found {kernel.dimensions}")
    p = np.arange(check_order(order) + 1)
    if kernel.samples is not None and kernel.spacing is not None:
        step = kernel.spacing[0]
        nodes = kernel.offset[0] + step * np.arange(len(kernel.samples))
        discrete = kernel.samples @ nodes[:, None] ** p * step
        # A hat of half-width `step` has the moments 2 step^p / ((p + 1)(p + 2)) for even p.
        return compose_moments(discrete, np.where(p % 2 == 0, 2 * step**p / ((p + 1) * (p + 2)), 0.0))
    sigma = np.sqrt(kernel.cov[0, 0])
    centred = np.where(p % 2 == 0, sigma**p * _double_factorial(p - 1), 0.0)
    moments = compose_moments(kernel.offset[0] ** p, centred)
    if pixels is not None and pixels.integrating:
        moments = compose_moments(moments, np.where(p % 2 == 0, (pixels.width / 2) ** p / (p + 1), 0.0))
    return moments


def plane_kernel_moments(
    kernel: Kernel, order: int, columns: PixelGrid | None = None, rows: PixelGrid | None = None
) -> Float64Array:
    """Raw moments of a kernel of the plane, with the widths of the pixels.

    Parameters
    ----------
    kernel : Kernel
        Of the plane.
    order : int
        Highest order in x and in y; for a tilted Gaussian at most 2.
    columns, rows : PixelGrid, optional
        The sensor; None leaves the pixels out.

    Returns
    -------
    ndarray, float64, shape (order + 1, order + 1)

    Raises
    ------
    ConfigurationError
        Kernel of a line, or an order that is not available.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import gaussian_kernel
    >>> plane_kernel_moments(gaussian_kernel([[1.0, 0.5], [0.5, 1.0]]), order=1)
    array([[1. , 0. ],
           [0. , 0.5]])
    """
    require(kernel.dimensions == 2, f"kernel: expected one of 2 dimensions, found {kernel.dimensions}")
    along = [kernel_moments(marginal_kernel(kernel, axis), order, grid) for axis, grid in enumerate((columns, rows))]
    moments = np.outer(*along)
    if kernel.samples is not None and kernel.spacing is not None:
        p = np.arange(order + 1)
        x, y = (
            first + step * np.arange(n)
            for first, step, n in zip(kernel.offset, kernel.spacing, reversed(kernel.samples.shape), strict=True)
        )
        discrete = (x[:, None] ** p).T @ kernel.samples.T @ y[:, None] ** p * kernel.spacing.prod()
        hats = [np.where(p % 2 == 0, 2 * step**p / ((p + 1) * (p + 2)), 0.0) for step in kernel.spacing]
        return compose_moments(discrete, np.outer(*hats), dimensions=2)
    tilt = kernel.cov[0, 1]
    if tilt != 0:
        require(order <= 2, f"order: expected at most 2 for a tilted Gaussian, found {order}")
        mx, my = kernel.offset
        extra = np.zeros((3, 3))
        # Isserlis: E XY, E X²Y, E XY² and E X²Y² beyond the product of the marginals.
        extra[1, 1], extra[2, 1], extra[1, 2] = tilt, 2 * mx * tilt, 2 * my * tilt
        extra[2, 2] = 2 * tilt**2 + 4 * mx * my * tilt
        moments = moments + extra[: order + 1, : order + 1]
    return moments


def compose_moments(first: ArrayLike, second: ArrayLike, dimensions: int = 1) -> Float64Array:
    """Raw moments of a sum of independent positions: the binomial relation (paper 2, eq. 3).

    Parameters
    ----------
    first, second : array_like, shape (..., p + 1) or (..., p + 1, p + 1)
        Raw moments with order 0, for example of the kernel and of the path.
    dimensions : int
        1 on a line, 2 in the plane.

    Returns
    -------
    ndarray, float64

    Raises
    ------
    DataError
        Orders do not agree.

    Examples
    --------
    >>> compose_moments([1.0, 0.5, 0.5], [1.0, 2.0, 4.0])
    array([1. , 2.5, 6.5])
    """
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.shape[-dimensions:] != b.shape[-dimensions:]:
        raise DataError(f"moments: expected equal orders, found shapes {a.shape} and {b.shape}")
    table = _binomial_table(a.shape[-1])
    if dimensions == 1:
        return np.einsum("pij,...i,...j->...p", table, a, b)
    return np.einsum("pij,qkl,...ik,...jl->...pq", table, table, a, b)


def remove_kernel(moments: ArrayLike, kernel: ArrayLike, dimensions: int = 1) -> Float64Array:
    """Moments of the path from those of the image and of the kernel: the binomial relation turned round.

    Parameters
    ----------
    moments : array_like, shape (..., p + 1) or (..., p + 1, p + 1)
        Raw moments of the image, order 0 included.
    kernel : array_like, shape (p + 1,) or (p + 1, p + 1)
        Raw moments of the kernel with order 0 equal to 1.
    dimensions : int
        1 on a line, 2 in the plane.

    Returns
    -------
    ndarray, float64
        y_δ^(p).

    Raises
    ------
    DataError
        Orders do not agree.

    Examples
    --------
    >>> remove_kernel([1.0, 2.5, 6.5], [1.0, 0.5, 0.5])
    array([1., 2., 4.])
    """
    k = np.asarray(kernel, np.float64)
    inverse = np.zeros_like(k)
    inverse[(0,) * dimensions] = 1.0
    # Order by order: the inverse under composition has no moment of its own but order 0.
    for index in np.ndindex(k.shape):
        if any(index):
            inverse[index] = -compose_moments(inverse, k, dimensions)[index]
    return compose_moments(moments, inverse, dimensions)


def central_moments(moments: ArrayLike, dimensions: int = 1) -> Float64Array:
    """Central moments from raw ones.

    Parameters
    ----------
    moments : array_like, shape (..., p + 1) or (..., p + 1, p + 1)
        Raw moments; divided by order 0.
    dimensions : int
        1 on a line, 2 in the plane.

    Returns
    -------
    ndarray, float64
        Order 0 is 1, order 1 is 0.

    Raises
    ------
    DataError
        Order 0 is not positive: a frame without light.

    Examples
    --------
    >>> central_moments([1.0, 2.0, 5.0])
    array([1., 0., 1.])
    """
    raw = np.asarray(moments, np.float64)
    share = raw[..., 0] if dimensions == 1 else raw[..., 0, 0]
    check_light(share)
    if dimensions == 1:
        raw = raw / share[..., None]
        p = np.arange(raw.shape[-1])
        return compose_moments(raw, (-raw[..., 1:2]) ** p)
    raw = raw / share[..., None, None]
    p = np.arange(raw.shape[-1])
    shift = (-raw[..., 1:2, 0]) ** p, (-raw[..., 0, 1:2]) ** p
    return compose_moments(raw, shift[0][..., :, None] * shift[1][..., None, :], dimensions=2)


def powers(values: Float64Array, order: int) -> Float64Array:
    """Powers 0 … order by repeated products, many times faster than ``**``.

    Parameters
    ----------
    values : ndarray, float64, shape (..., N_e)
    order : int
        Highest power.

    Returns
    -------
    ndarray, float64, shape (..., order + 1, N_e)

    Raises
    ------
    ConfigurationError
        The order is negative.

    Examples
    --------
    >>> powers(np.array([2.0, 3.0]), 2)
    array([[1., 1.],
           [2., 3.],
           [4., 9.]])
    """
    result = np.ones((*values.shape[:-1], check_order(order) + 1, values.shape[-1]))
    for p in range(order):
        result[..., p + 1, :] = result[..., p, :] * values
    return result


def check_light(total: Float64Array) -> None:
    """Raise if a total intensity is not positive.

    Parameters
    ----------
    total : ndarray, float64
        One or several totals.

    Raises
    ------
    DataError
        A frame without light.

    Examples
    --------
    >>> check_light(np.ones(3))
    """
    dark = int(np.count_nonzero(~(total > 0)))
    if dark:
        raise DataError(
            f"frame: expected a total intensity above 0, found {dark} of {np.size(total)} frames without light; "
            "divide by the known total instead"
        )


def check_order(order: int) -> int:
    """Return the order of a moment if it is one.

    Parameters
    ----------
    order : int
        Highest order asked for.

    Returns
    -------
    int

    Raises
    ------
    ConfigurationError
        The order is negative.

    Examples
    --------
    >>> check_order(2)
    2
    """
    require(order >= 0, f"order: expected at least 0, found {order}")
    return order


def _double_factorial(n: NDArray[np.integer]) -> Float64Array:
    """Product n (n − 2) (n − 4) … down to 1; 1 for n ≤ 0."""
    return np.array([np.prod(np.arange(k, 0, -2, dtype=np.float64)) for k in n])


def _binomial_table(size: int) -> Float64Array:
    """``table[p, i, p − i] = binom(p, i)``."""
    table = np.zeros((size, size, size))
    for p in range(size):
        i = np.arange(p + 1)
        table[p, i, p - i] = comb(p, i)
    return table

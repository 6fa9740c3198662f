"""Moments that images measure, and the noise in them, in a basis of one's choice.

Symbols (paper 1, eqs. 7 to 11)
-------------------------------
y^(p) : raw moment ``∫ η^p Y dη / T_e`` of the image, :func:`image_moments`; what it says about the motion is in
    :mod:`.moment_algebra`.
V : density of the white pixel noise, whose effect is :func:`moment_noise`.

The denominator is the known total intensity, not the measured one of paper 1, eq. 7: under strong noise the
measured total can be near zero or negative and the ratio has no useful variance.

The Legendre basis is monic and belongs to the interval of the pixels; on [−1, 1] its second moment is
``y^(2) − y^(0) / 3``.  Under white noise its moments are uncorrelated and have the least variance of all bases of
that order: 8V/45 for the second, against 2V/5 for y^(2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import ConfigurationError, DataError, require
from .kernels import Float64Array, PixelGrid
from .moment_algebra import check_light, check_order

BASES = ("monomial", "legendre")


def image_moments(
    image: ArrayLike,
    pixels: PixelGrid,
    order: int,
    basis: str = "monomial",
    total: float | None = 1.0,
    background: float = 0.0,
) -> Float64Array:
    """Moments of images of a line.

    Parameters
    ----------
    image : array_like, shape (..., count)
        Intensity per unit of length.
    pixels : PixelGrid
    order : int
        Highest order p.
    basis : {"monomial", "legendre"}
        What the image is projected on.
    total : float, optional
        Known total intensity of the exposure, the denominator. None divides by the measured total.
    background : float
        Intensity without light, taken off.

    Returns
    -------
    ndarray, float64, shape (..., order + 1)
        Orders 0 to p; order 0 is the measured share of the total.

    Raises
    ------
    DataError
        Shapes do not agree, values are not finite, or a frame holds no light to divide by.
    ConfigurationError
        Unknown basis, or an order or a total that makes no sense.

    Examples
    --------
    >>> image_moments([0.25, 0.75], PixelGrid(-1.0, 1.0, 2), order=2)
    array([1.  , 0.25, 0.25])
    """
    values = _check_image(image, (pixels.count,)) - background
    measured = values @ basis_functions(pixels, order, basis) * pixels.width
    return measured / _denominator(values.sum(-1) * pixels.width, total)[..., None]


def plane_moments(
    image: ArrayLike,
    columns: PixelGrid,
    rows: PixelGrid,
    order: int,
    basis: str = "monomial",
    total: float | None = 1.0,
    background: float = 0.0,
) -> Float64Array:
    """Moments of images of the plane.

    Parameters
    ----------
    image : array_like, shape (..., rows, columns)
        Intensity per unit of area.
    columns, rows : PixelGrid
        Pixels along x and along y.
    order : int
        Highest order in x and in y.
    basis : {"monomial", "legendre"}
        What the image is projected on; products of the functions of x and of y.
    total : float, optional
        Known total intensity of the exposure, the denominator. None divides by the measured total.
    background : float
        Intensity without light, taken off.

    Returns
    -------
    ndarray, float64, shape (..., order + 1, order + 1)
        ``[..., p, q]`` goes with x^p y^q.

    Raises
    ------
    DataError
        Shapes do not agree, values are not finite, or a frame holds no light to divide by.
    ConfigurationError
        Unknown basis, or an order or a total that makes no sense.

    Examples
    --------
    >>> pixels = PixelGrid(-1.0, 1.0, 2)
    >>> plane_moments([[0.0, 0.0], [0.0, 1.0]], pixels, pixels, order=1)
    array([[1.  , 0.5 ],
           [0.5 , 0.25]])
    """
    values = _check_image(image, (rows.count, columns.count)) - background
    cell = columns.width * rows.width
    along_x, along_y = basis_functions(columns, order, basis), basis_functions(rows, order, basis)
    measured = np.swapaxes(along_x, 0, 1) @ np.swapaxes(values, -1, -2) @ along_y * cell
    return measured / _denominator(values.sum((-1, -2)) * cell, total)[..., None, None]


def moment_noise(
    pixels: PixelGrid,
    order: int,
    density: float,
    basis: str = "monomial",
    image: ArrayLike | None = None,
    photons: float | None = None,
) -> Float64Array:
    """Covariance of the noise of the moments: ``V ∫ b_p b_q dη``, plus shot noise.

    On [−1, 1] with fine pixels: 2V, 2V/3 and 2V/5 for orders 0, 1, 2; 2V/3 between 0 and 2; 0 between 1 and 2.
    Paper 1, eq. 11, as it survives, has 3V for the second.

    Parameters
    ----------
    pixels : PixelGrid
    order : int
        Highest order.
    density : float
        V of the white noise.
    basis : {"monomial", "legendre"}
    image : array_like, shape (..., count), optional
        Noise-free image, for shot noise.
    photons : float, optional
        Photons that a total intensity of 1 stands for.

    Returns
    -------
    ndarray, float64, shape (..., order + 1, order + 1)

    Raises
    ------
    ConfigurationError
        Unknown basis, negative density, or photons without an image.

    Examples
    --------
    >>> moment_noise(PixelGrid(-1.0, 1.0, 2000), 2, density=0.1).diagonal().round(4)
    array([0.2   , 0.0667, 0.04  ])
    """
    require(0 <= density < np.inf, f"density: expected noise of at least 0, found {density:g}")
    functions = basis_functions(pixels, order, basis)
    cov = density * pixels.width * functions.T @ functions
    if photons is None:
        return cov
    require(image is not None and photons > 0, "photons: expected a number above 0 and the image they form")
    values = np.maximum(np.asarray(image, np.float64), 0.0)
    return cov + (functions.T * values[..., None, :]) @ functions * pixels.width / photons


def basis_functions(pixels: PixelGrid, order: int, basis: str = "monomial") -> Float64Array:
    """Functions that images are projected on, at the pixels.

    Parameters
    ----------
    pixels : PixelGrid
    order : int
        Highest order.
    basis : {"monomial", "legendre"}

    Returns
    -------
    ndarray, float64, shape (count, order + 1)

    Raises
    ------
    ConfigurationError
        Unknown basis or negative order.

    Examples
    --------
    >>> basis_functions(PixelGrid(-1.0, 1.0, 2), order=2, basis="legendre")[:, 2].round(4)
    array([-0.0833, -0.0833])
    """
    powers = pixels.centres[:, None] ** np.arange(check_order(order) + 1)
    return powers @ basis_change(pixels, order, basis).T


def basis_change(pixels: PixelGrid, order: int, basis: str) -> Float64Array:
    """Matrix from monomial moments to those of another basis.

    Parameters
    ----------
    pixels : PixelGrid
        Their interval is that of the Legendre polynomials.
    order : int
        Highest order.
    basis : {"monomial", "legendre"}

    Returns
    -------
    ndarray, float64, shape (order + 1, order + 1)
        Lower triangular with ones on the diagonal.

    Raises
    ------
    ConfigurationError
        Unknown basis or negative order.

    Examples
    --------
    >>> basis_change(PixelGrid(-1.0, 1.0, 10), 2, "legendre").round(4)
    array([[ 1.    ,  0.    ,  0.    ],
           [ 0.    ,  1.    ,  0.    ],
           [-0.3333,  0.    ,  1.    ]])
    """
    if basis not in BASES:
        raise ConfigurationError(f"basis: expected one of {', '.join(BASES)}, found {basis!r}")
    size = check_order(order) + 1
    if basis == "monomial":
        return np.eye(size)
    middle, half = (pixels.start + pixels.stop) / 2, (pixels.stop - pixels.start) / 2
    matrix = np.zeros((size, size))
    matrix[0, 0] = 1.0
    for n in range(size - 1):
        # Bonnet's recursion for the monic polynomials of the interval.
        matrix[n + 1, 1:] = matrix[n, :-1]
        matrix[n + 1] -= middle * matrix[n] + half**2 * n**2 / (4 * n**2 - 1) * matrix[n - 1]
    return matrix


def total_intensity(frames: ArrayLike, cell: float, background: float = 0.0) -> tuple[float, float]:
    """Total intensity of an exposure from several frames, robustly, with its standard error.

    Parameters
    ----------
    frames : array_like, shape (T, n) or (T, h, w)
        Frames of equal exposure.
    cell : float
        Width or area of a pixel.
    background : float
        Intensity without light, taken off.

    Returns
    -------
    total : float
        Median over the frames, so that a few outliers do not matter.
    standard_error : float
        Of the median, from the median absolute deviation; NaN for a single frame.

    Raises
    ------
    DataError
        No frames, or no light.

    Examples
    --------
    >>> total_intensity([[1.0, 1.0], [1.0, 1.0], [9.0, 9.0]], cell=0.5)
    (1.0, 0.0)
    """
    values = np.asarray(frames, np.float64)
    if values.ndim < 2 or values.size == 0 or not np.isfinite(values).all():
        raise DataError(f"frames: expected finite frames of shape (T, n) or (T, h, w), found shape {values.shape}")
    totals = (values - background).sum(tuple(range(1, values.ndim))) * cell
    total = float(np.median(totals))
    check_light(np.asarray(total))
    if len(totals) == 1:
        return total, float("nan")
    deviation = 1.4826 * float(np.median(np.abs(totals - total)))
    return total, float(np.sqrt(np.pi / 2) * deviation / np.sqrt(len(totals)))


def _denominator(measured: Float64Array, total: float | None) -> Float64Array:
    if total is None:
        check_light(measured)
        return measured
    require(0 < total < np.inf, f"total: expected an intensity above 0, found {total:g}")
    return np.asarray(total, np.float64)


def _check_image(image: ArrayLike, shape: tuple[int, ...]) -> Float64Array:
    values = np.asarray(image, np.float64)
    if values.ndim < len(shape) or values.shape[-len(shape) :] != shape:
        raise DataError(f"image: expected shape (..., {', '.join(map(str, shape))}), found {values.shape}")
    if not np.isfinite(values).all():
        raise DataError("image: expected finite values, found NaN or infinite ones")
    return values

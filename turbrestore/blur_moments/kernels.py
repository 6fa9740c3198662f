"""Pixels, and what a still point looks like on them: the image kernel, in one and two dimensions.

Symbols (paper 1, section IV; paper 2, section II)
-------------------------------------------------
η, Δ : position and width of a pixel, :class:`PixelGrid`.
Ψ : image kernel, :class:`Kernel`; σ or Σ is the width of a Gaussian, η₀ its offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ..core.errors import ConfigurationError, DataError, require

Float64Array = NDArray[np.float64]

_SQRT_2PI = float(np.sqrt(2 * np.pi))


@dataclass(frozen=True)
class PixelGrid:
    """A row of pixels of equal width.

    Parameters
    ----------
    start, stop : float
        Outer edges of the first and the last pixel, in units of the output y.
    count : int
        Number of pixels.
    integrating : bool
        Whether a pixel averages the light over its width Δ, or samples the density at its centre.

    Raises
    ------
    ConfigurationError
        No pixel, or no width.

    Examples
    --------
    >>> PixelGrid(-1.0, 1.0, 4).centres
    array([-0.75, -0.25,  0.25,  0.75])
    """

    start: float
    stop: float
    count: int
    integrating: bool = True

    def __post_init__(self) -> None:
        require(self.count >= 1, f"count: expected at least 1 pixel, found {self.count}")
        require(
            -np.inf < self.start < self.stop < np.inf,
            f"pixels: expected finite edges with start < stop, found {self.start:g} and {self.stop:g}",
        )

    @property
    def width(self) -> float:
        """Δ, the width of a pixel."""
        return (self.stop - self.start) / self.count

    @property
    def centres(self) -> Float64Array:
        """Positions η of the pixels, shape (count,)."""
        return self.start + self.width * (np.arange(self.count, dtype=np.float64) + 0.5)


@dataclass(frozen=True, eq=False)
class Kernel:
    """What a still point at y = 0 looks like: a Gaussian, a delta (zero covariance), or samples.

    Made by :func:`delta_kernel`, :func:`gaussian_kernel`, :func:`sampled_kernel` or :func:`kernel_from_still`.

    Parameters
    ----------
    offset : ndarray, float64, shape (d,)
        Centre of a Gaussian, or position of the first sample; (x, y) in the plane.
    cov : ndarray, float64, shape (d, d)
        Covariance of a Gaussian; zero for a delta; unused for samples.
    samples : ndarray, float64, shape (n,) or (h, w), optional
        Density at equal distances, with a total intensity of 1.
    spacing : ndarray, float64, shape (d,), optional
        Distance of the samples, (x, y) in the plane.

    Examples
    --------
    >>> gaussian_kernel(0.05).dimensions
    1
    """

    offset: Float64Array
    cov: Float64Array
    samples: Float64Array | None = None
    spacing: Float64Array | None = None

    @property
    def dimensions(self) -> int:
        """1 on a line, 2 in the plane."""
        return len(self.offset)


def delta_kernel(offset: ArrayLike = 0.0) -> Kernel:
    """Kernel of an ideal point.

    Parameters
    ----------
    offset : float or array_like, shape (2,)
        Where a point at 0 is seen; two numbers (x, y) make a kernel of the plane.

    Returns
    -------
    Kernel

    Examples
    --------
    >>> delta_kernel([0.0, 0.0]).dimensions
    2
    """
    centre = np.atleast_1d(np.asarray(offset, np.float64))
    return gaussian_kernel(np.zeros((len(centre), len(centre))), centre)


def gaussian_kernel(width: ArrayLike, offset: ArrayLike = 0.0) -> Kernel:
    """Gaussian kernel (paper 1, eq. 4; paper 2, section II-C).

    Parameters
    ----------
    width : float or array_like, shape (2,) or (d, d)
        σ on a line; (σ_x, σ_y) or the covariance matrix in the plane.
    offset : float or array_like, shape (d,)
        η₀, where a point at 0 is seen.

    Returns
    -------
    Kernel

    Raises
    ------
    ConfigurationError
        Negative or not finite width, a matrix that is no covariance, or an offset that does not go with it.

    Examples
    --------
    >>> gaussian_kernel([0.3, 0.4]).cov
    array([[0.09, 0.  ],
           [0.  , 0.16]])
    """
    values = np.asarray(width, np.float64)
    cov = np.diag(np.atleast_1d(values) ** 2) if values.ndim < 2 else values
    require(
        cov.shape in ((1, 1), (2, 2))
        and bool(np.isfinite(cov).all())
        and bool((values >= 0).all() or values.ndim == 2),
        f"width: expected σ of at least 0, (σ_x, σ_y) or a covariance matrix, found {values.tolist()}",
    )
    eigenvalues = np.linalg.eigvalsh(cov)
    require(
        bool(np.allclose(cov, cov.T)) and bool((eigenvalues >= 0).all()),
        f"width: expected a symmetric covariance without negative eigenvalues, found {values.tolist()}",
    )
    return Kernel(_per_axis("offset", offset, len(cov)), cov)


def sampled_kernel(values: ArrayLike, spacing: ArrayLike, first: ArrayLike) -> Kernel:
    """Kernel given by samples, linear in between and zero outside.

    The samples are what pixels see, so the width of a pixel is part of them and is not applied again.

    Parameters
    ----------
    values : array_like, shape (n,) or (h, w)
        Intensities; scaled to a total of 1.
    spacing : float or array_like, shape (2,)
        Distance of the samples, (x, y) in the plane.
    first : float or array_like, shape (2,)
        Position of the first sample, (x, y) in the plane.

    Returns
    -------
    Kernel

    Raises
    ------
    DataError
        Not finite, or no light in the samples.
    ConfigurationError
        A spacing is not positive, or spacing or position do not go with the samples.

    Examples
    --------
    >>> sampled_kernel([1, 2, 1], spacing=0.5, first=-0.5).samples
    array([0.5, 1. , 0.5])
    """
    samples = np.asarray(values, np.float64)
    if samples.ndim not in (1, 2) or samples.size == 0 or not np.isfinite(samples).all():
        raise DataError(f"values: expected finite samples of shape (n,) or (h, w), found shape {samples.shape}")
    step = _per_axis("spacing", spacing, samples.ndim)
    require(bool((step > 0).all()), f"spacing: expected distances above 0, found {step.tolist()}")
    total = samples.sum() * step.prod()
    if total <= 0:
        raise DataError(f"values: expected a kernel with light, found a total intensity of {total:g}")
    return Kernel(
        _per_axis("first", first, samples.ndim), np.zeros((samples.ndim, samples.ndim)), samples / total, step
    )


def kernel_from_still(
    frames: ArrayLike, *pixels: PixelGrid, position: ArrayLike = 0.0, background: float = 0.0
) -> Kernel:
    """Kernel from one exposure of a point at rest, or from the mean of several (paper 2, section II-C).

    Negative values that noise leaves are kept: cutting them off would widen the kernel.

    Parameters
    ----------
    frames : array_like, shape (n,), (T, n), (h, w) or (T, h, w)
        Exposures of the point at rest.
    *pixels : PixelGrid
        One row of pixels, or columns and rows.
    position : float or array_like, shape (d,)
        Output y during the exposures.
    background : float
        Intensity without light, taken off.

    Returns
    -------
    Kernel

    Raises
    ------
    DataError
        Shapes do not agree, or the frames hold no light.

    Examples
    --------
    >>> pixels = PixelGrid(-1.0, 1.0, 40)
    >>> still = line_response(gaussian_kernel(0.1), pixels.centres, pixels)
    >>> kernel = kernel_from_still(still, pixels)
    >>> bool(abs(kernel.samples.sum() * pixels.width - 1) < 1e-12)
    True
    """
    values = np.asarray(frames, np.float64)
    shape = tuple(grid.count for grid in reversed(pixels))
    if not pixels or values.shape[-len(pixels) :] != shape or values.ndim > len(pixels) + 1 or values.size == 0:
        raise DataError(f"frames: expected shape {shape} or (T, {', '.join(map(str, shape))}), found {values.shape}")
    mean = values.reshape(-1, *shape).mean(0) - background
    first = np.array([grid.centres[0] for grid in pixels]) - np.asarray(position, np.float64)
    return sampled_kernel(mean, np.array([grid.width for grid in pixels]), first)


def marginal_kernel(kernel: Kernel, axis: int) -> Kernel:
    """Kernel of one coordinate: a kernel of the plane integrated over the other.

    Parameters
    ----------
    kernel : Kernel
        Of the plane.
    axis : int
        0 for x, 1 for y.

    Returns
    -------
    Kernel
        On a line.

    Examples
    --------
    >>> marginal_kernel(gaussian_kernel([0.3, 0.4]), 1).cov
    array([[0.16]])
    """
    check_kernel(kernel, 2)
    if kernel.samples is None or kernel.spacing is None:
        return Kernel(kernel.offset[[axis]], kernel.cov[axis : axis + 1, axis : axis + 1])
    # Arrays count rows first, so summing over array axis `axis` leaves the coordinate `axis`.
    return sampled_kernel(kernel.samples.sum(axis), kernel.spacing[axis], kernel.offset[axis])


def line_response(kernel: Kernel, distance: Float64Array, pixels: PixelGrid) -> Float64Array:
    """Give what pixels at a distance η − y from a still point see.

    Parameters
    ----------
    kernel : Kernel
        On a line.
    distance : ndarray, float64
        η − y.
    pixels : PixelGrid
        Width, and whether pixels integrate.

    Returns
    -------
    ndarray, float64, shape of ``distance``

    Raises
    ------
    ConfigurationError
        Delta kernel on pixels that do not integrate.

    Examples
    --------
    >>> line_response(delta_kernel(), np.array([0.0, 1.0]), PixelGrid(0.0, 1.0, 2))
    array([2., 0.])
    """
    if kernel.samples is not None and kernel.spacing is not None:
        nodes = _nodes(kernel)
        return np.interp(distance, nodes, np.pad(kernel.samples, 1))
    d, sigma, width = distance - kernel.offset[0], float(np.sqrt(kernel.cov[0, 0])), pixels.width
    if sigma == 0:
        require(pixels.integrating, "kernel: expected pixels that integrate under a delta, found pixels that sample")
        # A hair of slack puts a point on the border of two pixels into one of them only, however it is rounded.
        return ((d > -width / 2 + 1e-12 * width) & (d <= width / 2 + 1e-12 * width)) / width
    if pixels.integrating:
        return (ndtr((d + width / 2) / sigma) - ndtr((d - width / 2) / sigma)) / width
    return np.exp(-0.5 * (d / sigma) ** 2) / (_SQRT_2PI * sigma)


def line_slope(kernel: Kernel, distance: Float64Array, pixels: PixelGrid) -> Float64Array:
    """Differentiate :func:`line_response` with respect to the distance η − y.

    Parameters
    ----------
    kernel : Kernel
        On a line.
    distance : ndarray, float64
        η − y.
    pixels : PixelGrid
        Width, and whether pixels integrate.

    Returns
    -------
    ndarray, float64, shape of ``distance``
        For samples the difference over one sample, centred.

    Raises
    ------
    ConfigurationError
        The image of a delta kernel has no derivative.

    Examples
    --------
    >>> line_slope(gaussian_kernel(1.0), np.array([0.0]), PixelGrid(-1.0, 1.0, 2))
    array([0.])
    """
    if kernel.samples is not None and kernel.spacing is not None:
        half = kernel.spacing[0] / 2
        ahead = line_response(kernel, distance + half, pixels)
        return (ahead - line_response(kernel, distance - half, pixels)) / (2 * half)
    d, sigma, width = distance - kernel.offset[0], float(np.sqrt(kernel.cov[0, 0])), pixels.width
    require(sigma > 0, "kernel: expected one with a width, found a delta, whose image has no derivative")
    if pixels.integrating:
        density = [np.exp(-0.5 * ((d + side * width / 2) / sigma) ** 2) for side in (1, -1)]
        return (density[0] - density[1]) / (_SQRT_2PI * sigma * width)
    return -d / sigma**2 * np.exp(-0.5 * (d / sigma) ** 2) / (_SQRT_2PI * sigma)


def check_kernel(kernel: Kernel, dimensions: int) -> None:
    """Raise unless a kernel belongs to a line (1) or to the plane (2).

    Parameters
    ----------
    kernel : Kernel
    dimensions : int
        1 or 2.

    Raises
    ------
    ConfigurationError
        The kernel has another dimension.

    Examples
    --------
    >>> check_kernel(delta_kernel(), 1)
    """
    if kernel.dimensions != dimensions:
        raise ConfigurationError(f"kernel: expected one of {dimensions} dimensions, found {kernel.dimensions}")


def _per_axis(name: str, values: ArrayLike, dimensions: int) -> Float64Array:
    """One finite number for every axis; a single one goes for all."""
    numbers = np.asarray(values, np.float64)
    require(
        numbers.shape in ((), (1,), (dimensions,)) and bool(np.isfinite(numbers).all()),
        f"{name}: expected {dimensions} finite numbers, found {numbers.tolist()}",
    )
    return np.broadcast_to(numbers, (dimensions,)).copy()


def _nodes(kernel: Kernel) -> Float64Array:
    """Positions of the samples on a line with one more at either end, where the kernel is zero."""
    assert kernel.samples is not None
    assert kernel.spacing is not None
    return kernel.offset[0] + kernel.spacing[0] * np.arange(-1, len(kernel.samples) + 1)

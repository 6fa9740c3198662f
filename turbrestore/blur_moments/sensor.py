"""The integrative image sensor: timing, exposure operator and pixel noise, in one and two dimensions.

During the exposure the image of a moving point is ``Y(η) = ∫ Ψ(η − y(t)) dt + n(η)``: motion becomes blur.

Symbols (paper 1, eq. 3; paper 2, sections II and III)
-----------------------------------------------------
T_f, T_a, T_e, T_r, T_s : periods and times of the fast system and of the sensor, :class:`ExposureTiming`.
N, N_e : fast steps in a slow step and in an exposure.
η, Δ, Ψ : pixel, its width and the image kernel, :mod:`.kernels`.
C_Ψ : exposure operator, :func:`expose` on a line, :func:`expose_plane` in the plane.
V : density of the white pixel noise, ``E n(η) n(ξ) = V δ(η − ξ)``, so that a pixel has the variance V / Δ.

Images hold a density: intensity per unit of length or of area, so that ``Σ Y Δ`` is the total intensity.  The
operator averages over the fast steps and multiplies by ``exposure``; with the default of 1 the total is 1
(paper 1, eq. 5), with T_e it is the integral as printed (paper 2, eq. 1).  All arrays are float64: they are small
and moments of high order lose digits.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from ..core.errors import DataError, require
from .kernels import Float64Array, Kernel, PixelGrid, check_kernel, line_response, marginal_kernel

# Nodes per pixel along x for a tilted Gaussian: the error stays under 1e-5 of the total down to σ = Δ / 2.
_NODES = 6


@dataclass(frozen=True)
class ExposureTiming:
    """When the sensor looks (paper 2, section II-A).

    Parameters
    ----------
    fast_period : float
        T_f, s: step of the fast system.
    exposure : float
        T_e, s: length of the exposure.
    readout : float
        T_r, s: time to read the image out.
    frame_period : float
        T_s, s: time from one exposure to the next, at least T_e + T_r.
    trigger : float
        T_a, s: start of the first exposure.

    Raises
    ------
    ConfigurationError
        A time is not positive, the period is shorter than exposure and readout, a time is no whole number of fast
        steps, or the exposure is shorter than one.

    Examples
    --------
    >>> timing = ExposureTiming(fast_period=1e-3, exposure=0.1, readout=0.35, frame_period=0.45, trigger=0.09)
    >>> timing.frame_steps, timing.exposure_steps, timing.trigger_steps
    (450, 100, 90)
    """

    fast_period: float
    exposure: float
    readout: float
    frame_period: float
    trigger: float = 0.0
    frame_steps: int = field(init=False)
    exposure_steps: int = field(init=False)
    trigger_steps: int = field(init=False)

    def __post_init__(self) -> None:
        for name in ("fast_period", "exposure", "frame_period"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"{name}: expected a time above 0 s, found {value:g}")
        for name in ("readout", "trigger"):
            value = getattr(self, name)
            require(0 <= value < np.inf, f"{name}: expected a time of at least 0 s, found {value:g}")
        shortest = self.exposure + self.readout
        require(
            self.frame_period >= shortest * (1 - 1e-12),
            f"frame_period: expected at least exposure + readout = {shortest:g} s, found {self.frame_period:g}",
        )
        object.__setattr__(self, "frame_steps", self._steps("frame_period"))
        object.__setattr__(self, "exposure_steps", self._steps("exposure"))
        object.__setattr__(self, "trigger_steps", self._steps("trigger"))
        require(
            self.exposure_steps >= 1,
            f"exposure: expected at least one fast period of {self.fast_period:g} s, found {self.exposure:g} s",
        )

    def _steps(self, name: str) -> int:
        """Whole number of fast steps in one of the times."""
        ratio = getattr(self, name) / self.fast_period
        require(
            abs(ratio - round(ratio)) <= 1e-9 * max(ratio, 1.0),
            f"{name}: expected a whole number of fast periods of {self.fast_period:g} s, found {ratio:g} of them",
        )
        return round(ratio)


@dataclass(frozen=True, eq=False)
class LineSensor:
    """A row of pixels that watches one point.

    Parameters
    ----------
    kernel : Kernel
        On a line.
    pixels : PixelGrid
    noise : float
        V, density of the white noise, above 0.
    total : float
        Total intensity of an exposure, known.
    photons : float, optional
        Photons that a total intensity of 1 stands for; no shot noise by default.

    Raises
    ------
    ConfigurationError
        Kernel of the plane; noise, total or photons that are not above 0.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import gaussian_kernel
    >>> LineSensor(gaussian_kernel(0.05), PixelGrid(-1.0, 1.0, 100), noise=0.1).total
    1.0
    """

    kernel: Kernel
    pixels: PixelGrid
    noise: float
    total: float = 1.0
    photons: float | None = None

    def __post_init__(self) -> None:
        check_kernel(self.kernel, 1)
        require(0 < self.noise < np.inf, f"noise: expected a density above 0, found {self.noise:g} (singular R)")
        require(0 < self.total < np.inf, f"total: expected an intensity above 0, found {self.total:g}")
        require(self.photons is None or self.photons > 0, f"photons: expected a number above 0, found {self.photons}")


def expose(path: ArrayLike, kernel: Kernel, pixels: PixelGrid, exposure: float = 1.0) -> Float64Array:
    """Exposure operator C_Ψ on a line: the image that a moving point leaves (paper 1, eq. 3; paper 2, eq. 1).

    Parameters
    ----------
    path : array_like, shape (..., N_e)
        Output y at the fast steps of the exposure.
    kernel : Kernel
        On a line.
    pixels : PixelGrid
    exposure : float
        Total intensity; T_e for the integral as printed.

    Returns
    -------
    ndarray, float64, shape (..., count)
        Intensity per unit of length; light that falls beside the pixels is lost.

    Raises
    ------
    DataError
        Empty exposure, or values that are not finite.
    ConfigurationError
        Delta kernel on pixels that do not integrate, or a kernel of the plane.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import PixelGrid, delta_kernel
    >>> expose([-0.5, 0.5, 0.5, 0.5], delta_kernel(), PixelGrid(-1.0, 1.0, 2))
    array([0.25, 0.75])
    """
    positions = _check_path(path, 1)
    check_kernel(kernel, 1)
    distance = pixels.centres[:, None] - positions[..., None, :]
    return exposure * line_response(kernel, distance, pixels).mean(-1)


def expose_plane(
    path: ArrayLike, kernel: Kernel, columns: PixelGrid, rows: PixelGrid, exposure: float = 1.0
) -> Float64Array:
    """Exposure operator C_Ψ in the plane.

    Parameters
    ----------
    path : array_like, shape (..., N_e, 2)
        Output (x, y) at the fast steps of the exposure.
    kernel : Kernel
        Of the plane.
    columns, rows : PixelGrid
        Pixels along x and along y; both integrate or neither does.
    exposure : float
        Total intensity.

    Returns
    -------
    ndarray, float64, shape (..., rows, columns)
        Intensity per unit of area.

    Raises
    ------
    DataError
        Empty exposure, or values that are not finite.
    ConfigurationError
        Delta kernel on pixels that do not integrate, or a kernel of a line.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import PixelGrid, delta_kernel
    >>> pixels = PixelGrid(-1.0, 1.0, 2)
    >>> expose_plane([[-0.5, 0.5]], delta_kernel([0.0, 0.0]), pixels, pixels)
    array([[0., 0.],
           [1., 0.]])
    """
    positions = _check_path(path, 2)
    check_kernel(kernel, 2)
    require(columns.integrating == rows.integrating, "pixels: expected both axes to integrate or neither")
    if kernel.samples is not None:
        return exposure * _sampled_plane(positions, kernel, columns, rows)
    if kernel.cov[0, 1] != 0:
        return exposure * _tilted_plane(positions, kernel, columns, rows)
    along = [
        line_response(marginal_kernel(kernel, axis), grid.centres - positions[..., axis, None], grid)
        for axis, grid in enumerate((columns, rows))
    ]
    return exposure * np.swapaxes(along[1], -1, -2) @ along[0] / positions.shape[-2]


def noise_variance(image: ArrayLike, cell: float, density: float, photons: float | None = None) -> Float64Array:
    """Variance of every pixel: white noise plus shot noise.

    Parameters
    ----------
    image : array_like
        Noise-free image.
    cell : float
        Δ, or the area of a pixel.
    density : float
        V of the white noise.
    photons : float, optional
        Photons that a total intensity of 1 stands for; no shot noise by default.

    Returns
    -------
    ndarray, float64, shape of ``image``

    Raises
    ------
    ConfigurationError
        Negative density, or photons not above 0.

    Examples
    --------
    >>> noise_variance([1.0, 2.0], cell=0.5, density=0.1, photons=10.0)
    array([0.4, 0.6])
    """
    require(0 <= density < np.inf, f"density: expected noise of at least 0, found {density:g}")
    require(photons is None or photons > 0, f"photons: expected a number above 0, found {photons}")
    values = np.asarray(image, np.float64)
    shot = 0.0 if photons is None else np.maximum(values, 0.0) / (photons * cell)
    return density / cell + shot + np.zeros_like(values)


def add_noise(
    image: ArrayLike, cell: float, rng: np.random.Generator, density: float, photons: float | None = None
) -> Float64Array:
    """Noise of the sensor: Poisson counts if photons are given, then white Gaussian noise.

    Parameters
    ----------
    image : array_like
        Noise-free image.
    cell : float
        Δ, or the area of a pixel.
    rng : numpy.random.Generator
        Source of randomness.
    density : float
        V of the white noise.
    photons : float, optional
        Photons that a total intensity of 1 stands for; no shot noise by default.

    Returns
    -------
    ndarray, float64, shape of ``image``

    Raises
    ------
    ConfigurationError
        Negative density, or photons not above 0.

    Examples
    --------
    >>> add_noise([1.0, 2.0], 0.5, np.random.default_rng(0), density=0.0)
    array([1., 2.])
    """
    noise_variance(0.0, cell, density, photons)
    values = np.asarray(image, np.float64)
    if photons is not None:
        values = rng.poisson(np.maximum(values, 0.0) * cell * photons) / (cell * photons)
    return values + np.sqrt(density / cell) * rng.standard_normal(values.shape)


def _tilted_plane(path: Float64Array, kernel: Kernel, columns: PixelGrid, rows: PixelGrid) -> Float64Array:
    """Gaussian whose axes are not those of the pixels: p(x) p(y | x), integrated in x by quadrature."""
    (xx, xy), (_, yy) = kernel.cov
    require(xx * yy > xy**2, "width: expected a covariance that is not singular, found one of a line")
    offset, weight = np.polynomial.legendre.leggauss(_NODES) if columns.integrating else (np.zeros(1), np.full(1, 2.0))
    conditional = Kernel(np.zeros(1), np.array([[yy - xy**2 / xx]]))
    sampled = PixelGrid(columns.start, columns.stop, columns.count, integrating=False)
    image = np.zeros((*path.shape[:-2], rows.count, columns.count))
    for node, share in zip(offset * columns.width / 2, weight / 2, strict=True):
        dx = columns.centres + node - path[..., 0, None]
        along_x = line_response(marginal_kernel(kernel, 0), dx, sampled)
        shift = kernel.offset[1] + xy / xx * (dx - kernel.offset[0])
        dy = rows.centres[:, None] - path[..., 1, None, None] - shift[..., None, :]
        image += share * (along_x[..., None, :] * line_response(conditional, dy, rows)).mean(-3)
    return image


def _sampled_plane(path: Float64Array, kernel: Kernel, columns: PixelGrid, rows: PixelGrid) -> Float64Array:
    assert kernel.samples is not None
    assert kernel.spacing is not None
    padded = np.pad(kernel.samples, 1)
    flat = path.reshape(-1, *path.shape[-2:])
    images = np.zeros((len(flat), rows.count, columns.count))
    for index, positions in enumerate(flat):
        for x, y in positions:
            column = (columns.centres - x - kernel.offset[0]) / kernel.spacing[0] + 1
            row = (rows.centres - y - kernel.offset[1]) / kernel.spacing[1] + 1
            images[index] += map_coordinates(padded, np.meshgrid(row, column, indexing="ij"), order=1)
    return (images / path.shape[-2]).reshape(*path.shape[:-2], rows.count, columns.count)


def _check_path(path: ArrayLike, dimensions: int) -> Float64Array:
    positions = np.asarray(path, np.float64)
    expected = "(..., N_e)" if dimensions == 1 else "(..., N_e, 2)"
    if positions.ndim < dimensions or (dimensions == 2 and positions.shape[-1] != 2):
        raise DataError(f"path: expected shape {expected}, found {positions.shape}")
    if positions.shape[-dimensions] == 0:
        raise DataError(f"path: expected at least one step in the exposure, found shape {positions.shape}")
    if not np.isfinite(positions).all():
        raise DataError("path: expected finite outputs, found NaN or infinite ones; the model may be unstable")
    return positions

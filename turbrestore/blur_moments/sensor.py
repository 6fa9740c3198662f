"""The integrative image sensor of a line: timing, pixels, image kernel and exposure operator.

During the exposure the image of a moving point is ``Y(η) = ∫ Ψ(η − y(t)) dt + n(η)``: motion becomes blur.

Symbols (paper 1, eq. 3; paper 2, sections II and III)
-----------------------------------------------------
T_f, T_a, T_e, T_r, T_s : periods and times of the fast system and of the sensor, :class:`ExposureTiming`.
N, N_e : number of fast steps in a frame period and in an exposure.
η, Δ : position and width of a pixel, :class:`PixelGrid`.
Ψ : image kernel with the width σ and the offset η₀, :class:`GaussianKernel`.
C_Ψ : exposure operator, :func:`expose`.
V : density of the white pixel noise, ``E n(η) n(ξ) = V δ(η − ξ)``; a pixel has the noise variance V / Δ.

Images are densities, intensity per unit of length, so ``Σ Y Δ`` is the total intensity.  The operator averages over
the fast steps and multiplies by the total, which is 1 by default (paper 1, eq. 5) and T_e for the integral as printed
(paper 2, eq. 1).  All arrays are float64, because the arrays are small and moments of high order lose digits.

Observers evaluate the operator thousands of times, as a table (:func:`tabulate`) of the response of all pixels for
closely spaced positions y of a point at rest, with linear interpolation between them.  A path becomes a histogram over
these positions, and its image a few matrix products.  With positions h = σ / 6 apart the error is below
h² / 8 · max|Ψ''| = 0.0035 of the peak of the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ..core.errors import DataError, require

Float64Array = NDArray[np.float64]

_SQRT_2PI = float(np.sqrt(2 * np.pi))
_POSITIONS_PER_SIGMA = 6
# Tails of a Gaussian beyond six σ are below 2e-8 of its peak.
_REACH = 6
# Pixels in one matrix product: fewer skip more positions out of reach, more use the CPU better.
_BLOCK = 16
# A larger table would take more than 160 MB.
_LARGEST = 20_000_000


@dataclass(frozen=True)
class ExposureTiming:
    """When the sensor is exposed (paper 2, section II-A)."""

    fast_period: float  # t_f, s: step of the fast system
    exposure: float  # t_e, s: length of the exposure
    readout: float  # t_r, s: time to read the image out
    frame_period: float  # t_s, s: time from one exposure to the next, at least T_e + T_r
    trigger: float = 0.0  # t_a, s: start of the first exposure
    frame_steps: int = field(init=False)
    exposure_steps: int = field(init=False)

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
        steps = {name: self._steps(name) for name in ("frame_period", "exposure", "trigger")}
        object.__setattr__(self, "frame_steps", steps["frame_period"])
        object.__setattr__(self, "exposure_steps", steps["exposure"])
        require(
            self.exposure_steps >= 1,
            f"exposure: expected at least one fast period of {self.fast_period:g} s, found {self.exposure:g} s",
        )

    def _steps(self, name: str) -> int:
        ratio = getattr(self, name) / self.fast_period
        require(
            abs(ratio - round(ratio)) <= 1e-9 * max(ratio, 1.0),
            f"{name}: expected a whole number of fast periods of {self.fast_period:g} s, found {ratio:g} of them",
        )
        return round(ratio)


@dataclass(frozen=True)
class PixelGrid:
    """A row of pixels of equal width."""

    # Outer edges of the first and the last pixel, in units of the output y.
    start: float
    stop: float
    count: int  # number of pixels
    integrating: bool = True  # whether a pixel averages the light over its width Δ or samples the density at its centre

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


@dataclass(frozen=True)
class GaussianKernel:
    """Gaussian image of a point at rest at y = 0 (paper 1, eq. 4; paper 2, section II-C)."""

    sigma: float  # σ; 0 is an ideal point
    offset: float = 0.0  # η₀, the position at which the point appears

    def __post_init__(self) -> None:
        require(0 <= self.sigma < np.inf, f"sigma: expected a width of at least 0, found {self.sigma:g}")
        require(bool(np.isfinite(self.offset)), f"offset: expected a finite position, found {self.offset:g}")

    def response(self, distance: Float64Array, pixels: PixelGrid) -> Float64Array:
        """Intensity that pixels record at the distances η − y from a point at rest."""
        d, sigma, width = distance - self.offset, self.sigma, pixels.width
        if sigma == 0:
            require(pixels.integrating, "kernel: expected integrating pixels under a delta, found pixels that sample")
            # The slack assigns a point on the border of two pixels to exactly one of them despite rounding.
            return ((d > -width / 2 + 1e-12 * width) & (d <= width / 2 + 1e-12 * width)) / width
        if pixels.integrating:
            return (ndtr((d + width / 2) / sigma) - ndtr((d - width / 2) / sigma)) / width
        return np.exp(-0.5 * (d / sigma) ** 2) / (_SQRT_2PI * sigma)

    def slope(self, distance: Float64Array, pixels: PixelGrid) -> Float64Array:
        """Differentiate :meth:`response` with respect to the distance."""
        d, sigma, width = distance - self.offset, self.sigma, pixels.width
        require(sigma > 0, "kernel: expected one with a width, found a delta, whose image has no derivative")
        if pixels.integrating:
            right, left = (np.exp(-0.5 * ((d + side * width / 2) / sigma) ** 2) for side in (1, -1))
            return (right - left) / (_SQRT_2PI * sigma * width)
        return -d / sigma**2 * np.exp(-0.5 * (d / sigma) ** 2) / (_SQRT_2PI * sigma)


@dataclass(frozen=True)
class LineSensor:
    """A row of pixels that records one point."""

    kernel: GaussianKernel
    pixels: PixelGrid
    noise: float  # V, density of the white noise, above 0
    total: float = 1.0  # known total intensity of an exposure

    def __post_init__(self) -> None:
        require(0 < self.noise < np.inf, f"noise: expected a density above 0, found {self.noise:g} (singular R)")
        require(0 < self.total < np.inf, f"total: expected an intensity above 0, found {self.total:g}")

    @property
    def deviation(self) -> float:
        """Standard deviation of the noise of a pixel, √(V / Δ)."""
        return float(np.sqrt(self.noise / self.pixels.width))


def expose(path: ArrayLike, kernel: GaussianKernel, pixels: PixelGrid, total: float = 1.0) -> Float64Array:
    """Exposure operator C_Ψ: the image of a moving point (paper 1, eq. 3; paper 2, eq. 1).

    ``path`` (..., N_e); returns (..., count).
    """
    positions = np.asarray(path, np.float64)
    if positions.ndim < 1 or positions.shape[-1] == 0:
        raise DataError(f"path: expected at least one step, shape (..., N_e), found shape {positions.shape}")
    if not np.isfinite(positions).all():
        raise DataError("path: expected finite outputs, found NaN or infinite ones; the model may be unstable")
    return total * kernel.response(pixels.centres[:, None] - positions[..., None, :], pixels).mean(-1)


@dataclass(frozen=True, eq=False)
class ExposureTable:
    """Responses of the P pixels to a point at M positions ``first + step · m``, made by :func:`tabulate`."""

    # Positions of the table.
    first: float
    step: float
    response: Float64Array  # (M, P): image of a point at each position; the first and last rows are zero
    slope: Float64Array  # (M, P): derivative of ``response`` with respect to the position
    blocks: tuple[tuple[slice, slice], ...]  # runs of pixels, and the positions from which light reaches them

    def image_and_jacobian(self, path: Float64Array, jacobian: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Image of a path, and its derivative with respect to the state.

        ``path`` (..., N_e); ``jacobian`` (..., N_e, n); returns ``image`` (..., P), ``derivative`` (..., n, P).
        """
        # A position beyond the table falls into its first or last row, which holds no light.
        place = np.clip((path - self.first) / self.step, 0.0, len(self.response) - 1.0)
        index = place.astype(np.intp)
        weights = np.concatenate([np.ones_like(path)[..., None, :], np.moveaxis(jacobian, -1, -2)], -2)
        spread = self._histogram(index[..., None, :], (place - index)[..., None, :], weights) / path.shape[-1]
        return self._sum(spread[..., 0, :], self.response), self._sum(spread[..., 1:, :], self.slope)

    def _sum(self, spread: Float64Array, responses: Float64Array) -> Float64Array:
        """Sum responses with the weights of a histogram, skipping positions whose light misses the pixels."""
        rows = spread.reshape(-1, spread.shape[-1])
        image = np.empty((len(rows), responses.shape[1]))
        for pixels, positions in self.blocks:
            image[:, pixels] = rows[:, positions] @ responses[positions, pixels]
        return image.reshape(*spread.shape[:-1], -1)

    def _histogram(self, index: NDArray[np.intp], share: Float64Array, weight: Float64Array) -> Float64Array:
        """Distribute the weights of a path over the two nearest positions of the table, shape (..., M)."""
        rows, size = int(np.prod(weight.shape[:-1])), len(self.response)
        offset = size * np.arange(rows).reshape((*weight.shape[:-1], 1))
        flat, upper = (index + offset).ravel(), share * weight
        below = np.bincount(flat, (weight - upper).ravel(), rows * size)
        above = np.bincount(flat, upper.ravel(), rows * size)
        # The last position of a row has the share zero, so nothing spills into the next row.
        below[1:] += above[:-1]
        return np.asarray(below, np.float64).reshape(*weight.shape[:-1], size)


def tabulate(sensor: LineSensor) -> ExposureTable:
    """Tabulate the exposure operator of a sensor."""
    kernel, pixels = sensor.kernel, sensor.pixels
    require(kernel.sigma > 0, "kernel: expected one with a width, found a delta, whose image has no derivative")
    step, reach = kernel.sigma / _POSITIONS_PER_SIGMA, _REACH * kernel.sigma
    low, high = kernel.offset - reach, kernel.offset + reach
    first = pixels.start - high - pixels.width
    span = (pixels.stop - low + pixels.width - first) / step
    require(
        span * pixels.count <= _LARGEST,
        f"kernel: expected one wide enough for a table, found {span:.2g} positions for {pixels.count} pixels",
    )
    count = int(np.ceil(span)) + 2
    distance = pixels.centres - (first + step * np.arange(count))[:, None]
    response = sensor.total * kernel.response(distance, pixels)
    slope = -sensor.total * kernel.slope(distance, pixels)
    response[[0, -1]] = slope[[0, -1]] = 0.0
    lit = (distance > low - pixels.width) & (distance < high + pixels.width)
    blocks = []
    for start in range(0, pixels.count, _BLOCK):
        reached = np.flatnonzero(lit[:, start : start + _BLOCK].any(1))
        blocks.append((slice(start, min(start + _BLOCK, pixels.count)), slice(reached[0], reached[-1] + 1)))
    return ExposureTable(float(first), float(step), response, slope, tuple(blocks))

"""The exposure operator as a table, for estimators that evaluate it thousands of times.

The response of all pixels is tabulated over the position y of a still point, linearly interpolated.  A path then
becomes a histogram over the positions of the table, and its image a few matrix products.  With positions h = σ / 6
apart the error stays below h² / 8 · max|Ψ''| = 0.0035 of the peak of the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import require
from .kernels import Float64Array, line_response, line_slope
from .sensor import LineSensor

_FINENESS = 6
# Tails of a Gaussian beyond six σ are below 2e-8 of its peak.
_REACH = 6
# Pixels in one matrix product; fewer waste less on positions out of reach, more use the processor better.
_BLOCK = 16
# Entries beyond which a table takes more memory than it is worth: 160 MB.
_LARGEST = 20_000_000


@dataclass(frozen=True, eq=False)
class ExposureTable:
    """Responses of the pixels to a point at the positions ``first + step · m``.

    Parameters
    ----------
    first, step : float
        Positions of the table.
    response : ndarray, float64, shape (M, P)
        Image of a point at each position; the first and last rows are zero.
    slope : ndarray, float64, shape (M, P)
        Its derivative with respect to the position.
    blocks : tuple of (slice, slice)
        Runs of pixels, and the positions from which light reaches them.

    Examples
    --------
    >>> from turbrestore.blur_moments.experiments.scenarios import mirror_model
    >>> mirror_model().table.image(np.zeros((3, 100))).shape
    (3, 80)
    """

    first: float
    step: float
    response: Float64Array
    slope: Float64Array
    blocks: tuple[tuple[slice, slice], ...]

    def image(self, path: Float64Array) -> Float64Array:
        """Image that a path leaves.

        Parameters
        ----------
        path : ndarray, float64, shape (..., N_e)

        Returns
        -------
        ndarray, float64, shape (..., P)
        """
        index, share = self._locate(path)
        return self._seen(self._histogram(index, share, np.ones_like(path)), self.response) / path.shape[-1]

    def image_and_jacobian(self, path: Float64Array, jacobian: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Image that a path leaves, and its derivative with respect to the state.

        Parameters
        ----------
        path : ndarray, float64, shape (..., N_e)
        jacobian : ndarray, float64, shape (..., N_e, n)
            Derivative of the path.

        Returns
        -------
        image : ndarray, float64, shape (..., P)
        derivative : ndarray, float64, shape (..., n, P)
        """
        index, share = self._locate(path)
        columns = np.moveaxis(jacobian, -1, -2)
        weights = np.concatenate([np.ones_like(path)[..., None, :], columns], -2)
        spread = self._histogram(index[..., None, :], share[..., None, :], weights)
        image, derivative = self._seen(spread[..., 0, :], self.response), self._seen(spread[..., 1:, :], self.slope)
        return image / path.shape[-1], derivative / path.shape[-1]

    def _seen(self, spread: Float64Array, responses: Float64Array) -> Float64Array:
        """Sum of the responses to a histogram, without the pixels that a position does not reach."""
        tall = spread.reshape(-1, spread.shape[-1])
        seen = np.empty((len(tall), responses.shape[1]))
        for pixels, positions in self.blocks:
            seen[:, pixels] = tall[:, positions] @ responses[positions, pixels]
        return seen.reshape(*spread.shape[:-1], -1)

    def _locate(self, path: Float64Array) -> tuple[NDArray[np.intp], Float64Array]:
        # A position beyond the table lands in its first or last row, which holds no light.
        place = np.clip((path - self.first) / self.step, 0.0, len(self.response) - 1.0)
        index = place.astype(np.intp)
        return index, place - index

    def _histogram(self, index: NDArray[np.intp], share: Float64Array, weight: Float64Array) -> Float64Array:
        """Weights of a path spread over the two nearest positions of the table, shape (..., M)."""
        rows, size = int(np.prod(weight.shape[:-1])), len(self.response)
        offset = size * np.arange(rows).reshape((*weight.shape[:-1], 1))
        flat, upper = (index + offset).ravel(), share * weight
        below = np.bincount(flat, (weight - upper).ravel(), rows * size)
        above = np.bincount(flat, upper.ravel(), rows * size)
        # Nothing is left to spill from the last position into the next row: its share is zero.
        below[1:] += above[:-1]
        return np.asarray(below, np.float64).reshape(*weight.shape[:-1], size)


def tabulate(sensor: LineSensor) -> ExposureTable:
    """Tabulate the exposure operator of a sensor.

    Parameters
    ----------
    sensor : LineSensor
        Its kernel has a width; the image of a delta has no derivative.

    Returns
    -------
    ExposureTable

    Raises
    ------
    ConfigurationError
        Delta kernel, or one so narrow that its table would not fit in memory.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.kernels import PixelGrid, gaussian_kernel
    >>> table = tabulate(LineSensor(gaussian_kernel(0.1), PixelGrid(-1.0, 1.0, 40), noise=0.1))
    >>> float(round(table.image(np.zeros(3)).sum() * 0.05, 6))
    1.0
    """
    kernel, pixels = sensor.kernel, sensor.pixels
    if kernel.samples is not None and kernel.spacing is not None:
        step = kernel.spacing[0] / 2
        low, high = kernel.offset[0], kernel.offset[0] + kernel.spacing[0] * (len(kernel.samples) - 1)
        low, high = low - 2 * kernel.spacing[0], high + 2 * kernel.spacing[0]
    else:
        sigma = float(np.sqrt(kernel.cov[0, 0]))
        step = sigma / _FINENESS
        low, high = kernel.offset[0] - _REACH * sigma, kernel.offset[0] + _REACH * sigma
    first = pixels.start - high - pixels.width
    if step == 0:
        # The slope names the cause.
        line_slope(kernel, np.zeros(1), pixels)
    span = (pixels.stop - low + pixels.width - first) / step
    require(
        span * pixels.count <= _LARGEST,
        f"kernel: expected one wide enough for a table, found {span:.2g} positions for {pixels.count} pixels",
    )
    count = int(np.ceil(span)) + 2
    distance = pixels.centres - (first + step * np.arange(count))[:, None]
    response = sensor.total * line_response(kernel, distance, pixels)
    slope = -sensor.total * line_slope(kernel, distance, pixels)
    response[[0, -1]] = slope[[0, -1]] = 0.0
    lit = (distance > low - pixels.width) & (distance < high + pixels.width)
    blocks = []
    for start in range(0, pixels.count, _BLOCK):
        reached = np.flatnonzero(lit[:, start : start + _BLOCK].any(1))
        blocks.append((slice(start, min(start + _BLOCK, pixels.count)), slice(reached[0], reached[-1] + 1)))
    return ExposureTable(float(first), float(step), response, slope, tuple(blocks))

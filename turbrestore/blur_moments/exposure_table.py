"""The exposure operator as a table, for observers that evaluate it thousands of times.

The table holds the response of all pixels for closely spaced positions y of a point at rest, with linear interpolation
between them.  A path becomes a histogram over these positions, and its image a few matrix products.  With positions
h = σ / 6 apart the error is below h² / 8 · max|Ψ''| = 0.0035 of the peak of the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import require
from .sensor import Float64Array, LineSensor

_POSITIONS_PER_SIGMA = 6
# Tails of a Gaussian beyond six σ are below 2e-8 of its peak.
_REACH = 6
# Pixels in one matrix product: fewer skip more positions out of reach, more use the CPU better.
_BLOCK = 16
# A larger table would take more than 160 MB.
_LARGEST = 20_000_000


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

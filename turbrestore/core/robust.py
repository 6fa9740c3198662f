"""Statistics that a few outliers do not change, and an even choice of some of many things."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .arrays import ROUNDING

# Standard deviation of normal numbers in their median absolute one: 1 / Φ⁻¹(3/4).
MEDIAN_DEVIATION = 1.4826
# Frames that a median over time is taken of, which then has a quarter of the deviation of one (1.25 / √25), and rows of
# them that are sorted at once.
MEDIAN_OF, MEDIAN_ROWS = 25, 64
# Tukey's constant, in standard deviations: fits by these weights keep 95 % of the efficiency of least squares.
_TUKEY = 4.685
# Fits, each with the weights of the residuals of the one before: the first by least squares, and three that settle.
ROUNDS = 4


def robust_scale(residuals: NDArray[np.floating]) -> float:
    """Return the standard deviation of residuals about zero, by their median absolute value; 0 for none."""
    return MEDIAN_DEVIATION * float(np.median(np.abs(residuals))) if residuals.size else 0.0


def bisquare_weights(residuals: NDArray[np.floating], scale: float) -> NDArray[np.floating]:
    """Return Tukey's weights, from 1 for no residual to 0 beyond 4.685 of their ``scale``."""
    return np.clip(1 - (residuals / max(_TUKEY * scale, ROUNDING)) ** 2, 0, 1) ** 2


def spread(count: int, most: int) -> list[int]:
    """Return the places of at most ``most`` of ``count`` things, spread evenly."""
    return [int(place) for place in np.linspace(0, count - 1, min(most, count)).round()]

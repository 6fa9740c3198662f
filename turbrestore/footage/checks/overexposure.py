"""Frames that are white where others show the scene, as in exposure brackets and where automatic exposure hunts.

Evening out the exposure makes white grey, with an edge where a channel clips; flow follows that edge, and fusion
darkens what is bright.  Frames are left out, rather than filled, because at least half of the clip remains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class _Limits:
    """By how much an overexposed frame exceeds the half of the clip that has least white."""

    white: float = 0.05  # share of the values; what noise or the glitter of water turns white is less
    # Factor of the level; both chosen.  What turns white where the camera pans to a brighter part changes it less.
    brighter: float = 1.25


_LIMITS = _Limits()


def overexposed(white: NDArray[np.float64], level: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark, (T,), the overexposed frames among those that are used, by their share of white values and mean level."""
    usual = np.quantile(white[used], 0.5, method="lower")
    shown = used & (white <= usual)
    clipped = white > usual + _LIMITS.white
    return np.asarray(used & clipped & (level > _LIMITS.brighter * np.median(level[shown])))

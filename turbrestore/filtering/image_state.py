"""Image update of the alternating filter (paper 3, eqs. 14a, 14c, 15 and 16).

Symbols
-------
ρ̂, Σ : image and its variance per pixel, :class:`PixelGaussian`
S : variance by which the image drifts from frame to frame (eq. 13a)
I ∘ ŵ, Z : registered frame and its variance about the image (eq. 15)
L : gain (eq. 16)

The paper takes Σ, Z and L to be one number each; here they vary from pixel to pixel.  Pixels are independent of each
other, and channels share the variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DataError
from ..runtime.image_stacks import Stack


@dataclass(frozen=True, eq=False)
class PixelGaussian:
    """Mean and variance of every pixel."""

    mean: NDArray[np.floating]  # (H, W) or (H, W, 3): ρ̂, intensities
    variance: NDArray[np.floating]  # (H, W): Σ, squared intensities, not negative

    def __post_init__(self) -> None:
        mean = np.asarray(self.mean)
        mean = mean if mean.dtype in (np.float32, np.float64) else mean.astype(np.float64)
        variance = np.asarray(self.variance, mean.dtype)
        pixels = variance.shape
        if mean.shape not in (pixels, (*pixels, 3)):
            raise DataError(f"mean: expected the shape of variance {pixels} or {(*pixels, 3)}, found {mean.shape}")
        if not np.isfinite(np.sum(mean, dtype=np.float64)):
            raise DataError("mean: expected finite values, found NaN or infinite ones")
        if not np.isfinite(np.sum(variance, dtype=np.float64)) or (variance < 0).any():
            raise DataError("variance: expected finite values of at least 0, found others")
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "variance", variance)


class PixelStacks(NamedTuple):
    """ρ̂ and Σ as arrays or tensors with the channels first: shapes (C, H, W) and (H, W)."""

    mean: Stack
    variance: Stack


def update_pixels(state: PixelStacks, registered: Stack, noise: Stack, drift: float) -> tuple[PixelStacks, Stack]:
    """Predict the image and update it by a registered frame (paper 3, eqs. 14a, 14c, 15 and 16).

    ``registered`` (C, H, W); ``noise`` (H, W); returns ``gain`` (H, W).
    """
    prior = state.variance + drift  # (14c); by (14a) the mean stays
    gain = prior / (prior + noise)  # L of (16)
    mean = state.mean + gain * (registered - state.mean)  # (16)
    # L Z equals (1 − L) Σ of (16) without its cancellation where Z is small.
    return PixelStacks(mean, gain * noise), gain

"""The levels of a clip, and those that the stages work at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import FloatArray


@dataclass(frozen=True)
class Levels:
    """Stretched intensities are ``gain * (intensity - low)``."""

    low: float = 0.0  # intensity that becomes 0
    gain: float = 1.0

    @property
    def changed(self) -> bool:
        """Whether anything is stretched."""
        return (self.low, self.gain) != (0.0, 1.0)

    @property
    def full_scale(self) -> tuple[float, float]:
        """Black and white of the clip, at the levels of the stages."""
        black = 0.0 - self.gain * self.low
        return black, black + self.gain

    def stretched(self, image: FloatArray) -> FloatArray:
        """Bring an image to the levels of the stages."""
        return (image - np.float32(self.low)) * np.float32(self.gain) if self.changed else image

    def original(self, image: FloatArray) -> FloatArray:
        """Bring an image back to the levels of the clip."""
        return image / np.float32(self.gain) + np.float32(self.low) if self.changed else image

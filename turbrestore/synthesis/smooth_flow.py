"""Sequences with known motion: smooth random flows that change steadily, and frames distorted by them.

Each component of a flow is a stationary Gaussian field in space (Gaussian correlation) and an autoregression of order
one in time.  This is not a model of the atmosphere; it is used where the true flow must be known, in tests, examples
and benchmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow, check_image
from ..core.errors import require
from ..registration.flow_algebra import invert_flow
from ..registration.warp import warp


@dataclass(frozen=True)
class SmoothFlowParams:
    """Statistics of a smooth random flow."""

    rms: float = 1.5  # root mean square of each component, pixels
    # Standard deviation of the Gaussian that smooths white noise into the field, pixels.
    correlation_length: float = 16.0
    persistence: float = 0.8  # correlation of one frame with the next, 0 (independent) to below 1

    def __post_init__(self) -> None:
        require(self.rms >= 0, f"rms: expected 0 pixels or more, found {self.rms}")
        require(
            self.correlation_length > 0,
            f"correlation_length: expected a positive number of pixels, found {self.correlation_length}",
        )
        require(0 <= self.persistence < 1, f"persistence: expected 0 to below 1, found {self.persistence}")


def smooth_flows(
    count: int, height: int, width: int, rng: np.random.Generator, params: SmoothFlowParams | None = None
) -> FloatArray:
    """Draw a sequence of smooth random flows.

    Returns (count, height, width, 2).
    """
    require(min(count, height, width) >= 1, f"size: expected positive numbers, found {count}×{height}×{width}")
    params = params or SmoothFlowParams()
    fresh = np.sqrt(1 - params.persistence**2)
    flows = np.empty((count, height, width, 2), np.float32)
    for index in range(count):
        field = _smooth_field(height, width, rng, params.correlation_length) * params.rms
        flows[index] = field if index == 0 else params.persistence * flows[index - 1] + fresh * field
    return flows


def distort(
    scene: ArrayLike, flows: ArrayLike, rng: np.random.Generator, blur: float = 0.0, noise: float = 0.0
) -> FloatArray:
    """Distort a scene by flows: ``I_k = (Kρ) ∘ w_k⁻¹`` plus noise (paper 3, eq. 6).

    ``scene`` (H, W) or (H, W, 3); ``flows`` (T, H, W, 2); returns (T, H, W) or (T, H, W, 3).
    """
    require(blur >= 0, f"blur: expected 0 pixels or more, found {blur}")
    require(noise >= 0, f"noise: expected 0 or more, found {noise}")
    image, stack = check_image(scene, "scene"), check_flow(flows, "flows")
    blurred = cv2.GaussianBlur(image, (0, 0), blur) if blur > 0 else image
    frames = np.stack([warp(blurred, invert_flow(flow)) for flow in stack])
    if noise > 0:
        frames += rng.normal(0.0, noise, frames.shape).astype(np.float32)
    return np.clip(frames, 0.0, 1.0)


def _smooth_field(height: int, width: int, rng: np.random.Generator, length: float) -> FloatArray:
    """Gaussian field of unit variance, correlated over ``length`` pixels, without a border effect."""
    margin = int(np.ceil(4 * length))
    white = rng.standard_normal((height + 2 * margin, width + 2 * margin, 2), dtype=np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), length)[margin : margin + height, margin : margin + width]
    # White noise through a Gaussian of deviation s keeps a share 1 / (4 π s²) of its variance.
    return smooth * np.float32(np.sqrt(4 * np.pi) * length)

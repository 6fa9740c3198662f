"""The image as a state: its prediction, and its update by a registered frame (paper 3, section 4).

::

    ρ̂ ← ρ̂                                 (14a)
    Σ ← Σ + S                             (14c)
    I ∘ ŵ = ρ + ζ,  ζ ~ N(0, Z)           (15)
    ρ̂ ← ρ̂ + L (I ∘ ŵ − ρ̂)                 (16)
    Σ ← (1 − L) Σ
    L = Σ / (Σ + Z)

Symbols
-------
ρ̂, Σ : image and its variance
S : variance of the drift of the image from one frame to the next
I ∘ ŵ, Z : registered frame and its variance about the image, :mod:`turbrestore.filtering.frame_noise`
L : gain

The paper takes Σ, Z and L to be one number each; here they vary from pixel to pixel.  Pixels are independent of each
other, and channels share the variance.
"""

from __future__ import annotations

from ..runtime.image_stacks import Stack
from .estimates import PixelStacks


def predict_image(image: PixelStacks, drift: float) -> PixelStacks:
    """Predict the image one frame ahead: its mean stays (14a), and ``drift``, S, adds to its variance (14c)."""
    return image._replace(variance=image.variance + drift)


def update_image(predicted: PixelStacks, registered: Stack, noise: Stack) -> tuple[PixelStacks, Stack]:
    """Update the predicted image by a registered frame (15, 16).

    ``registered`` (C, H, W) is I ∘ ŵ and ``noise`` (H, W) is Z; returns the image and its gain L (H, W).
    """
    gain = predicted.variance / (predicted.variance + noise)
    mean = predicted.mean + gain * (registered - predicted.mean)
    # L Z equals (1 − L) Σ without its cancellation where Z is small.
    return PixelStacks(mean, gain * noise), gain

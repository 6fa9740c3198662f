"""The sample clip: the resolution chart, bent by smooth random flows, softened by a blur that changes, and noisy."""

from __future__ import annotations

import numpy as np

from ..core.arrays import FloatArray
from .scenes import resolution_chart
from .smooth_flow import SmoothFlowParams, distort, smooth_flows

# Frames per second.  It and all numbers below were chosen.
RATE = 25
_HEIGHT, _WIDTH, _FRAMES = 192, 256, 48
_MOTION = SmoothFlowParams(rms=1.8, correlation_length=14.0, persistence=0.8)
# Widths of the blur between which each frame has one, pixels; standard deviation of the noise.
_BLURS, _NOISE = (0.9, 2.0), 0.01
_SEED = 2026


def sample_clip() -> tuple[FloatArray, FloatArray]:
    """Make the sample clip.

    Returns ``frames`` (48, 192, 256), ``truth`` (192, 256).
    """
    rng = np.random.default_rng(_SEED)
    truth = resolution_chart(_HEIGHT, _WIDTH)
    flows = smooth_flows(_FRAMES, _HEIGHT, _WIDTH, rng, _MOTION)
    # Over a long time the displacement averages to zero; a clip this short needs help to show the true geometry.
    flows -= flows.mean(axis=0)
    blurs = rng.uniform(*_BLURS, _FRAMES)
    frames = [
        distort(truth, flow[None], rng, blur=blur, noise=_NOISE)[0] for flow, blur in zip(flows, blurs, strict=True)
    ]
    return np.stack(frames), truth

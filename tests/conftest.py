"""Small synthetic sequences with known motion, shared by several tests."""

from dataclasses import dataclass

import numpy as np
import pytest

from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows


@dataclass(frozen=True)
class Sequence:
    scene: np.ndarray
    flows: np.ndarray
    frames: np.ndarray


def make_sequence(
    seed: int, count: int = 16, size: int = 96, blur: float = 1.0, noise: float = 0.01, **statistics: float
) -> Sequence:
    rng = np.random.default_rng(seed)
    scene = resolution_chart(size, size)
    flows = smooth_flows(count, size, size, rng, SmoothFlowParams(**statistics))
    # Frames tell the scene up to their mean displacement only.  It is taken out of either half, so that training on
    # the first half gives the true geometry and results can be compared in place.
    for half in np.array_split(np.arange(count), 2):
        flows[half] -= flows[half].mean(axis=0)
    return Sequence(scene, flows, distort(scene, flows, rng, blur=blur, noise=noise))


@pytest.fixture(scope="session")
def sequence() -> Sequence:
    return make_sequence(seed=1)

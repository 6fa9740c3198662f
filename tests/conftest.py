"""Small synthetic sequences with known motion, shared by several tests."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import skimage.data

from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows


@dataclass(frozen=True)
class Sequence:
    scene: np.ndarray
    flows: np.ndarray
    frames: np.ndarray


def natural_scene(size: int) -> np.ndarray:
    """The photographer: edges, faint texture, a flat sky."""
    photo = cv2.resize(skimage.data.camera(), (256, 256), interpolation=cv2.INTER_AREA)
    return photo[20 : 20 + size, 60 : 60 + size].astype(np.float32) / 255


SCENES = {"chart": lambda size: resolution_chart(size, size), "camera": natural_scene}


def make_sequence(
    seed: int,
    count: int = 16,
    size: int = 96,
    scene: str = "chart",
    blur: float = 1.0,
    blur_change: float = 0.0,
    noise: float = 0.01,
    **statistics: float,
) -> Sequence:
    """Frames whose blur is drawn anew for each, between ``blur`` and ``blur + blur_change``."""
    rng = np.random.default_rng(seed)
    image = SCENES[scene](size)
    flows = smooth_flows(count, size, size, rng, SmoothFlowParams(**statistics))
    # Frames tell the scene up to their mean displacement only.  It is taken out of either half, so that training on
    # the first half gives the true geometry and results can be compared in place.
    for half in np.array_split(np.arange(count), 2):
        flows[half] -= flows[half].mean(axis=0)
    blurs = blur + blur_change * rng.uniform(0, 1, count)
    frames = [distort(image, flow[None], rng, blur=b, noise=noise)[0] for flow, b in zip(flows, blurs, strict=True)]
    return Sequence(image, flows, np.stack(frames))


@pytest.fixture(scope="session")
def sequence() -> Sequence:
    return make_sequence(seed=1)

"""The check of a steadied frame against its input."""

import cv2
import numpy as np
import skimage.data

from turbrestore.steady.fusion import share_of_estimate
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SCENE = cv2.resize(skimage.data.camera(), (128, 128), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
RNG = np.random.default_rng(0)
FLOWS = smooth_flows(9, 128, 128, RNG, SmoothFlowParams(rms=1.0, correlation_length=20.0, persistence=0.0))
FRAMES = [distort(SCENE, flow[None], RNG, noise=0.02)[0] for flow in FLOWS]
MEAN = np.mean(FRAMES[1:], 0)


def test_what_is_nearer_to_the_mean_and_no_softer_stays():
    assert share_of_estimate(SCENE, FRAMES[0], MEAN, 0.02).mean() > 0.97
    # A noisy frame is not sharper than one without noise.
    noisy = SCENE + RNG.normal(0, 0.1, SCENE.shape).astype(np.float32)
    assert share_of_estimate(SCENE, noisy, SCENE, 0.1).mean() > 0.97


def test_a_part_that_has_slipped_passes_as_the_frame():
    slipped = SCENE.copy()
    slipped[40:88, 40:88] = np.roll(SCENE, 6, 1)[40:88, 40:88]
    share = share_of_estimate(slipped, FRAMES[0], MEAN, 0.02)
    worse = cv2.GaussianBlur((slipped - SCENE) ** 2, (0, 0), 4.0) > 0.05
    assert worse.sum() > 200
    assert share[worse].mean() < 0.3
    assert share[:24].mean() > 0.97


def test_a_part_that_was_blurred_passes_as_the_frame():
    soft = SCENE.copy()
    soft[64:] = cv2.GaussianBlur(SCENE, (0, 0), 4.0)[64:]
    share = share_of_estimate(soft, SCENE, soft, 0.0)
    edges = cv2.GaussianBlur((soft - SCENE) ** 2, (0, 0), 4.0)[72:] > 0.01
    assert share[72:][edges].mean() < 0.3
    assert share[:48].min() > 0.9

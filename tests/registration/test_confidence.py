import cv2
import numpy as np
import pytest

from turbrestore.registration.confidence import (
    _gradient,
    flow_confidence,
    noise_share,
    posterior_mean,
    regularise_flow,
    subtract_noise,
)
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows


def texture(side=96, seed=0):
    noise = np.random.default_rng(seed).standard_normal((side, side)).astype(np.float32)
    return 0.5 + 0.4 * cv2.GaussianBlur(noise, (0, 0), 1.5)


def size(flow):
    return float(np.sqrt(np.mean(np.sum(np.square(flow, dtype=np.float64), axis=-1))))


def test_one_window_is_the_posterior_mean():
    # Without wider windows what is expected is zero.
    image, rng = texture(12), np.random.default_rng(1)
    flow, noise = rng.normal(0, 2, (12, 12, 2)).astype(np.float32), 0.05
    confidence = flow_confidence(image)[:1]
    xx, xy, yy = confidence[0].astype(np.float64)
    tensor = np.moveaxis(np.array([[xx, xy], [xy, yy]]), (0, 1), (2, 3))
    # The covariance of a displacement is ten times σ² / (A J) within A = 16 π pixels, and that of the prior 0.5²; the
    # tensor is known to a hundredth of its mean eigenvalue.
    information = 16 * np.pi * tensor / (10 * noise**2)
    tilt = 0.01 * 16 * np.pi * ((xx + yy) / 2)[..., None, None] / (10 * noise**2) * np.eye(2)
    expected = np.linalg.solve(information + np.eye(2) / 0.25 + tilt, information @ flow[..., None].astype(np.float64))
    assert regularise_flow(flow, confidence, noise) == pytest.approx(expected[..., 0], abs=1e-4)


@pytest.mark.parametrize(("noise", "left"), [(0.12, (0.12, 0.06, 0.03)), (0.005, (0.005, 0.005, 0.005))])
def test_each_window_draws_towards_the_next_wider_one(noise, left):
    # Equal tensors and flow everywhere: each window moves what the next wider one expects towards the flow.  Noise
    # averages out in wider windows, but not below 0.01.
    tensors = tuple(np.full((side, side, 3), (1e-5, 0, 2e-5), np.float32).transpose(2, 0, 1) for side in (16, 8, 4))
    found = regularise_flow(np.ones((16, 16, 2), np.float32), tensors, noise)
    expected = np.zeros(2)
    for sigma in reversed(left):
        prior = 10 * sigma**2 / (16 * np.pi * 0.25) + 0.01 * 1.5e-5
        share = np.array([1e-5, 2e-5]) / (np.array([1e-5, 2e-5]) + prior)
        expected = expected + share * (1 - expected)
    assert found == pytest.approx(np.broadcast_to(expected, (16, 16, 2)), rel=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("degrees", [0, 30, 45, 77])
@pytest.mark.parametrize("profile", ["edge", "stripes", "ramp"])
def test_single_edges_of_any_direction_invent_no_motion(profile, degrees, noise):
    y, x = np.mgrid[:64, :64] - 32.0
    across = x * np.cos(np.radians(degrees)) + y * np.sin(np.radians(degrees))
    image = {
        "edge": np.where(across > 0, 0.9, 0.1),
        "stripes": 0.5 + 0.3 * np.sin(across / 3),
        "ramp": 0.5 + across / 99,
    }
    rng = np.random.default_rng(7)
    reference = (image[profile] + rng.normal(0, noise, (64, 64))).astype(np.float32)
    flow = smooth_flows(1, 64, 64, rng, SmoothFlowParams(rms=1.5))[0]
    found = regularise_flow(flow, flow_confidence(reference), noise)
    assert np.isfinite(found).all()
    assert size(found) < 1.2 * size(flow)
    assert (found >= np.minimum(flow.min(axis=(0, 1)), 0)).all()
    assert (found <= np.maximum(flow.max(axis=(0, 1)), 0)).all()


def test_texture_keeps_its_flow():
    flow = smooth_flows(1, 96, 96, np.random.default_rng(2), SmoothFlowParams(rms=2.0))[0]
    assert size(regularise_flow(flow, flow_confidence(texture()), 0.005) - flow) < 0.05


def test_stripes_keep_only_the_motion_across_them():
    stripes = np.tile(0.5 + 0.3 * np.sin(np.arange(64) / 2), (64, 1)).astype(np.float32)
    flow = np.broadcast_to(np.float32([1.5, 4.0]), (64, 64, 2))
    found = regularise_flow(flow, flow_confidence(stripes), 0.01)[8:-8, 8:-8]
    assert np.abs(found[..., 0] - 1.5).max() < 0.05
    assert np.abs(found[..., 1]).max() < 0.05


@pytest.mark.parametrize("noise", [0.005, 0.03])
def test_noise_is_no_texture(noise):
    rng = np.random.default_rng(3)
    reference = (0.5 + rng.normal(0, noise, (96, 96))).astype(np.float32)
    flow = rng.normal(0, 5, (96, 96, 2)).astype(np.float32)
    assert size(regularise_flow(flow, flow_confidence(reference), noise)) < 0.01 * size(flow)


def test_a_flat_half_moves_as_its_neighbourhood():
    image = texture()
    image[:, 48:] = 0.5
    flow = np.full((96, 96, 2), 2.0, np.float32)
    flow[:, 56:] = np.random.default_rng(4).normal(0, 6, (96, 40, 2))
    found = regularise_flow(flow, flow_confidence(image), 0.01)
    assert size(found[:, 56:] - 2) < 0.1
    assert size(found[8:-8, 8:40] - 2) < 0.02


@pytest.mark.parametrize("shape", [(8, 9), (17, 40), (33, 64, 3)])
def test_odd_sizes_and_no_noise_are_fine(shape):
    rng = np.random.default_rng(6)
    flow = rng.normal(0, 1, (*shape[:2], 2)).astype(np.float32)
    before = flow.copy()
    found = regularise_flow(flow, flow_confidence(rng.random(shape).astype(np.float32)), 0.0)
    assert np.isfinite(found).all()
    assert found.dtype == np.float32
    assert (flow == before).all()


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_eigenvalues_of_tensors_are_lowered_by_the_noise(noise):
    """Of flat pixels, whose tensors vanish, of edges, which have one eigenvalue, and of texture, which has two."""
    gradients = np.random.default_rng(24).normal(0, 0.3, (60, 2, 2)).astype(np.float32)
    gradients[:20, 1] = 0
    gradients[:3] = 0
    tensors = np.einsum("pki,pkj->pij", gradients, gradients)
    planes = tuple(tensors[:, i, j].copy() for i, j in ((0, 0), (0, 1), (1, 1)))
    fast, slow = np.empty((3, 60), np.float32), np.empty((3, 60), np.float32)
    subtract_noise(np.float32(noise), *planes, fast)
    subtract_noise.py_func(np.float32(noise), *planes, slow)
    assert fast == pytest.approx(slow, rel=1e-4, abs=1e-6)
    values, vectors = np.linalg.eigh(tensors.astype(np.float64))
    expected = np.einsum("pij,pj,pkj->pik", vectors, np.maximum(values - noise, 0), vectors)
    found = np.array([[fast[0], fast[1]], [fast[1], fast[2]]]).transpose(2, 0, 1)
    assert found == pytest.approx(expected, abs=1e-6)


def test_the_compiled_posterior_mean_is_that_of_the_plain_loop():
    rng = np.random.default_rng(25)
    xx, yy, weighted_x, weighted_y, expected_x, expected_y = rng.random((6, 50), np.float32)
    xy = 0.9 * np.sqrt(xx * yy)
    results = np.empty((2, 2, 50), np.float32)
    for loop, result in zip((posterior_mean, posterior_mean.py_func), results, strict=True):
        loop(np.float32(0.01), xx, xy, yy, weighted_x, weighted_y, expected_x, expected_y, *result)
    assert results[0] == pytest.approx(results[1], abs=1e-4)


def test_arguments_are_not_changed():
    rng = np.random.default_rng(26)
    image, flow = rng.random((40, 31), np.float32), rng.normal(0, 2, (40, 31, 2)).astype(np.float32)
    confidence, before = flow_confidence(image), (image.copy(), flow.copy())
    tensors = [tensor.copy() for tensor in confidence]
    regularise_flow(flow, confidence, 0.02)
    assert all(map(np.array_equal, (image, flow, *confidence), (*before, *tensors)))


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_the_share_of_noise_in_gradients(noise):
    rng = np.random.default_rng(27)
    scene, white = texture(), rng.normal(0, noise, (96, 96)).astype(np.float32)
    whole, scene_alone = (float(np.square(np.hypot(*_gradient(image))).mean()) for image in (scene + white, scene))
    assert noise_share(scene + white, noise) == pytest.approx(1 - scene_alone / whole, abs=0.05)

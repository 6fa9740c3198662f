"""Exposures with known motion."""

import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.sequence import CameraParams, exposed_frame, flows_between
from turbrestore.synthesis.smooth_flow import distort, smooth_flows


def spot(size=48, sigma=3.0):
    axis = np.arange(size) - size // 2
    profile = np.exp(-(axis**2) / (2 * sigma**2))
    return np.outer(profile, profile).astype(np.float32)


def moments(image):
    """Mean position (x, y) and covariance of the light."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    positions = np.stack([x.ravel(), y.ravel()])
    weights = image.ravel().astype(np.float64)
    mean = np.average(positions, axis=1, weights=weights)
    return mean, np.cov(positions, aweights=weights, ddof=0)


def constant(dx, dy, size=48):
    return np.broadcast_to(np.float32([dx, dy]), (size, size, 2)).copy()


def test_motion_adds_its_covariance_to_the_light():
    # cov(image) = cov(scene) + cov(motion over the exposure), and the mean is that of the motion.
    path = np.array([[-3.0, 0.5], [-1.0, 1.0], [2.0, -1.5], [4.0, 0.0]])
    image, flow = exposed_frame(spot(), (constant(*step) for step in path))
    (mean, covariance), (start, still) = moments(image), moments(spot())
    assert mean - start == pytest.approx(path.mean(axis=0), abs=0.01)
    assert covariance - still == pytest.approx(np.cov(path.T, ddof=0), abs=0.05)
    assert flow[24, 24] == pytest.approx(path.mean(axis=0), abs=1e-6)
    assert image.sum() == pytest.approx(spot().sum(), rel=1e-3)


def test_one_instant_is_a_plain_distortion():
    scene, rng = resolution_chart(64, 64), np.random.default_rng(0)
    flow = smooth_flows(1, 64, 64, rng)[0]
    image, mean = exposed_frame(scene, [flow])
    assert np.clip(image, 0, 1) == pytest.approx(distort(scene, flow[None], rng)[0], abs=1e-6)
    assert (mean == flow).all()


def test_colour_and_blur_that_crops():
    scene = np.dstack([spot(), 0.5 * spot(), spot()])
    seen = []

    def crop(image, index):
        seen.append(index)
        return image[4:-4, 4:-4]

    image, flow = exposed_frame(scene, [constant(1, 0), constant(3, 0)], crop)
    assert image.shape == (40, 40, 3)
    assert flow.shape == (48, 48, 2)
    assert seen == [0, 1]
    assert image[..., 1] == pytest.approx(image[..., 0] / 2, abs=1e-6)


def test_flows_between_frames_are_linear_in_time():
    flows = smooth_flows(4, 16, 16, np.random.default_rng(1))
    shares = CameraParams(frame_rate=10.0, exposure=0.05, sub_frames=5).sub_frame_shares()
    assert shares == pytest.approx((0.05, 0.15, 0.25, 0.35, 0.45))
    frames = list(flows_between(iter(flows), shares))
    assert len(frames) == 3
    for k, between in enumerate(frames):
        for share, flow in zip(shares, between, strict=True):
            assert flow == pytest.approx((1 - share) * flows[k] + share * flows[k + 1], abs=1e-6)


def test_what_cannot_be_is_refused():
    with pytest.raises(DataError, match="^sub_flows"):
        exposed_frame(spot(), [])
    with pytest.raises(DataError, match="^flow"):
        exposed_frame(spot(), [np.zeros((4, 4, 2), np.float32)])

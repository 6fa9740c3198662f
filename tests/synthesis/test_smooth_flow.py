import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr
from turbrestore.registration.warp import warp
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows


def test_flow_has_the_statistics_it_is_asked_for():
    params = SmoothFlowParams(rms=2.0, correlation_length=6.0, persistence=0.7)
    flows = smooth_flows(400, 64, 64, np.random.default_rng(0), params).astype(np.float64)
    # 400 frames × 2 components × (64 / 21)² patches with a memory of 3 frames: about 1,500 independent values,
    # so the deviation is known to 2 %, and correlations to 0.03.
    assert flows.std() == pytest.approx(2.0, rel=0.06)
    assert np.mean(flows[1:] * flows[:-1]) / flows.var() == pytest.approx(0.7, abs=0.05)
    shifted = np.mean(flows[:, :, 6:] * flows[:, :, :-6]) / flows.var()
    assert shifted == pytest.approx(np.exp(-1 / 4), abs=0.05)
    border, middle = flows[:, :4].std(), flows[:, 30:34].std()
    assert border == pytest.approx(middle, rel=0.15)


def test_frames_follow_the_sign_rule():
    rng = np.random.default_rng(1)
    scene, flows = resolution_chart(96, 96), smooth_flows(3, 96, 96, rng)
    frames = distort(scene, flows, rng, blur=1.5)
    still = distort(scene, np.zeros_like(flows), rng, blur=1.5)[0]
    for frame, flow in zip(frames, flows, strict=True):
        inside = (slice(10, -10), slice(10, -10))
        assert psnr(warp(frame, flow)[inside], still[inside]) > psnr(frame[inside], still[inside]) + 10


def test_noise_has_the_deviation_it_is_asked_for():
    rng = np.random.default_rng(2)
    frames = distort(np.full((64, 64), 0.5), np.zeros((8, 64, 64, 2)), rng, noise=0.02)
    assert frames.std() == pytest.approx(0.02, rel=0.05)


def test_the_same_seed_gives_the_same_flow():
    first, again, other = (smooth_flows(2, 32, 32, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert (first == again).all()
    assert not (first == other).any()


def test_bad_parameters_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigurationError, match="at least 64 pixels"):
        resolution_chart(10, 200)
    with pytest.raises(ConfigurationError, match="^size"):
        smooth_flows(0, 8, 8, rng)
    for bad in ({"blur": -1.0}, {"noise": -1.0}):
        with pytest.raises(ConfigurationError, match=f"^{next(iter(bad))}: expected"):
            distort(np.zeros((8, 8)), np.zeros((1, 8, 8, 2)), rng, **bad)
    with pytest.raises(DataError):
        distort(np.zeros((8, 8)), np.zeros((1, 9, 8, 2)), rng)

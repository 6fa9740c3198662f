from collections import Counter

import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import sample_linear, strips, warp
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows


def smooth_flow(rng, size=48, rms=1.5):
    return smooth_flows(1, size, size, rng, SmoothFlowParams(rms=rms, correlation_length=10.0))[0]


def test_flows_are_sampled_below_a_32nd_of_a_pixel_too():
    ramp = np.tile(np.arange(32, dtype=np.float32), (32, 1))
    shift = np.full((32, 32, 2), 0.01, np.float32)
    composed = compose_flows(np.dstack([ramp, ramp.T]), shift)[4:-4, 4:-4]
    assert np.abs(composed - np.dstack([ramp, ramp.T])[4:-4, 4:-4] - 0.02).max() < 1e-5


@pytest.mark.parametrize("seed", range(5))
def test_inverse_composed_with_the_flow_is_the_identity(seed):
    flow = smooth_flow(np.random.default_rng(seed))
    inverse = invert_flow(flow, iterations=50, tolerance=1e-5)
    interior = (slice(6, -6), slice(6, -6))
    assert np.abs(compose_flows(flow, inverse)).max() < 1e-4
    # The other way round, the inverse is interpolated between the points where it was found.
    assert np.abs(compose_flows(inverse, flow)[interior]).max() < 0.05


def test_strips_are_inverted_until_each_is_done(monkeypatch):
    """Those that lie still after one step, others as far as they need; each is followed into the rows of others."""
    flow = smooth_flow(np.random.default_rng(5), 60)
    flow *= np.linspace(-1, 1, 60, dtype=np.float32).clip(0)[:, None, None]
    whole = invert_flow(flow, iterations=50, tolerance=1e-5)
    monkeypatch.setattr("turbrestore.registration.warp._STRIP", 600)
    steps = Counter()

    def count(planes, inverse, rows):
        steps[rows.start] += 1
        return sample_linear(planes, inverse, rows)

    with monkeypatch.context() as patch:
        patch.setattr("turbrestore.registration.flow_algebra.sample_linear", count)
        parts = invert_flow(flow, iterations=50, tolerance=1e-5)
    assert list(steps) == [rows.start for rows in strips(flow.shape)] == [0, 10, 20, 30, 40, 50]
    assert steps[0] == steps[10] == 1
    assert 3 < steps[50] < 50
    assert np.abs(parts - whole).max() < 5e-5
    assert np.abs(compose_flows(flow, parts)).max() < 1e-4
    assert np.abs(whole).max() > 1


def test_composition_warps_as_two_warps_do():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:48, :48]
    image = (0.5 + 0.3 * np.sin(x / 7) * np.cos(y / 6)).astype(np.float32)
    outer, inner = smooth_flow(rng), smooth_flow(rng)
    twice = warp(warp(image, outer), inner)
    once = warp(image, compose_flows(outer, inner))
    assert np.abs(twice - once)[6:-6, 6:-6].max() < 2e-3


def test_wrong_shapes_are_refused():
    with pytest.raises(DataError, match="^flow: expected shape"):
        invert_flow(np.zeros((2, 4, 4, 2)))
    with pytest.raises(DataError, match="^inner: expected shape"):
        compose_flows(np.zeros((4, 5, 2)), np.zeros((4, 4, 2)))

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.registration.warp import _sample_planes, compose_flows, inside, invert_flow, strips, warp, warp_adjoint
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows


def smooth_flow(rng, size=48, rms=1.5):
    return smooth_flows(1, size, size, rng, SmoothFlowParams(rms=rms, correlation_length=10.0))[0]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 8.0), st.sampled_from([(9, 7), (2, 5), (16, 16)]))
def test_adjoint(seed, scale, shape):
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, *shape)).astype(np.float32)
    # Rough and far, so that positions outside the image are sampled too.
    flow = (scale * rng.standard_normal((*shape, 2))).astype(np.float32)
    left = float(np.vdot(warp(a, flow, "linear").astype(np.float64), b))
    right = float(np.vdot(a.astype(np.float64), warp_adjoint(b, flow)))
    assert left == pytest.approx(right, abs=1e-4 * a.size**0.5)


@pytest.mark.parametrize("shape", [(150, 330), (330, 150), (90, 270, 3), (1, 40)])
def test_the_cubic_warp_is_that_of_scipy_for_images_of_many_strips(shape, monkeypatch):
    from scipy.ndimage import map_coordinates

    monkeypatch.setattr("turbrestore.registration.warp._STRIP", 5000)
    assert len(list(strips(shape))) > 1 or shape[0] == 1

    rng = np.random.default_rng(1)
    image, flow = rng.random(shape).astype(np.float32), rng.normal(0, 3, (*shape[:2], 2)).astype(np.float32)
    y, x = np.mgrid[: shape[0], : shape[1]]
    place = [np.clip(y + flow[..., 1], 0, shape[0] - 1), np.clip(x + flow[..., 0], 0, shape[1] - 1)]
    channels = image.reshape(*shape[:2], -1)
    planes = [map_coordinates(channels[..., c], place, order=3, mode="mirror") for c in range(channels.shape[2])]
    assert np.abs(warp(image, flow) - np.dstack(planes).reshape(shape)).max() < 1e-4


def test_adjoint_of_colour_is_that_of_each_channel():
    rng = np.random.default_rng(0)
    image, flow = rng.random((6, 8, 3)).astype(np.float32), smooth_flow(rng, 8)[:6]
    each = np.stack([warp_adjoint(image[..., c], flow) for c in range(3)], axis=-1)
    assert np.allclose(warp_adjoint(image, flow), each)


@pytest.mark.parametrize("shift", [1 / 64, 1 / 100, 1 / 1000])
def test_shifts_below_a_32nd_of_a_pixel_are_exact(shift):
    ramp = np.tile(np.arange(32, dtype=np.float32), (32, 1))
    flow = np.zeros((32, 32, 2), np.float32)
    flow[..., 0] = shift
    for interpolation in ("linear", "cubic"):
        moved = warp(ramp, flow, interpolation)[8:-8, 8:-8] - ramp[8:-8, 8:-8]
        assert np.abs(moved - shift).max() < 1e-5


def test_flows_are_sampled_below_a_32nd_of_a_pixel_too():
    ramp = np.tile(np.arange(32, dtype=np.float32), (32, 1))
    shift = np.full((32, 32, 2), 0.01, np.float32)
    composed = compose_flows(np.dstack([ramp, ramp.T]), shift)[4:-4, 4:-4]
    assert np.abs(composed - np.dstack([ramp, ramp.T])[4:-4, 4:-4] - 0.02).max() < 1e-5


def test_cubic_warp_is_the_interpolating_spline():
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(0)
    image, flow = rng.random((40, 30)).astype(np.float32), rng.normal(0, 2, (40, 30, 2)).astype(np.float32)
    y, x = np.mgrid[:40, :30]
    position = [np.clip(y + flow[..., 1], 0, 39), np.clip(x + flow[..., 0], 0, 29)]
    expected = map_coordinates(image.astype(np.float64), position, order=3, mode="mirror")
    assert np.abs(warp(image, flow) - expected).max() < 1e-4


def test_zero_flow_changes_nothing():
    image = np.random.default_rng(0).random((9, 11)).astype(np.float32)
    assert (warp(image, np.zeros((9, 11, 2)), "linear") == image).all()


def test_warp_follows_the_sign_rule():
    reference = np.zeros((8, 8), np.float32)
    frame = np.zeros((8, 8), np.float32)
    reference[4, 3], frame[4, 5] = 1, 1  # the point moves by +2 in x
    flow = np.zeros((8, 8, 2), np.float32)
    flow[..., 0] = 2
    assert (warp(frame, flow, "linear") == reference).all()


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
        return _sample_planes(planes, inverse, rows)

    with monkeypatch.context() as patch:
        patch.setattr("turbrestore.registration.warp._sample_planes", count)
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


def test_inside_is_what_a_linear_warp_of_ones_between_zeros_gives():
    from scipy.ndimage import map_coordinates

    flow = np.random.default_rng(4).normal(0, 6, (14, 18, 2)).astype(np.float32)
    y, x = np.mgrid[:14, :18]
    expected = map_coordinates(np.ones((14, 18)), [y + flow[..., 1], x + flow[..., 0]], order=1, mode="grid-constant")
    assert 0.2 < expected.mean() < 0.9
    assert np.abs(inside(flow) - expected).max() < 1e-5


def test_arguments_are_not_changed():
    rng = np.random.default_rng(3)
    image, flow = rng.random((16, 16)).astype(np.float32), smooth_flow(rng, 16)
    copies = image.copy(), flow.copy()
    warp(image, flow), warp_adjoint(image, flow), invert_flow(flow), compose_flows(flow, flow)
    assert (image == copies[0]).all()
    assert (flow == copies[1]).all()


def test_wrong_shapes_and_names_are_refused():
    image, flow = np.zeros((4, 4)), np.zeros((4, 5, 2))
    with pytest.raises(DataError, match="expected shape \\(4, 4, 2\\)"):
        warp(image, flow)
    with pytest.raises(DataError, match="expected shape"):
        warp_adjoint(image, flow)
    with pytest.raises(ConfigurationError, match="linear, cubic"):
        warp(image, np.zeros((4, 4, 2)), "lanczos")
    with pytest.raises(DataError):
        inside(np.zeros((2, 4, 4, 2)))
    with pytest.raises(DataError):
        invert_flow(np.zeros((2, 4, 4, 2)))
    with pytest.raises(DataError):
        compose_flows(flow, np.zeros((4, 4, 2)))

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import inside, warp


@pytest.mark.parametrize("shape", [(150, 330), (330, 150), (90, 270, 3), (1, 40)])
def test_the_cubic_warp_is_that_of_scipy(shape):
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(1)
    image, flow = rng.random(shape).astype(np.float32), rng.normal(0, 3, (*shape[:2], 2)).astype(np.float32)
    y, x = np.mgrid[: shape[0], : shape[1]]
    place = [np.clip(y + flow[..., 1], 0, shape[0] - 1), np.clip(x + flow[..., 0], 0, shape[1] - 1)]
    channels = image.reshape(*shape[:2], -1)
    planes = [map_coordinates(channels[..., c], place, order=3, mode="mirror") for c in range(channels.shape[2])]
    assert np.abs(warp(image, flow) - np.dstack(planes).reshape(shape)).max() < 1e-4


@pytest.mark.parametrize("shift", [1 / 64, 1 / 100, 1 / 1000])
def test_shifts_below_a_32nd_of_a_pixel_are_exact(shift):
    ramp = np.tile(np.arange(32, dtype=np.float32), (32, 1))
    flow = np.zeros((32, 32, 2), np.float32)
    flow[..., 0] = shift
    for interpolation in ("linear", "cubic"):
        moved = warp(ramp, flow, interpolation)[8:-8, 8:-8] - ramp[8:-8, 8:-8]
        assert np.abs(moved - shift).max() < 1e-5


def test_warp_follows_the_sign_rule():
    reference = np.zeros((8, 8), np.float32)
    frame = np.zeros((8, 8), np.float32)
    reference[4, 3], frame[4, 5] = 1, 1  # the point moves by +2 in x
    flow = np.zeros((8, 8, 2), np.float32)
    flow[..., 0] = 2
    assert (warp(frame, flow, "linear") == reference).all()


def test_inside_is_what_a_linear_warp_of_ones_between_zeros_gives():
    from scipy.ndimage import map_coordinates

    flow = np.random.default_rng(4).normal(0, 6, (14, 18, 2)).astype(np.float32)
    y, x = np.mgrid[:14, :18]
    expected = map_coordinates(np.ones((14, 18)), [y + flow[..., 1], x + flow[..., 0]], order=1, mode="grid-constant")
    assert 0.2 < expected.mean() < 0.9
    assert np.abs(inside(flow) - expected).max() < 1e-5


def test_arguments_are_not_changed():
    rng = np.random.default_rng(3)
    image, flow = rng.random((16, 16)).astype(np.float32), rng.normal(0, 1, (16, 16, 2)).astype(np.float32)
    copies = image.copy(), flow.copy()
    warp(image, flow), warp(image, flow, "linear"), inside(flow), invert_flow(flow), compose_flows(flow, flow)
    assert (image == copies[0]).all()
    assert (flow == copies[1]).all()


def test_wrong_shapes_and_names_are_refused():
    image, flow = np.zeros((4, 4)), np.zeros((4, 5, 2))
    with pytest.raises(DataError, match="expected shape \\(4, 4, 2\\)"):
        warp(image, flow)
    with pytest.raises(ConfigurationError, match="linear, cubic"):
        warp(image, np.zeros((4, 4, 2)), "lanczos")
    with pytest.raises(DataError):
        inside(np.zeros((2, 4, 4, 2)))

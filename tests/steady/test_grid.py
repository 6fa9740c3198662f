"""The coarser grid that displacements live on."""

import cv2
import numpy as np
import pytest
from shaken_scenes import photo, shaken

from turbrestore.registration.flow_algebra import compose_flows
from turbrestore.steady.camera_path.camera import camera_flow, fit_camera
from turbrestore.steady.dewarping import _measure
from turbrestore.steady.grid import enlarged, follow, grid_of, inverted, reduced
from turbrestore.steady.windows import iter_windows

TURN = np.array([[0.01, 0.02, 1.5], [-0.02, 0.005, -0.7]])


@pytest.mark.parametrize("shape", [(64, 90), (128, 160), (131, 257)])
def test_a_motion_of_the_camera_is_the_same_on_the_grid_and_on_the_image(shape):
    grid, whole = grid_of(shape), camera_flow(TURN, shape)
    on_grid = camera_flow(TURN, shape, grid)
    assert on_grid.shape == (*grid, 2)
    assert np.abs(enlarged(on_grid, shape) - whole)[2:-2, 2:-2].max() < 1e-4
    mean = cv2.resize(whole, grid[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(on_grid - mean).max() < 1e-4
    assert np.allclose(fit_camera(on_grid, shape), TURN, atol=1e-5)


def test_flows_of_the_grid_are_pixels_of_the_image():
    shape = (131, 257)
    ramp = np.tile(np.arange(shape[1], dtype=np.float32), (shape[0], 1))
    moved = follow(reduced(ramp), np.full((*grid_of(shape), 2), (3.0, 0.0), np.float32), shape)
    assert np.abs(moved - reduced(ramp) - 3)[:, 2:-4].max() < 1e-3
    flow = camera_flow(TURN, shape, grid_of(shape))
    # What leads out of the image has no inverse.
    both = compose_flows(enlarged(flow, shape), enlarged(inverted(flow, shape), shape))
    assert np.abs(both)[8:-8, 8:-8].max() < 5e-3


def test_a_flow_that_stretches_by_a_third_is_inverted():
    shape = (128, 192)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    flow = np.stack([8 * np.sin(x / 24) * np.cos(y / 24), 5 * np.cos(x / 30)], -1).astype(np.float32)
    both = compose_flows(flow, enlarged(inverted(cv2.resize(flow, grid_of(shape)[::-1]), shape), shape))
    assert np.abs(both)[16:-16, 16:-16].max() < 0.15


def test_flow_to_an_earlier_frame_undoes_that_from_there():
    frames = shaken([photo()] * 3, rms=2.0)
    windows = list(iter_windows(frames, (1, 2)))
    later, earlier = (enlarged(_measure(windows[k])[0][2 - 2 * k], frames[0].shape) for k in (0, 2))
    assert np.abs(compose_flows(later, earlier))[8:-8, 8:-8].mean() < 0.02
    assert np.abs(later + earlier)[8:-8, 8:-8].mean() > 0.1

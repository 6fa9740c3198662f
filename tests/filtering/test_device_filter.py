"""The filter with torch finds what it finds on the CPU; torch on the CPU stands in for a GPU."""

import numpy as np
import pytest
from torch_devices import DEVICES, frames_of, on_devices

from conftest import SCENES, make_sequence
from turbrestore.core.arrays import luminance
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import filter_frames
from turbrestore.filtering.filter_records import FilterParams
from turbrestore.filtering.frame_noise import warp_frame
from turbrestore.runtime.image_stacks import load, store
from turbrestore.runtime.runtime import Runtime

SIZE = 72


def coloured(scene):
    return np.stack([scene, scene**2, 1 - scene], axis=-1).astype(np.float32)


def filter_both(frames, flows, known, device, **settings):
    """Filter on the CPU and on a device."""
    image, dynamics, params = frames.mean(axis=0), identify(flows), FilterParams(inner_iterations=1, **settings)
    here, there = (
        filter_frames(frames, image, dynamics, params, known_flows=known, runtime=Runtime(device=name))
        for name in ("cpu", device)
    )
    assert there.image.dtype == there.variance.dtype == np.float32
    return here, there


def assert_alike(here, there, tolerance):
    for name in ("gains", "sharpness", "shares", "innovations"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-3)
    assert there.variance == pytest.approx(here.variance, rel=1e-3)
    assert np.abs(here.image - there.image).max() < tolerance


@on_devices
@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("sharpness", [2.0, 0.0])
def test_image_and_variance_are_those_of_the_cpu(device, colour, sharpness):
    scene = SCENES["camera"](SIZE)[:, :-5]
    frames, flows = frames_of(coloured(scene) if colour else scene, 6, seed=4)
    both = filter_both(frames, flows, flows, device, sharpness=sharpness, image_drift=1e-4, prior_frames=2)
    assert_alike(*both, 1e-5)


@on_devices
def test_folds_and_samples_beyond_the_frame_count_as_little(device):
    frames, flows = frames_of(SCENES["camera"](SIZE), 6, seed=4)
    torn = flows + np.random.default_rng(5).normal(0, 0.8, flows.shape).astype(np.float32)
    here, there = filter_both(frames, torn, torn, device)
    assert_alike(here, there, 1e-4)
    assert here.variance.mean() > 2 * filter_both(frames, flows, flows, device)[0].variance.mean()


@on_devices
def test_a_foreign_frame_has_a_finite_noise_however_much_sharpness_counts(device):
    frames, flows = frames_of(SCENES["camera"](SIZE), 12, seed=4)
    known = flows.copy()
    # Its gradient is against that of the scene, and its flow folds.
    frames[8] = 1 - frames[8]
    known[8] += np.random.default_rng(5).normal(0, 3, flows[8].shape).astype(np.float32)
    here, there = filter_both(frames, flows, known, device, sharpness=10.0)
    for found in (here, there):
        assert np.isfinite(found.image).all()
        assert np.isfinite(found.variance).all()
        assert found.variance.min() > 0
    assert np.abs(here.image - there.image).max() < 1e-4
    assert here.shares[8] < 0.01


@on_devices
def test_frames_that_do_not_count_and_measured_flows(device):
    sequence = make_sequence(seed=14, count=10, size=64)
    frames = [None if number in (2, 7) else frame for number, frame in enumerate(sequence.frames)]
    dynamics, params = identify(sequence.flows), FilterParams(block=4)
    here, there = (
        filter_frames(frames, sequence.scene, dynamics, params, runtime=Runtime(device=name))
        for name in ("cpu", device)
    )
    assert np.abs(here.image - there.image).mean() < 1e-3
    assert (np.isnan(here.sharpness) == np.isnan(there.sharpness)).all()
    assert np.isnan(here.sharpness).sum() == 2


@pytest.mark.parametrize("device", ["cpu", *DEVICES])
def test_a_warped_frame_has_its_luminance_and_pixels_come_back(device):
    image = coloured(SCENES["camera"](20))
    flow = np.full((20, 20, 2), 0.75, np.float32)
    channels, grey, seen = map(store, warp_frame(image, load(flow, device)))
    assert channels.shape == (3, 20, 20)
    assert grey == pytest.approx(luminance(np.ascontiguousarray(np.moveaxis(channels, 0, -1))), abs=1e-6)
    assert seen[:19, :19].min() == 1
    assert seen[19, 5] == pytest.approx(0.25)

"""Flow and warps on a device give what they give on the CPU; torch on the CPU stands in for a GPU."""

from dataclasses import replace

import numpy as np
import pytest
from torch_devices import frames_of, on_devices

from turbrestore.registration.flow import FlowParams, estimate_flow
from turbrestore.registration.flow_methods.tvl1 import prepare_tvl1, tvl1_flows
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import Runtime
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

SIZE = 72
TVL1 = FlowParams(method="tvl1")


def both(function, device):
    return function(Runtime()), function(Runtime(device=device))


@on_devices
def test_flows_are_those_of_the_cpu(device):
    frames, _ = frames_of(SCENES["camera"](SIZE, SIZE + 9), 3, seed=0)
    here, there = both(lambda runtime: estimate_flow(frames.mean(axis=0), frames, TVL1, runtime), device)
    apart = np.linalg.norm(here - there, axis=-1)
    assert apart.mean() < 1e-3
    assert apart.max() < 0.02


@on_devices
def test_large_motion_and_a_start(device):
    frames, flows = frames_of(SCENES["brick"](SIZE, SIZE), 2, rms=3.0, seed=1)
    grey = 255 * frames
    here, there = (tvl1_flows(grey, prepare_tvl1(grey.mean(axis=0), device=d), flows) for d in ("cpu", device))
    assert np.linalg.norm(here.flows - there.flows, axis=-1).mean() < 1e-3
    assert (here.warps == there.warps).all()
    assert (here.settled == there.settled).all()


@on_devices
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_do_not_matter(device, batch):
    frames, _ = frames_of(SCENES["camera"](48, 48), 5, seed=2)
    small = replace(TVL1, tvl1=replace(TVL1.tvl1, batch=batch))
    one, other = (estimate_flow(frames[0], frames, params, Runtime(device=device)) for params in (TVL1, small))
    assert np.abs(one - other).max() < 1e-3


@on_devices
def test_methods_of_opencv_run_on_the_cpu(device):
    frames, _ = frames_of(SCENES["camera"](48, 48), 2, seed=3)
    here, there = both(lambda runtime: estimate_flow(frames[0], frames, FlowParams(), runtime), device)
    assert here.tobytes() == there.tobytes()


@on_devices
@pytest.mark.parametrize("colour", [False, True])
def test_warps_are_those_of_the_cpu(device, colour):
    scene = SCENES["camera"](50, 64)
    image = np.stack([scene, scene**2, 1 - scene], axis=-1) if colour else scene
    flow = smooth_flows(1, 50, 64, np.random.default_rng(6), SmoothFlowParams(rms=6.0, correlation_length=5.0))[0]
    assert np.abs(warp(image, flow) - warp(image, flow, device=device)).max() < 1e-5

"""Devices on which torch is tested: its CPU, which stands in for a GPU, and a GPU where there is one."""

from importlib.util import find_spec

import numpy as np
import pytest

from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

NO_TORCH = pytest.mark.skipif(find_spec("torch") is None, reason="torch is not installed")


def _devices():
    if find_spec("torch") is None:
        return [pytest.param("cpu:0", marks=NO_TORCH)]
    import torch

    return ["cpu:0", *(["cuda"] if torch.cuda.is_available() else [])]


DEVICES = _devices()
on_devices = pytest.mark.parametrize("device", DEVICES)


def frames_of(scene, count, seed, rms=1.5):
    """Frames of a scene in turbulent motion, and the flows."""
    rng = np.random.default_rng(seed)
    params = SmoothFlowParams(rms=rms, correlation_length=8.0, persistence=0.5)
    flows = smooth_flows(count, *scene.shape[:2], rng, params)
    return distort(scene, flows, rng, blur=0.8, noise=0.01), flows

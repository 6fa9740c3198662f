"""A whole restoration on a device is that of the CPU; torch on the CPU stands in for a GPU."""

import sys

import numpy as np
import pytest
from torch_devices import NO_TORCH, frames_of, on_devices

from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError
from turbrestore.filtering.filter_records import FilterParams
from turbrestore.metrics import psnr
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams
from turbrestore.runtime import device as device_module
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.scenes import SCENES
from turbrestore_cli.__main__ import main

TVL1 = FlowParams(method="tvl1")


@on_devices
def test_the_image_is_that_of_the_cpu(device):
    scene = SCENES["camera"](64, 72)
    frames = frames_of(scene, 8, seed=13)[0]
    here = restore(frames, RestoreParams(flow=TVL1))
    there, again = (restore(frames, RestoreParams(flow=TVL1), Runtime(device=device)) for _ in range(2))
    for a, b in ((here.centroid, there.centroid), (here.filtered, there.filtered), (here, there)):
        assert abs(psnr(a.image, scene) - psnr(b.image, scene)) < 0.02
    assert np.linalg.norm(here.centroid.flows - there.centroid.flows, axis=-1).mean() < 0.02
    assert there.filtered.shares == pytest.approx(here.filtered.shares, rel=1e-2)
    assert there.image.tobytes() == again.image.tobytes()
    assert Decision("device", device, "asked for") in there.decisions
    assert not any(decision.subject == "device" for decision in here.decisions)


@on_devices
def test_arrays_that_cannot_be_written(device):
    frames = frames_of(SCENES["camera"](64, 64), 3, seed=16)[0]
    frames.flags.writeable = False
    before = frames.copy()
    restore(frames, RestoreParams(flow=TVL1), Runtime(device=device))
    assert frames.tobytes() == before.tobytes()


@on_devices
@pytest.mark.parametrize(
    ("place", "advice", "params"),
    [
        ("registration.flow_methods.tvl1.tvl1_flows", "lower flow.tvl1.batch", RestoreParams(flow=TVL1)),
        ("registration.warp.warp_stack", "process a smaller part .*", RestoreParams()),
        ("filtering.frame_noise.warp_stack", "process a smaller part .*", RestoreParams(filter=FilterParams())),
    ],
)
def test_what_to_do_is_said_where_the_memory_of_the_device_is_too_small(device, place, advice, params, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("CUDA out of memory.")

    frames = frames_of(SCENES["camera"](48, 48), 3, seed=17)[0]
    monkeypatch.setattr(f"turbrestore.{place}", fail)
    line = f"^device: the memory of '{device[:3]}.* is not enough; {advice} or use 'cpu'$"
    with pytest.raises(ConfigurationError, match=line):
        restore(frames, params, Runtime(device=device))


def test_auto_is_settled_before_the_stages(monkeypatch):
    monkeypatch.setattr(device_module, "_cuda_is_there", lambda: False)
    frames = frames_of(SCENES["camera"](64, 64), 3, seed=15)[0]
    params = RestoreParams(until="centroid", centroid=CentroidParams(iterations=1))
    here, there = (restore(frames, params, Runtime(device=name)) for name in ("cpu", "auto"))
    assert here.image.tobytes() == there.image.tobytes()
    assert there.decisions[0] == Decision("device", "CPU", "torch sees no GPU")


def test_without_torch_a_device_ends_the_command_before_it_keeps_anything(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    np.save(tmp_path / "in.npy", np.random.default_rng(0).random((3, 32, 32)).astype(np.float32))
    words = ["restore", str(tmp_path / "in.npy"), str(tmp_path / "out.png"), "--device", "cuda"]
    assert main([*words, "--keep", str(tmp_path / "kept")]) == 2
    assert "--device: expected torch for 'cuda', which is not installed" in capsys.readouterr().err
    assert not list(tmp_path.glob("**/*.npz"))


@NO_TORCH
def test_a_device_that_is_not_there_ends_the_command(tmp_path, capsys, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    np.save(tmp_path / "in.npy", np.random.default_rng(0).random((3, 32, 32)).astype(np.float32))
    assert main(["restore", str(tmp_path / "in.npy"), str(tmp_path / "out.png"), "--device", "cuda"]) == 2
    said = "torch sees no CUDA device here, found 'cuda'; use 'cpu' or 'auto'"
    assert capsys.readouterr().err.strip().endswith(said)
    assert not (tmp_path / "out.png").exists()

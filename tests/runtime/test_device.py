"""Every stage on a device finds what it finds on the processor; torch on the processor stands in for a GPU."""

import subprocess
import sys
import textwrap
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from turbrestore import settings as restoration_module
from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import FilterParams, filter_frames
from turbrestore.footage.frame_selection import Share
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams, estimate_flow
from turbrestore.registration.tvl1 import refer_tvl1, tvl1_flows
from turbrestore.registration.warp import warp
from turbrestore.runs.resumption import stage_facts
from turbrestore.runtime import device as device_module
from turbrestore.runtime.device import TORCH_BYTES, check_device, explain_device, find_device, memory_of, needs_torch
from turbrestore.settings import RestoreParams, explain_devices, place_stages
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows
from turbrestore_cli.__main__ import main

SIZE = 72
NO_TORCH = pytest.mark.skipif(find_spec("torch") is None, reason="torch is not installed")


def devices():
    """Names to test: torch on the processor, and a GPU where there is one."""
    if find_spec("torch") is None:
        return [pytest.param("cpu:0", marks=NO_TORCH)]
    import torch

    return ["cpu:0", *(["cuda"] if torch.cuda.is_available() else [])]


on_devices = pytest.mark.parametrize("device", devices())


def psnr(image, truth):
    return -10 * np.log10(np.mean(np.square(image - truth)))


def frames_of(scene, count, rms=1.5, seed=0, length=8.0):
    """Frames of a scene in turbulent motion, and the flows."""
    rng = np.random.default_rng(seed)
    params = SmoothFlowParams(rms=rms, correlation_length=length, persistence=0.5)
    flows = smooth_flows(count, *scene.shape[:2], rng, params)
    return distort(scene, flows, rng, blur=0.8, noise=0.01), flows


def coloured(scene):
    return np.stack([scene, scene**2, 1 - scene], axis=-1).astype(np.float32)


class TestChoice:
    def test_the_processor_needs_no_torch(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "torch", None)
        assert find_device("cpu") == find_device("auto") == "cpu"

    @NO_TORCH
    @pytest.mark.parametrize(("there", "found"), [(False, "cpu"), (True, "cuda")])
    def test_auto_takes_a_gpu_where_torch_sees_one(self, there, found, monkeypatch):
        monkeypatch.setattr(device_module, "_may_have_gpu", lambda: True)
        monkeypatch.setattr(device_module, "_cuda_is_there", lambda: there)
        assert find_device("auto") == found

    def test_missing_torch_is_named(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "torch", None)
        with pytest.raises(
            ConfigurationError, match=r"^device: torch is not installed, found 'cuda'; install .* 'cpu'$"
        ):
            find_device("cuda")

    @NO_TORCH
    def test_missing_gpu_is_named(self, monkeypatch):
        import torch

        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        with pytest.raises(
            ConfigurationError, match=r"^device: torch sees no CUDA device here, found 'cuda:1'; use 'cpu'"
        ):
            find_device("cuda:1")

    @NO_TORCH
    @pytest.mark.parametrize("name", ["gpu", "mps", "meta", "meta:x", "quantum:3", "hpu"])
    def test_unknown_names_are_named(self, name):
        with pytest.raises(ConfigurationError, match=f"^device: .*'{name}'"):
            find_device(name)

    @pytest.mark.parametrize("name", ["", "GPU", "cuda 1", "cuda:", None, 0])
    def test_settings_are_checked_without_torch(self, name, monkeypatch):
        monkeypatch.setitem(sys.modules, "torch", None)
        with pytest.raises(ConfigurationError, match="^device: expected auto, cpu, cuda"):
            check_device(name)
        for settings in (FlowParams, FilterParams, DeconvolutionParams):
            if name is None:
                assert settings(device=name).device is None
            else:
                with pytest.raises(ConfigurationError, match="^device: expected auto, cpu, cuda"):
                    settings(device=name)

    @pytest.mark.parametrize(
        ("system", "nodes", "library", "asked"),
        [
            ("linux", ["null", "nvme0", "dri"], False, False),
            ("linux", ["nvidiactl"], False, True),
            ("linux", ["kfd"], False, True),
            ("linux", ["dxg"], False, True),
            ("linux", [], True, True),
            ("darwin", ["nvidiactl"], True, False),
            ("win32", [], False, True),
        ],
    )
    def test_auto_loads_torch_where_there_may_be_a_gpu(self, system, nodes, library, asked, monkeypatch, tmp_path):
        import_of = SimpleNamespace(cuda=SimpleNamespace(is_available=lambda: asked_for.append(1) or True))
        asked_for = []

        def load(name):
            assert name == "libcuda.so.1"
            if not library:
                raise OSError(name)

        monkeypatch.setattr(device_module.sys, "platform", system)
        monkeypatch.setattr(device_module, "_DEVICES", tmp_path)
        monkeypatch.setattr(device_module.ctypes, "CDLL", load)
        monkeypatch.setattr(device_module.importlib.util, "find_spec", lambda name: name)
        monkeypatch.setitem(sys.modules, "torch", import_of)
        for node in nodes:
            (tmp_path / node).touch()
        assert find_device("auto") == ("cuda" if asked else "cpu")
        assert bool(asked_for) is needs_torch("auto") is asked

    @NO_TORCH
    def test_memory_that_torch_takes_is_known(self):
        script = """
            import re, numpy, cv2, scipy
            from pathlib import Path
            import turbrestore.settings
            def most():
                return 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
            before = most()
            import torch
            float(torch.fft.rfft2(torch.ones(64, 64)).abs().sum(dtype=torch.float64))
            print(most() - before, torch.version.cuda or torch.version.hip or "")
        """
        # Only Linux tells a process the most memory that it has taken since it began, without a library.
        if not Path("/proc/self/status").exists():
            pytest.skip("the system does not say how much memory a process takes")
        words = [sys.executable, "-c", textwrap.dedent(script)]
        taken, *build = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
        assert int(taken) > 0.5 * TORCH_BYTES
        assert build or int(taken) < 1.2 * TORCH_BYTES

    def test_what_is_said(self):
        def told(wanted, found, method, **own):
            return explain_device(wanted, found, {"optical flow": found, "filter": found, **own}, method)

        assert told("cpu", "cpu", "tvl1") == ()
        assert told("auto", "cpu", "dis") == (Decision("device", "processor", "no GPU that torch sees"),)
        assert told("cuda", "cuda", "tvl1") == (Decision("device", "cuda", "asked for"),)
        first, second = told("auto", "cuda", "farneback")
        assert (first.choice, second.choice) == ("cuda", "on the processor")
        assert "farneback" in second.reason
        assert told("cpu", "cpu", "dis", filter="cuda") == (Decision("filter", "on cuda", "a setting of its own"),)
        own = told("cuda", "cuda", "tvl1", **{"optical flow": "cpu"})
        assert own[1:] == (Decision("optical flow", "on the processor", "a setting of its own"),)
        assert [item.subject for item in told("cpu", "cpu", "dis", **{"optical flow": "cuda"})] == ["optical flow"]

    def test_lack_of_memory_is_one_line_and_other_errors_are_not(self):
        line = r"^device: the memory of 'cuda:1' is not enough; lower --flow.tvl1.batch or use 'cpu'$"
        for said in ("CUDA out of memory. Tried 2 GiB", "[enforce] DefaultCPUAllocator: not enough memory: you tried"):
            with pytest.raises(ConfigurationError, match=line), memory_of("cuda:1", "lower --flow.tvl1.batch"):
                raise RuntimeError(said)
        with pytest.raises(RuntimeError, match="^a bug$"), memory_of("cuda", "lower the batch"):
            raise RuntimeError("a bug")


@on_devices
class TestFlow:
    def test_flows_are_those_of_the_processor(self, device):
        frames, _ = frames_of(SCENES["camera"](SIZE, SIZE + 9), 3)
        mean = frames.mean(axis=0)
        here, there = (estimate_flow(mean, frames, FlowParams(method="tvl1", device=d)) for d in ("cpu", device))
        apart = np.linalg.norm(here - there, axis=-1)
        assert apart.mean() < 1e-3
        assert apart.max() < 0.02

    def test_large_motion_and_a_start(self, device):
        frames, flows = frames_of(SCENES["brick"](SIZE, SIZE), 2, rms=3.0, seed=1)
        grey = 255 * frames
        here, there = (tvl1_flows(grey, refer_tvl1(grey.mean(axis=0), device=d), flows) for d in ("cpu", device))
        assert np.linalg.norm(here.flows - there.flows, axis=-1).mean() < 1e-3
        assert (here.warps == there.warps).all()
        assert (here.settled == there.settled).all()

    @pytest.mark.parametrize("batch", [1, 2, 5])
    def test_batches_do_not_matter(self, device, batch):
        frames, _ = frames_of(SCENES["camera"](48, 48), 5, seed=2)
        params = FlowParams(method="tvl1", device=device)
        small = replace(params, tvl1=replace(params.tvl1, batch=batch))
        apart = estimate_flow(frames[0], frames, params) - estimate_flow(frames[0], frames, small)
        assert np.abs(apart).max() < 1e-3

    def test_methods_of_opencv_stay_where_they_are(self, device):
        frames, _ = frames_of(SCENES["camera"](48, 48), 2, seed=3)
        here, there = (estimate_flow(frames[0], frames, FlowParams(device=d)) for d in ("cpu", device))
        assert here.tobytes() == there.tobytes()


@on_devices
class TestMemory:
    @pytest.mark.parametrize(
        ("place", "advice", "settings"),
        [
            ("registration.flow.tvl1_flows", "lower --flow.tvl1.batch", {"flow": FlowParams(method="tvl1")}),
            ("registration.warp.warp_stack", "take a smaller --roi", {}),
            ("filtering.torch_fusion.warp_stack", "take a smaller --roi", {}),
        ],
    )
    def test_what_to_do_is_said_where_it_is_not_enough(self, device, place, advice, settings, monkeypatch):
        def fail(*_):
            raise RuntimeError("CUDA out of memory.")

        monkeypatch.setattr(f"turbrestore.{place}", fail)
        frames, _ = frames_of(SCENES["camera"](48, 48), 3, seed=17)
        line = f"^device: the memory of '{device[:3]}.* is not enough; {advice} or use 'cpu'$"
        with pytest.raises(ConfigurationError, match=line):
            restore(frames, RestoreParams(device=device, **settings))


@on_devices
class TestFusion:
    def run(self, scene, device, spread=0.0, **settings):
        """Fuse frames here and there; the flows have some noise, and so fold, where ``spread`` is large."""
        frames, flows = frames_of(scene, 6, seed=4)
        flows += np.random.default_rng(5).normal(0, spread, flows.shape).astype(np.float32)
        image, dynamics = frames.mean(axis=0), identify(flows)
        params = FilterParams(inner_iterations=1, **settings)
        here, there = (
            filter_frames(frames, image, dynamics, replace(params, device=d), known_flows=flows)
            for d in ("cpu", device)
        )
        for name in ("gains", "sharpness", "shares", "innovations"):
            assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-3)
        assert there.image.dtype == there.variance.dtype == np.float32
        assert there.variance == pytest.approx(here.variance, rel=1e-3)
        return here, there

    @pytest.mark.parametrize("colour", [False, True])
    @pytest.mark.parametrize("sharpness", [2.0, 0.0])
    def test_image_and_variance_are_those_of_the_processor(self, device, colour, sharpness):
        scene = SCENES["camera"](SIZE, SIZE + 5)
        scene = coloured(scene) if colour else scene
        here, there = self.run(scene, device, sharpness=sharpness, image_drift=1e-4, prior_frames=2)
        assert np.abs(here.image - there.image).max() < 1e-5

    def test_folds_and_samples_beyond_the_frame_count_as_little(self, device):
        scene = SCENES["camera"](SIZE, SIZE)
        here, there = self.run(scene, device, spread=0.8)
        calm, _ = self.run(scene, device)
        assert here.variance.mean() > 2 * calm.variance.mean()
        assert np.abs(here.image - there.image).max() < 1e-4

    def test_a_foreign_frame_has_a_finite_noise_however_much_sharpness_counts(self, device):
        scene = SCENES["camera"](SIZE, SIZE)
        frames, flows = frames_of(scene, 12, seed=4)
        image, dynamics = frames.mean(axis=0), identify(flows)
        # Its gradient is against that of the scene, and its flow folds.
        frames[8] = 1 - frames[8]
        flows[8] += np.random.default_rng(5).normal(0, 3, flows[8].shape).astype(np.float32)
        params = FilterParams(inner_iterations=1, sharpness=10.0)
        here, there = (
            filter_frames(frames, image, dynamics, replace(params, device=d), known_flows=flows)
            for d in ("cpu", device)
        )
        for found in (here, there):
            assert np.isfinite(found.image).all()
            assert np.isfinite(found.variance).all()
            assert found.variance.min() > 0
        assert np.abs(here.image - there.image).max() < 1e-4
        assert here.shares[8] < 0.01

    def test_warp(self, device):
        scene = SCENES["camera"](50, 64)
        flow = smooth_flows(1, 50, 64, np.random.default_rng(6), SmoothFlowParams(rms=6.0, correlation_length=5.0))[0]
        for image in (scene, coloured(scene)):
            assert np.abs(warp(image, flow) - warp(image, flow, device=device)).max() < 1e-5


@on_devices
class TestRestoration:
    FLOW = FlowParams(method="tvl1")

    def test_image_is_that_of_the_processor(self, device):
        scene = SCENES["camera"](SIZE, SIZE + 8)
        frames, _ = frames_of(scene, 12, seed=13)
        here = restore(frames, RestoreParams(flow=self.FLOW))
        there, again = (restore(frames, RestoreParams(flow=self.FLOW, device=device)) for _ in range(2))
        for a, b in ((here.centroid, there.centroid), (here.filtered, there.filtered), (here, there)):
            assert abs(psnr(a.image, scene) - psnr(b.image, scene)) < 0.02
        assert np.linalg.norm(here.centroid.flows - there.centroid.flows, axis=-1).mean() < 0.02
        assert there.filtered.shares == pytest.approx(here.filtered.shares, rel=1e-2)
        assert there.image.tobytes() == again.image.tobytes()
        assert Decision("device", device, "asked for") in there.decisions
        assert not any(decision.subject == "device" for decision in here.decisions)

    def test_arrays_that_cannot_be_written(self, device):
        frames, _ = frames_of(SCENES["camera"](64, 64), 3, seed=16)
        frames.flags.writeable = False
        before = frames.copy()
        restore(frames, RestoreParams(flow=self.FLOW, device=device))
        assert frames.tobytes() == before.tobytes()

    def test_frames_that_do_not_count_and_blur_as_noise(self, device):
        scene = coloured(SCENES["camera"](64, 64))
        frames, _ = frames_of(scene, 8, seed=14)
        for changes in ({"keep_best": Share(0.5)}, {"filter": FilterParams(frame_noise="blur", inner_iterations=1)}):
            params = RestoreParams(until="filter", **changes)
            here, there = (restore(frames, replace(params, device=d)) for d in ("cpu", device))
            assert abs(psnr(here.image, scene) - psnr(there.image, scene)) < 0.02
            assert (np.isnan(here.filtered.sharpness) == np.isnan(there.filtered.sharpness)).all()


class TestPlacing:
    def test_a_stage_keeps_a_device_of_its_own(self, monkeypatch):
        monkeypatch.setattr(restoration_module, "find_device", lambda wanted: wanted)
        own = {"flow": FlowParams(device="cpu"), "filter": FilterParams(device="cuda:1")}
        placed = place_stages(RestoreParams(device="cuda", **own))
        assert (placed.flow.device, placed.filter.device, placed.deconvolution.device) == ("cpu", "cuda:1", "cuda")
        assert place_stages(placed) == placed
        assert [(item.subject, item.choice) for item in explain_devices(placed)] == [
            ("device", "cuda"),
            ("optical flow", "on the processor"),
            ("filter", "on cuda:1"),
        ]

    @pytest.mark.parametrize("stage", ["flow", "filter", "deconvolution"])
    def test_the_device_of_a_stage_is_looked_for_before_the_first(self, stage, tmp_path, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "torch", None)
        np.save(tmp_path / "in.npy", np.random.default_rng(0).random((3, 32, 32)).astype(np.float32))
        words = ["restore", str(tmp_path / "in.npy"), str(tmp_path / "out.png"), f"--{stage}.device", "cuda"]
        assert main([*words, "--keep", str(tmp_path / "kept")]) == 2
        assert "device: torch is not installed, found 'cuda'" in capsys.readouterr().err
        assert not list(tmp_path.glob("**/*.npz"))

    def test_auto_of_a_stage_is_settled_in_what_is_kept(self, monkeypatch):
        monkeypatch.setattr(device_module, "_cuda_is_there", lambda: False)
        source = FrameSource.from_array(np.zeros((5, 16, 16)))
        auto = RestoreParams(filter=FilterParams(device="auto"), deconvolution=DeconvolutionParams(device="auto"))
        assert stage_facts(source, auto) == stage_facts(source, RestoreParams())

    def test_auto_is_settled_before_the_stages(self, monkeypatch):
        monkeypatch.setattr(device_module, "_cuda_is_there", lambda: False)
        frames, _ = frames_of(SCENES["camera"](64, 64), 3, seed=15)
        params = RestoreParams(until="centroid", centroid=CentroidParams(iterations=1))
        here, there = (restore(frames, replace(params, device=d)) for d in ("cpu", "auto"))
        assert here.image.tobytes() == there.image.tobytes()
        assert there.decisions[0] == Decision("device", "processor", "no GPU that torch sees")

    @NO_TORCH
    def test_a_device_that_is_not_there_ends_the_command_before_it_reads(self, tmp_path, capsys, monkeypatch):
        import torch

        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        np.save(tmp_path / "in.npy", np.random.default_rng(0).random((3, 32, 32)).astype(np.float32))
        assert main(["restore", str(tmp_path / "in.npy"), str(tmp_path / "out.png"), "--device", "cuda"]) == 2
        assert capsys.readouterr().err.strip().endswith("found 'cuda'; use 'cpu' or 'auto'")
        assert not (tmp_path / "out.png").exists()

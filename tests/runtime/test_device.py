"""How a device is chosen, and what is said where it is not there or has too little memory."""

import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import pytest
from torch_devices import NO_TORCH

from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError
from turbrestore.runtime import device as device_module
from turbrestore.runtime.device import TORCH_BYTES, check_device, explain_device, find_device, memory_of, needs_torch
from turbrestore.runtime.runtime import Runtime


class TestChoice:
    def test_the_cpu_needs_no_torch(self, monkeypatch):
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
            ConfigurationError, match=r"^device: expected torch for 'cuda', .*pip install .*torch.* or use cpu$"
        ):
            find_device("cuda")

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
        with pytest.raises(ConfigurationError, match="^device: expected auto, cpu, cuda"):
            Runtime(device=name)

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
    # Without a library only Linux tells a process the most memory that it has taken since it began.
    @pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
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
        words = [sys.executable, "-c", textwrap.dedent(script)]
        taken, *build = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
        assert int(taken) > 0.5 * TORCH_BYTES
        assert build or int(taken) < 1.2 * TORCH_BYTES

    def test_what_is_said(self):
        assert explain_device("cpu", "cpu", "tvl1") == ()
        assert explain_device("auto", "cpu", "dis") == (Decision("device", "CPU", "torch sees no GPU"),)
        assert explain_device("cuda", "cuda", "tvl1") == (Decision("device", "cuda", "asked for"),)
        first, second = explain_device("auto", "cuda", "farneback")
        assert (first.choice, second.choice) == ("cuda", "on the CPU")
        assert "farneback" in second.reason

    def test_lack_of_memory_is_one_line_and_other_errors_are_not(self):
        line = r"^device: the memory of 'cuda:1' is not enough; lower flow.tvl1.batch or use 'cpu'$"
        for said in ("CUDA out of memory. Tried 2 GiB", "[enforce] DefaultCPUAllocator: not enough memory: you tried"):
            with pytest.raises(ConfigurationError, match=line), memory_of("cuda:1", "lower flow.tvl1.batch"):
                raise RuntimeError(said)
        with pytest.raises(RuntimeError, match="^a bug$"), memory_of("cuda", "lower the batch"):
            raise RuntimeError("a bug")

"""Where a stage computes: on the CPU with NumPy and OpenCV, or on a device with torch.

A device is named by a string: ``"cpu"`` is NumPy and OpenCV, ``"cuda"`` a GPU, and ``"auto"`` a GPU where torch sees
one and else ``"cpu"``.  Any other name that torch gives a device may be used from Python: ``"cuda:1"``, or ``"cpu:0"``,
which is torch on the CPU, for tests.  Every stage takes and returns NumPy arrays wherever it computes, and the results
agree to rounding.

torch is imported only when a device is asked for, because that takes two seconds and 200 MB.  ``"auto"`` imports it
only where there may be a GPU.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.decision import Decision
from ..core.errors import ConfigurationError, require
from ..core.extras import install_command

CPU = "cpu"
# Memory of the process that torch 2.13 takes once it is imported and has computed something on the CPU, bytes:
# 200 MB, and 270 MB the first time, when its modules are compiled as well.  Builds with CUDA take more.
TORCH_BYTES = 2.8e8
_NAME = re.compile(r"[a-z]+(:\d+)?")
# What a system with a GPU that torch can use has among its devices: NVIDIA's, those of its boards, AMD's, and that of
# the Windows Subsystem for Linux.  torch has no GPU of this kind under macOS; of other systems nothing is known.
_NODES = {"linux": ("nvidia*", "nvhost*", "nvmap", "kfd", "dxg"), "darwin": ()}
_DEVICES = Path("/dev")
_NO_GPU = "torch sees no GPU"
_NO_MEMORY = ("out of memory", "not enough memory")
_SMALLER = "process a smaller part of the frame (roi)"


def check_device(name: str) -> None:
    """Raise unless a setting looks like the name of a device; whether it is there is not asked."""
    known = isinstance(name, str) and _NAME.fullmatch(name) is not None
    require(known, f"device: expected auto, cpu, cuda or a name that torch knows, found {name!r}")


def find_device(wanted: str) -> str:
    """Name of the device that a setting means on this machine."""
    check_device(wanted)
    if wanted == CPU:
        return CPU
    if wanted == "auto":
        return "cuda" if needs_torch(wanted) and _cuda_is_there() else CPU
    try:
        import torch
    except ImportError as error:
        raise ConfigurationError(
            f"device: expected torch for {wanted!r}, which is not installed; run {install_command('torch')}, or use cpu"
        ) from error
    if wanted.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigurationError(f"device: torch sees no CUDA device here, found {wanted!r}; use 'cpu' or 'auto'")
    try:
        _compute_on(wanted)
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        raise ConfigurationError(f"device: torch has no {wanted!r} here; use 'cpu' or 'auto'") from error
    return wanted


def needs_torch(wanted: str | None) -> bool:
    """Tell whether torch is loaded to compute on a device, or only to ask for one."""
    if wanted == "auto":
        return importlib.util.find_spec("torch") is not None and _may_have_gpu()
    return wanted is not None and wanted != CPU


def explain_device(wanted: str, found: str, flow_method: str) -> tuple[Decision, ...]:
    """Put into words where a restoration computes."""
    if wanted == CPU:
        return ()
    if found == CPU:
        return (Decision("device", "CPU", _NO_GPU),)
    device = Decision("device", found, "asked for" if wanted == found else "torch sees this GPU")
    if flow_method == "tvl1":
        return (device,)
    reason = f"the method {flow_method} is OpenCV's, which runs on the CPU only; tvl1 runs on a device"
    return device, Decision("optical flow", "on the CPU", reason)


@contextmanager
def memory_of(device: str, advice: str = _SMALLER) -> Iterator[None]:
    """Say in one line that the memory of a device is not enough."""
    try:
        yield
    except RuntimeError as error:
        # torch has no exception of its own for a lack of memory on the CPU.
        if not any(said in str(error) for said in _NO_MEMORY):
            raise
        raise ConfigurationError(f"device: the memory of {device!r} is not enough; {advice} or use 'cpu'") from error


@functools.cache
def _compute_on(device: str) -> float:
    """Sum on a device: not every one that makes a tensor has numbers in it, or sums in double precision.

    Once is enough; waiting for the answer at every frame would hold a GPU up.
    """
    import torch

    return float(torch.ones(2, device=device).sum(dtype=torch.float64))


def _cuda_is_there() -> bool:
    import torch

    return torch.cuda.is_available()


def _may_have_gpu() -> bool:
    """Tell without torch, which takes long to load; False only where it is sure."""
    nodes = _NODES.get(sys.platform)
    if nodes is None or any(any(_DEVICES.glob(pattern)) for pattern in nodes):
        return True
    if not nodes:
        return False
    try:
        # NVIDIA's nodes may be missing until a program first uses a GPU, but none does without this library.
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True

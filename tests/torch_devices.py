"""Devices on which torch is tested: its CPU, which stands in for a GPU, and a GPU where there is one."""

from importlib.util import find_spec

import pytest

NO_TORCH = pytest.mark.skipif(find_spec("torch") is None, reason="torch is not installed")


def _devices():
    if find_spec("torch") is None:
        return [pytest.param("cpu:0", marks=NO_TORCH)]
    import torch

    return ["cpu:0", *(["cuda"] if torch.cuda.is_available() else [])]


DEVICES = _devices()
on_devices = pytest.mark.parametrize("device", DEVICES)

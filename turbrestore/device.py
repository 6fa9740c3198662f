"""Where a stage computes: on the processor with NumPy and OpenCV, or on a device with torch.

A device is a word: ``"cpu"`` is NumPy and OpenCV, ``"cuda"`` a GPU, and ``"auto"`` a GPU where torch sees one and else
``"cpu"``.  Any other name that torch gives a device may be used from Python: ``"cuda:1"``, or ``"cpu:0"``, which is
torch on the processor, for tests.  Every stage takes and gives NumPy arrays wherever it computes, and finds the same to
rounding.

torch is loaded when a device is asked for, and not before: that takes two seconds.
"""

from __future__ import annotations

import importlib.util
import re

from .decision import Decision
from .errors import ConfigurationError, require

PROCESSOR = "cpu"
_NAME = re.compile(r"[a-z]+(:\d+)?")
_INSTALL = "install turbrestore[torch] or use 'cpu'"


def check_device(name: str) -> None:
    """Raise unless a setting looks like the name of a device; whether it is there is not asked.

    Parameters
    ----------
    name : str
        What was set.

    Raises
    ------
    ConfigurationError
        It cannot be a name.

    Examples
    --------
    >>> check_device("cuda:1")
    >>> check_device("GPU 1")
    Traceback (most recent call last):
    ...
    turbrestore.errors.ConfigurationError: device: expected auto, cpu, cuda or a name that torch knows, found 'GPU 1'
    """
    known = isinstance(name, str) and _NAME.fullmatch(name) is not None
    require(known, f"device: expected auto, cpu, cuda or a name that torch knows, found {name!r}")


def find_device(wanted: str) -> str:
    """Name of the device that a setting means on this machine.

    Parameters
    ----------
    wanted : str
        ``"auto"``, ``"cpu"``, ``"cuda"`` or another of torch's names.

    Returns
    -------
    str
        ``"cpu"``: NumPy and OpenCV; any other: torch on the device of that name.

    Raises
    ------
    ConfigurationError
        A device other than ``"auto"`` and ``"cpu"`` was asked for and is not there, or torch is not installed.

    Examples
    --------
    >>> find_device("cpu")
    'cpu'
    """
    check_device(wanted)
    if wanted == PROCESSOR:
        return PROCESSOR
    if wanted == "auto":
        return "cuda" if importlib.util.find_spec("torch") is not None and _cuda_is_there() else PROCESSOR
    try:
        import torch
    except ImportError as error:
        raise ConfigurationError(f"device: torch is not installed, found {wanted!r}; {_INSTALL}") from error
    if wanted.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigurationError(f"device: torch sees no CUDA device here, found {wanted!r}; use 'cpu' or 'auto'")
    try:
        torch.empty(1, device=wanted)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ConfigurationError(f"device: torch has no {wanted!r} here; use 'cpu' or 'auto'") from error
    return wanted


def explain_device(wanted: str, found: str, flow_method: str) -> tuple[Decision, ...]:
    """Say where the stages computed.

    Parameters
    ----------
    wanted : str
        What was asked for.
    found : str
        From :func:`find_device`.
    flow_method : str
        Method of the optical flow; those of OpenCV stay on the processor.

    Returns
    -------
    tuple of Decision
        Empty where the processor was asked for.

    Examples
    --------
    >>> explain_device("cpu", "cpu", "dis")
    ()
    >>> explain_device("cuda", "cuda", "dis")[1].choice
    'on the processor'
    """
    if wanted == PROCESSOR:
        return ()
    if found == PROCESSOR:
        return (Decision("device", "processor", "no GPU that torch sees"),)
    chosen = Decision("device", found, "asked for" if wanted == found else "a GPU that torch sees")
    if flow_method == "tvl1":
        return (chosen,)
    reason = f"the method {flow_method} is OpenCV's and runs there only; tvl1 runs on a device"
    return chosen, Decision("optical flow", "on the processor", reason)


def _cuda_is_there() -> bool:
    import torch

    return torch.cuda.is_available()

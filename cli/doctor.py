"""``turbrestore doctor``: what this installation can do, and what to do about what it cannot.

Nothing but the standard library is imported at the top: a broken library is a finding, not a crash.
"""

from __future__ import annotations

import importlib.util
import json as json_format
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from types import ModuleType
from typing import Annotated, Literal

from cyclopts import Parameter

from turbrestore import __version__
from turbrestore.core.errors import TurbrestoreError
from turbrestore.core.extras import install_command
from turbrestore.runtime.device import needs_torch

from .streams import put

# Modules and distributions that every run needs, and those that extras add.
REQUIRED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-contrib-python-headless",
    "skimage": "scikit-image",
    "PIL": "pillow",
    "imageio": "imageio",
    "av": "av",
    "tifffile": "tifffile",
    "imagecodecs": "imagecodecs",
    "msgspec": "msgspec",
    "numba": "numba",
    "threadpoolctl": "threadpoolctl",
}
EXTRAS = {
    "torch": "torch",
    "matplotlib": "report",
    "jinja2": "report",
    "astropy": "fits",
    "rawpy": "raw",
    "pillow_heif": "heic",
    "distributed": "distributed",
    "nicegui": "app",
    "napari": "napari",
}
READ = ("h264", "ffv1", "hevc", "vp9", "mjpeg", "gif")
WRITTEN = ("ffv1", "libx264")
OLDEST_PYTHON = (3, 11)

State = Literal["ok", "missing", "warning", "broken"]


@dataclass(frozen=True)
class Finding:
    """What was found out about one part, and what to do about it."""

    name: str
    state: State
    found: str
    advice: str = ""


def doctor(*, json: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Check what this installation can do: libraries, video codecs, cores, GPU and extras.

    Ends with 1 if something that every run needs is broken; what is missing from the extras is no failure.

    Parameters
    ----------
    json : bool
        Print JSON.
    """
    findings = [finding for check in CHECKS for finding in check()]
    if json:
        record = {"turbrestore": __version__, "findings": [asdict(finding) for finding in findings]}
        put(json_format.dumps(record, indent=2))
    else:
        for item in findings:
            put(f"{item.state:<8} {item.name:<14} {item.found}")
            if item.advice:
                put(f"{'':<23} → {item.advice}")
    broken = [finding.name for finding in findings if finding.state == "broken"]
    if broken:
        raise TurbrestoreError(f"doctor: {', '.join(broken)} must work and does not; the report says what to do")


def check_python() -> Iterator[Finding]:
    """Versions of turbrestore and Python."""
    yield Finding("turbrestore", "ok", __version__)
    enough = sys.version_info[:2] >= OLDEST_PYTHON
    advice = "" if enough else "use Python 3.11 or newer"
    yield Finding("Python", "ok" if enough else "broken", f"{platform.python_version()} on {platform.system()}", advice)


def check_libraries() -> Iterator[Finding]:
    """Whether the libraries that every run needs load, in a version that will do."""
    for module, distribution in REQUIRED.items():
        yield check_library(module, distribution)


def check_library(module: str, distribution: str) -> Finding:
    """Load one module that every run needs, and compare its version with what turbrestore asks for."""
    bounds = required_versions(distribution)
    install = f"pip install '{distribution}{bounds}'"
    try:
        version = str(getattr(importlib.import_module(module), "__version__", "")) or metadata.version(distribution)
    except ModuleNotFoundError as error:
        return Finding(module, "broken", f"not installed ({error.name})", install)
    except Exception as error:  # a library that is damaged may raise anything
        return Finding(module, "broken", f"does not load: {_line(error)}", f"{install} --force-reinstall")
    state: State = "ok" if _fits(version, bounds) else "broken"
    return Finding(module, state, version, "" if state == "ok" else install)


def check_opencv() -> Iterator[Finding]:
    """Which packages bring cv2."""
    brought = sorted(set(metadata.packages_distributions().get("cv2", [])))
    wanted = REQUIRED["cv2"]
    repair = f"pip uninstall -y {' '.join(brought)} && pip install '{wanted}{required_versions(wanted)}'"
    if len(brought) > 1:
        yield Finding("cv2 package", "warning", f"{', '.join(brought)} overwrite each other's files", repair)
    elif brought:
        state: State = "ok" if brought == [wanted] else "warning"
        yield Finding("cv2 package", state, brought[0], "" if state == "ok" else repair)


def check_codecs() -> Iterator[Finding]:
    """Which videos can be read and written."""
    try:
        codec = importlib.import_module("av.codec")
    except Exception:  # reported with the libraries
        return
    for mode, names in (("read", READ), ("write", WRITTEN)):
        for name in names:
            known = _has_codec(codec, name, mode[0])
            advice = "" if known else "pip install --force-reinstall av  (its own wheels bring all codecs)"
            yield Finding(f"{mode} {name}", "ok" if known else "warning", "yes" if known else "no", advice)


def check_cores() -> Iterator[Finding]:
    """How many frames are worked on side by side."""
    there = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else there
    yield Finding("cores", "ok", f"{usable} usable of {there}; as many threads, unless --threads says otherwise")
    limits = [
        f"{name}={os.environ[name]}" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS") if name in os.environ
    ]
    if limits:
        yield Finding("thread limits", "ok", ", ".join(limits))


def check_extras() -> Iterator[Finding]:
    """Libraries that add something and may be missing; loading all of them takes seconds, so none is loaded."""
    for module, extra in EXTRAS.items():
        if importlib.util.find_spec(module) is None:
            yield Finding(module, "missing", "optional", install_command(extra))
            continue
        yield Finding(module, "ok", metadata.version(module))
        if module == "torch":
            yield _gpu(install_command(extra))


def required_versions(distribution: str) -> str:
    """Bounds that turbrestore sets on a package, as ``>=2.0``; empty where it is not installed itself.

    Examples
    --------
    >>> required_versions("no-such-package")
    ''
    """
    try:
        lines = metadata.requires("turbrestore") or []
    except metadata.PackageNotFoundError:
        return ""
    found = (re.fullmatch(r"([\w.-]+)\s*([<>=!~\d.,\s]*)(;.*)?", line) for line in lines)
    return next((match[2].strip() for match in found if match and match[1] == distribution), "")


def _fits(version: str, bounds: str) -> bool:
    """Whether a version lies within bounds such as ``<6,>=5``."""
    return all(
        (_numbers(version) >= _numbers(bound)) if sign == ">=" else (_numbers(version) < _numbers(bound))
        for sign, bound in re.findall(r"(>=|<)\s*([\d.]+)", bounds)
    )


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)[:3]]


def _has_codec(codec: ModuleType, name: str, mode: str) -> bool:
    try:
        codec.Codec(name, mode)
    except ValueError:
        return False
    return True


def _gpu(install: str) -> Finding:
    """Ask torch for its GPU, unless the machine has no device that could be one."""
    if needs_torch("auto"):
        try:
            import torch

            if torch.cuda.is_available():
                return Finding("GPU", "ok", torch.cuda.get_device_name(0))
        except Exception as error:  # a library that is damaged may raise anything
            return Finding("GPU", "warning", f"torch does not load: {_line(error)}", f"{install} --force-reinstall")
    return Finding("GPU", "missing", "optional; torch sees none and computes on the CPU")


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:120]


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_libraries,
    check_opencv,
    check_codecs,
    check_cores,
    check_extras,
)

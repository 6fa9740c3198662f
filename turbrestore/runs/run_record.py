"""What a run was: its input, settings and versions."""

from __future__ import annotations

import dataclasses
import functools
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from turbrestore import __version__

from ..core.arrays import FloatArray
from ..io.source import FrameSource
from ..settings import RestoreParams

_PACKAGES = (
    *("numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "av", "tifffile", "pillow", "numba", "torch"),
)


@dataclass(frozen=True, eq=False)
class RunRecord:
    """What a restoration was made from, and with what.

    Attributes
    ----------
    name : str
        Name of the input, without its folder.
    frame : ndarray, float32, shape (H, W) or (H, W, 3)
        One frame, from the middle.
    frame_number : int
        Its number in the file, from 0.
    source : str
        Format, depth and rate of the input, for people.
    settings : dict
        All settings, nested as in the settings file; None where left to be measured.
    command : tuple of str
        Words of a command that repeats the run; empty if there is none.
    warnings : tuple of str
        Remarks of the reader.
    versions : dict of str to str
        Of turbrestore, Python and the packages that compute.
    finished : str
        Time, ISO 8601, UTC.
    """

    name: str
    frame: FloatArray
    frame_number: int = 0
    source: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    command: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    finished: str = ""


def describe_run(
    source: FrameSource, settings: RestoreParams | Mapping[str, Any] | None = None, command: tuple[str, ...] = ()
) -> RunRecord:
    """Record what a restoration is made from; reads one frame.

    Parameters
    ----------
    source : FrameSource
        What was restored.
    settings : RestoreParams or mapping, optional
        Settings of the run.
    command : tuple of str
        Words of a command that repeats the run.

    Returns
    -------
    RunRecord

    Raises
    ------
    DataError
        The frame cannot be read.

    Examples
    --------
    >>> import numpy as np
    >>> record = describe_run(FrameSource.from_array(np.zeros((5, 4, 6), np.uint8), fps=25.0))
    >>> record.name, record.frame_number, record.source
    ('array', 2, 'array/uint8, 8 bits, 25 frames per second')
    """
    middle = len(source) // 2
    parts = [source.format, f"{source.bit_depth} bits"]
    if source.fps is not None:
        parts.append(f"{source.fps:g} frames per second")
    if not isinstance(settings, Mapping):
        settings = dataclasses.asdict(settings or RestoreParams())
    return RunRecord(
        name=source.name if source.path is None else source.path.resolve().name,
        frame=source.read(middle, middle + 1)[0],
        frame_number=source.numbers[middle],
        source=", ".join(parts),
        settings=dict(settings),
        command=command,
        warnings=source.warnings,
        versions=versions(),
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def versions() -> dict[str, str]:
    """Versions of turbrestore, Python and the packages that compute."""
    system = f"{platform.system()} {platform.machine()}"
    return {"turbrestore": __version__, "Python": platform.python_version(), **_package_versions(), "system": system}


@functools.cache
def _package_versions() -> dict[str, str]:
    """Versions of the packages that compute, each of which is read from a file of metadata."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found

"""The record of what a computation may use of the machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..core.errors import require
from .device import CPU, check_device
from .memory_size import MemorySize
from .threads import available_cores
from .tiling import HALO


@dataclass(frozen=True)
class Runtime:
    """What a computation may use of the machine: threads, memory, a device, and a folder for scratch files.

    The number of threads and the scratch folder never change a result.  A memory limit changes it only where fewer
    frames have to be trained on or frames have to be split into tiles; a device changes it by rounding.

    Parameters
    ----------
    threads : int
        Frames that are worked on side by side; 0 means one for each core that the process may use.
    memory_limit : MemorySize, optional
        Most memory that the process may take, such as 2GB.
    device : str
        Where flow by tvl1, warps, fusion and deconvolution are computed: cpu, cuda, or auto for a GPU where torch
        sees one.
    scratch : Path, optional
        Folder of the files that hold stacks of frames and flows.  A stage without it keeps them in memory; a whole
        restoration uses files where a memory limit or tiles ask for them, or memory would take more than 2.2 GB; by
        default among the temporary files.
    tile : int, optional
        Longest side of the tiles in which a restoration processes larger frames, pixels; at least 384.  By default
        frames are processed as a whole, if that keeps the memory limit.

    Raises
    ------
    ConfigurationError
        A number is out of range, or the name of the device is not one.

    Examples
    --------
    >>> Runtime(threads=2, memory_limit="2GB").memory_limit
    2000000000.0
    """

    threads: int = 0
    memory_limit: MemorySize | None = None
    device: str = CPU
    scratch: Path | None = None
    tile: int | None = None

    def __post_init__(self) -> None:
        require(self.threads >= 0, f"threads: expected 0 or more, found {self.threads}")
        check_device(self.device)
        require(
            self.tile is None or self.tile >= 4 * HALO, f"tile: expected at least {4 * HALO} pixels, found {self.tile}"
        )
        if self.memory_limit is not None:
            # A number or text is as good where settings are written in Python.
            object.__setattr__(self, "memory_limit", MemorySize(self.memory_limit))

    @property
    def workers(self) -> int:
        """Threads that work: those asked for, else one for each core that the process may use."""
        return self.threads or available_cores()


# Frozen, so that it can be the default of every stage.
DEFAULT = Runtime()

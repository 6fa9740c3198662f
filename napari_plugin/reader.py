"""Clips as layers of napari: frames are decoded when they are shown."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from turbrestore.core.arrays import FloatArray
from turbrestore.io.source import FrameSource
from turbrestore.io.video import VIDEO_SUFFIXES, open_frames

if TYPE_CHECKING:
    import dask.array

LayerData = tuple[Any, dict[str, Any], str]
# Where a layer says which file it shows.
PATH = "turbrestore_path"


def get_reader(path: str | list[str]) -> Callable[[str], list[LayerData]] | None:
    """Return the function that reads a clip; None for what is none by its name, or more than one."""
    if not isinstance(path, str) or not path.lower().removesuffix(".gz").endswith(VIDEO_SUFFIXES):
        return None
    return read_clip


def read_clip(path: str) -> list[LayerData]:
    """Open a clip as one layer of intensities from 0 to 1.

    Raises
    ------
    TurbrestoreError
        The file is missing, damaged, or no clip.
    """
    source = open_frames(path)
    settings = {
        "name": Path(path).stem,
        "rgb": len(source.shape) == 4,
        "contrast_limits": (0.0, 1.0),
        "metadata": {PATH: str(Path(path).absolute()), "fps": source.fps, "remarks": source.warnings},
    }
    return [(lazy_frames(source), settings, "image")]


def lazy_frames(source: FrameSource) -> dask.array.Array:
    """Return frames as a Dask array of one frame a chunk, float32."""
    import dask.array

    def load(block_info: dict[Any, Any] | None = None) -> NDArray[np.float32] | FloatArray:
        # Dask calls without the places of a block where it asks for the type.
        if not block_info:
            return np.empty((0,) * len(source.shape), np.float32)
        number = block_info[None]["array-location"][0][0]
        return source.read(number, number + 1)

    chunks = ((1,) * len(source), *((length,) for length in source.shape[1:]))
    return dask.array.map_blocks(
        load, chunks=chunks, dtype=np.float32, meta=np.empty((0,) * len(source.shape), np.float32)
    )

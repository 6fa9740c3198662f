"""The state of the filter on disk, between two blocks of frames."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..core.errors import DataError
from ..filtering.estimates import Gaussian, PixelGaussian
from ..filtering.filter_records import FilterCheckpoint, FilterState, FrameRecord
from ..io.npy import read_npz
from ..io.output import atomic_output

_FIGURES = ("gain", "innovation", "sharpness", "information")


def save_checkpoint(path: str | os.PathLike[str], checkpoint: FilterCheckpoint, key: str) -> None:
    """Write a checkpoint; an older one is replaced when the new one is complete."""
    image, flow, records = checkpoint.state.image, checkpoint.state.flow, checkpoint.records
    arrays: dict[str, np.ndarray] = {name: np.array([getattr(record, name) for record in records]) for name in _FIGURES}
    states = np.array([record.flow_state for record in records], np.float64)
    arrays |= {"image": image.mean, "variance": image.variance, "flow": flow.mean, "covariance": flow.cov}
    arrays |= {"flow_sum": checkpoint.state.flow_sum, "training_flow": checkpoint.state.training_flow}
    arrays["reference"] = checkpoint.reference
    with atomic_output(path, overwrite=True) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, key=np.array(key), flow_states=states, **arrays)


def load_checkpoint(path: str | os.PathLike[str], key: str) -> FilterCheckpoint:
    """Read a checkpoint back."""
    try:
        kept = read_npz(Path(path))
        found = str(kept["key"])
        figures = np.stack([kept[name] for name in _FIGURES], axis=-1)
        records = [FrameRecord(one, *map(float, row)) for one, row in zip(kept["flow_states"], figures, strict=True)]
        image, flow = PixelGaussian(kept["image"], kept["variance"]), Gaussian(kept["flow"], kept["covariance"])
        state = FilterState(image, flow, kept["flow_sum"], kept["training_flow"])
        checkpoint = FilterCheckpoint(state, tuple(records), kept["reference"])
    except (DataError, KeyError, ValueError, AttributeError, TypeError) as error:
        raise DataError(f"{path}: expected a checkpoint of the filter, found something else or damage") from error
    if found != key:
        raise DataError(f"{path}: expected a checkpoint of this run, found one of other frames or settings")
    return checkpoint

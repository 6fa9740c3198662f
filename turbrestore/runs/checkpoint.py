"""The state of the filter on disk, between two blocks of frames."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..core.errors import DataError, InputNotFoundError
from ..filtering.filter_records import FilterCheckpoint, FilterState, FrameRecord
from ..filtering.kalman import Gaussian, PixelGaussian
from ..io.npy import read_npz
from ..io.output import atomic_output

_FIGURES = ("gain", "innovation", "sharpness", "information")
_STATE = ("image", "variance", "flow", "covariance", "flow_sum", "training_flow")
_ARRAYS = (*_STATE, "reference", "flow_states", *_FIGURES)


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
    source = Path(path)
    kept = _read(source, key)
    try:
        arrays = {name: kept[name] for name in _ARRAYS}
        states, figures = arrays["flow_states"], np.stack([arrays[name] for name in _FIGURES], axis=-1)
        records = tuple(FrameRecord(state, *map(float, row)) for state, row in zip(states, figures, strict=True))
        state = FilterState(
            PixelGaussian(arrays["image"], arrays["variance"]),
            Gaussian(arrays["flow"], arrays["covariance"]),
            arrays["flow_sum"],
            arrays["training_flow"],
        )
    except (DataError, KeyError, ValueError, AttributeError, TypeError) as error:
        raise _something_else(source) from error
    return FilterCheckpoint(state, records, arrays["reference"])


def _read(source: Path, key: str) -> dict[str, np.ndarray]:
    """Read the arrays of a checkpoint that has the key."""
    if not source.is_file():
        raise InputNotFoundError(f"{source}: no such file")
    try:
        kept = read_npz(source)
        found = str(kept["key"])
    except (DataError, KeyError) as error:
        raise _something_else(source) from error
    if found != key:
        raise DataError(f"{source}: expected a checkpoint of this run, found one of other frames or settings")
    return kept


def _something_else(source: Path) -> DataError:
    return DataError(f"{source}: expected a checkpoint of the filter, found something else or damage")

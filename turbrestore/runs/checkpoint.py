"""The state of the filter on disk: between two blocks of frames, or between two tiles."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from ..core.errors import DataError, InputNotFoundError
from ..filtering.alternating import FilterCheckpoint, Filtered, FilterState, FrameRecord
from ..filtering.kalman import Gaussian, PixelGaussian
from ..io.npy import read_npz, write_npz
from ..io.output import atomic_output
from ..tiled_stages import FilteredTiles

_FIGURES = ("gain", "innovation", "sharpness", "information")
_PART = tuple(field.name for field in fields(Filtered))
_ARRAYS = ("image", "variance", "flow", "covariance", "reference", "flow_states", *_FIGURES)


def save_checkpoint(path: str | os.PathLike[str], checkpoint: FilterCheckpoint, key: str) -> None:
    """Write a checkpoint; an older one is replaced when the new one is complete.

    Parameters
    ----------
    path : path
    checkpoint : FilterCheckpoint
    key : str
        Tells of which frames and settings it is; kept in the file, so that file and key cannot come apart.

    Raises
    ------
    OutputError, StorageError
        The file cannot be created or completed; the older one is left.

    Examples
    --------
    >>> import tempfile
    >>> state = FilterState(PixelGaussian(np.zeros((2, 3)), np.ones((2, 3))), Gaussian(np.zeros(1), np.eye(1)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     one = FilterCheckpoint(state, (FrameRecord(np.zeros(1), 1.0, 0.1, 1.0, 9.0),), np.zeros((2, 3)))
    ...     save_checkpoint(folder + "/c.npz", one, "A")
    ...     len(load_checkpoint(folder + "/c.npz", "A").records)
    1
    """
    image, flow, records = checkpoint.state.image, checkpoint.state.flow, checkpoint.records
    arrays: dict[str, np.ndarray] = {name: np.array([getattr(record, name) for record in records]) for name in _FIGURES}
    states = np.array([record.flow_state for record in records], np.float64)
    arrays |= {"image": image.mean, "variance": image.variance, "flow": flow.mean, "covariance": flow.cov}
    arrays["reference"] = checkpoint.reference
    with atomic_output(path, overwrite=True) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, key=np.array(key), flow_states=states, **arrays)


def load_checkpoint(path: str | os.PathLike[str], key: str) -> FilterCheckpoint:
    """Read a checkpoint back.

    Parameters
    ----------
    path : path
        File written by :func:`save_checkpoint`.
    key : str
        What it was written with.

    Returns
    -------
    FilterCheckpoint

    Raises
    ------
    InputNotFoundError
        There is no such file.
    DataError
        It is damaged, something else or has another key.

    Examples
    --------
    >>> load_checkpoint("missing.npz", "A")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.InputNotFoundError: missing.npz: no such file
    """
    source = Path(path)
    kept = _read(source, key)
    try:
        arrays = {name: kept[name] for name in _ARRAYS}
        states, figures = arrays["flow_states"], np.stack([arrays[name] for name in _FIGURES], axis=-1)
        records = tuple(FrameRecord(state, *map(float, row)) for state, row in zip(states, figures, strict=True))
        state = FilterState(
            PixelGaussian(arrays["image"], arrays["variance"]), Gaussian(arrays["flow"], arrays["covariance"])
        )
    except (DataError, KeyError, ValueError, AttributeError, TypeError) as error:
        raise _something_else(source) from error
    return FilterCheckpoint(state, records, arrays["reference"])


def save_tiles(path: str | os.PathLike[str], tiles: FilteredTiles, key: str) -> None:
    """Write what the filter has made of some tiles; an older file is replaced when the new one is complete.

    Parameters
    ----------
    path : path
    tiles : FilteredTiles
    key : str
        As in :func:`save_checkpoint`.

    Raises
    ------
    OutputError, StorageError
        The file cannot be created or completed; the older one is left.

    Examples
    --------
    >>> import tempfile
    >>> image, one = np.ones((2, 3), np.float32), np.ones(4)
    >>> record = Filtered(image[:0], image[:0], one[:, None], one, one, one, one, 1e-4, 1.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_tiles(folder + "/c.npz", FilteredTiles((record, record), (image, image)), "A")
    ...     len(load_tiles(folder + "/c.npz", "A").parts)
    2
    """
    arrays: dict[str, np.ndarray] = {"key": np.array(key), "count": np.array(len(tiles.parts))}
    for number, (part, mean) in enumerate(zip(tiles.parts, tiles.means, strict=True)):
        arrays |= {f"{name}_{number}": np.asanyarray(getattr(part, name)) for name in _PART}
        arrays[f"mean_{number}"] = mean
    with atomic_output(path, overwrite=True) as temporary, temporary.open("wb") as stream:
        write_npz(stream, arrays)


def load_tiles(path: str | os.PathLike[str], key: str, scratch: Path | None = None) -> FilteredTiles:
    """Read back what the filter has made of some tiles.

    Parameters
    ----------
    path : path
        File written by :func:`save_tiles`.
    key : str
        What it was written with.
    scratch : Path, optional
        Folder of a file for large images; by default they are in memory.

    Returns
    -------
    FilteredTiles

    Raises
    ------
    InputNotFoundError
        There is no such file.
    DataError
        It is damaged, something else or has another key.

    Examples
    --------
    >>> load_tiles("missing.npz", "A")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.InputNotFoundError: missing.npz: no such file
    """
    source = Path(path)
    kept = _read(source, key, scratch)
    try:
        numbers = range(int(kept["count"]))
        parts = tuple(_part(kept, number) for number in numbers)
        return FilteredTiles(parts, tuple(kept[f"mean_{number}"] for number in numbers))
    except (KeyError, ValueError, TypeError) as error:
        raise _something_else(source) from error


def _part(kept: dict[str, np.ndarray], number: int) -> Filtered:
    found = {name: kept[f"{name}_{number}"] for name in _PART}
    image_noise, motion_share = float(found.pop("image_noise")), float(found.pop("motion_share"))
    return Filtered(**found, image_noise=image_noise, motion_share=motion_share)


def _read(source: Path, key: str, scratch: Path | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of a checkpoint that has the key."""
    if not source.is_file():
        raise InputNotFoundError(f"{source}: no such file")
    try:
        # Many small images take as much memory as one that is large.
        kept = read_npz(source, scratch=scratch, large=0)
        found = str(kept["key"])
    except (DataError, KeyError) as error:
        raise _something_else(source) from error
    if found != key:
        raise DataError(f"{source}: expected a checkpoint of this run, found one of other frames or settings")
    return kept


def _something_else(source: Path) -> DataError:
    return DataError(f"{source}: expected a checkpoint of the filter, found something else or damage")

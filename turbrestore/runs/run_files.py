"""Files of a run: the results of its stages, its images, and ``run.json``, from which a report can be made later.

The folder holds one stage file for each result (``centroid.npz``, …), the images in full precision (``images.npz``)
and ``run.json``, which says that the run is complete once it holds the part ``restoration``.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any

from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, InputNotFoundError, OutputError
from ..io.npy import read_npz, write_npz
from ..io.output import atomic_output, atomic_write
from ..registration.centroid import CentroidParams
from ..results import Restoration
from .run_record import RunRecord
from .stage_files import KINDS, load_artifact, save_artifact
from .typed_records import KeptRecord, convert_to

SCHEMA = 6
RECORD, IMAGES, MEAN = "run.json", "images.npz", "mean.npy"
# All files of a kept run.
RUN_FILES = (*(f"{name}.npz" for name in KINDS), MEAN, IMAGES, RECORD)
_ANEW = "start anew without resuming, or keep the stages in another folder"
# Fields of a restoration that lie in no other file.
_DESCRIBED = (
    *("crop", "guard_readings", "decisions", "train", "frame_count", "seconds", "seeing"),
    *("structure", "is_mean", "objects_replaced", "unseen"),
)
# Maps of the size of the result: the largest value, and what it is.
_MAPS = {"uncertainty": (math.inf, "deviations"), "disagreement": (1.0, "shares")}
# Where `turbrestore report` writes by default.
REPORT = "report.html"


def save_run(folder: str | os.PathLike[str], restoration: Restoration, run: RunRecord) -> None:
    """Keep a run in a folder; what an earlier one left there is replaced.

    Parameters
    ----------
    folder : path
        Created if its parent exists.
    restoration : Restoration
    run : RunRecord

    Raises
    ------
    OutputError
        The folder cannot be created or written to.
    StorageError
        Writing failed.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from turbrestore.pipeline import RestoreParams, restore
    >>> frames = np.random.default_rng(0).uniform(size=(4, 32, 32)).astype(np.float32)
    >>> restoration = restore(frames, RestoreParams(until="centroid"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_run(folder, restoration, RunRecord("noise", frames[2]))
    ...     again, run = load_run(folder)
    >>> run.name, bool((again.image == restoration.image).all())
    ('noise', True)
    """
    place = Path(folder)
    try:
        place.mkdir(exist_ok=True)
        # Whoever looks while the files are written must not take them for one run.
        (place / RECORD).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{place}: cannot be written to ({error.strerror})") from error
    save_results(place, restoration, run, KeptRecord())


def save_results(folder: Path, restoration: Restoration, run: RunRecord, record: KeptRecord) -> None:
    """Write the images, the results of the stages that are not there yet, and the record of all."""
    # A report would be of an earlier run.
    (folder / REPORT).unlink(missing_ok=True)
    results = {name: getattr(restoration, name) for name in KINDS}
    for name, result in results.items():
        if result is None:
            (folder / f"{name}.npz").unlink(missing_ok=True)
        elif f"{name}.npz" not in record.files:
            save_artifact(folder / f"{name}.npz", result, overwrite=True)
    with atomic_output(folder / IMAGES, overwrite=True) as temporary, temporary.open("wb") as stream:
        images = {"frame": run.frame, "mean": restoration.mean, "image": restoration.image}
        images |= {name: part for name in _MAPS if (part := getattr(restoration, name)) is not None}
        write_npz(stream, images)
    record.run = {item.name: getattr(run, item.name) for item in dataclasses.fields(run) if item.name != "frame"}
    record.restoration = {
        "results": [name for name, result in results.items() if result is not None],
        **{name: getattr(restoration, name) for name in _DESCRIBED},
    }
    write_record(folder, record)


def write_record(folder: Path, record: KeptRecord) -> None:
    """Write ``run.json``; an older one is replaced when the new one is complete."""
    parts = {name: part for name, part in vars(record).items() if part is not None}
    # In one order, whichever of the stages were taken over.
    parts["files"] = dict(sorted(record.files.items()))
    text = json.dumps({"schema": SCHEMA, **parts}, indent=1, default=dataclasses.asdict) + "\n"
    atomic_write(folder / RECORD, text.encode(), overwrite=True)


def read_record(folder: Path) -> KeptRecord | None:
    """Read ``run.json``."""
    path = folder / RECORD
    found = _read_json(path)
    if found is None:
        return None
    layout = found.get("schema")
    if layout != SCHEMA:
        raise DataError(f"{path}: expected the record of a run, layout {SCHEMA}, found layout {layout!r:.40}")
    return convert_to(KeptRecord, found, str(path))


def read_stages(folder: str | os.PathLike[str]) -> KeptRecord | None:
    """Read the record of the stages that are kept in a folder; one of an older layout says nothing of them."""
    place = Path(folder)
    try:
        found = _read_json(place / RECORD) or {}
        layout = found.get("schema")
        if type(layout) is int and 0 < layout < SCHEMA and "facts" in found:
            return KeptRecord(facts={})
        record = read_record(place)
    except DataError as error:
        raise DataError(f"{error}; {_ANEW}") from error
    return None if record is None or record.facts is None else record


def load_run(folder: str | os.PathLike[str]) -> tuple[Restoration, RunRecord]:
    """Read a kept run back.

    Parameters
    ----------
    folder : path
        Written by :func:`save_run`.

    Returns
    -------
    restoration : Restoration
    run : RunRecord

    Raises
    ------
    InputNotFoundError
        There is no such folder, or the run in it is not complete.
    DataError
        A file is damaged, or of another version of the layout.

    Examples
    --------
    >>> load_run("missing")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.InputNotFoundError: missing: expected the folder of a kept run, ...
    """
    place = Path(folder)
    record, name = read_record(place), str(place / RECORD)
    if record is None or record.restoration is None:
        raise InputNotFoundError(f"{place}: expected the folder of a kept run, found no complete {RECORD} in it")
    images = _read_images(place / IMAGES)
    run = convert_to(RunRecord, {**(record.run or {}), "frame": images.pop("frame")}, f"{name}: run")
    # The report shows settings as they are, and computes with one of the centroid.
    convert_to(CentroidParams, run.settings.get("centroid", {}), f"{name}: run.settings.centroid")
    results = convert_to(tuple[str, ...], record.restoration.get("results"), f"{name}: restoration.results")
    if "centroid" not in results or not set(results) <= KINDS.keys():
        raise DataError(f"{name}: expected results among {', '.join(KINDS)}, found {results!r:.80}")
    stages = {stage: load_artifact(place / f"{stage}.npz", KINDS[stage]) for stage in results}
    parts = {**dict.fromkeys(KINDS), **record.restoration, **stages, **images}
    restoration = convert_to(Restoration, parts, f"{name}: restoration")
    _check_sizes(place / IMAGES, restoration, run.frame)
    return restoration, run


def _read_json(path: Path) -> dict[str, Any] | None:
    """Return the object in a file, an empty one where the file holds something else, None if there is no file."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: expected the record of a run, found no file")
    try:
        found = json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: expected the record of a run, found something else or damage") from error
    return found if isinstance(found, dict) else {}


def _read_images(path: Path) -> dict[str, FloatArray]:
    if not path.is_file():
        raise InputNotFoundError(f"{path}: no such file")
    try:
        found = read_npz(path)
        arrays = {name: found[name] for name in ("frame", "mean", "image")}
    except (DataError, KeyError) as error:
        raise DataError(f"{path}: expected the images of a run, found something else or damage") from error
    images = {name: check_image(array, f"{path}: {name}") for name, array in arrays.items()}
    return {**images, **{name: found[name] for name in found.keys() & _MAPS.keys()}}


def _check_sizes(path: Path, restoration: Restoration, frame: FloatArray) -> None:
    """Refuse images that do not fit each other, and maps with values that no map has."""
    x, y, width, height = restoration.crop
    image, mean = restoration.image, restoration.mean
    if frame.shape != mean.shape or image.shape[:2] != (height, width):
        shapes = [part.shape for part in (frame, mean, image)]
        raise DataError(f"{path}: expected images of one size, found {shapes} and {restoration.crop}")
    if min(x, y) < 0 or x + width > mean.shape[1] or y + height > mean.shape[0]:
        raise DataError(f"{path}: expected the result to lie within the frames, found it at {restoration.crop}")
    for name, (most, what) in _MAPS.items():
        part = getattr(restoration, name)
        if part is None:
            continue
        if part.shape != (height, width) or part.dtype.str != "<f4" or not ((part >= 0) & (part <= most)).all():
            raise DataError(f"{path}: expected {what} of shape {(height, width)}, found {part.shape}")

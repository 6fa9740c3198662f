"""Files of a run: the results of its stages, its images, and ``run.json``, from which a report can be made later.

The folder holds one stage file for each result (``centroid.npz``, …), the images in full precision (``images.npz``)
and ``run.json``, which says that the run is complete once it holds the part ``restoration``.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ..blur.estimation import BlurEstimate
from ..blur.posterior import BlurPosterior
from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, InputNotFoundError, OutputError
from ..deconvolution.deconvolve import Deconvolution
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..io.npy import read_npz, write_npz
from ..io.output import atomic_output, atomic_write
from ..registration.centroid import Centroid
from ..registration.coverage import Rectangle
from ..results import Restoration
from ..settings import RestoreParams
from .json_fields import JsonFields
from .run_record import RunRecord
from .stage_files import load_artifact, save_artifact

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 4
RECORD, IMAGES, MEAN = "run.json", "images.npz", "mean.npy"
RESULTS = ("centroid", "dynamics", "filtered", "blur", "posterior", "deconvolution")
# All files of a kept run.
RUN_FILES = (*(f"{name}.npz" for name in RESULTS), MEAN, IMAGES, RECORD)
_ANEW = "start anew without resuming, or keep the stages in another folder"
# Maps of the size of the result: the largest value, and what it is.
_MAPS = {"uncertainty": (math.inf, "deviations"), "disagreement": (1.0, "shares")}
# Where `turbrestore report` writes by default.
REPORT = "report.html"

Stage = TypeVar("Stage", bound="DataclassInstance")


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
    >>> from turbrestore.pipeline import restore
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
    write_record(place, save_results(place, restoration, run, ()))


def save_results(folder: Path, restoration: Restoration, run: RunRecord, stored: Collection[str]) -> dict[str, Any]:
    """Write the images, and the results of the stages that are not there yet."""
    # A report would be of an earlier run.
    (folder / REPORT).unlink(missing_ok=True)
    results = {name: getattr(restoration, name) for name in RESULTS}
    for name, result in results.items():
        if result is None:
            (folder / f"{name}.npz").unlink(missing_ok=True)
        elif f"{name}.npz" not in stored:
            save_artifact(folder / f"{name}.npz", result, overwrite=True)
    with atomic_output(folder / IMAGES, overwrite=True) as temporary, temporary.open("wb") as stream:
        images = {"frame": run.frame, "mean": restoration.mean, "image": restoration.image}
        images |= {name: part for name in _MAPS if (part := getattr(restoration, name)) is not None}
        write_npz(stream, images)
    described = {item.name: getattr(run, item.name) for item in dataclasses.fields(run) if item.name != "frame"}
    restored = {
        "results": [name for name, result in results.items() if result is not None],
        "crop": list(restoration.crop),
        "guard_readings": [dataclasses.asdict(reading) for reading in restoration.guard_readings],
        "decisions": [dataclasses.asdict(decision) for decision in restoration.decisions],
        "train": restoration.train,
        "frame_count": restoration.frame_count,
        "seconds": restoration.seconds,
        "seeing": None if restoration.seeing is None else dataclasses.asdict(restoration.seeing),
    }
    return {"run": described, "restoration": restored}


def write_record(folder: Path, parts: Mapping[str, Any]) -> None:
    """Write ``run.json``; an older one is replaced when the new one is complete."""
    text = json.dumps({"schema": SCHEMA, **parts}, indent=1) + "\n"
    atomic_write(folder / RECORD, text.encode(), overwrite=True)


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read ``run.json``."""
    record = _read_json(folder / RECORD)
    if record is None:
        return None
    found = _layout_of(record)
    if found != SCHEMA:
        raise DataError(
            f"{folder / RECORD}: expected the record of a run, layout {SCHEMA}, found layout {found or 'none'}"
        )
    return record


def read_stages(folder: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Read the record of the stages that are kept in a folder."""
    place = Path(folder)
    try:
        kept = _read_json(place / RECORD)
        if 0 < _layout_of(kept) < SCHEMA and "facts" in kept:
            return {"facts": {}, "files": {}, "deblurred": {}, "outputs": []}
        record = read_record(place)
        if record is None or "facts" not in record:
            return None
        fields = JsonFields(place / RECORD, record)
        facts = fields.part("facts")
        for stage in facts.record:
            facts.part(stage)
        fields.named_texts("files")
        fields.texts("outputs")
        verdict = fields.part("deblurred")
        if verdict.record:
            verdict.flag("estimated")
            verdict.flag("measured")
            verdict.guard_readings("readings")
            verdict.decisions("decisions")
    except DataError as error:
        raise DataError(f"{error}; {_ANEW}") from error
    return record


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
    record = read_record(place)
    if record is None or "restoration" not in record:
        raise InputNotFoundError(f"{place}: expected the folder of a kept run, found no complete {RECORD} in it")
    fields = JsonFields(place / RECORD, record)
    facts, run = fields.part("restoration"), fields.part("run")
    names = facts.texts("results")
    if "centroid" not in names or not set(names) <= set(RESULTS):
        raise DataError(f"{fields.path}: expected results among {', '.join(RESULTS)}, found {', '.join(names)}")
    crop = _crop(facts)
    images = _read_images(place / IMAGES, crop)
    restoration = Restoration(
        image=images["image"],
        crop=crop,
        mean=images["mean"],
        centroid=load_artifact(place / "centroid.npz", Centroid),
        dynamics=_stage(place, names, "dynamics", FlowDynamics),
        filtered=_stage(place, names, "filtered", Filtered),
        blur=_stage(place, names, "blur", BlurEstimate),
        posterior=_stage(place, names, "posterior", BlurPosterior),
        deconvolution=_stage(place, names, "deconvolution", Deconvolution),
        guard_readings=facts.guard_readings("guard_readings"),
        decisions=facts.decisions("decisions"),
        train=facts.value("train", int),
        frame_count=facts.value("frame_count", int),
        seconds=facts.numbers("seconds"),
        seeing=facts.seeing("seeing"),
        **{name: images.get(name) for name in _MAPS},
    )
    return restoration, RunRecord(
        name=run.value("name", str),
        frame=images["frame"],
        frame_number=run.value("frame_number", int),
        source=run.value("source", str),
        settings=run.part("settings").like(dataclasses.asdict(RestoreParams())),
        command=run.texts("command"),
        warnings=run.texts("warnings"),
        versions={name: str(text) for name, text in run.value("versions", dict).items()},
        finished=run.value("finished", str),
    )


def _read_json(path: Path) -> Any:
    """Content of a file, None if there is none."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: expected the record of a run, found no file")
    try:
        # A file that holds null is no record either.
        return json.loads(path.read_text("utf-8")) or {}
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: expected the record of a run, found something else or damage") from error


def _layout_of(record: Any) -> int:
    """Version of the layout of a record, 0 where it states none."""
    found = record.get("schema") if isinstance(record, dict) else None
    return found if type(found) is int else 0


def _stage(place: Path, names: tuple[str, ...], name: str, kind: type[Stage]) -> Stage | None:
    return load_artifact(place / f"{name}.npz", kind) if name in names else None


def _crop(fields: JsonFields) -> Rectangle:
    found = fields.value("crop", list)
    if len(found) != 4 or not all(type(number) is int and number >= 0 for number in found):
        raise DataError(f"{fields.path}: expected crop to be x, y, width and height, found {found!r:.40}")
    x, y, width, height = found
    return x, y, width, height


def _read_images(path: Path, crop: Rectangle) -> dict[str, FloatArray]:
    if not path.is_file():
        raise InputNotFoundError(f"{path}: no such file")
    try:
        found = read_npz(path)
        arrays = {name: found[name] for name in ("frame", "mean", "image")}
    except (DataError, KeyError) as error:
        raise DataError(f"{path}: expected the images of a run, found something else or damage") from error
    images = {name: check_image(array, f"{path}: {name}") for name, array in arrays.items()}
    x, y, width, height = crop
    if images["frame"].shape != images["mean"].shape or images["image"].shape[:2] != (height, width):
        raise DataError(f"{path}: expected images of one size, found {[image.shape for image in images.values()]}")
    if x + width > images["mean"].shape[1] or y + height > images["mean"].shape[0]:
        raise DataError(f"{path}: expected the result to lie within the frames, found it at {crop}")
    for name in found.keys() & _MAPS.keys():
        part, (most, what) = found[name], _MAPS[name]
        if part.shape != (height, width) or part.dtype.str != "<f4" or not ((part >= 0) & (part <= most)).all():
            raise DataError(f"{path}: expected {what} of shape {(height, width)}, found {part.shape}")
        images[name] = part
    return images

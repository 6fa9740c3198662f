"""What a run was: input, settings, versions; and a whole run in a folder, from which a report can be made later.

The folder holds one artifact a stage (``centroid.npz``, …), the images in full precision (``images.npz``) and
``run.json``, which is written last: a folder without it is not complete.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from turbrestore import __version__

from ..blur.blur_cues import BlurBounds
from ..blur.estimation import BlurEstimate
from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, InputNotFoundError, OutputError
from ..deconvolution.deconvolve import Deconvolution
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..io.npy import read_npz, write_npz
from ..io.output import atomic_output, atomic_write
from ..io.source import FrameSource
from ..registration.centroid import Centroid
from ..registration.coverage import Rectangle
from ..settings import Restoration, RestoreParams
from .artifacts import load_artifact, save_artifact
from .record_fields import RecordFields

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 1
RECORD, IMAGES = "run.json", "images.npz"
RESULTS = ("centroid", "dynamics", "filtered", "blur", "blur_bounds", "deconvolution")
# All files that a kept run consists of.
RUN_FILES = (*(f"{name}.npz" for name in RESULTS), IMAGES, RECORD)
# Where `turbrestore report` writes by default.
REPORT = "report.html"
_PACKAGES = (
    *("numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "av", "tifffile", "pillow", "numba", "torch"),
)

Stage = TypeVar("Stage", bound="DataclassInstance")


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
    source: FrameSource,
    settings: RestoreParams | Mapping[str, Any] | None = None,
    command: tuple[str, ...] = (),
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
    """Versions of turbrestore, Python and the packages that compute.

    Returns
    -------
    dict of str to str

    Examples
    --------
    >>> list(versions())[:3]
    ['turbrestore', 'Python', 'numpy']
    """
    found = {"turbrestore": __version__, "Python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return {**found, "system": f"{platform.system()} {platform.machine()}"}


def save_run(
    folder: str | os.PathLike[str], restoration: Restoration, run: RunRecord, stored: Collection[str] = ()
) -> None:
    """Keep a run in a folder; what an earlier one left there is replaced.

    Parameters
    ----------
    folder : path
        Created if its parent is there.
    restoration : Restoration
    run : RunRecord
    stored : collection of str
        Names of results, such as ``"centroid"``, whose artifacts lie in the folder already.

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
        # Whoever looks while the files are written must not take them for one run; a report would be of the last one.
        for name in (RECORD, REPORT):
            (place / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{place}: cannot be written to ({error.strerror})") from error
    results = {name: getattr(restoration, name) for name in RESULTS}
    for name, result in results.items():
        if result is None:
            (place / f"{name}.npz").unlink(missing_ok=True)
        elif name not in stored:
            save_artifact(place / f"{name}.npz", result, overwrite=True)
    with atomic_output(place / IMAGES, overwrite=True) as temporary, temporary.open("wb") as stream:
        write_npz(stream, {"frame": run.frame, "mean": restoration.mean, "image": restoration.image})
    record = {
        "schema": SCHEMA,
        "run": {item.name: getattr(run, item.name) for item in dataclasses.fields(run) if item.name != "frame"},
        "restoration": {
            "results": [name for name, result in results.items() if result is not None],
            "crop": list(restoration.crop),
            "guard_readings": [dataclasses.asdict(reading) for reading in restoration.guard_readings],
            "decisions": [dataclasses.asdict(decision) for decision in restoration.decisions],
            "train": restoration.train,
            "frame_count": restoration.frame_count,
            "seconds": restoration.seconds,
        },
    }
    atomic_write(place / RECORD, (json.dumps(record, indent=2) + "\n").encode(), overwrite=True)


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
        There is no such folder, or it is not complete.
    DataError
        A file is damaged, or of another version of the layout.

    Examples
    --------
    >>> load_run("missing")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.InputNotFoundError: missing: expected a folder written by --keep, found no run.json in it
    """
    place = Path(folder)
    fields = RecordFields(place / RECORD, _read_record(place))
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
        blur_bounds=_stage(place, names, "blur_bounds", BlurBounds),
        deconvolution=_stage(place, names, "deconvolution", Deconvolution),
        guard_readings=facts.guard_readings("guard_readings"),
        decisions=facts.decisions("decisions"),
        train=facts.value("train", int),
        frame_count=facts.value("frame_count", int),
        seconds=facts.numbers("seconds"),
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


def _stage(place: Path, names: tuple[str, ...], name: str, kind: type[Stage]) -> Stage | None:
    return load_artifact(place / f"{name}.npz", kind) if name in names else None


def _crop(fields: RecordFields) -> Rectangle:
    found = fields.value("crop", list)
    if len(found) != 4 or not all(type(number) is int and number >= 0 for number in found):
        raise DataError(f"{fields.path}: expected crop to be x, y, width and height, found {found!r:.40}")
    x, y, width, height = found
    return x, y, width, height


def _read_record(place: Path) -> dict[str, Any]:
    path = place / RECORD
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: expected the record of a run, found no file")
    try:
        record = json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputNotFoundError(f"{place}: expected a folder written by --keep, found no {RECORD} in it") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: expected the record of a run, found something else or damage") from error
    found = record.get("schema") if isinstance(record, dict) else "none"
    if type(found) is not int or found != SCHEMA:
        raise DataError(f"{path}: expected the record of a run, layout {SCHEMA}, found layout {found!r:.40}")
    return record


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
    return images

"""What commands write: settings, kept stages, JSON and one-line summaries."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from turbrestore import __version__
from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import OutputError, require
from turbrestore.io.astronomy.fits_header import is_fits
from turbrestore.io.astronomy.fits_output import FITS_OUTPUT_SUFFIX, write_fits
from turbrestore.io.images.image_files import write_image
from turbrestore.io.output import atomic_write, check_output
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.results import Restoration
from turbrestore.runs.folder_lock import LOCK
from turbrestore.runs.run_files import REPORT, RUN_FILES, read_stages
from turbrestore.runs.run_folder import CHECKPOINT, RunFolder, is_part
from turbrestore.runs.stage_files import save_flows
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.scratch import iter_frames
from turbrestore.settings import PRESETS, Preset, RestoreParams

from .options import Machine, Selection
from .streams import put

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from turbrestore.runs.run_record import RunRecord

FLOW_FILE = (".npy", FITS_OUTPUT_SUFFIX)
_SHORT = {"deconvolution.sigma": "sigma"}
_IMAGES = ("frame", "mean", "centroid", "filtered", "deconvolved")


def print_json(record: dict[str, Any]) -> None:
    """Write one JSON object to standard output; what is not a finite number becomes null."""
    put(json.dumps(_plain(record), indent=2, allow_nan=False))


def describe(restoration: Restoration, truth: FloatArray | None) -> dict[str, Any]:
    """Facts of a restoration that a script may want."""
    record: dict[str, Any] = {
        "frames": restoration.frame_count,
        "train": restoration.train,
        "size": [restoration.image.shape[1], restoration.image.shape[0]],
        "seconds": restoration.seconds,
        "centroid": {
            "converged": restoration.centroid.converged,
            "mean_flow_sizes": restoration.centroid.mean_flow_sizes.tolist(),
        },
    }
    if restoration.dynamics is not None:
        record["dynamics"] = {
            "rank": restoration.dynamics.rank,
            "energy_share": restoration.dynamics.energy_share,
            "residual_variance": restoration.dynamics.R,
            "largest_eigenvalue": float(abs(restoration.dynamics.eigenvalues).max(initial=0.0)),
            "notes": list(restoration.dynamics.notes),
        }
    if restoration.filtered is not None:
        record["filter"] = {
            "image_noise": restoration.filtered.image_noise,
            "sharpness_weight": restoration.filtered.sharpness_weight,
            "mean_innovation": float(np.nanmean(restoration.filtered.innovations)),
        }
    if restoration.deconvolution is not None:
        record["deconvolution"] = {
            "sigma": restoration.deconvolution.sigma,
            "fidelity": restoration.deconvolution.fidelity,
            "iterations": restoration.deconvolution.iterations,
            "converged": restoration.deconvolution.converged,
        }
    if restoration.blur is not None:
        names = ("sigma", "uncertainty", "exponent", "noise", "reduction", "evidence")
        record["blur"] = {name: getattr(restoration.blur, name) for name in names}
    record["guards"] = [dataclasses.asdict(reading) for reading in restoration.guard_readings]
    record["crop"] = list(restoration.crop)
    record["verdict"] = dataclasses.asdict(restoration.verdict)
    record["decisions"] = [dataclasses.asdict(decision) for decision in restoration.decisions]
    if truth is not None:
        images = stage_images(restoration)
        figures = (dataclasses.asdict(compare(image, truth)) for image in iter_frames(images.values()))
        record["stages"] = dict(zip(images, figures, strict=True))
    return record


def stage_images(restoration: Restoration) -> dict[str, FloatArray]:
    """Image of every stage that ran, in order."""
    images = {"mean": restoration.mean, "centroid": restoration.centroid.image}
    if restoration.filtered is not None:
        images["filtered"] = restoration.filtered.image
    if restoration.deconvolution is not None:
        images["deconvolved"] = restoration.deconvolution.image
    return images


def summary(output: Path, restoration: Restoration) -> str:
    """One line for a person: what was gained, and what to look at."""
    return f"{output} ({sum(restoration.seconds.values()):.1f} s): {restoration.verdict}"


def write_result(
    path: Path, restoration: Restoration, source: FrameSource, bit_depth: int, command: tuple[str, ...], overwrite: bool
) -> None:
    """Write the restored image; a FITS file also has the header of the input, the history of the run and UNCERT."""
    finer, header, uncertainty = restoration.finer, source.header, restoration.uncertainty
    image = restoration.image if finer is None else finer
    if not is_fits(path):
        write_image(path, image, bit_depth, overwrite, source.levels)
        return
    if finer is not None:
        from turbrestore.footage.object_crop import without_sky

        # Both are those of the grid of the frames.
        header, uncertainty = without_sky(header), None
    x, y, *_ = restoration.crop
    history = [f"turbrestore {__version__}: {shlex.join(command)}", *source.warnings]
    history += [f"{decision.subject}: {decision.choice}" for decision in restoration.decisions]
    if uncertainty is not None:
        history.append("UNCERT: standard deviation of each pixel, infinite where nothing is known")
    rows, columns = source.window
    write_fits(
        path,
        image,
        bit_depth,
        overwrite,
        header=header,
        history=history,
        origin=(columns.start + x, rows.start + y),
        uncertainty=uncertainty,
        levels=source.levels,
    )


def write_flows(
    path: Path, flows: FloatArray, image: FloatArray, source: FrameSource, reference: Path, overwrite: bool
) -> None:
    """Write the flows from an image to the frames of a video; a FITS file also has the image and the header."""
    if not is_fits(path):
        save_flows(path, flows, overwrite)
        return
    command = shlex.join(("turbrestore", "flow", str(reference), str(source.path), str(path)))
    meaning = "FLOW: displacements (dx, dy) from the image to each frame, pixels; dy along the rows as they are stored"
    history = [f"turbrestore {__version__}: {command}", *source.warnings, meaning]
    rows, columns = source.window
    origin = (columns.start, rows.start)
    write_fits(
        path,
        image,
        32,
        overwrite,
        header=source.header,
        history=history,
        origin=origin,
        levels=source.levels,
        flows=flows,
    )


def check_distinct(outputs: Iterable[Path]) -> None:
    """Refuse two outputs that are one file, under any names: the second would replace the first."""
    known: set[str] = set()
    for path in outputs:
        # Path.resolve raises an error for links in a circle.
        real = os.path.realpath(path)
        if real in known:
            raise OutputError(f"{path}: is named for two outputs; choose another name for one of them")
        known.add(real)


def check_output_depth(depth: int | None, suffix: str = "") -> None:
    """Refuse a depth that no output has, or not the one of this suffix."""
    if depth is None:
        return
    require(depth in (8, 16, 32), f"--bit-depth: expected 8, 16 or 32, found {depth}")
    holds = suffix.lower() not in (".png", ".ser", ".mkv")
    require(holds or depth < 32, f"--bit-depth: expected TIFF or FITS for 32 bits, found {suffix}")


def check_keep(folder: Path | None, taken: list[Path], overwrite: bool, resume: bool) -> None:
    """Refuse a folder for the stages that cannot be used, before any work begins.

    It is new or empty, unless overwriting is allowed or a run in it is resumed, and none of the paths ``taken`` by
    inputs and outputs.
    """
    if folder is None:
        return
    if folder.resolve() in {path.resolve() for path in taken}:
        raise OutputError(f"{folder}: is an input or output already; name another folder to keep the stages in")
    if not folder.exists():
        check_output(folder, suffixes=None)
        return
    if not folder.is_dir():
        raise OutputError(f"{folder}: is a file; name a folder to keep the stages in")
    for name in (LOCK, *RUN_FILES, REPORT, CHECKPOINT, *(f"{image}.png" for image in _IMAGES)):
        if (folder / name).is_symlink():
            raise OutputError(f"{folder / name}: is a link to a file elsewhere; remove it or name another folder")
        if (folder / name).resolve() in {path.resolve() for path in taken}:
            raise OutputError(f"{folder / name}: is an input or output already; name another folder")
        check_output(folder / name, taken, overwrite=True, suffixes=None)
    known = resume and read_stages(folder) is not None
    # What a run leaves that is killed while it starts.
    rest = [path for path in folder.iterdir() if path.name != LOCK and not is_part(path)]
    if not overwrite and not known and rest:
        if resume:
            raise OutputError(f"{folder}: holds no run to go on with; choose another folder or add --overwrite")
        raise OutputError(f"{folder}: is not empty; choose another folder, add --overwrite, or --resume the run in it")


def save_stages(stages: RunFolder, restoration: Restoration, run: RunRecord, bit_depth: int) -> None:
    """Complete a kept run: what a report needs, and images to look at."""
    folder = stages.folder
    stages.complete(restoration, run)
    images = {"frame": run.frame, **stage_images(restoration)}
    for name in _IMAGES:
        if name in images:
            write_image(folder / f"{name}.png", images[name], bit_depth, overwrite=True)
        else:
            # What an earlier run left would not belong to this one.
            (folder / f"{name}.png").unlink(missing_ok=True)


def settings_record(
    params: RestoreParams,
    selection: Selection,
    bit_depth: int | None,
    machine: Machine,
    memory_limit: MemorySize | None,
    preset: Preset = "standard",
    tile: int | None = None,
) -> dict[str, Any]:
    """All settings of a run, nested as in a settings file; None where they are left to be measured."""
    head = {"preset": preset, "bit_depth": bit_depth, "memory_limit": memory_limit, "tile": tile}
    return {**head, **dataclasses.asdict(machine), **dataclasses.asdict(selection), **dataclasses.asdict(params)}


def write_figure(path: Path, figure: Figure, overwrite: bool) -> None:
    """Write a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130, facecolor="white")
    atomic_write(path, buffer.getvalue(), overwrite)


def write_settings(path: Path, record: dict[str, Any]) -> None:
    """Write settings as TOML that ``--config`` reads; those left to be measured are left out."""
    head = f"# Settings of a run of turbrestore {__version__}; --config with this file repeats it.\n"
    atomic_write(path, (head + tomli_w.dumps(_without_none(record))).encode(), overwrite=True)


def repeating_command(input: Path, output: Path, record: dict[str, Any]) -> tuple[str, ...]:
    """Return the words of the command that repeats a run; settings that differ from its preset become flags."""
    paths = (str(path) if not str(path).startswith("-") else f"./{path}" for path in (input, output))
    preset: Preset = record["preset"]
    usual = settings_record(PRESETS[preset], Selection(), None, Machine(), None)
    return ("turbrestore", "restore", *paths, *changed_flags(record, usual))


def changed_flags(record: dict[str, Any], usual: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the flags of all settings that differ from the usual ones, in their short form."""
    for name, value in record.items():
        flag = name.replace("_", "-")
        if isinstance(value, dict):
            yield from changed_flags(value, usual[name], f"{prefix}{flag}.")
        elif value == usual[name]:
            continue
        elif isinstance(value, bool):
            yield f"--{prefix}{flag if value else f'no-{flag}'}"
        else:
            yield f"--{_SHORT.get(prefix + flag, prefix + flag)}={value}"


def _without_none(record: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in record.items()
        if value is not None
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value

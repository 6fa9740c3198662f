"""What commands write: settings, kept stages, JSON and one-line summaries."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Any

import tomli_w

from turbrestore import __version__
from turbrestore.arrays import FloatArray
from turbrestore.artifacts import save_artifact
from turbrestore.errors import OutputError
from turbrestore.images import atomic_write, check_output, write_image
from turbrestore.metrics import compare
from turbrestore.pipeline import Restoration, RestoreParams

from .options import Selection

_ARTIFACTS = ("centroid", "dynamics", "filtered", "deconvolution")
_IMAGES = ("mean", "centroid", "filtered", "deconvolved")


def print_json(record: dict[str, Any]) -> None:
    """Write one JSON object to standard output; what is not a finite number becomes null."""
    sys.stdout.write(json.dumps(_plain(record), indent=2, allow_nan=False) + "\n")


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
            "motion_factor": float(restoration.dynamics.motion_factor.mean()),
            "largest_eigenvalue": float(abs(restoration.dynamics.eigenvalues).max(initial=0.0)),
            "notes": list(restoration.dynamics.notes),
        }
    if restoration.filtered is not None:
        record["filter"] = {
            "image_noise": restoration.filtered.image_noise,
            "motion_share": restoration.filtered.motion_share,
            "mean_innovation": float(restoration.filtered.innovations.mean()),
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
    if restoration.blur_bounds is not None:
        record["blur_bounds"] = dataclasses.asdict(restoration.blur_bounds)
    if truth is not None:
        stages = {name: dataclasses.asdict(compare(image, truth)) for name, image in stage_images(restoration).items()}
        record["stages"] = stages
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
    """One line for a person."""
    seconds = sum(restoration.seconds.values())
    words = [f"{output}: {restoration.frame_count} frames in {seconds:.1f} s"]
    if restoration.deconvolution is not None:
        sigma = restoration.deconvolution.sigma
        words.append(f"blur of {sigma:.2f} pixels removed" if sigma > 0 else "no blur removed")
    return ", ".join(words)


def check_keep(folder: Path | None, taken: list[Path], overwrite: bool) -> None:
    """Refuse a folder for the stages that cannot be used, before any work begins.

    It is new or empty, unless overwriting is allowed, and none of the paths ``taken`` by inputs and outputs.
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
    if not overwrite and any(folder.iterdir()):
        raise OutputError(f"{folder}: is not empty; choose another folder or allow overwriting")
    for name in (*(f"{stage}.npz" for stage in _ARTIFACTS), *(f"{image}.png" for image in _IMAGES)):
        check_output(folder / name, overwrite=True, suffixes=None)


def save_stages(folder: Path, restoration: Restoration, bit_depth: int) -> None:
    """Keep every stage: artifacts for the stage commands, images to look at."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror})") from error
    images = stage_images(restoration)
    for name in _ARTIFACTS:
        result = getattr(restoration, name)
        if result is None:
            # What an earlier run left would not belong to this one.
            (folder / f"{name}.npz").unlink(missing_ok=True)
        else:
            save_artifact(folder / f"{name}.npz", result, overwrite=True)
    for name in _IMAGES:
        if name in images:
            write_image(folder / f"{name}.png", images[name], bit_depth, overwrite=True)
        else:
            (folder / f"{name}.png").unlink(missing_ok=True)


def write_settings(path: Path, params: RestoreParams, selection: Selection, bit_depth: int | None) -> None:
    """Write settings as TOML that ``--config`` reads; those left to be measured are left out."""
    head = f"# Settings of a run of turbrestore {__version__}; --config with this file repeats it.\n"
    record = {"bit_depth": bit_depth, **dataclasses.asdict(selection), **dataclasses.asdict(params)}
    atomic_write(path, (head + tomli_w.dumps(_without_none(record))).encode(), overwrite=True)


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

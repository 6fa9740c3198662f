"""``turbrestore info`` and ``turbrestore evaluate``: look at inputs and results."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from turbrestore.core.arrays import FloatArray, check_flow
from turbrestore.core.errors import DataError, require
from turbrestore.footage.checks.content import ContentReport, clean_source
from turbrestore.footage.temporal_mean import temporal_mean
from turbrestore.io.images.image_files import read_image
from turbrestore.io.limits import DEFAULT_LIMITS, check_input, input_errors
from turbrestore.io.npy import map_npy
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.memory_plan import training_share
from turbrestore.metrics import appearance, compare, compare_flows, part_shown
from turbrestore.runs.stage_files import load_flows
from turbrestore.stacking.quality import measure_quality, quality_table, sort_by_quality

from .inputs import open_checked, read_input_image
from .options import Flag, Selection, limits_of
from .output import print_json
from .streams import put

FLOW_SUFFIXES = (".npy", ".npz", ".flo")
# Unit and direction of every figure.
MEANINGS = {
    "psnr": "dB, higher is better",
    "psnr_fit": "dB after the best gain and offset, higher is better",
    "ssim": "structural similarity, 1 is best",
    "sharpness": "ratio to the second image, 1 is best if that is the truth",
    "overshoot": "share of the pixels, lower is better",
    "endpoint_error": "pixels, lower is better",
    "endpoint_error_centred": "pixels about the mean error, lower is better",
    "true_length": "pixels, mean length of the true flows",
}
# First bytes of a Middlebury flow file: 202021.25 as a float.
FLO_MAGIC = b"PIEH"


def info(
    input: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    quality: Flag = False,
    json: Flag = False,
) -> None:
    """Say what a video is: size, frames, rate, bit depth, what is wrong with it, and how many frames train by default.

    Parameters
    ----------
    input : Path
        Video (mp4, mkv, mov, avi, mts, wmv, …), animated PNG or WebP, TIFF stack, SER, FITS cube, .npy, or folder of
        images or FITS files.
    quality : bool
        Sort the frames by quality, and say what keeping 10, 25 and 50 % of them costs in noise and gains in sharpness,
        and which share is best.
    json : bool
        Print JSON.
    """
    source, content = open_checked(input, selection)
    cleaned = clean_source(source, content)
    record: dict[str, object] = {"input": str(input), **describe_clip(cleaned, content)}
    found = sort_by_quality(measure_quality(cleaned)) if quality else None
    if found is None or not json:
        _report(record, json)
    if found is not None and json:
        figures = dataclasses.asdict(found)
        ranked = [{"frame": cleaned.numbers[place], "quality": float(found.quality[place])} for place in found.order]
        print_json({**record, "quality": {**figures, "quality": ranked}})
    elif found is not None:
        put(f"\n{quality_table(found, cleaned.numbers)}")


def describe_clip(source: FrameSource, content: ContentReport) -> dict[str, object]:
    """Facts of a clip that was looked through and cleaned, for a person or a script."""
    count, height, width = source.shape[:3]
    return {
        "format": source.format,
        "frames": len(content.numbers),
        "usable_frames": count,
        "width": width,
        "height": height,
        "channels": 3 if len(source.shape) == 4 else 1,
        "bit_depth": source.bit_depth,
        "frames_per_second": None if source.fps is None else round(source.fps, 3),
        "duration_seconds": None if not source.fps else round(len(content.numbers) / source.fps, 2),
        "train": training_share(count, source.shape[1:]) if count >= 2 else None,
        "filled_values": content.filled_values,
        "stuck_pixels": len(content.stuck),
        "duplicated_frames": len(content.duplicated),
        "blank_frames": len(content.blank),
        "scenes": [f"{scene.first}:{scene.last + 1}" for scene in content.scenes],
        "saturated": round(content.saturated, 4),
        "warnings": list(source.warnings),
    }


def evaluate(
    result: Path,
    truth: Path | None = None,
    /,
    *,
    reference: Path | None = None,
    clip: Path | None = None,
    max_pixels: int | None = None,
    json: Flag = False,
) -> None:
    """Compare a result with the truth, after taking out crop and global shift.

    Images: PSNR, PSNR and structural similarity after the best gain and offset, sharpness and overshoot.  Flows:
    end-point error.

    Parameters
    ----------
    result : Path
        Image, or stage file with an image (.npz); flows (.npy, centroid .npz, .flo) where the truth is flows.
    truth : Path
        Image of the true scene, or true flows.  An array of .npy is flows if its last axis has two numbers.
    reference : Path
        Image of the same size, such as a frame or the temporal mean: sharpness and overshoot are measured against it.
    clip : Path
        Video, to compare its temporal mean as well, cut to the part that the result shows.  What the result gained over
        the mean is what the restoration did.
    max_pixels : int
        Largest image to read, pixels; by default 67 million.
    json : bool
        Print JSON.
    """
    figures: dict[str, float] = {}
    mean: dict[str, float] = {}
    limits = limits_of(max_pixels)
    if truth is not None and _holds_flows(truth):
        require(reference is None, "--reference: has no effect on flows; leave it out")
        require(clip is None, "--clip: has no effect on flows; leave it out")
        figures |= dataclasses.asdict(compare_flows(_read_flows(result), _read_flows(truth)))
    else:
        require(truth is not None or reference is not None, "evaluate: expected a truth or --reference, found neither")
        image = read_input_image(result, limits)
        require(clip is None or truth is not None, "--clip: has no effect without a truth; leave it out")
        if truth is not None:
            scene = read_input_image(truth, limits)
            figures |= dataclasses.asdict(compare(image, scene))
            if clip is not None:
                whole = temporal_mean(open_frames(clip, limits=limits))
                mean = dataclasses.asdict(compare(part_shown(whole, image), scene))
        if reference is not None:
            figures |= dataclasses.asdict(appearance(image, read_image(reference, limits).image))
    rounded, of_mean = ({name: _rounded(value) for name, value in some.items()} for some in (figures, mean))
    if json:
        print_json(rounded | ({"temporal_mean": of_mean} if of_mean else {}))
        return
    if of_mean:
        put(f"{'':<24}{'result':>8}{'mean':>9}")
    for name, value in rounded.items():
        row = [f"{name.replace('_', ' '):<24}{_plain(value):>8}", f"{_plain(of_mean[name]):>9}" if of_mean else ""]
        put(f"{''.join(row)}  {MEANINGS[name]}")


def _holds_flows(path: Path) -> bool:
    """Tell flows from an image by the name, and arrays by their last axis."""
    suffix = path.suffix.lower()
    return suffix in FLOW_SUFFIXES and (suffix != ".npy" or map_npy(path).shape[-1:] == (2,))


def _read_flows(path: Path) -> FloatArray:
    """Flows of shape (T, H, W, 2); one from a .flo file."""
    if path.suffix.lower() != ".flo":
        return load_flows(path)
    DEFAULT_LIMITS.check_bytes(check_input(path).st_size, str(path))
    with input_errors(path):
        data = path.read_bytes()
    header = np.frombuffer(data[:12].ljust(12, b"\0"), "<i4")
    width, height = int(header[1]), int(header[2])
    if data[:4] != FLO_MAGIC or len(data) != 12 + 8 * width * height or width < 1:
        raise DataError(f"{path}: expected a flow in a .flo file, found something else or damage")
    return check_flow(np.frombuffer(data, "<f4", offset=12).reshape(1, height, width, 2), str(path))


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value:g}"


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def _report(record: dict[str, object], as_json: bool) -> None:
    if as_json:
        print_json(record)
        return
    rows = [(name, line) for name, value in record.items() for line in (value if isinstance(value, list) else [value])]
    put("\n".join(f"{name.replace('_', ' '):<18} {'–' if line is None else line}" for name, line in rows))

"""``turbrestore info`` and ``turbrestore evaluate``: look at inputs and results."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from turbrestore.images import read_image
from turbrestore.metrics import compare
from turbrestore.pipeline import training_share
from turbrestore.video import open_frames

from .options import Flag, Selection
from .output import print_json


def info(
    input: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    json: Flag = False,
) -> None:
    """Say what a video is: size, frames, rate, bit depth, and how many frames train by default.

    Parameters
    ----------
    input : Path
        Video (mp4, mkv, avi, mov, webm, gif), TIFF stack, SER, .npy, or folder of images.
    json : bool
        Print JSON.
    """
    source = open_frames(input, frames=selection.frame_range(), roi=selection.region())
    count, height, width = source.shape[:3]
    record = {
        "input": str(input),
        "format": source.format,
        "frames": count,
        "width": width,
        "height": height,
        "channels": 3 if len(source.shape) == 4 else 1,
        "bit_depth": source.bit_depth,
        "frames_per_second": source.fps,
        "train": training_share(count, source.shape[1:]) if count >= 2 else None,
        "warnings": list(source.warnings),
    }
    _report(record, json)


def evaluate(result: Path, truth: Path, /, *, json: Flag = False) -> None:
    """Compare a result with the truth, after taking out crop and global shift.

    Parameters
    ----------
    result : Path
        Image.
    truth : Path
        Image of the true scene.
    json : bool
        Print JSON.
    """
    comparison = compare(read_image(result).image, read_image(truth).image)
    _report({name: round(value, 4) for name, value in dataclasses.asdict(comparison).items()}, json)


def _report(record: dict[str, object], as_json: bool) -> None:
    if as_json:
        print_json(record)
        return
    for name, value in record.items():
        lines = value if isinstance(value, list) else [value]
        for line in lines:
            sys.stdout.write(f"{name.replace('_', ' '):<18} {'–' if line is None else line}\n")

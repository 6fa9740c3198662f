"""How commands open inputs: within limits; videos are looked through, and remarked on."""

from __future__ import annotations

from pathlib import Path

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import DataError, require
from turbrestore.footage.content import ContentParams, ContentReport, check_content, clean_source
from turbrestore.io.images import read_image
from turbrestore.io.limits import Limits
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.runs.stage_files import load_stage_image

from .options import Selection
from .progress import say


def open_input(input: Path, selection: Selection, quiet: bool) -> FrameSource:
    """Open a video, repair its content or leave frames out, and say what was done."""
    source, report = open_checked(input, selection)
    if report.contrast == 0:
        raise DataError(f"{source.name}: expected a scene with some contrast, found frames of one intensity")
    cleaned = clean_source(source, report)
    for warning in cleaned.warnings:
        say(f"{cleaned.name}: {warning}", quiet)
    return cleaned


def open_checked(input: Path, selection: Selection) -> tuple[FrameSource, ContentReport]:
    """Open a video as its file has it, and look at every frame."""
    require(
        not (selection.strict and selection.skip_damaged),
        "--strict: contradicts --skip-damaged; leave one of them out",
    )
    source = open_frames(
        input,
        frames=selection.frame_range(),
        roi=selection.region(),
        limits=selection.limits(),
        skip_damaged=selection.skip_damaged,
        bayer=selection.bayer,
    )
    return source, check_content(source, ContentParams(strict=selection.strict))


def read_input_image(input: Path, limits: Limits) -> FloatArray:
    """Read an image file within limits, or the image of a stage file."""
    return load_stage_image(input) if input.suffix.lower() == ".npz" else read_image(input, limits).image

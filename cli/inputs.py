"""How commands open inputs: within limits; videos are looked through, and remarked on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from turbrestore.core.arrays import FloatArray, check_image
from turbrestore.core.errors import DataError, require
from turbrestore.footage.checks.content import ContentParams, ContentReport, check_content, clean_source
from turbrestore.io.astronomy.fits import open_fits
from turbrestore.io.astronomy.fits_header import is_fits
from turbrestore.io.images.image_files import IMAGE_SUFFIXES, read_image, read_pixels
from turbrestore.io.images.tiff import TIFF_SUFFIXES
from turbrestore.io.limits import Limits
from turbrestore.io.npy import map_npy
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.memory_plan import training_share
from turbrestore.runs.stage_files import load_guide, load_stage_image
from turbrestore.settings import RestoreParams

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
        hdr=selection.hdr,
        axes=selection.axes,
    )
    source = _calibrated(source, selection)
    if selection.crop_to_object:
        from turbrestore.footage.object_crop import crop_to_object

        source = crop_to_object(source)
    if selection.derotate is not None:
        from turbrestore.stacking.derotation import derotated, read_rotation

        source = derotated(source, read_rotation(selection.derotate))
    return source, check_content(source, ContentParams(strict=selection.strict))


def files_read(selection: Selection, *named: Path | None, params: RestoreParams | None = None) -> list[Path]:
    """List the files and folders that a command reads, which no output may replace: those it names, and settings do."""
    calibration = (None if name is None else Path(name) for name in (selection.dark, selection.flat))
    names = () if params is None else (params.static_mask, params.psf, params.reference, params.like)
    of_settings = (Path(name) for name in names if name not in (None, "auto", "off"))
    return [path for path in (*named, *calibration, *of_settings) if path is not None]


def with_absolute_paths(selection: Selection, params: RestoreParams) -> tuple[Selection, RestoreParams]:
    """Make the paths that settings name independent of the folder that a process works in."""
    dark, flat = (None if name is None else str(Path(name).absolute()) for name in (selection.dark, selection.flat))
    mask = params.static_mask
    if mask not in ("auto", "off"):
        mask = str(Path(mask).absolute())
    psf, reference, like = (
        None if name is None else str(Path(name).absolute()) for name in (params.psf, params.reference, params.like)
    )
    placed = dataclasses.replace(params, static_mask=mask, psf=psf, reference=reference, like=like)
    return dataclasses.replace(selection, dark=dark, flat=flat), placed


def frames_to_train(source: FrameSource, selection: Selection, train: int | None) -> int:
    """Return how many frames to use: as many as wanted, all that were named, or as many as ``restore`` trains on."""
    wanted = len(source) if train is None and selection.frames is not None else train
    return training_share(len(source), source.shape[1:], wanted)


def read_input_image(input: Path, limits: Limits) -> FloatArray:
    """Read an image file within limits, the image of a stage file, or an array of one image."""
    if input.suffix.lower() == ".npy":
        pixels = map_npy(input)
        if pixels.ndim != 2 and pixels.shape[2:] != (3,):
            raise DataError(f"{input}: expected an image of shape (H, W) or (H, W, 3), found shape {pixels.shape}")
        height, width = pixels.shape[:2]
        limits.check_size(width, height, str(input))
        return check_image(pixels, str(input))
    return load_stage_image(input) if input.suffix.lower() == ".npz" else read_image(input, limits).image


def read_guide(guide: Path, input: Path, limits: Limits) -> FloatArray:
    """Read the guide of a deconvolution; between stage files it follows the geometry of the input."""
    if guide.suffix.lower() == input.suffix.lower() == ".npz":
        return load_guide(guide, input)
    return read_input_image(guide, limits)


def _calibrated(source: FrameSource, selection: Selection) -> FrameSource:
    """Take out what ``--dark`` and ``--flat`` name."""
    if selection.dark is None and selection.flat is None:
        return source
    from turbrestore.footage.sensor.calibration import calibrated, make_calibration

    limits = selection.limits()
    dark, flat = (
        None if name is None else _open_frame(Path(name), limits) for name in (selection.dark, selection.flat)
    )
    return calibrated(source, make_calibration(source, dark, flat))


def _open_frame(path: Path, limits: Limits) -> FrameSource:
    """Open a video, or one image as a video of one frame."""
    if is_fits(path):
        return open_fits(path, limits, single=True)
    if path.is_dir() or path.suffix.lower() not in IMAGE_SUFFIXES or path.suffix.lower() in TIFF_SUFFIXES:
        return open_frames(path, limits=limits)
    pixels, notes = read_pixels(path, limits)
    return dataclasses.replace(FrameSource.from_array(pixels[None], path.name), path=path, warnings=notes)

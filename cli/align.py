"""``turbrestore align``: results of many clips in one geometry."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.core.errors import OutputError, TurbrestoreError, require
from turbrestore.footage.frame_selection import frame_quality
from turbrestore.io.folders import frame_files
from turbrestore.io.images.image_files import IMAGE_SUFFIXES, ImageFile, read_image, write_image
from turbrestore.io.output import IMAGE_OUTPUT_SUFFIXES, atomic_write, check_output
from turbrestore.stacking.alignment import Alignment
from turbrestore.stacking.results_alignment import AlignedResults, align_results, contact_sheet

from .batch_plan import find_clips, name_outputs
from .options import Flag, Machine, limits_of
from .output import check_distinct
from .progress import say

TABLE, SHEET, COLOUR = "alignment.csv", "sheet.png", "rgb"
_COLUMNS = ("result", "shift_x", "shift_y", "rotation", "scale", "bent", "likeness", "quality", "reason")


def align(
    *results: Path,
    out: Annotated[Path | None, Parameter(show=False)] = None,
    onto: Path | None = None,
    rgb: tuple[Path, Path, Path] | None = None,
    max_pixels: int | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Align the results of many clips to each other: shift, rotation, scale, and the smooth motion that remains.

    Brightness and contrast may differ.  Ends with 1 if any result could not be aligned.

    Parameters
    ----------
    results : Path
        Images, and last the folder to write to.  Images are files and patterns such as 'results/*.png'.  The folder
        gets each image aligned, alignment.csv with where it lay, and sheet.png with a thumbnail of each.
    out : Path
        The folder to write to, in place of the last word.
    onto : Path
        Image to align to; by default the median of the results.
    rgb : Path
        Three images of the red, green and blue filter, which are aligned too and written as one colour image, rgb.
    max_pixels : int
        Largest image to read, pixels; by default 67 million.
    overwrite : bool
        Replace existing outputs.
    quiet : bool
        No remarks.
    """
    named, out = _folder_last(results, out)
    files = _images(find_clips([*named, *(rgb or ())]))
    outputs = [
        path if path.suffix.lower() in IMAGE_OUTPUT_SUFFIXES else path.with_name(path.name + _suffix(file))
        for path, file in zip(name_outputs(files, out, ""), files, strict=True)
    ]
    colour = out / f"{COLOUR}{_suffix(rgb[0])}" if rgb is not None else None
    every = [*outputs, out / TABLE, out / SHEET, *([] if colour is None else [colour])]
    check_distinct(every)
    _make(out)
    read = [*files, *([] if onto is None else [onto])]
    for path in every:
        check_output(path, read, overwrite, suffixes=None)
    limits = limits_of(max_pixels)
    images = [read_image(path, limits) for path in files]
    target = None if onto is None else read_image(onto, limits).image
    found = align_results([image.image for image in images], target, machine.runtime())
    for path, file, image in zip(outputs, images, found.images, strict=True):
        if image is not None:
            write_image(path, image, file.bit_depth, overwrite)
    atomic_write(out / TABLE, _table(files, found).encode(errors="replace"), overwrite)
    shown = [(image, str(number)) for number, image in enumerate(found.images, 1) if image is not None]
    write_image(out / SHEET, contact_sheet(*zip(*shown, strict=True)), 8, overwrite)
    if colour is not None and rgb is not None:
        _write_colour(colour, rgb, files, images, found, overwrite)
    failed = [path for path, image in zip(files, found.images, strict=True) if image is None]
    say(f"{out}: {len(files) - len(failed)} of {len(files)} results aligned, {_spread(found)}", quiet)
    if failed:
        raise TurbrestoreError(f"align: {len(failed)} of {len(files)} results are not aligned; {out / TABLE} says why")


def _folder_last(paths: tuple[Path, ...], out: Path | None) -> tuple[tuple[Path, ...], Path]:
    """Split the words of the command into the results and the folder to write to."""
    if out is not None:
        return paths, out
    require(len(paths) >= 1, "align: expected images, and last the folder to write to")
    require(not paths[-1].is_file(), f"align: expected the folder to write to last, found the file {paths[-1]}")
    return paths[:-1], paths[-1]


def _images(paths: list[Path]) -> list[Path]:
    """List images, those of folders among them."""
    found = [file for path in paths for file in (frame_files(path) if path.is_dir() else [path])]
    for path in found:
        require(path.suffix.lower() in IMAGE_SUFFIXES, f"{path}: expected an image; turbrestore batch restores videos")
    return list(dict.fromkeys(found))


def _suffix(path: Path) -> str:
    """Suffix of what is written for an image: its own, or PNG where that is not written."""
    suffix = path.suffix.lower()
    return suffix if suffix in IMAGE_OUTPUT_SUFFIXES else ".png"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror})") from error


def _table(files: list[Path], found: AlignedResults) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for path, image, one in zip(files, found.images, found.alignments, strict=True):
        if isinstance(one, str) or image is None:
            writer.writerow([path, *[""] * (len(_COLUMNS) - 2), one])
            continue
        figures = [*one.shift, one.rotation, one.scale, one.residual, one.likeness, frame_quality([image])[0]]
        writer.writerow([path, *(f"{value:.5g}" for value in figures), ""])
    return text.getvalue()


def _spread(found: AlignedResults) -> str:
    """Say how far the results lay apart."""
    lay = [one for one in found.alignments if isinstance(one, Alignment)]
    shift = float(np.max([np.hypot(*one.shift) for one in lay]))
    turned = float(np.max([abs(one.rotation) for one in lay]))
    return f"the farthest {shift:.1f} pixels away, the most turned {turned:.2f}°"


def _write_colour(
    path: Path,
    rgb: tuple[Path, Path, Path],
    files: list[Path],
    images: list[ImageFile],
    found: AlignedResults,
    overwrite: bool,
) -> None:
    planes: list[FloatArray] = []
    for name in rgb:
        place = files.index(name)
        image = found.images[place]
        if image is None:
            raise TurbrestoreError(f"{name}: {found.alignments[place]}; {COLOUR} is not written")
        planes.append(luminance(image))
    write_image(path, np.stack(planes, -1), max(images[files.index(name)].bit_depth for name in rgb), overwrite)

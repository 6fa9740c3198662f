"""Folders of images as videos: which files are frames, in which order, and that they are of one kind."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from ..core.errors import DataError
from ..core.remarks import counted
from .astronomy.fits import open_fits_folder
from .astronomy.fits_header import FITS_SUFFIXES, is_fits
from .counts import source_of_numbers
from .images.image_files import IMAGE_SUFFIXES, read_pixels
from .images.raw_files import RAW_SUFFIXES
from .limits import Limits, input_errors
from .output import size_text
from .pixels import PixelArray
from .source import FrameSource

# Number, dot and number, not within a longer chain such as a date.
_FRACTION = re.compile(r"(?<![\d.])(\d+)\.(\d+)(?!\.?\d)")
# Of two files of one shot the first in this order is read.
_BEST = (*RAW_SUFFIXES, ".fits", ".fit", ".fts", ".tif", ".tiff", ".png", ".pgm", ".ppm", ".bmp", ".webp", ".jpg")


def open_folder(folder: Path, limits: Limits) -> FrameSource:
    """Open the images of a folder as a video; all have the size and type of the first."""
    with input_errors(folder):
        files = frame_files(folder)
    if not files:
        names = ", ".join((*IMAGE_SUFFIXES, *FITS_SUFFIXES))
        raise DataError(f"{folder}: expected images ({names}), found none in the folder")
    files, remarks = _one_of_each_shot(files)
    limits.check_count(len(files), str(folder))
    fits = sum(map(is_fits, files))
    if fits == len(files):
        source = open_fits_folder(folder, files, limits)
        return dataclasses.replace(source, warnings=(*source.warnings, *remarks))
    if fits:
        raise DataError(
            f"{folder}: expected images of one kind, found {counted(fits, 'FITS file')} among {len(files)} images"
        )
    first, notes = read_pixels(files[0], limits)

    def images(chosen: Sequence[int]) -> Iterator[PixelArray]:
        for number in chosen:
            pixels, _ = read_pixels(files[number], limits, like=files[0])
            if pixels.dtype != first.dtype or pixels.shape != first.shape:
                raise _odd_image(files, number, limits)
            yield pixels

    form, shape = f"images/{files[0].suffix.lower()[1:]}", (len(files), *first.shape)
    return source_of_numbers(folder, form, shape, first.dtype, images, (*notes, *remarks), limits)


def frame_files(folder: Path) -> list[Path]:
    """Images of a folder that are the frames of a video, without hidden files, folders and broken links.

    They are sorted by name, with digits compared as numbers, see :func:`in_order`.
    """
    named = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES or is_fits(path))
    return in_order(path for path in named if path.name[0] != "." and path.is_file())


def in_order(files: Iterable[Path]) -> list[Path]:
    """Sort files by name, with digits compared as numbers, and with decimals where the names have them.

    Digits after a dot are decimals if they differ in number and none ends in 0, as seconds are printed; those of a
    counter without leading zeros, ``part2.9`` and ``part2.10``, are not.
    """
    listed = list(files)
    digits = [match[2] for file in listed for match in _FRACTION.finditer(file.stem)]
    decimal = len({len(text) for text in digits}) > 1 and not any(len(text) > 1 and text[-1] == "0" for text in digits)

    def natural(file: Path) -> tuple[list[tuple[float, str]], str]:
        pattern = r"\d+\.\d+|\d+|\D+" if decimal else r"\d+|\D+"
        parts = re.findall(pattern, file.stem)
        return [(float(part), "") if part[0].isdecimal() else (-1.0, part.lower()) for part in parts], file.name

    return sorted(listed, key=natural)


def _one_of_each_shot(files: Sequence[Path]) -> tuple[list[Path], tuple[str, ...]]:
    """Leave out files that hold the shot of another, such as JPEG beside DNG; say so in a remark.

    Of the kinds of files that every shot has, the one that keeps most is read.
    """
    shots: dict[str, dict[str, Path]] = {}
    for file in files:
        shots.setdefault(file.stem.lower(), {})[file.suffix.lower()] = file
    kinds = {suffix for shot in shots.values() for suffix in shot}
    several = [shot for shot in shots.values() if len(shot) > 1]
    if not several:
        return list(files), ()
    common = [suffix for suffix in kinds if all(suffix in shot for shot in shots.values())]
    chosen = {id(shot): min(common or shot, key=_rank) for shot in shots.values()}
    kept = [shot[chosen[id(shot)]] for shot in shots.values()]
    read = " or ".join(sorted({chosen[id(shot)] for shot in several}, key=_rank))
    there = " and ".join(sorted({suffix for shot in several for suffix in shot}, key=_rank))
    return kept, (f"{counted(len(several), 'shot')} found as {there}: {read} is read",)


def _rank(suffix: str) -> int:
    return _BEST.index(suffix) if suffix in _BEST else len(_BEST)


def _odd_image(files: list[Path], number: int, limits: Limits) -> DataError:
    """Error for an image that is not like the first; of three images it names the one that differs from the others."""
    others = [0, number, number + 1 if number + 1 < len(files) else number // 2]
    kinds = []
    for place in others:
        pixels, _ = read_pixels(files[place], limits)
        kinds.append(f"{size_text(pixels.shape)} {pixels.dtype}")
    odd, usual = (0, 1) if kinds[1] == kinds[2] else (1, 0)
    return DataError(
        f"{files[others[odd]]}: expected {kinds[usual]} as {files[others[usual]].name}, found {kinds[odd]}; "
        "take it out of the folder if it is not a frame"
    )

"""Names of the files of a folder: their order, and files that hold the same shot."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from .raw_files import RAW_SUFFIXES

# Number, dot and number, not within a longer chain such as a date.
_FRACTION = re.compile(r"(?<![\d.])(\d+)\.(\d+)(?!\.?\d)")
# Of two files of one shot the first in this order is read.
_BEST = (*RAW_SUFFIXES, ".fits", ".fit", ".fts", ".tif", ".tiff", ".png", ".pgm", ".ppm", ".bmp", ".webp", ".jpg")


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


def one_of_each_shot(files: Sequence[Path]) -> tuple[list[Path], tuple[str, ...]]:
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
    return kept, (f"{len(several)} shots are there as {there}: {read} is read",)


def _rank(suffix: str) -> int:
    return _BEST.index(suffix) if suffix in _BEST else len(_BEST)

"""What a machine reads in clips whose answers are known: in one frame, in the mean, and in the restored image.

``python benchmarks/answers.py`` simulates clips, three of each kind by each of two simulators, with seeds on which
nothing was trained or chosen; ``--quick`` takes one of each kind.  ``python benchmarks/answers.py FOLDER`` reads a
user's own clips, which ``FOLDER/answers.json`` lists:

    [{"clip": "plate.mp4", "bytes": 1048576, "sha256": "9f86…", "licence": "CC BY 4.0", "kind": "words",
      "answer": ["AB12", "CDE"]}]

``clip`` is a video or a folder of images within the folder, ``bytes`` and ``sha256`` are those of the file, or of the
files in the folder one after the other in the order of their names; a wrong one is refused, with the one that was
found.  No answer is printed, so that a table of number plates can be shown.

Kinds, their answers, and what is read
--------------------------------------
words   list of words: the share of them that Tesseract reads, 0 to 1 (:mod:`words`)
code    text of a QR or bar code: 1 where OpenCV reads it from the image or its enlargements, otherwise 0
stars   separation of two stars, pixels: 1 where the two brightest peaks are as far apart to half a pixel, otherwise 0
lines   two ends, x, y, x, y, of each of some edges that are straight, pixels: root mean square distance of each edge
        from the line through it, pixels; nothing where an edge cannot be seen
image   path of a reference within the folder: PSNR against it after a shift and a change of gain and offset, dB
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blur_scenes import MARGIN
from blur_simulators import SIMULATORS, record
from provenance import publish
from words import missing, share_read

from turbrestore.core.arrays import FloatArray, from_unit, luminance
from turbrestore.core.errors import DataError, InputNotFoundError, TurbrestoreError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.video import open_frames
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.synthesis.scenes import printed_words

SIDE, FRAMES, SEEDS = 160, 40, (9500, 9501, 9502)
SIMULATED = {"screens": "phase screens", "kernels": "sums of short exposures"}
LISTING = "answers.json"
FIELDS = "clip", "bytes", "sha256", "licence", "kind", "answer"
COLUMNS = ("one frame", "mean", "restored", "truth")
# A frame is read in this many places of the clip, and the mean counts.
FRAMES_READ = 5
# Most enlargement at which a code is read.
ENLARGED = 3
# A second star is at least this share of the first and this many deviations of the noise high, and the dip between them
# is this share of it; its distance counts to this many pixels.
FAINTEST, ABOVE_NOISE, DIP, EXACT = 0.3, 6.0, 0.05, 0.5
# Pixels beside a line within which its edge is looked for, and the least step of an edge that can be seen.
REACH, STEP = 10, 0.02
# Bars of the digits of an EAN-13 code: those of the left half of odd parity, and which of the left are of even parity.
ODD = ("0001101", "0011001", "0010011", "0111101", "0100011", "0110001", "0101111", "0111011", "0110111", "0001011")
EVEN = ("000000", "001011", "001101", "001110", "010011", "011001", "011100", "010101", "010110", "011010")

HEAD = """# What a machine reads

What `{command}` measures: {count} simulated clips a row, each at most {frames} frames of {side}×{side}, read before \
and after restoration.  The readers are described in that file.  "Truth" is the scene in the mean geometry of the \
clip, which bends lines and moves stars a little.  A dash stands where not all clips of a row can be read.

"""
COLUMN_HEADS = "unit | one frame | mean | restored | truth |\n|---|---|---|---:|---:|---:|---:|\n"


@dataclass(frozen=True, eq=False)
class Question:
    """A clip, read when it is asked, with its answer; ``truth`` is its scene, if known."""

    name: str
    kind: str
    answer: Any
    frames: Callable[[], FloatArray]
    truth: FloatArray | None = None
    licence: str = ""


@dataclass(frozen=True)
class Reader:
    """A function of an image and an answer that returns NaN where nothing is read, its unit, and which answers fit."""

    read: Callable[[FloatArray, Any], float]
    unit: str
    expected: str
    fits: Callable[[Any], bool]


def code_read(image: FloatArray, text: str) -> float:
    """Return 1 where OpenCV reads this text from a QR or bar code in the image or its enlargements, otherwise 0."""
    grey = from_unit(luminance(image), 8)
    for scale in range(1, ENLARGED + 1):
        large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        readers = cv2.QRCodeDetector(), cv2.barcode.BarcodeDetector()
        found = [reader.detectAndDecode(large)[0] for reader in readers]
        # An EAN-13 code that begins with 0 is read as the 12 digits of a UPC-A code.
        if text in found or text in (f"0{code}" for code in found):
            return 1.0
    return 0.0


def two_apart(image: FloatArray, separation: float) -> float:
    """Return 1 where the two brightest peaks are as far apart as two stars, to half a pixel, otherwise 0."""
    # One pixel of noise is no star.
    grey = cv2.GaussianBlur(luminance(image), (0, 0), 1.0)
    grey -= np.median(grey)
    least = max(FAINTEST * grey.max(), ABOVE_NOISE * 1.4826 * np.median(np.abs(grey)))
    peaks = (grey == cv2.dilate(grey, np.ones((3, 3)))) & (grey >= least)
    places = sorted(np.argwhere(peaks[1:-1, 1:-1]) + 1, key=lambda place: -grey[*place])
    for place in places[1:]:
        between = np.linspace(places[0], place, 50, dtype=np.float32)
        path = cv2.remap(grey, between[:, 1], between[:, 0], cv2.INTER_LINEAR)
        if path.min() < (1 - DIP) * grey[*place]:
            found = np.linalg.norm(_summit(grey, places[0]) - _summit(grey, place))
            return float(abs(found - separation) <= EXACT)
    return 0.0


def _summit(grey: FloatArray, place: np.ndarray) -> FloatArray:
    """Place of a peak by the parabolas through it and its neighbours."""
    y, x = place
    shifts = []
    for low, middle, high in ((grey[y - 1, x], grey[y, x], grey[y + 1, x]), grey[y, x - 1 : x + 2]):
        curvature = low - 2 * middle + high
        shifts.append(0.5 * (low - high) / curvature if curvature < 0 else 0.0)
    return np.float32(place) + np.float32(shifts)


def bending(image: FloatArray, lines: Sequence[Sequence[float]]) -> float:
    """Root mean square distance of edges from the straight lines through them, pixels; NaN where one cannot be seen."""
    grey, residuals = cv2.GaussianBlur(luminance(image), (0, 0), 1.0), []
    beside = np.arange(-REACH, REACH + 1, dtype=np.float32)[:, None]
    for line in lines:
        start, end = np.float32(line).reshape(2, 2)
        length = float(np.linalg.norm(end - start))
        along = np.linspace(0, 1, int(length) + 1, dtype=np.float32)
        across = np.float32([start[1] - end[1], end[0] - start[0]]) / length
        points = (start + along[:, None] * (end - start))[:, None] + beside * across
        seen = cv2.remap(grey, *np.moveaxis(points, -1, 0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if abs(np.median(seen[:, -1] - seen[:, 0])) < STEP:
            return float("nan")
        slope = np.square(np.diff(seen, axis=1))
        places = (slope * np.arange(slope.shape[1])).sum(1) / np.maximum(slope.sum(1), 1e-12)
        residuals.append(np.mean(np.square(places - np.polyval(np.polyfit(along, places, 1), along))))
    return float(np.sqrt(np.mean(residuals)))


def likeness(image: FloatArray, reference: FloatArray) -> float:
    """PSNR against a reference after a shift and a change of gain and offset, dB."""
    return compare(luminance(image), luminance(reference)).psnr_fit


def _are_words(answer: Any) -> bool:
    return isinstance(answer, list) and all(isinstance(word, str) and word for word in answer)


def _are_lines(answer: Any) -> bool:
    return isinstance(answer, list) and all(map(_is_line, answer))


def _is_line(answer: Any) -> bool:
    four = isinstance(answer, list) and len(answer) == 4 and all(map(_is_number, answer))
    return four and answer[:2] != answer[2:]


def _is_number(answer: Any) -> bool:
    return isinstance(answer, (int, float)) and np.isfinite(answer)


def _is_text(answer: Any) -> bool:
    return isinstance(answer, str)


READERS = {
    "words": Reader(share_read, "share read", "a list of words", _are_words),
    "code": Reader(code_read, "share read", "a text", _is_text),
    "stars": Reader(two_apart, "share measured", "a number", _is_number),
    "lines": Reader(bending, "bent by, px", "a list of lines of four numbers, not of no length", _are_lines),
    "image": Reader(likeness, "PSNR, dB", "the path of an image", _is_text),
}


def ask(question: Question) -> dict[str, float]:
    """Read a clip before and after restoration."""
    read, frames = READERS[question.kind].read, question.frames()
    drawn = np.linspace(0, len(frames) - 1, FRAMES_READ).round().astype(int)
    row = {
        "one frame": float(np.mean([read(frames[number], question.answer) for number in drawn])),
        "mean": read(frames.mean(0), question.answer),
        "restored": read(np.clip(restore(frames).image, 0, 1), question.answer),
    }
    return row if question.truth is None else row | {"truth": read(question.truth, question.answer)}


def listed(folder: Path) -> list[Question]:
    """Clips of a user with their answers, all of which are checked.

    Raises
    ------
    InputNotFoundError
        The folder has no listing, or a clip is not there.
    DataError
        The listing is not as described, or a clip is not the one that is listed.
    """
    path = folder / LISTING
    if not path.is_file():
        raise InputNotFoundError(f"{path}: expected the list of the clips and their answers, found none")
    try:
        entries = [{**dict.fromkeys(FIELDS), **entry} for entry in json.loads(path.read_text("utf-8"))]
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: expected a list of clips as in benchmarks/answers.py, found {error}") from error
    return [_checked(folder, entry) for entry in entries]


def _checked(folder: Path, entry: dict[str, Any]) -> Question:
    path = folder / LISTING
    if lacking := [name for name in FIELDS if not entry[name]]:
        raise DataError(f"{path}: expected {', '.join(FIELDS)} of every clip, found no {lacking[0]}")
    name, kind, licence = (str(entry[field]) for field in ("clip", "kind", "licence"))
    if kind not in READERS:
        raise DataError(f"{path}: expected a kind of {', '.join(READERS)}, found {kind}")
    reader, answer = READERS[kind], entry["answer"]
    if not reader.fits(answer):
        raise DataError(f"{path}: expected {reader.expected} as the answer of {name}, found another")
    clip = folder / name
    if not clip.exists():
        raise InputNotFoundError(f"{clip}: expected the clip that {LISTING} lists, found none")
    found, wanted = _digest(clip), f"{entry['bytes']} bytes, sha256 {entry['sha256']}"
    if found != wanted:
        raise DataError(f"{clip}: expected {wanted}, found {found}")
    if kind == "words":
        answer = [word.lower() for word in answer]
    if kind == "image":
        answer = read_image(folder / answer).image
    return Question(name, kind, answer, lambda: open_frames(clip).read(), licence=licence)


def _digest(path: Path) -> str:
    """Size and digest of a file, or of the files in a folder, in words."""
    digest, size = hashlib.sha256(), 0
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if part.is_file():
            digest.update(part.read_bytes())
            size += part.stat().st_size
    return f"{size} bytes, sha256 {digest.hexdigest()}"


def simulated(thing: str, simulator: str, seed: int) -> Question:
    """Draw a scene with an answer and a clip of it."""
    rng = np.random.default_rng([seed, [*DRAWN].index(thing), [*SIMULATED].index(simulator)])
    kind, draw = DRAWN[thing]
    scene, answer = draw(SIDE + 2 * MARGIN, rng)
    frames, truth = SIMULATORS[simulator](scene, FRAMES, rng)
    seen = record(frames, rng)
    if kind == "image":
        return Question(thing, kind, truth, lambda: seen)
    return Question(thing, kind, answer, lambda: seen, truth)


def _plate(side: int, rng: np.random.Generator) -> tuple[FloatArray, list[str]]:
    """Print three groups of letters and digits."""
    letters = [rng.choice(list(some), 3) for some in ("ABCDEFGHJKLMNPRSTUVWXYZ", "23456789", "ABCDEFGHJKLMNPRSTUVWXYZ")]
    groups = ["".join(letters) for letters in letters]
    scene = np.full((side, side), np.float32(0.3))
    inner = scene[MARGIN:-MARGIN, MARGIN:-MARGIN]
    inner[20:-20, 10:-10] = printed_words(inner.shape[0] - 40, inner.shape[1] - 20, groups)
    return scene, [group.lower() for group in groups]


def _qr_code(side: int, rng: np.random.Generator) -> tuple[FloatArray, str]:
    text = "-".join(str(number) for number in rng.integers(1000, 10000, 2))
    modules = cv2.QRCodeEncoder.create().encode(text).astype(np.float32) / 255
    return _label(np.kron(modules, np.ones((4, 4), np.float32)), side), text


def _bar_code(side: int, rng: np.random.Generator) -> tuple[FloatArray, str]:
    """Draw an EAN-13 code whose bars are a pixel and a half wide at least."""
    digits = rng.integers(0, 10, 12).tolist()
    digits.append(-(sum(digits[0::2]) + 3 * sum(digits[1::2])) % 10)
    left = "".join(
        ODD[digit] if odd == "0" else _mirrored(ODD[digit])
        for digit, odd in zip(digits[1:7], EVEN[digits[0]], strict=True)
    )
    right = "".join(_inverted(ODD[digit]) for digit in digits[7:])
    bars = 1 - np.array([int(bar) for bar in f"101{left}01010{right}101"], np.float32)
    wide = cv2.resize(np.repeat(bars, 9)[None], (143, 1), interpolation=cv2.INTER_AREA)
    return _label(np.repeat(wide, 70, axis=0), side), "".join(map(str, digits))


def _inverted(bars: str) -> str:
    return bars.translate(str.maketrans("01", "10"))


def _mirrored(bars: str) -> str:
    return _inverted(bars)[::-1]


def _label(code: FloatArray, side: int) -> FloatArray:
    """Put a code on a light label before something darker."""
    scene = np.full((side, side), np.float32(0.35))
    top, left = (side - code.shape[0]) // 2, (side - code.shape[1]) // 2
    scene[top - 8 : top + code.shape[0] + 8, left - 8 : left + code.shape[1] + 8] = 0.9
    scene[top : top + code.shape[0], left : left + code.shape[1]] = 0.08 + 0.82 * code
    return scene


def _two_stars(side: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Draw two stars, 6 to 12 pixels apart, and some fainter ones around them."""
    separation, angle = float(rng.uniform(6, 12)), rng.uniform(0, np.pi)
    step = separation / 2 * np.array([np.cos(angle), np.sin(angle)])
    middle = side / 2 + rng.uniform(-8, 8, 2)
    stars = [(middle - step, 0.9), (middle + step, float(rng.uniform(0.4, 0.8)))]
    stars += [(rng.uniform(0, side, 2), float(rng.uniform(0.005, 0.03))) for _ in range(25)]
    y, x = np.mgrid[:side, :side].astype(np.float32)
    light = sum(much * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 0.9**2)) for (u, v), much in stars)
    return np.float32(0.03 + light), separation


def _edges(side: int, rng: np.random.Generator) -> tuple[FloatArray, list[list[float]]]:
    """Draw bright and dark courses."""
    tile, start = 32, MARGIN + 16
    scene = np.full((side, side), np.float32(0.3))
    for top in range(start, side - MARGIN - tile, 2 * tile):
        scene[top : top + tile] = rng.uniform(0.6, 0.9)
    scene += np.float32(0.02) * cv2.GaussianBlur(rng.standard_normal((side, side)), (0, 0), 1.5).astype(np.float32)
    edges = [start - MARGIN - 0.5 + tile * number for number in range(4)]
    return scene, [[10.0, edge, SIDE - 10.0, edge] for edge in edges]


def _granules(side: int, rng: np.random.Generator) -> tuple[FloatArray, None]:
    """Draw bright cells with dark lanes between them."""
    seeds = np.full((side, side), np.uint8(255))
    seeds[tuple(rng.integers(0, side, (2, (side // 14) ** 2)))] = 0
    away = cv2.distanceTransform(seeds, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    light = cv2.GaussianBlur(np.float32(1 - np.clip(away / 12, 0, 1) ** 2), (0, 0), 0.7)
    return 0.25 + 0.6 * light, None


# What is drawn: the kind of its reader, and the function that draws a square of a side and gives the answer.
DRAWN: dict[str, tuple[str, Callable[[int, np.random.Generator], tuple[FloatArray, Any]]]] = {
    "number plate": ("words", _plate),
    "QR code": ("code", _qr_code),
    "EAN-13 bar code": ("code", _bar_code),
    "double star": ("stars", _two_stars),
    "courses of a wall": ("lines", _edges),
    "granules of the Sun": ("image", _granules),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Read and print."""
    options = _options(arguments)
    try:
        text = _of_simulations(options.quick) if options.folder is None else _of_own(options.folder)
    except TurbrestoreError as error:
        print(f"answers: {error}", file=sys.stderr)
        return error.exit_code
    publish(text, options.write)
    return 0


def _of_simulations(quick: bool) -> str:
    seeds, simulators = (SEEDS[:1], [*SIMULATED][:1]) if quick else (SEEDS, [*SIMULATED])
    lines = []
    for thing, (kind, _) in DRAWN.items():
        for simulator in simulators if _can_read(kind) else ():
            rows = [_row(simulated(thing, simulator, seed)) for seed in seeds]
            lines.append(f"| {thing} | {SIMULATED[simulator]} | {_cells(kind, rows)} |\n")
    command = f"python benchmarks/answers.py{' --quick' * quick}"
    head = HEAD.format(command=command, count=len(seeds), frames=FRAMES, side=SIDE)
    return f"{head}| what is read | air | {COLUMN_HEADS}{''.join(lines)}"


def _of_own(folder: Path) -> str:
    asked = [question for question in listed(folder) if _can_read(question.kind)]
    lines = [f"| {_cell(one.name)} | {_cell(one.licence)} | {_cells(one.kind, [_row(one)])} |\n" for one in asked]
    return f"# What a machine reads\n\n| clip | licence | {COLUMN_HEADS}{''.join(lines)}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _can_read(kind: str) -> bool:
    """Whether what reads this kind is installed."""
    if kind == "words" and (reason := missing("tesseract")):
        print(f"words are left out: {reason}", file=sys.stderr)
        return False
    return True


def _row(question: Question) -> dict[str, float]:
    row = ask(question)
    print(f"{question.name}: {row}", file=sys.stderr, flush=True)
    return row


def _cells(kind: str, rows: Sequence[dict[str, float]]) -> str:
    """Join the unit and the means over clips, a dash where not all can be read."""
    means = [float(np.mean([row.get(column, np.nan) for row in rows])) for column in COLUMNS]
    return " | ".join([READERS[kind].unit, *("–" if np.isnan(mean) else f"{mean:.2f}" for mean in means)])


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help=f"folder of {LISTING} and the clips that it lists")
    parser.add_argument("--quick", action="store_true", help="simulate one clip of each kind")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args(arguments)
    if options.quick and options.folder is not None:
        parser.error("--quick: all clips of a folder are read")
    return options


if __name__ == "__main__":
    sys.exit(main())

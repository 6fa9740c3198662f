"""Scenes for synthetic turbulence, at any size: a resolution chart, a page of words, and pictures.

The pictures are those contained in the wheel of scikit-image; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import as_file, files
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import require
from ..io.images.image_files import read_image

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

# Smallest scene that is drawn, pixels a side, chosen.
SMALLEST = 64
# Grey pictures, then those in colour.
PICTURES = ("camera", "brick", "grass", "gravel", "coins", "moon", "page", "astronaut", "cat", "coffee", "rocket")
_FILES = {"cat": "chelsea.png", "rocket": "rocket.jpg"}
# Common words of five to eight letters, which are in the dictionary of a text recogniser.
WORDS = ("harbour", "window", "engine", "seventh", "market", "glacier", "copper", "journey", "planet", "bridge")
# Intensities of ink and paper, chosen.
_DARK, _BRIGHT = 0.12, 0.88
# Scenes are drawn this many times larger and averaged down, which avoids jagged edges; chosen.
OVERSAMPLING = 4
# Distance of lines in font sizes, and smallest font, whose letters are about half as high; both chosen.
_LINE_SPACING = 1.2
_SMALLEST_FONT = 6


def resolution_chart(height: int = 256, width: int = 256) -> FloatArray:
    """Draw a chart of bars, letters, a Siemens star, a checkerboard and thin lines.

    Returns (height, width).
    """
    require(min(height, width) >= SMALLEST, f"size: expected at least {SMALLEST} pixels a side, found {width}×{height}")
    rows = np.linspace(0, height, 3).round().astype(int)
    columns = np.linspace(0, width, 4).round().astype(int)
    painters: list[list[Callable[[int, int], FloatArray]]] = [
        [_bars, _siemens_star, _letters],
        [_thin_lines, _letters, _checkerboard],
    ]
    chart = np.full((height, width), _BRIGHT, np.float32)
    for row, line in enumerate(painters):
        for column, paint in enumerate(line):
            top, left = rows[row], columns[column]
            h, w = int(rows[row + 1] - top), int(columns[column + 1] - left)
            margin = max(2, min(h, w) // 14)
            inner = paint((h - 2 * margin) * OVERSAMPLING, (w - 2 * margin) * OVERSAMPLING)
            small = cv2.resize(inner, (w - 2 * margin, h - 2 * margin), interpolation=cv2.INTER_AREA)
            chart[top + margin : top + h - margin, left + margin : left + w - margin] = small
    return chart


def picture(name: str, height: int, width: int) -> FloatArray:
    """Load a photograph or texture of scikit-image, crop it centrally to the proportions asked for, and resize it.

    Returns (height, width) or (height, width, 3).
    """
    require(name in PICTURES, f"picture: expected one of {', '.join(PICTURES)}, found {name!r}")
    require(min(height, width) >= 1, f"size: expected at least 1 pixel a side, found {width}×{height}")
    # The functions of skimage.data could start a download, so the file is read directly.
    with as_file(files("skimage.data") / _FILES.get(name, f"{name}.png")) as path:
        whole = read_image(path).image
    scale = min(whole.shape[0] / height, whole.shape[1] / width)
    rows, columns = (max(1, round(scale * side)) for side in (height, width))
    top, left = (whole.shape[0] - rows) // 2, (whole.shape[1] - columns) // 2
    part = whole[top : top + rows, left : left + columns]
    method = cv2.INTER_AREA if scale >= 1 else cv2.INTER_CUBIC
    return np.clip(cv2.resize(part, (width, height), interpolation=method), 0.0, 1.0)


def printed_words(height: int, width: int, words: Sequence[str] = WORDS) -> FloatArray:
    """Print words on a page, as large as they fit, to measure how much of a text can be read.

    Returns (height, width).
    """
    from PIL import Image, ImageDraw

    require(min(height, width) >= SMALLEST, f"size: expected at least {SMALLEST} pixels a side, found {width}×{height}")
    require(any(word.strip() for word in words), "words: expected at least one word, found none")
    margin = max(4, min(height, width) // 20) * OVERSAMPLING
    room = (width * OVERSAMPLING - 2 * margin, height * OVERSAMPLING - 2 * margin)
    font, lines = _largest_print(words, *room)
    require(bool(lines), f"words: expected words that fit on {width}×{height} pixels, found {len(words)}; print fewer")
    ink = Image.new("L", (width * OVERSAMPLING, height * OVERSAMPLING))
    drawing = ImageDraw.Draw(ink)
    pitch = room[1] / len(lines)
    for index, line in enumerate(lines):
        drawing.text((margin, margin + (index + 0.5) * pitch), line, fill=255, font=font, anchor="lm")
    share = cv2.resize(np.asarray(ink, np.float32) / 255, (width, height), interpolation=cv2.INTER_AREA)
    return (_BRIGHT + (_DARK - _BRIGHT) * share).astype(np.float32)


def _largest_print(words: Sequence[str], width: int, height: int) -> tuple[FreeTypeFont | ImageFont, list[str]]:
    """Largest font with which the words fit, and their lines; no lines if there is none."""
    from PIL import ImageFont

    size = float(height)
    while size >= _SMALLEST_FONT * OVERSAMPLING:
        font = ImageFont.load_default(size)
        lines = _broken_lines(words, font, width)
        if lines and len(lines) * _LINE_SPACING * size <= height:
            return font, lines
        # Each step is a twelfth of an octave.
        size *= 2 ** (-1 / 12)
    return ImageFont.load_default(), []


def _broken_lines(words: Sequence[str], font: FreeTypeFont | ImageFont, width: int) -> list[str]:
    """Break words into lines of at most ``width`` pixels; no lines if a word is longer."""
    lines: list[str] = []
    for word in words:
        if font.getlength(word) > width:
            return []
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _bars(height: int, width: int) -> FloatArray:
    """Bars of increasing frequency, vertical in the upper half and horizontal in the lower."""
    x = np.linspace(0, 1, width, endpoint=False, dtype=np.float32)
    finest = width / OVERSAMPLING / 5
    phase = finest * (0.25 * x + 0.375 * x**2)
    upright = np.where(phase % 1 < 0.5, _DARK, _BRIGHT).astype(np.float32)
    y = np.linspace(0, 1, height - height // 2, endpoint=False, dtype=np.float32)
    level = np.where((finest * (0.25 * y + 0.25 * y**2)) % 1 < 0.5, _DARK, _BRIGHT).astype(np.float32)
    upper, lower = np.tile(upright, (height // 2, 1)), np.tile(level[:, None], (1, width))
    return np.vstack([upper, lower])


def _siemens_star(height: int, width: int) -> FloatArray:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    dy, dx = y - (height - 1) / 2, x - (width - 1) / 2
    sectors = np.where(np.sin(18 * np.arctan2(dy, dx)) > 0, _DARK, _BRIGHT).astype(np.float32)
    return np.where(np.hypot(dx, dy) <= 0.48 * min(height, width), sectors, np.float32(_BRIGHT))


def _letters(height: int, width: int) -> FloatArray:
    """Lines of letters, each smaller than the one above."""
    ink = np.zeros((height, width), np.uint8)
    baseline, size = 0.0, 0.24 * height
    for text in ("HAZE", "SEEING", "REFRACT", "TURBULENCE", "SCINTILLATION"):
        (text_width, text_height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 2)
        scale = min(size / text_height, 0.98 * width / text_width)
        thickness = max(1, round(0.14 * scale * text_height))
        baseline += 1.35 * scale * text_height
        if baseline > height:
            break
        origin = (round(0.01 * width), round(baseline))
        cv2.putText(ink, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness, cv2.LINE_8)
        size *= 0.8
    return _printed(ink)


def _thin_lines(height: int, width: int) -> FloatArray:
    """Fan of lines one to two pixels wide."""
    ink = np.zeros((height, width), np.uint8)
    for index, angle in enumerate(np.linspace(0, np.pi / 2, 11)):
        end = (round(width * float(np.cos(angle))), round(height * float(np.sin(angle))))
        cv2.line(ink, (0, 0), end, 255, OVERSAMPLING * (1 + index % 2), cv2.LINE_8)
    return _printed(ink)


def _printed(ink: NDArray[np.uint8]) -> FloatArray:
    return np.where(ink > 127, np.float32(_DARK), np.float32(_BRIGHT))


def _checkerboard(height: int, width: int) -> FloatArray:
    """Squares of four sizes, one in each quarter."""
    y, x = np.mgrid[:height, :width]
    side = np.where(y < height // 2, np.where(x < width // 2, 12, 8), np.where(x < width // 2, 6, 4)) * OVERSAMPLING
    return np.where((x // side + y // side) % 2 == 0, _DARK, _BRIGHT).astype(np.float32)


SCENES: dict[str, Callable[[int, int], FloatArray]] = {
    "chart": resolution_chart,
    "words": printed_words,
    **{name: partial(picture, name) for name in PICTURES},
}

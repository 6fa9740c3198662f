"""Scenes to look at through turbulence, drawn at any size."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import require

SMALLEST = 64
_DARK, _BRIGHT = 0.12, 0.88
# Drawn this many times larger and averaged down: no jagged edges.
_OVERSAMPLING = 4


def resolution_chart(height: int = 256, width: int = 256) -> FloatArray:
    """Bars, letters, a Siemens star, a checkerboard and thin lines, one kind in each part of the image.

    Parameters
    ----------
    height, width : int
        Size in pixels, at least 64.

    Returns
    -------
    ndarray, float32, shape (height, width)

    Raises
    ------
    ConfigurationError
        The size is too small.

    Examples
    --------
    >>> chart = resolution_chart(128, 192)
    >>> chart.shape, round(float(chart.min()), 2), round(float(chart.max()), 2)
    ((128, 192), 0.12, 0.88)
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
            inner = paint((h - 2 * margin) * _OVERSAMPLING, (w - 2 * margin) * _OVERSAMPLING)
            small = cv2.resize(inner, (w - 2 * margin, h - 2 * margin), interpolation=cv2.INTER_AREA)
            chart[top + margin : top + h - margin, left + margin : left + w - margin] = small
    return chart


def _bars(height: int, width: int) -> FloatArray:
    """Bars that get finer from left to right, upright in the upper half and level in the lower."""
    x = np.linspace(0, 1, width, endpoint=False, dtype=np.float32)
    finest = width / _OVERSAMPLING / 5
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
        cv2.line(ink, (0, 0), end, 255, _OVERSAMPLING * (1 + index % 2), cv2.LINE_8)
    return _printed(ink)


def _printed(ink: NDArray[np.uint8]) -> FloatArray:
    return np.where(ink > 127, np.float32(_DARK), np.float32(_BRIGHT))


def _checkerboard(height: int, width: int) -> FloatArray:
    """Squares that shrink from quarter to quarter."""
    y, x = np.mgrid[:height, :width]
    side = np.where(y < height // 2, np.where(x < width // 2, 12, 8), np.where(x < width // 2, 6, 4)) * _OVERSAMPLING
    return np.where((x // side + y // side) % 2 == 0, _DARK, _BRIGHT).astype(np.float32)


SCENES: dict[str, Callable[[int, int], FloatArray]] = {"chart": resolution_chart}

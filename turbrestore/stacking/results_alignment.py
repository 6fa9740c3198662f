"""The results of many clips in one geometry, and all of them on one sheet.

Symbols
-------
q_i : results; F_i : alignment of q_i to a reference, see :mod:`turbrestore.stacking.alignment`
F̄ : mean of the F_i; V : its inverse flow

Where no result is named as the reference, all are first aligned to the sharpest one.  Its geometry is its own, so that
all are moved onto the mean geometry, ``q_i ∘ (id + F_i ∘ (id + V) + V)``, as frames are onto their centroid (paper 3,
eq. 12); the median of these is free of what only a few of them have, and all are aligned to it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..core.arrays import FloatArray, from_unit, luminance
from ..core.errors import DataError
from ..core.robust import spread
from ..footage.frame_selection import frame_quality
from ..registration.flow_algebra import compose_flows, invert_flow
from ..registration.warp import warp
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.threads import map_ahead
from .alignment import Alignment, align_to

# Results that the median is taken of, at most, chosen.
_MEDIAN_OF = 31
# Longest side of a thumbnail, and room for its number, pixels; both chosen.
_SIDE, _LINE = 160, 18


@dataclass(frozen=True, eq=False)
class AlignedResults:
    """Results in one geometry.

    Attributes
    ----------
    images : tuple of ndarray or None
        float32, of the size of the reference; None for those that could not be aligned.
    alignments : tuple of Alignment or str
        Where each lay against the reference, or why it could not be aligned.
    reference : ndarray, float32, shape (H, W)
        Luminance of what they were aligned to.
    """

    images: tuple[FloatArray | None, ...]
    alignments: tuple[Alignment | str, ...]
    reference: FloatArray


def align_results(
    results: Sequence[FloatArray], onto: FloatArray | None = None, runtime: Runtime = DEFAULT
) -> AlignedResults:
    """Align images of one scene to one of them, or to their median.

    Images of other sizes are compared centre to centre.

    Parameters
    ----------
    results : sequence of ndarray, float32, shape (H, W) or (H, W, 3)
        At least one.
    onto : ndarray, float32, shape (H, W) or (H, W, 3), optional
        The reference; by default the median of the results, in the size of the sharpest one.
    runtime : Runtime
        Threads.

    Returns
    -------
    AlignedResults

    Raises
    ------
    DataError
        There are no results, or none of them can be aligned.

    Examples
    --------
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> chart = resolution_chart(96, 96)
    >>> found = align_results([chart, np.roll(chart, 3, axis=1)], onto=chart)
    >>> [round(one.shift[0]) for one in found.alignments]
    [0, 3]
    """
    if not results:
        raise DataError("results: expected at least one image, found none")
    anchor = onto if onto is not None else results[int(np.argmax([float(frame_quality([one])[0]) for one in results]))]
    size = anchor.shape[:2]
    canvas = tuple(max(one.shape[axis] for one in (anchor, *results)) for axis in (0, 1))
    placed = [_on_canvas(one, canvas) for one in results]
    reference = luminance(_on_canvas(anchor, canvas))
    found = _aligned(placed, reference, runtime)
    if onto is None:
        reference = _median(placed, found)
        found = _aligned(placed, reference, runtime)
    part = _centre(canvas, size)
    images = tuple(
        None if isinstance(one, str) else np.ascontiguousarray(warp(image, one.flow)[part])
        for image, one in zip(placed, found, strict=True)
    )
    return AlignedResults(images, tuple(found), reference[part])


def contact_sheet(images: Sequence[FloatArray], labels: Sequence[str]) -> FloatArray:
    """Draw thumbnails with a short label each, in rows, as one image in colour."""
    longest = max(max(image.shape[:2]) for image in images)
    cells = []
    for image, label in zip(images, labels, strict=True):
        small = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        factor = min(_SIDE / longest, 1.0)
        size = max(round(small.shape[1] * factor), 1), max(round(small.shape[0] * factor), 1)
        small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
        cell = np.zeros((_SIDE + _LINE, _SIDE, 3), np.uint8)
        cell[: small.shape[0], : small.shape[1]] = from_unit(small, 8)
        place, white = (2, _SIDE + 13), (230, 230, 230)
        cells.append(cv2.putText(cell, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, white, 1, cv2.LINE_AA))
    columns = int(np.ceil(np.sqrt(len(cells))))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [np.hstack(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    return np.vstack(rows).astype(np.float32) / np.float32(255)


def _aligned(images: Sequence[FloatArray], reference: FloatArray, runtime: Runtime) -> list[Alignment | str]:
    def align(image: FloatArray) -> Alignment | str:
        try:
            return align_to(image, reference)
        except DataError as error:
            return str(error).removeprefix("image: ")

    found = [one for _, one in map_ahead(align, images, runtime.threads)]
    if all(isinstance(one, str) for one in found):
        raise DataError(f"results: expected images of one scene, found none that can be aligned; {found[0]}")
    return found


def _median(images: Sequence[FloatArray], found: Sequence[Alignment | str]) -> FloatArray:
    """Median of the luminance of aligned images, on their mean geometry."""
    pairs = [(image, one.flow) for image, one in zip(images, found, strict=True) if isinstance(one, Alignment)]
    V = invert_flow(np.mean([flow for _, flow in pairs], axis=0, dtype=np.float32))
    chosen = [pairs[place] for place in spread(len(pairs), _MEDIAN_OF)]
    moved = [warp(luminance(image), compose_flows(flow, V)) for image, flow in chosen]
    median = np.median(moved, axis=0)
    return np.asarray(median, np.float32)


def _on_canvas(image: FloatArray, canvas: tuple[int, ...]) -> FloatArray:
    """Put an image into the middle of a canvas, which its border fills."""
    part = _centre(canvas, image.shape[:2])
    widths = [(piece.start, length - piece.stop) for piece, length in zip(part, canvas, strict=True)]
    return np.pad(image, [*widths, *[(0, 0)] * (image.ndim - 2)], mode="edge")


def _centre(canvas: tuple[int, ...], size: tuple[int, ...]) -> tuple[slice, slice]:
    rows, columns = ((whole - part) // 2 for whole, part in zip(canvas, size, strict=True))
    return slice(rows, rows + size[0]), slice(columns, columns + size[1])

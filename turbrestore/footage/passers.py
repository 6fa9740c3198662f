"""What moves through the scene: cars and people, behind which most frames show the background.

Symbols
-------
m, v : median of the frames at every pixel; squared median deviation, scaled to a variance
d : squared deviation of a frame from m, averaged in a Gaussian window

Turbulence bends edges by a few pixels, so v is large beside edges.  A pixel belongs to what passes where d exceeds the
largest v around it several times, over an area that holds a disc of 15 pixels; what is smaller, the alternating filter
leaves out (:mod:`turbrestore.filtering.frame_noise`).  Such pixels are replaced by the mean of the frames that show the
background there.  The mean is less sharp than a frame and weighs little in the filter, but flow is no longer pulled
along by what passes.

The median is the background where that is seen in more than half of the frames.  Frames are compared where they are, so
nothing is replaced while the camera moves.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import global_shifts

# Frames of which the median is taken, the fewest that tell what passes, and rows that it is taken of at once.
_SAMPLES, _FEWEST, _ROWS = 25, 9, 64
_MEDIAN_DEVIATION = 1.4826
# d counts from the first times the sum of v and the square of the second; windows of d and of v, pixels.
_EXCEEDS, _LEAST_DEVIATION = 8.0, 0.01
_WINDOW, _USUAL_WINDOW, _USUAL_REACH = 1.5, 3.0, 4
# Radii of the gaps that are closed, of the discs that must fit, and of the surroundings that are replaced too, pixels.
_GAP, _DISC, _AROUND = 2, 7, 3
# Standard deviation of the transition between frame and background, pixels.
_FADE = 1.5
# Least and largest share of the frames that passes, largest part of a frame that is replaced, and fewest frames that
# show a pixel of the background.
_LEAST, _LARGEST, _LARGEST_PART, _SEEN = 0.0025, 0.35, 0.5, 3
# Root mean square of the shifts from which the camera moves, pixels; least share of all edges that the background has;
# longest side of the frames that both are found in.
_CAMERA, _OWN_EDGES, _SIDE = 3.0, 0.5, 192


@dataclass(frozen=True, eq=False)
class Background:
    """The scene behind what passes, and where something does.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    known : ndarray, uint8, shape (H, W)
        1 where enough frames show the background, else 0.
    masks : dict of int to ndarray, uint8
        What passes in a frame, by the number of the frame in the file: a PNG of shape (H, W); none where nothing does.
    window : tuple of slice
        Rows and columns of the file that these are.
    """

    image: FloatArray
    known: NDArray[np.uint8]
    masks: dict[int, NDArray[np.uint8]]
    window: Window

    def shown(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Replace what passes in a frame, or in a window of it.

        Parameters
        ----------
        number : int
            Of the frame, in the file.
        values : ndarray, float32, shape (h, w) or (h, w, 3)
        window : tuple of slice
            Rows and columns of the file that they are.

        Returns
        -------
        ndarray, float32, shape of ``values``

        Examples
        --------
        >>> _, stored = cv2.imencode(".png", np.ones((16, 16), np.uint8))
        >>> scene, known = np.full((16, 16), 0.5, np.float32), np.ones((16, 16), np.uint8)
        >>> background = Background(scene, known, {7: stored}, np.s_[0:16, 0:16])
        >>> background.shown(7, np.ones((1, 2), np.float32), np.s_[8:9, 8:10])
        array([[0.5, 0.5]], dtype=float32)
        """
        if number not in self.masks:
            return values
        # The whole mask is faded, so that a tile is that part of the whole frame.
        mask = np.asarray(cv2.imdecode(self.masks[number], cv2.IMREAD_GRAYSCALE), np.uint8)
        inside = cv2.erode(mask, _disc(_AROUND)).astype(np.float32)
        weight = np.maximum(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _FADE), inside) * (mask & self.known)
        part = tuple(
            slice(wanted.start - own.start, wanted.stop - own.start)
            for wanted, own in zip(window, self.window, strict=True)
        )
        weight = weight[part] if values.ndim == 2 else weight[part][..., None]
        return values + weight * (self.image[part] - values)


def without_passers(source: FrameSource) -> tuple[FrameSource, tuple[Decision, ...]]:
    """Replace what passes by the background; a source in which nothing does is returned as it is.

    Parameters
    ----------
    source : FrameSource

    Returns
    -------
    source : FrameSource
    decisions : tuple of Decision
        What was found, if anything.

    Raises
    ------
    DataError
        Frames are damaged.

    Examples
    --------
    >>> frames = np.tile(np.kron(np.eye(3, 6), np.full((16, 16), 0.5)), (15, 1, 1))
    >>> for k, frame in enumerate(frames):
    ...     frame[12:30, 6 * k : 6 * k + 12] = 0.9
    >>> cleaned, (found,) = without_passers(FrameSource.from_array(frames))
    >>> bool(cleaned.read().max() < 0.6), found.subject
    (True, 'passers')
    """
    usual = _usual_of(source) if len(source) >= _FEWEST else None
    if usual is None:
        return source, ()
    background, share, touched = _background(source, *usual)
    reason = f"they cover {share:.1%} of the frames, and {touched:.0%} of the scene at some time"
    decision = Decision("passers", "replaced by the background", reason)
    return source.adjusted(background.shown), (decision,)


def _usual_of(source: FrameSource) -> tuple[FloatArray, FloatArray] | None:
    """Median of the frames, and the value that d does not exceed where nothing passes; None where nothing does."""
    picked = np.unique(np.linspace(0, len(source) - 1, _SAMPLES).round().astype(int))
    sample = dataclasses.replace(source, numbers=tuple(source.numbers[int(index)] for index in picked))
    stack = np.empty((len(sample), *sample.shape[1:3]), np.uint8)
    for plane, frame in zip(stack, sample, strict=True):
        np.rint(255 * np.clip(luminance(frame), 0, 1), out=plane, casting="unsafe")
    median, usual = _usual(stack)
    share = float(np.mean([_passing(_grey(plane), median, usual).mean() for plane in stack]))
    return (median, usual) if _LEAST <= share <= _LARGEST and _stands(stack, median, usual) else None


def _grey(plane: NDArray[np.uint8]) -> FloatArray:
    return plane.astype(np.float32) / np.float32(255)


def _stands(stack: NDArray[np.uint8], median: FloatArray, usual: FloatArray) -> bool:
    """Whether what is left without the passers is a scene, with edges of its own, that stands in the frame.

    A planet that drifts over a black sky passes through nothing.
    """
    height, width = median.shape
    factor = max(1.0, max(height, width) / _SIDE)
    size = max(16, round(width / factor)), max(16, round(height / factor))
    whole, left = (np.empty((len(stack), size[1], size[0]), np.float32) for _ in range(2))
    for number, plane in enumerate(stack):
        grey = _grey(plane)
        for small, image in ((whole, grey), (left, np.where(_passing(grey, median, usual) > 0, median, grey))):
            small[number] = cv2.GaussianBlur(cv2.resize(image, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    edges = [np.hypot(*np.gradient(small, axis=(1, 2))).sum() for small in (whole, left)]
    shifts = global_shifts(left) * (width / size[0], height / size[1])
    return bool(edges[1] > _OWN_EDGES * edges[0]) and float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))) < _CAMERA


def _usual(stack: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
    """Median, and the value that d does not exceed where nothing passes."""
    median, variance = (np.empty(stack.shape[1:], np.float32) for _ in range(2))
    for top in range(0, stack.shape[1], _ROWS):
        rows = np.s_[top : top + _ROWS]
        values = stack[:, rows].astype(np.float32) / 255
        median[rows] = np.median(values, axis=0)
        variance[rows] = (_MEDIAN_DEVIATION * np.median(np.abs(values - median[rows]), axis=0)) ** 2
    around = cv2.GaussianBlur(variance, (0, 0), _USUAL_WINDOW)
    around = cv2.dilate(around, np.ones((2 * _USUAL_REACH + 1,) * 2, np.uint8))
    return median, np.float32(_EXCEEDS) * (around + np.float32(_LEAST_DEVIATION**2))


def _passing(grey: FloatArray, median: FloatArray, usual: FloatArray) -> NDArray[np.uint8]:
    """Mark what passes by 1; nothing where it would be most of the frame, which then shows something else."""
    mask = (cv2.GaussianBlur((grey - median) ** 2, (0, 0), _WINDOW) > usual).view(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(_GAP))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(_DISC))
    mask = np.asarray(cv2.dilate(mask, _disc(_AROUND)), np.uint8)
    return mask if mask.mean() <= _LARGEST_PART else np.zeros_like(mask)


def _background(source: FrameSource, median: FloatArray, usual: FloatArray) -> tuple[Background, float, float]:
    """Average the frames where nothing passes; the share of the frames and that of the scene where something does."""
    total, count = np.zeros(source.shape[1:]), np.zeros(source.shape[1:3], np.float32)
    masks: dict[int, NDArray[np.uint8]] = {}
    for number, frame in zip(source.numbers, source, strict=True):
        mask = _passing(luminance(frame), median, usual)
        if mask.any():
            masks[number] = np.asarray(cv2.imencode(".png", mask)[1], np.uint8)
        cv2.accumulate(frame, total, 1 - mask)
        count += 1 - mask
    seen = np.maximum(count, 1) if total.ndim == 2 else np.maximum(count, 1)[..., None]
    known = (count >= _SEEN).astype(np.uint8)
    background = Background((total / seen).astype(np.float32), known, masks, source.window)
    return background, 1 - float(count.mean()) / len(source), float((count < len(source)).mean())


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)

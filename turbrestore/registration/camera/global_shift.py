"""Global shifts: the motion that a shaking or drifting camera adds to turbulence, removed before dense flow.

Symbols
-------
s : shift (dx, dy) of a whole frame, pixels, ``reference(x, y) ≈ frame(x + dx, y + dy)``
F, R : spectra of the windowed frame and reference; ``R* F / |R* F|`` peaks at s (phase correlation, Kuglin and Hines
    1975)

Dense flow follows a texture over at most a tenth of the image side; phase correlation finds shifts of a quarter of it
and more.  It is cheap, because it runs on reduced images: dense flow measures the rest.  A peak is accepted only if
moving the frame by it makes the images clearly more alike where they overlap.  Turbulence alone does not pass that
test, so its frames are left as they are.

A camera that turns or zooms is followed by :mod:`turbrestore.registration.camera.stabilisation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import FloatArray, check_frames, check_image, luminance
from ...core.errors import DataError
from ...runtime.fourier import irfft2, rfft2
from ...runtime.scratch import iter_frames
from ...runtime.threads import map_ahead

# Images are reduced by a whole factor until no side is longer; larger ones would only take longer.
LONGEST_SIDE = 192
# Window of the local contrast normalisation, pixels of the reduced image: with half of it, tests lose a camera that
# turns, and with twice as much one that drifts.  Intensity deviation below which a region counts as flat, chosen.
_WINDOW, _FLOOR = 6.0, 0.01
# Standard deviation of the expected peak, pixels of the reduced image, chosen: turbulence smears it.
_PEAK_WIDTH = 1.0
# Correlation that a shift must reach, and its least gain over the correlation without a shift, both chosen.
LEAST_CORRELATION, _LEAST_GAIN = 0.3, 0.1
# Share of the image below which an overlap says nothing about the whole, chosen.
_LEAST_OVERLAP = 0.1
# Shifts up to this many pixels, chosen, are left to dense flow.  From as many on, a camera turns.
DEAD_ZONE = 2.0
# A flow moves as a whole if this share of it, chosen, lies within the dead zone around its median; both are computed
# from at most so many rows and columns, for their cost.
_SHARE_OF_WHOLE, _SAMPLE = 0.75, 32

Shift = NDArray[np.float64]
Slices = tuple[slice, slice]
Pixels = TypeVar("Pixels", bound=NDArray[Any])


@dataclass(frozen=True)
class ShiftReference:
    """An image that shifts are measured against."""

    reduced: FloatArray  # (h, w): the reduced image with normalised contrast
    spectrum: NDArray[np.complex64]  # (h, w // 2 + 1): its conjugate spectrum under a Hann window
    shape: tuple[int, int]  # (H, W) of the image at full size


def prepare_shift_reference(image: ArrayLike) -> ShiftReference:
    """Prepare an image (H, W[, 3]) that the shifts of many frames are measured against."""
    checked = check_image(image)
    reduced = reduce_image(checked)
    return ShiftReference(reduced, np.conj(_spectrum(reduced)), checked.shape[:2])


def measure_shift(image: ArrayLike, reference: ShiftReference) -> Shift | None:
    """Shift (2,) of a frame (H, W[, 3]) against a reference; None if they are not alike."""
    checked = check_image(image)
    if checked.shape[:2] != reference.shape:
        raise DataError(f"image: expected {reference.shape} pixels as the reference has, found {checked.shape[:2]}")
    reduced = reduce_image(checked)
    peak = _peak(reference.spectrum * _spectrum(reduced), reduced.shape)
    still = correlation(reference.reduced, reduced)
    to, origin = overlap(reduced.shape, np.rint(peak))
    seen = reduced[origin]
    moved = correlation(reference.reduced[to], seen) if seen.size > _LEAST_OVERLAP * reduced.size else 0.0
    if max(still, moved) < LEAST_CORRELATION:
        return None
    scale = np.divide(reference.shape, reduced.shape)[::-1]
    return peak * scale if moved > still + _LEAST_GAIN else np.zeros(2)


def global_shifts(frames: ArrayLike) -> Shift:
    """Shift of each frame against the mean position of all.

    Frames are compared with the middle one, and if that is too far away, with the last one whose shift is known.  A
    frame that resembles neither, because it is black or shows something else, gets a shift between its neighbours'.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Frames of one scene.

    Returns
    -------
    ndarray, float64, shape (T, 2)
        (dx, dy) in pixels, zero on average.

    Raises
    ------
    DataError
        Wrong shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> scene = np.random.default_rng(0).random((64, 100)).astype(np.float32)
    >>> global_shifts(np.stack([scene[:, k : k + 64] for k in (0, 10, 20)])).round()[:, 0]
    array([ 10.,   0., -10.])
    """
    return known_shifts(check_frames(frames))[0]


def known_shifts(stack: FloatArray, threads: int = 0) -> tuple[Shift, NDArray[np.bool_]]:
    """Shifts (T, 2) of frames (T, H, W[, 3]) against their mean position, and which of them (T,) were found."""
    numbers = np.arange(len(stack))
    # The middle frame may itself show something else.
    for anchor in (len(stack) // 2, len(stack) // 4, 3 * len(stack) // 4):
        shifts, known = np.zeros((len(stack), 2)), numbers == anchor
        for order in (numbers[anchor + 1 :], numbers[:anchor][::-1]):
            _follow(stack, anchor, order.tolist(), shifts, known, threads)
        if 2 * known.sum() > len(stack):
            break
    shifts = np.column_stack([np.interp(numbers, numbers[known], axis) for axis in shifts[known].T])
    return shifts - shifts.mean(axis=0), known


def reduce_image(image: FloatArray) -> FloatArray:
    """Reduce an image (H, W[, 3]) to a small luminance of zero mean and unit deviation in a Gaussian window."""
    height, width = image.shape[:2]
    factor = -(-max(height, width) // LONGEST_SIDE)
    size = max(width // factor, 1), max(height // factor, 1)
    grey = luminance(image if factor == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    centred = grey - cv2.GaussianBlur(grey, (0, 0), _WINDOW)
    return centred / np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), _WINDOW) + np.float32(_FLOOR**2))


def frame_shift(image: FloatArray, start: FloatArray | None, reference: ShiftReference) -> FloatArray:
    """Shift (2,) of a frame (H, W[, 3]) in whole pixels, zero if it is so small that dense flow finds it."""
    known = None if start is None else _common_shift(start)
    shift = measure_shift(image, reference) if known is None else known
    if shift is None or np.abs(shift).max() <= DEAD_ZONE:
        return np.zeros(2, np.float32)
    return np.rint(shift).astype(np.float32)


def shift_frame(frame: Pixels, shift: ArrayLike, outside: Pixels) -> Pixels:
    """Move a frame (H, W) onto the grid of the reference by whole pixels; ``outside`` (H, W) fills the rest."""
    to, origin = overlap(frame.shape, shift)
    result = outside.copy()
    result[to] = frame[origin]
    return result


def overlap(shape: tuple[int, ...], shift: ArrayLike) -> tuple[Slices, Slices]:
    """Where a reference and a frame that is shifted by whole pixels (2,) overlap."""
    to, origin = [], []
    for length, moved in zip(shape, np.asarray(shift)[::-1], strict=False):
        step = min(max(int(moved), -length), length)
        to.append(slice(max(-step, 0), length - max(step, 0)))
        origin.append(slice(max(step, 0), length - max(-step, 0)))
    return (to[0], to[1]), (origin[0], origin[1])


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Correlate two images (H, W)."""
    a, b = a - a.mean(), b - b.mean()
    energy = float(np.vdot(a, a)) * float(np.vdot(b, b))
    return float(np.vdot(a, b)) / energy**0.5 if energy > 0 else 0.0


def _follow(
    stack: FloatArray, anchor: int, order: Sequence[int], shifts: Shift, known: NDArray[np.bool_], threads: int
) -> None:
    """Fill in the shifts of frames on one side of the anchor, from near to far."""
    at_anchor = prepare_shift_reference(stack[anchor])

    # Most frames resemble the anchor: all are compared with it side by side, and the others one after the other.
    frames = iter_frames(map(stack.__getitem__, order))
    against_anchor = [shift for _, shift in map_ahead(lambda f: measure_shift(f, at_anchor), frames, threads)]
    key, key_shift, last = at_anchor, shifts[anchor], anchor
    for number, frame, against in zip(order, iter_frames(map(stack.__getitem__, order)), against_anchor, strict=True):
        found = against if key is at_anchor else measure_shift(frame, key)
        if found is None:
            nearer = prepare_shift_reference(stack[last])
            found = measure_shift(frame, nearer)
            if found is not None:
                key, key_shift = nearer, shifts[last]
        if found is not None:
            shifts[number], known[number], last = key_shift + found, True, number


def _common_shift(flow: FloatArray) -> FloatArray | None:
    """Median of a flow, or None if only a part of the scene moves: that uncovers no border of the frame."""
    sample = flow[:: -(-len(flow) // _SAMPLE), :: -(-flow.shape[1] // _SAMPLE)].reshape(-1, 2)
    shift = np.median(sample, axis=0).astype(np.float32)
    together = (np.abs(sample - shift) <= DEAD_ZONE).all(axis=1).mean()
    return shift if together >= _SHARE_OF_WHOLE else None


def _spectrum(reduced: FloatArray) -> NDArray[np.complex64]:
    window = cv2.createHanningWindow((max(reduced.shape[1], 2), max(reduced.shape[0], 2)), cv2.CV_32F)
    return rfft2(reduced * window)


def _peak(product: NDArray[np.complex64], shape: tuple[int, ...]) -> Shift:
    """Position (x, y) of the largest phase correlation, to a fraction of a pixel."""
    height, width = shape
    y, x = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    blur = np.exp(-2 * np.pi**2 * _PEAK_WIDTH**2 * (x * x + y * y)).astype(np.float32)
    size = np.abs(product)
    surface = irfft2(product * (blur / (size + 1e-6 * size.max() + 1e-30)), (height, width))
    row, column = np.unravel_index(int(np.argmax(surface)), surface.shape)
    across = surface[row, [column - 1, column, (column + 1) % width]]
    down = surface[[row - 1, row, (row + 1) % height], column]
    place = np.array([column + _vertex(across), row + _vertex(down)])
    period = np.array([width, height])
    return (place + period / 2) % period - period / 2


def _vertex(three: FloatArray) -> float:
    """Vertex of the parabola through three values, counted from the middle one."""
    bend = float(three[0] - 2 * three[1] + three[2])
    return 0.5 * float(three[0] - three[2]) / bend if bend < 0 else 0.0

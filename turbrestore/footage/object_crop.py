"""A bright object on a dark field, such as a planet: a window that follows it, however far it drifts.

The window moves by whole pixels, so that nothing is interpolated. What is left of the drift is a pixel or two, which
the registration takes out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..core.errors import DataError
from ..core.robust import robust_scale
from ..io.pixels import PixelArray, to_unit, unrepaired
from ..io.source import FrameSource, numbers_text
from .checks.missing_pixels import fill_holes

# The object exceeds this share of the way from the field to its own brightness, after smoothing, pixels; both chosen.
_SHARE, _SMOOTHING = 0.15, 2.0
# Room around the object, as a share of its size and at least, pixels; both chosen.
_MARGIN, _LEAST_MARGIN = 0.2, 16
# An object exceeds the noise of the field by so many standard deviations, and by two levels of 8 bits; both chosen.
_LEAST_CONTRAST, _LEAST_LEVELS = 8.0, 2 / 255
# Cards that say where in the sky a pixel of a FITS image lies.
_SKY = ("CRPIX", "CRVAL", "CTYPE", "CDELT", "CUNIT", "CROTA", "CD1_", "CD2_", "PC1_", "PC2_")


@dataclasses.dataclass(frozen=True)
class ObjectPlace:
    """Where the object is in a frame."""

    # Centre of its light, pixels.
    x: float
    y: float
    # Size of the box around it, pixels.
    width: int
    height: int
    cut: bool  # whether it touches the border of the frame


def find_object(frame: FloatArray) -> ObjectPlace | None:
    """Find the largest bright object of a frame; None where nothing exceeds its noise.

    ``frame`` (H, W) or (H, W, 3).
    """
    grey = luminance(frame)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    field = float(np.median(smooth))
    noise = robust_scale(smooth - field)
    top = float(smooth.max())
    if top - field < max(_LEAST_CONTRAST * noise, _LEAST_LEVELS):
        return None
    bright = np.uint8(smooth > field + _SHARE * (top - field))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(bright)
    largest = 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))
    left, upper, width, height = (int(value) for value in boxes[largest, :4])
    part = slice(upper, upper + height), slice(left, left + width)
    light = np.where(labels[part] == largest, smooth[part] - field, 0).astype(np.float64)
    total = light.sum()
    x = left + float((light.sum(axis=0) * np.arange(width)).sum() / total)
    y = upper + float((light.sum(axis=1) * np.arange(height)).sum() / total)
    whole = left > 0 and upper > 0 and left + width < grey.shape[1] and upper + height < grey.shape[0]
    return ObjectPlace(x, y, width, height, not whole)


def crop_to_object(source: FrameSource) -> FrameSource:
    """Follow the object of a video with a window of one size; every frame is read once to find it.

    Frames in which it touches the border or is not found are left out. Where the window would leave the frame, it stops
    at its border.

    Raises
    ------
    DataError
        No object stands out, or it fills the frames.

    Examples
    --------
    >>> frames = np.zeros((3, 80, 200), np.float32)
    >>> for number, x in enumerate((20, 90, 160)):
    ...     frames[number, 30:50, x : x + 20] = 1
    >>> source = crop_to_object(FrameSource.from_array(frames))
    >>> source.shape, source.warnings
    ((3, 56, 56), ('cropped to the object: 56×56 pixels, which follow a drift of 140×0 pixels',))
    """
    places = {number: find_object(frame) for number, frame in zip(source.numbers, _shown(source), strict=True)}
    whole = {number: place for number, place in places.items() if place is not None and not place.cut}
    if not whole:
        remedy = "leave out --crop-to-object"
        raise DataError(f"{source.name}: expected a bright object within the frames, found none; {remedy}")
    height, width = source.shape[1:3]
    sizes = [(place.height, place.width) for place in whole.values()]
    # A frame or two that is torn, or crossed by an aeroplane, does not set the size.
    rows, columns = (int(np.ceil(np.percentile(side, 95))) for side in zip(*sizes, strict=True))
    margin = max(_LEAST_MARGIN, int(np.ceil(_MARGIN * max(rows, columns))))
    window = min(rows + 2 * margin, height), min(columns + 2 * margin, width)
    if window == (height, width):
        raise DataError(f"{source.name}: expected an object smaller than the frames, found one that fills them")
    corners = {number: _corner(place, window, (height, width)) for number, place in whole.items()}
    drift = np.ptp([(place.x, place.y) for place in whole.values()], axis=0).round().astype(int)

    def pixels(chosen: Sequence[int]) -> Iterator[PixelArray]:
        frames = dataclasses.replace(source, numbers=tuple(chosen)).native()
        for number, frame in zip(chosen, frames, strict=True):
            # Frames without the object are left out below.
            upper, left = corners.get(number, (0, 0))
            yield frame[upper : upper + window[0], left : left + window[1]]

    remark = (
        f"cropped to the object: {window[1]}×{window[0]} pixels, which follow a drift of {drift[0]}×{drift[1]} pixels"
    )
    lost = [number for number in places if number not in whole]
    cropped = dataclasses.replace(
        source,
        file_shape=(source.file_shape[0], *window, *source.file_shape[3:]),
        window=(slice(0, window[0]), slice(0, window[1])),
        pixels=pixels,
        repair=unrepaired,
        header=without_sky(source.header),
        warnings=(*source.warnings, remark),
    )
    return cropped.without(lost, f"the object is cut or not there: {numbers_text(lost)} left out")


def without_sky(header: tuple[str, ...]) -> tuple[str, ...]:
    """Leave out the cards that say where pixels lie in the sky."""
    return tuple(card for card in header if not card.startswith(_SKY))


def _corner(place: ObjectPlace, window: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
    """Upper left corner of the window in a frame."""
    middle = round(place.y - (window[0] - 1) / 2), round(place.x - (window[1] - 1) / 2)
    upper, left = (min(max(start, 0), most - side) for start, side, most in zip(middle, window, size, strict=True))
    return upper, left


def _shown(source: FrameSource) -> Iterator[FloatArray]:
    for number, pixels in zip(source.numbers, source.native(), strict=True):
        whole = fill_holes(pixels) if np.issubdtype(pixels.dtype, np.floating) else pixels
        yield to_unit(whole, source.full_scale, f"{source.name}: frame {number}")

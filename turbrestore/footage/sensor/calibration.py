"""Dark and flat frames: what a camera adds and how unequal its pixels are, taken out of every frame.

``calibrated = (frame − dark) · mean(flat) / flat``. Pixels that stand out in the dark are hot, those that see less than
a tenth of the mean flat are dead; both are filled from around. Frames of a Bayer sensor are calibrated as it saw them,
before they have colours. The dark has the exposure, gain and temperature of the clip; the flat is used as it is, so its
own dark should be small or subtracted already.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...core.errors import DataError
from ...core.remarks import counted
from ...core.robust import robust_scale
from ...io.output import size_text
from ...io.pixels import PixelArray, planes_of, to_unit, with_planes
from ...io.source import FrameSource
from ..checks.missing_pixels import fill_holes

# A pixel is hot where the dark exceeds its median by so many standard deviations, and by so much of full scale, and
# dead where the flat is below so much of its mean; all chosen.
_HOT_DEVIATIONS, _HOT_LEAST = 8.0, 0.01
_DEAD = 0.1
# Share of bad pixels from which something else is wrong, chosen.
_MOST_BAD = 0.1


@dataclass(frozen=True, eq=False)
class Calibration:
    """What to take out of the frames of a clip.

    Attributes
    ----------
    dark : ndarray, float32, shape (H, W) or (H, W, 3), or None
        Intensity to subtract.
    gain : ndarray, float32, shape (H, W) or (H, W, 3), or None
        Factor of every pixel.
    bad : ndarray, bool, shape (H, W) or (H, W, 3)
        Hot and dead pixels.
    remark : str
        What it was made from, with a checksum of its values.
    """

    dark: FloatArray | None
    gain: FloatArray | None
    bad: NDArray[np.bool_]
    remark: str


def make_calibration(clip: FrameSource, dark: FrameSource | None, flat: FrameSource | None) -> Calibration:
    """Average dark and flat frames for a clip; each is read once, a frame at a time.

    Parameters
    ----------
    clip : FrameSource
        Frames to calibrate; its size counts before a region is selected.
    dark, flat : FrameSource or None
        Frames of the size of the clip. Those of FITS files that are scaled are compared with the clip by the values in
        the files, others by their intensities. Darks of another depth are compared by their values, or by their
        intensities where they have only those that values of the smaller depth, spread over the larger, become; some
        frames tell that, and one does not.

    Raises
    ------
    DataError
        Another size, another depth that the values do not explain, a flat without light, or more than a tenth of the
        pixels hot or dead.

    Examples
    --------
    >>> clip = FrameSource.from_array(np.full((2, 4, 4), 0.5))
    >>> flat = FrameSource.from_array(np.array([[[0.2, 0.4, 0.2, 0.8]] * 4]), "flat")
    >>> make_calibration(clip, None, flat).gain[0].round(3).tolist()
    [2.0, 1.0, 2.0, 0.5]
    """
    clip, dark, flat = _as_sensor(clip), *(None if each is None else _as_sensor(each) for each in (dark, flat))
    shape = clip.file_shape[1:]
    bad, remarks = np.zeros(shape, bool), []
    offset = gain = None
    if dark is not None:
        offset = _dark_level(clip, dark)
        usual = np.median(offset)
        bad |= offset > usual + max(_HOT_DEVIATIONS * robust_scale(offset - usual), _HOT_LEAST)
        remarks.append(
            f"dark of {dark.name} ({counted(len(dark), 'frame')}, {_digest(offset)}) subtracted, "
            f"{counted(int(bad.sum()), 'hot pixel')}"
        )
    if flat is not None:
        light = _values(flat, _average(clip, flat))
        mean = float(light.mean())
        if not mean > 0:
            raise DataError(f"{flat.name}: expected a flat with light, found none")
        dead = light < _DEAD * mean
        gain = np.where(dead, 1, mean / np.where(dead, 1, light)).astype(np.float32)
        bad |= dead
        remarks.append(
            f"flat of {flat.name} ({counted(len(flat), 'frame')}, {_digest(gain)}) divided out, "
            f"{counted(int(dead.sum()), 'dead pixel')}"
        )
    if bad.mean() > _MOST_BAD:
        raise DataError(
            f"{clip.name}: expected few hot or dead pixels, found {bad.sum()} of {bad.size}; check dark and flat"
        )
    return Calibration(offset, gain, bad, "; ".join(remarks))


def calibrate(frame: FloatArray, calibration: Calibration, mosaic: bool = False) -> FloatArray:
    """Return a frame without dark, unequal gains and bad pixels; what leaves [0, 1] is clipped.

    Parameters
    ----------
    frame : ndarray, float32, shape (H, W) or (H, W, 3)
    calibration : Calibration
    mosaic : bool
        The frame is that of a Bayer sensor: bad pixels are filled from pixels of their colour.

    Returns
    -------
    ndarray, float32

    Examples
    --------
    >>> dark = np.full((2, 2), 0.1, np.float32)
    >>> calibrate(np.full((2, 2), 0.6, np.float32), Calibration(dark, None, np.zeros((2, 2), bool), "")).tolist()
    [[0.5, 0.5], [0.5, 0.5]]
    """
    light = frame.copy() if calibration.dark is None else frame - calibration.dark
    if calibration.gain is not None:
        light *= calibration.gain
    np.clip(light, 0, 1, out=light)
    if calibration.bad.any():
        missing = np.isnan(light)
        light[calibration.bad] = np.nan
        light = with_planes(light, fill_holes(planes_of(light))) if mosaic else fill_holes(light)
        # What was missing before is for the check of the content to find.
        light[missing] = np.nan
    return light


def calibrated(clip: FrameSource, calibration: Calibration) -> FrameSource:
    """Calibrate every frame while it is read; the depth of the clip stays.

    Examples
    --------
    >>> clip = FrameSource.from_array(np.full((1, 2, 2), 128, np.uint8))
    >>> twice = Calibration(None, np.full((2, 2), 1.5, np.float32), np.zeros((2, 2), bool), "flat")
    >>> source = calibrated(clip, twice)
    >>> round(float(source.read().max()) * 255), source.bit_depth, source.warnings
    (192, 8, ('flat',))
    """
    before = clip.repair

    def repaired(pixels: PixelArray) -> PixelArray:
        pixels = pixels if before is None else before(pixels)
        if not np.issubdtype(pixels.dtype, np.floating):
            pixels = to_unit(pixels, clip.full_scale, clip.name)
        return calibrate(pixels.astype(np.float32), calibration, mosaic=clip.bayer is not None)

    return dataclasses.replace(clip, repair=repaired, warnings=(*clip.warnings, calibration.remark))


def _as_sensor(source: FrameSource) -> FrameSource:
    """Take the mosaic of a Bayer sensor for grey frames: calibration comes before colour."""
    if source.bayer is None:
        return source
    return dataclasses.replace(source, file_shape=source.file_shape[:3], bayer=None)


def _dark_level(clip: FrameSource, dark: FrameSource) -> FloatArray:
    """Average of the dark in intensities of the clip."""
    mean = _average(clip, dark)
    if clip.levels is None and dark.levels is None:
        return (mean * _dark_scale(clip, dark)).astype(np.float32)
    black, white = (0, clip.full_scale) if clip.levels is None else clip.levels
    return (_values(dark, mean) / (white - black)).astype(np.float32)


def _dark_scale(clip: FrameSource, dark: FrameSource) -> float:
    """Full scale of a dark in that of the clip: 1, or the ratio of both where the same numbers mean the same light.

    Programs store 12 bits in files of 16 either as they are or spread over the range.  The mean of many frames has all
    numbers, so a single one does not tell.
    """
    low, high = sorted((clip, dark), key=lambda source: source.full_scale)
    if low.full_scale in (1, high.full_scale):
        return 1.0
    frames = [next(high.select((place, place + 1)).native()) for place in sorted({0, len(high) // 2, len(high) - 1})]
    lit = np.concatenate([frame[frame > 0] for frame in frames])
    ratio = high.full_scale / low.full_scale
    if lit.size and any(np.array_equal(np.rint(np.rint(lit / step) * step), lit) for step in (ratio, round(ratio))):
        return 1.0
    # Numbers of 8 bits are not stored in files of more.
    if not lit.size or lit.max() > low.full_scale or len(frames) == 1 or low.bit_depth <= 8:
        raise DataError(
            f"{high.name}: expected some frames of values up to {low.full_scale} as in {low.name}, or of those spread "
            f"over {high.full_scale}; convert one of the two to the depth of the other"
        )
    return dark.full_scale / clip.full_scale


def _average(clip: FrameSource, source: FrameSource) -> NDArray[np.float64]:
    if source.file_shape[1:] != clip.file_shape[1:]:
        expected, found = size_text(clip.file_shape[1:]), size_text(source.file_shape[1:])
        raise DataError(f"{source.name}: expected {expected} as in {clip.name}, found {found}")
    total = np.zeros(source.shape[1:])
    for frame in source:
        total += frame
    return total / len(source)


def _values(source: FrameSource, mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bring mean intensities to the numbers of the file."""
    black, white = (0, source.full_scale) if source.levels is None else source.levels
    return mean * (white - black) + black


def _digest(values: FloatArray) -> str:
    return hashlib.blake2b(values.tobytes(), digest_size=4).hexdigest()

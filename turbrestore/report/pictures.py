"""The images of the report, encoded so that they can be compared and the file stays small.

All images of a report have the same encoding: beside a lossless image, the artefacts of a lossy one could be mistaken
for the work of the restoration. They are lossless WebP if all of them together are small enough, else WebP of high
quality. Lossless WebP is a seventh smaller than PNG on noisy frames, and quality 95 about half of that, with errors of
1.3 grey levels root mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, from_unit
from ..display.preview import data_uri, encode_image, shrink
from ..results import Restoration
from ..runtime.scratch import iter_frames, iter_parts

# Most bytes of all lossless images together, before base64: with half a megabyte of plots the page is below 2 MB.
_LOSSLESS_BYTES = 1_050_000
# Quality of the images where they would take more.
_QUALITY = 95
# Longest side of an image, pixels, chosen.
_LONGEST = 2048
# An image is shown over its own range where it spans less than the first share of full scale, or where nothing in it is
# brighter than the second; the percentage of pixels at either end that may be clipped, and the margin beyond them, as a
# share of the span; all chosen.
_NARROW, _DARK, _CLIPPED, _MARGIN = 0.2, 0.5, 0.2, 0.1
# What the switch of the page does: it clips this percentage of the pixels at either end. Where the median of what is
# not black is dim, as in a night scene with lamps, shadows are lifted until it is brighter, by at least this exponent.
# All chosen.
_STRETCHED, _BLACK, _DIM, _BRIGHTER, _LEAST_EXPONENT = 0.5, 0.05, 0.15, 0.3, 0.45
_TITLES = {"frame": "Frame", "mean": "Mean", "centroid": "Centroid", "filtered": "Filtered", "result": "Result"}


@dataclass(frozen=True)
class Picture:
    """An image of the report."""

    # Name in the page's code, and name that is shown.
    key: str
    title: str
    address: str  # data URI
    # Pixels.
    width: int
    height: int


@dataclass(frozen=True)
class Stretch:
    """Display of an image with more contrast: ``(slope · value + intercept) ** exponent``.

    The exponent is below 1 for scenes with most of their content in the shadows.
    """

    slope: float = 1.0
    intercept: float = 0.0
    exponent: float = 1.0


@dataclass(frozen=True)
class Gallery:
    """All images of a report, their encoding in words, and how a switch of the page stretches their contrast."""

    pictures: tuple[Picture, ...]
    encoding: str
    stretch: Stretch = Stretch()


def stages(restoration: Restoration, frame: FloatArray) -> dict[str, FloatArray]:
    """Return the images of all stages, cropped like the result. A last stage equal to the result is left out."""
    images = {"frame": frame, "mean": restoration.mean, "centroid": restoration.centroid.image}
    if restoration.filtered is not None:
        images["filtered"] = restoration.filtered.image
    images = {key: image[restoration.shown] for key, image in images.items()}
    last = next(reversed(images))
    if all(
        (one == other).all() for one, other in zip(iter_parts(restoration.image), iter_parts(images[last]), strict=True)
    ):
        del images[last]
    return {**images, "result": restoration.image}


def encode_gallery(images: dict[str, FloatArray], frame_number: int) -> Gallery:
    """Encode images for the page.

    ``images`` (H, W) or (H, W, 3) each.
    """
    low, high = shown_range(images["result"])
    shown = {key: to_levels(image, low, high) for key, image in zip(images, iter_frames(images.values()), strict=True)}
    encoding = "8 bits, lossless"
    files = {key: encode_image(levels, "webp") for key, levels in shown.items()}
    if sum(map(len, files.values())) > _LOSSLESS_BYTES:
        files = {key: encode_image(levels, "webp", _QUALITY) for key, levels in shown.items()}
        encoding = f"8 bits, WebP of quality {_QUALITY}"
    if max(images["result"].shape[:2]) > _LONGEST:
        encoding += f", reduced to {_LONGEST} pixels"
    if (low, high) != (0, 1):
        encoding += f", black is {low:.4g} and white {high:.4g} of full scale"
    titles = {**_TITLES, "frame": f"{_TITLES['frame']} {frame_number}"}
    pictures = (
        Picture(key, titles[key], data_uri(data, "webp"), shown[key].shape[1], shown[key].shape[0])
        for key, data in files.items()
    )
    return Gallery(tuple(pictures), encoding, stretch_of(shown["result"]))


def shown_range(image: FloatArray) -> tuple[float, float]:
    """Intensities shown black and white: 0 and 1, or the image's own where it is dark or uses little of the scale."""
    low, high = (float(value) for value in np.percentile(image, (_CLIPPED, 100 - _CLIPPED)))
    margin = _MARGIN * (high - low)
    if 0 < high - low < _NARROW:
        return low - margin, high + margin
    return (0.0, high + margin) if 0 < high < _DARK else (0.0, 1.0)


def stretch_of(levels: NDArray[np.unsignedinteger]) -> Stretch:
    """Choose the stretch of an image of 8 bits as it is shown."""
    shown = levels.astype(np.float32) / 255
    low, high = (float(value) for value in np.percentile(shown, (_STRETCHED, 100 - _STRETCHED)))
    slope = 1 / max(high - low, 1 / 255)
    lit = (shown[shown > low + _BLACK * (high - low)] - low) * slope
    median = float(np.median(lit)) if lit.size else 1.0
    exponent = 1.0 if median >= _DIM else max(float(np.log(_BRIGHTER) / np.log(median)), _LEAST_EXPONENT)
    return Stretch(slope, -low * slope, exponent)


def to_levels(image: FloatArray, low: float, high: float, longest: int = _LONGEST) -> NDArray[np.unsignedinteger]:
    """Reduce an image for the page, with 8 bits from ``low`` to ``high``."""
    small = shrink(image, longest)
    return from_unit(small if (low, high) == (0, 1) else (small - np.float32(low)) / np.float32(high - low), 8)

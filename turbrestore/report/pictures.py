"""Images of the report, coded so that they can be compared and the file stays small.

All images of a report are coded alike: beside a lossless one, what a lossy coder did to another would pass for the
work of the restoration.  They are lossless if all of them together are small enough, else WebP of high quality.
Lossless WebP is a seventh smaller than PNG on noisy frames, and quality 95 about half of that, with errors of
1.3 grey levels root mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, from_unit
from ..display.preview import data_uri, encode_image
from ..runtime.scratch import iter_frames, iter_parts
from ..settings import Restoration

# All images together, bytes before base64, which with half a megabyte of plots and text stays below 2 MB; quality
# beyond it; longest side that is shown, pixels.
_LOSSLESS_BYTES = 1_050_000
_QUALITY = 95
_LONGEST = 2048
_TITLES = {
    "frame": "Frame",
    "mean": "Mean",
    "centroid": "Centroid",
    "filtered": "Filtered",
    "result": "Result",
}


@dataclass(frozen=True)
class Picture:
    """An image of the report.

    Attributes
    ----------
    key, title : str
        For the program and for people.
    address : str
        Data URI.
    width, height : int
        Pixels.
    """

    key: str
    title: str
    address: str
    width: int
    height: int


@dataclass(frozen=True)
class Gallery:
    """All images of a report, and how they are coded.

    Attributes
    ----------
    pictures : tuple of Picture
    coding : str
        For people.
    """

    pictures: tuple[Picture, ...]
    coding: str


def stages(restoration: Restoration, frame: FloatArray) -> dict[str, FloatArray]:
    """Images from the first to the last stage, all of the part that the result shows; the result only once.

    Parameters
    ----------
    restoration : Restoration
    frame : ndarray, float32
        One frame as it was read.

    Returns
    -------
    dict of str to ndarray
    """
    x, y, width, height = restoration.crop
    images = {"frame": frame, "mean": restoration.mean, "centroid": restoration.centroid.image}
    if restoration.filtered is not None:
        images["filtered"] = restoration.filtered.image
    images = {key: image[y : y + height, x : x + width] for key, image in images.items()}
    last = next(reversed(images))
    if all(
        (one == other).all() for one, other in zip(iter_parts(restoration.image), iter_parts(images[last]), strict=True)
    ):
        del images[last]
    return {**images, "result": restoration.image}


def encode_gallery(images: dict[str, FloatArray], frame_number: int) -> Gallery:
    """Encode images for a page.

    Parameters
    ----------
    images : dict of str to ndarray, float32, shape (H, W) or (H, W, 3)
        Of one size.
    frame_number : int
        Which frame ``images["frame"]`` is.

    Returns
    -------
    Gallery
    """
    shown = dict(zip(images, map(_levels, iter_frames(images.values())), strict=True))
    coding = "8 bits, lossless"
    files = {key: encode_image(levels, "webp") for key, levels in shown.items()}
    if sum(map(len, files.values())) > _LOSSLESS_BYTES:
        files = {key: encode_image(levels, "webp", _QUALITY) for key, levels in shown.items()}
        coding = f"8 bits, WebP of quality {_QUALITY}"
    if max(images["result"].shape[:2]) > _LONGEST:
        coding += f", reduced to {_LONGEST} pixels"
    titles = {**_TITLES, "frame": f"{_TITLES['frame']} {frame_number}"}
    pictures = (
        Picture(key, titles[key], data_uri(data, "webp"), shown[key].shape[1], shown[key].shape[0])
        for key, data in files.items()
    )
    return Gallery(tuple(pictures), coding)


def _levels(image: FloatArray) -> NDArray[np.unsignedinteger]:
    factor = _LONGEST / max(image.shape[:2])
    if factor < 1:
        height, width = (max(round(side * factor), 1) for side in image.shape[:2])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return from_unit(image, 8)

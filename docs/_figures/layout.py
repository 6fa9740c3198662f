"""Labelled panels side by side, and WebP files that stay small."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from turbrestore.core.arrays import FloatArray

IMAGES = Path(__file__).parents[1] / "images"
_GAP, _BAND, _FONT = 6, 30, 20
# A band that is readable on light and on dark pages.
_BACKGROUND, _TEXT = (36, 41, 47), (255, 255, 255)

Picture = NDArray[np.uint8]


def colour(image: FloatArray, height: int | None = None) -> Picture:
    """Convert an image to 8 bits and three channels, and bring it to a height."""
    levels = (np.clip(image, 0, 1) * 255).round().astype(np.uint8)
    if levels.ndim == 2:
        levels = np.repeat(levels[..., None], 3, axis=2)
    if height is None or height == levels.shape[0]:
        return levels
    width = round(levels.shape[1] * height / levels.shape[0])
    return cv2.resize(levels, (width, height), interpolation=cv2.INTER_CUBIC)


def row(panels: Mapping[str, FloatArray], height: int | None = None) -> Image.Image:
    """Images side by side at one height, each under a band with its label; the gaps are transparent."""
    parts = [_labelled(label, colour(image, height)) for label, image in panels.items()]
    whole = Image.new("RGBA", (sum(part.width + _GAP for part in parts) - _GAP, parts[0].height))
    left = 0
    for part in parts:
        whole.paste(part, (left, 0))
        left += part.width + _GAP
    return whole


def save(name: str, picture: Image.Image, largest: int, quality: int = 88) -> None:
    """Write a picture as WebP, with the quality lowered until it fits."""
    path = IMAGES / f"{name}.webp"
    while True:
        picture.save(path, "WEBP", quality=quality, method=6)
        if path.stat().st_size <= largest:
            break
        quality -= 6
    print(f"{path.name}: {picture.width}×{picture.height}, {path.stat().st_size / 1000:.0f} kB")


def save_film(name: str, pictures: Sequence[Image.Image], milliseconds: int, quality: int) -> None:
    """Write pictures as an animated WebP that plays for ever."""
    path = IMAGES / f"{name}.webp"
    first, *others = [picture.convert("RGB") for picture in pictures]
    first.save(
        path, "WEBP", save_all=True, append_images=others, duration=milliseconds, loop=0, quality=quality, method=6
    )
    print(f"{path.name}: {len(pictures)} frames of {first.width}×{first.height}, {path.stat().st_size / 1000:.0f} kB")


def _labelled(label: str, picture: Picture) -> Image.Image:
    height, width = picture.shape[:2]
    panel = Image.new("RGBA", (width, height + _BAND), (*_BACKGROUND, 255))
    panel.paste(Image.fromarray(picture), (0, _BAND))
    font = ImageFont.load_default(_FONT)
    ImageDraw.Draw(panel).text((width / 2, _BAND / 2), label, fill=_TEXT, font=font, anchor="mm")
    return panel

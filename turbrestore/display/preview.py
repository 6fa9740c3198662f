"""Images as files and data URIs, and the HTML card that notebooks show for a result."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, from_unit
from ..core.errors import DataError

# OpenCV writes lossless WebP where the quality is above 100.
_LOSSLESS = 101
# Longest side of the image on a card, pixels, chosen.
_THUMBNAIL = 224


def encode_image(
    pixels: NDArray[np.unsignedinteger], kind: Literal["png", "webp"] = "png", quality: int | None = None
) -> bytes:
    """Encode an image of 8 bits as a file.

    ``pixels`` (H, W) or (H, W, 3).
    """
    settings = [] if kind == "png" else [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS if quality is None else quality]
    try:
        done, data = cv2.imencode(f".{kind}", pixels if pixels.ndim == 2 else pixels[..., ::-1], settings)
    except cv2.error:
        done = False
    if not done:
        raise DataError(f"image: expected a size that {kind} can hold, found {pixels.shape[1]}×{pixels.shape[0]}")
    return data.tobytes()


def data_uri(data: bytes, kind: str = "png") -> str:
    """Make a data URI, an address that contains the image file itself."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def shrink(image: FloatArray, longest: int) -> FloatArray:
    """Reduce an image by averaging, if its longest side is larger than allowed.

    ``image`` (H, W) or (H, W, 3).
    """
    factor = longest / max(image.shape[:2])
    if factor >= 1:
        return image
    height, width = (max(round(side * factor), 1) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def summary(title: str, facts: Iterable[tuple[str, str]], shape: tuple[int, ...]) -> str:
    """Write size and key figures of an image (H, W[, 3]), a line each, as an interpreter prints a result."""
    return "\n".join([f"{title}: {shape[1]}×{shape[0]} pixels", *(f"{name}: {value}" for name, value in facts)])


def preview(title: str, facts: Iterable[tuple[str, str]], image: FloatArray | None = None) -> str:
    """Make a small HTML card for notebooks: a thumbnail beside key figures.

    ``image`` (H, W) or (H, W, 3).
    """
    rows = "".join(
        f"<tr><th style='text-align:left;font-weight:normal;opacity:.7;padding:1px 12px 1px 0'>{html.escape(name)}</th>"
        f"<td style='text-align:left;padding:1px 0;font-variant-numeric:tabular-nums'>{html.escape(value)}</td></tr>"
        for name, value in facts
    )
    address = "" if image is None else data_uri(encode_image(from_unit(shrink(image, _THUMBNAIL), 8)))
    picture = f"<img alt='' style='flex:none' src='{address}'>" if address else ""
    return (
        f"<div style='display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start'>{picture}"
        f"<div><strong>{html.escape(title)}</strong><table style='border:0;margin:4px 0 0'>{rows}</table></div></div>"
    )

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
# Longest side of the image on a card, pixels.
_THUMBNAIL = 224


def encode_image(
    pixels: NDArray[np.unsignedinteger], kind: Literal["png", "webp"] = "png", quality: int | None = None
) -> bytes:
    """Encode an image of 8 bits as a file.

    Parameters
    ----------
    pixels : ndarray, uint8, shape (H, W) or (H, W, 3)
    kind : {"png", "webp"}
    quality : int, optional
        Quality of WebP, 1 to 100; lossless by default.

    Returns
    -------
    bytes

    Raises
    ------
    DataError
        The image cannot be encoded, for example because it is larger than the format allows.

    Examples
    --------
    >>> encode_image(np.zeros((4, 4), np.uint8))[1:4]
    b'PNG'
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
    """Make a data URI, an address that contains the image file itself.

    Parameters
    ----------
    data : bytes
        Content of an image file.
    kind : str
        ``"png"`` or ``"webp"``.

    Returns
    -------
    str

    Examples
    --------
    >>> data_uri(b"abc")
    'data:image/png;base64,YWJj'
    """
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def shrink(image: FloatArray, longest: int) -> FloatArray:
    """Reduce an image by averaging, if its longest side is larger than allowed.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    longest : int
        Longest side of the result, pixels.

    Returns
    -------
    ndarray, float32

    Examples
    --------
    >>> shrink(np.zeros((10, 400), np.float32), 200).shape
    (5, 200)
    """
    factor = longest / max(image.shape[:2])
    if factor >= 1:
        return image
    height, width = (max(round(side * factor), 1) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def preview(title: str, facts: Iterable[tuple[str, str]], image: FloatArray | None = None) -> str:
    """Make a small HTML card for notebooks: a thumbnail beside key figures.

    Parameters
    ----------
    title : str
    facts : iterable of (str, str)
        Name and value.
    image : ndarray, float32, shape (H, W) or (H, W, 3), optional
        It is reduced to at most 224 pixels a side.

    Returns
    -------
    str
        HTML; all text is escaped.

    Examples
    --------
    >>> preview("Blur", [("width", "1.2 < 2 px")]).count("&lt;")
    1
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

"""Images and key figures as HTML: what notebooks show of a result, and the pictures of a report."""

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

# cv2 takes a quality above 100 for lossless.
_LOSSLESS = 101
_THUMBNAIL = 224


def encode_image(
    pixels: NDArray[np.unsignedinteger], kind: Literal["png", "webp"] = "png", quality: int | None = None
) -> bytes:
    """Image file of 8 bits.

    Parameters
    ----------
    pixels : ndarray, uint8, shape (H, W) or (H, W, 3)
    kind : {"png", "webp"}
    quality : int, optional
        Of WebP, 1 to 100; lossless by default.

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
    """Address that holds the image itself.

    Parameters
    ----------
    data : bytes
        Image file.
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


def preview(title: str, facts: Iterable[tuple[str, str]], image: FloatArray | None = None) -> str:
    """Small card for notebooks: a thumbnail beside key figures.

    Parameters
    ----------
    title : str
    facts : iterable of (str, str)
        Name and value.
    image : ndarray, float32, shape (H, W) or (H, W, 3), optional
        Reduced to at most 224 pixels.

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
    address = "" if image is None else data_uri(encode_image(from_unit(_thumbnail(image), 8)))
    picture = f"<img alt='' style='flex:none' src='{address}'>" if address else ""
    return (
        f"<div style='display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start'>{picture}"
        f"<div><strong>{html.escape(title)}</strong><table style='border:0;margin:4px 0 0'>{rows}</table></div></div>"
    )


def _thumbnail(image: FloatArray) -> FloatArray:
    factor = _THUMBNAIL / max(image.shape[:2])
    if factor >= 1:
        return image
    size = [max(round(side * factor), 1) for side in image.shape[1::-1]]
    return np.clip(cv2.resize(image, size, interpolation=cv2.INTER_AREA), 0, 1)

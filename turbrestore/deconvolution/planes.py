"""Planes that a deconvolution works on: channels of an image, and the margin about them.

Symbols
-------
f : observed image, of H × W pixels.
margin : pixels about it that were not seen, see :mod:`turbrestore.deconvolution.deconvolve`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from ..core.arrays import FloatArray, check_image, luminance
from ..core.errors import DataError
from ..runtime.scratch import drop_pages


def split_planes(image: FloatArray, channels: str) -> list[FloatArray]:
    """Split an image into what is deblurred.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        f.
    channels : {"luminance", "each"}
        Of a colour image, luminance alone, or every channel.

    Returns
    -------
    list of ndarray, float32, shape (H, W)

    Examples
    --------
    >>> len(split_planes(np.zeros((2, 2, 3), np.float32), "each"))
    3
    """
    if image.ndim == 3 and channels == "each":
        planes = [np.ascontiguousarray(image[..., index]) for index in range(image.shape[2])]
        drop_pages(image)
        return planes
    return [luminance(image)]


def join_planes(image: FloatArray, restored: list[FloatArray], channels: str) -> FloatArray:
    """Put deblurred planes together; the reverse of :func:`split_planes`.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        f, which chroma is taken from.
    restored : list of ndarray, float32, shape (H, W)
    channels : {"luminance", "each"}

    Returns
    -------
    ndarray, float32, shape of ``image``

    Examples
    --------
    >>> grey = np.full((2, 2), 0.5, np.float32)
    >>> join_planes(np.zeros((2, 2, 3), np.float32), [grey], "luminance")[0, 0]
    array([0.5, 0.5, 0.5], dtype=float32)
    """
    if image.ndim == 2:
        return restored[0]
    if channels == "each":
        return np.stack(restored, axis=-1)
    return image + (restored[0] - luminance(image))[..., None]


def margin_widths(shape: tuple[int, ...], margin: int | None) -> list[tuple[int, int]]:
    """Pixels to add before and after each axis.

    Parameters
    ----------
    shape : tuple of int
        (H, W).
    margin : int or None
        Least width; None adds nothing.

    Returns
    -------
    list of (int, int)
        ``margin`` or more, up to a size with a fast transform.

    Examples
    --------
    >>> margin_widths((64, 62), 4)
    [(4, 4), (5, 5)]
    """
    if margin is None:
        return [(0, 0)] * len(shape)
    extra = [fft.next_fast_len(size + 2 * margin, real=True) - size for size in shape]
    return [(total // 2, total - total // 2) for total in extra]


def padded_guide(guide: ArrayLike | None, shape: tuple[int, ...], widths: list[tuple[int, int]]) -> FloatArray | None:
    """Luminance of a guide, continued by reflection into the margin.

    Parameters
    ----------
    guide : array_like, shape (H, W) or (H, W, 3), or None
    shape : tuple of int
        (H, W).
    widths : list of (int, int)
        From :func:`margin_widths`.

    Returns
    -------
    ndarray, float32, or None

    Raises
    ------
    DataError
        The guide has another size.

    Examples
    --------
    >>> padded_guide([[0.0, 1.0]], (1, 2), [(0, 0), (1, 1)])
    array([[0., 0., 1., 1.]], dtype=float32)
    """
    if guide is None:
        return None
    grey = luminance(check_image(guide, "guide"))
    if grey.shape != shape:
        raise DataError(f"guide: expected the size of the image {shape}, found {grey.shape}")
    return np.pad(grey, widths, mode="symmetric")

"""Fourier transforms of images by NumPy.

Those of SciPy are as fast, but importing any part of SciPy takes twice as long as importing NumPy itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .threads import map_ahead

Complex = NDArray[np.complexfloating[Any, Any]]
Real = NDArray[np.floating[Any]]


def rfft2(image: Real, threads: int = 1) -> Complex:
    """Half-spectrum (…, H, W // 2 + 1) of images (…, H, W), in their precision; ``threads`` share the work."""
    height, width = image.shape[-2:]
    spectrum = np.empty((*image.shape[:-1], width // 2 + 1), np.result_type(image, np.complex64))

    # Only with a factor of its own precision does NumPy compute in single precision, four times as fast.
    def transform_rows(part: slice) -> None:
        np.fft.rfft(image[..., part, :], norm="forward", out=spectrum[..., part, :])

    def transform_columns(part: slice) -> None:
        columns = spectrum[..., part]
        np.fft.fft(columns, axis=-2, norm="forward", out=columns)
        columns *= height * width

    _share(transform_rows, height, threads)
    _share(transform_columns, spectrum.shape[-1], threads)
    return spectrum


def irfft2(spectrum: Complex, shape: tuple[int, int], threads: int = 1) -> Real:
    """Images (…, H, W) of half-spectra (…, H, W // 2 + 1), in their precision; ``threads`` share the work."""
    moved: Any = np.empty_like(spectrum)
    image = np.empty((*spectrum.shape[:-1], shape[1]), spectrum.real.dtype)

    def transform_columns(part: slice) -> None:
        np.fft.ifft(spectrum[..., part], axis=-2, out=moved[..., part])

    def transform_rows(part: slice) -> None:
        np.fft.irfft(moved[..., part, :], shape[1], out=image[..., part, :])

    _share(transform_columns, spectrum.shape[-1], threads)
    _share(transform_rows, shape[0], threads)
    return image


def fast_length(length: int) -> int:
    """Smallest length, ``length`` at least, that has no prime factor above 5, so that its transform is fast."""
    while pow(30, 64, length):
        length += 1
    return length


def _share(transform: Callable[[slice], None], length: int, threads: int) -> None:
    step = -(-length // threads)
    parts = [slice(start, min(start + step, length)) for start in range(0, length, step)]
    for _ in map_ahead(transform, parts, threads) if threads > 1 else map(transform, parts):
        pass

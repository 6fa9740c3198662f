"""FITS: cubes and folders of images in, images with header and history out.

Rows and columns keep the order of the file, as NumPy and Astropy show it: the first row of the file is the first of the
frame, whatever ROWORDER says. Axes are those of NumPy, the reverse of NAXIS1, NAXIS2 and so on.

=================================  ==========================================================================
axes                               frames
=================================  ==========================================================================
(T, H, W)                          grey
(T, 3, H, W)                       colour, where the second axis has three values
(3, T, H, W)                       colour, where the second has not and the first has
(T, H, W, 3)                       colour, where only the last has
(T, 1, H, W)                       grey
a folder of (H, W) or (3, H, W)    grey or colour, one file a frame
extensions of (H, W), of one name  grey, one extension a frame
grey, with BAYERPAT                colour, by bilinear interpolation
=================================  ==========================================================================

==================================  =========================================================================
numbers                             intensity
==================================  =========================================================================
8 bits                              0 to 255
16 or 32 bits, BZERO of the middle  unsigned: 0 to 65535, or to 4294967295
floating point in [0, 1]            as they are
all others, with BSCALE and BZERO   0, or the lowest value of all frames if that is negative, becomes black; the
                                    highest value of all frames becomes white, but for isolated values far
                                    beyond the others, which are clipped; a remark says so
NaN, BLANK                          missing: filled from around, where a frame has up to 1 % of them
==================================  =========================================================================
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import DataError
from ...runtime.scratch import iter_frames
from ..counts import CountRange, range_of_counts
from ..limits import DEFAULT_LIMITS, Limits
from ..npy import MappedFrames
from ..pixels import PixelArray, demosaic, depth_of, full_scale_of
from ..source import FrameSource
from .fits_header import FitsImage, find_images

# Begin of the card that says that the planes of a cube are colours.
_IN_COLOUR = "CTYPE3  = 'RGB"


@dataclass(frozen=True)
class _Levels:
    """How the numbers of a file become pixels: unsigned, counts of a range, or floating point as it is."""

    unsigned: np.dtype[Any] | None = None
    counts: CountRange | None = None
    missing: bool = False

    def pixels(self, numbers: NDArray[Any], image: FitsImage) -> PixelArray:
        if self.unsigned is None:
            values = _values(numbers, image)
            return values if self.counts is None else self.counts.unit(values)
        # Adding half of the range modulo the range flips the highest bit.
        flip = 0 if numbers.dtype.kind == "u" else 1 << (8 * numbers.dtype.itemsize - 1)
        found = np.ascontiguousarray(numbers, numbers.dtype.newbyteorder("=")).view(self.unsigned) ^ flip
        found = found.astype(self.unsigned, copy=False)
        if not self.missing:
            return found
        values = np.divide(found, np.float32(np.iinfo(self.unsigned).max), dtype=np.float32)
        if image.blank is not None:
            values[numbers == image.blank] = np.nan
        return values


def open_fits(path: str | os.PathLike[str], limits: Limits = DEFAULT_LIMITS, single: bool = False) -> FrameSource:
    """Open a FITS cube as a video, with ``single`` also one grey image as a video of one frame.

    Frames are read one at a time, those of a ``.gz`` file are loaded as a whole. Where the highest value has to be
    found, every frame is read once. The errors are those of :func:`turbrestore.io.video.open_frames`;
    ConfigurationError where Astropy is not installed.
    """
    path = Path(path)
    images = find_images(path, limits)
    if len(images) > 1:
        return _open_images(images, path, limits, f"its {len(images)} extensions of one size are taken for frames")
    image = images[0]
    frames = _as_frames(image, image.numbers(limits))
    if not single and frames.ndim == 3 and any(card.startswith(_IN_COLOUR) for card in image.cards):
        raise DataError(f"{path}: a single image in colour; name a video, or the folder that holds the frames")
    if single and frames.ndim == 2:
        frames = frames[None]
    if frames.ndim == 2:
        raise DataError(f"{path}: a single image; name a video, or the folder that holds the frames")
    limits.check_count(len(frames), str(path))
    read = MappedFrames.of(frames) if isinstance(frames, np.memmap) else lambda chosen: (frames[n] for n in chosen)
    return _source(images, path, frames.shape, lambda chosen: ((image, frame) for frame in iter_frames(read(chosen))))


def open_fits_folder(folder: Path, files: Sequence[Path], limits: Limits = DEFAULT_LIMITS) -> FrameSource:
    """Open FITS files of one image each as a video; all have the size and type of the first."""
    images = [find_images(file, limits)[0] for file in files]
    for image in images:
        if image.kind != images[0].kind:
            expected, found = (f"{other.shape} {other.dtype}" for other in (images[0], image))
            raise DataError(f"{image.path}: expected {expected} as the first image, found {found}")
    return _open_images(images, folder, limits)


def _open_images(images: Sequence[FitsImage], path: Path, limits: Limits, *remarks: str) -> FrameSource:
    """Open images of one kind, each of which is a frame and may have a scaling of its own."""

    def numbers(chosen: Sequence[int]) -> Iterator[tuple[FitsImage, NDArray[Any]]]:
        for number in chosen:
            yield images[number], _as_image(images[number], images[number].numbers(limits))

    _, first = next(numbers([0]))
    return _source(images, path, (len(images), *first.shape), numbers, *remarks)


def read_fits(path: Path, limits: Limits) -> tuple[PixelArray, tuple[str, ...]]:
    """Read one image, grey or colour; return it in a type that its values fill, and remarks."""
    image = find_images(path, limits)[0]
    numbers = _as_image(image, image.numbers(limits))
    levels, notes = _levels([image], [(image, numbers)])
    pixels, bayer = levels.pixels(numbers, image), image.bayer if numbers.ndim == 2 else None
    return pixels if bayer is None else demosaic(pixels, bayer), notes


def _source(
    images: Sequence[FitsImage],
    path: Path,
    shape: tuple[int, ...],
    numbers: Callable[[Sequence[int]], Iterator[tuple[FitsImage, NDArray[Any]]]],
    *remarks: str,
) -> FrameSource:
    """Describe a video; ``numbers`` reads frames of given places, each with the image that it is of."""
    levels, notes = _levels(images, numbers(range(shape[0])))
    image, counts = images[0], levels.counts
    dtype = levels.unsigned or image.dtype.newbyteorder("=")
    unsigned = levels.unsigned is not None and not levels.missing
    bayer = image.bayer if len(shape) == 3 else None
    return FrameSource(
        name=path.name,
        format=f"fits/{dtype}" if bayer is None else f"fits/{dtype} as {bayer}",
        file_shape=shape if bayer is None else (*shape, 3),
        full_scale=full_scale_of(dtype, str(path)) if unsigned else 1,
        bit_depth=depth_of(dtype) if counts is None else 32,
        pixels=lambda chosen: (levels.pixels(frame, part) for part, frame in numbers(chosen)),
        path=path,
        warnings=(*notes, *remarks),
        levels=None if counts is None else counts.levels,
        header=image.cards,
        bayer=bayer,
    )


def _as_frames(image: FitsImage, numbers: NDArray[Any]) -> NDArray[Any]:
    """View as (T, H, W) or (T, H, W, 3), or (H, W) for one image."""
    shape = numbers.shape
    if numbers.ndim < 4:
        return numbers
    if shape[1] == 1:
        return numbers[:, 0]
    if shape[1] == 3:
        return np.moveaxis(numbers, 1, -1)
    if shape[0] == 3:
        return np.moveaxis(numbers, 0, -1)
    if shape[3] != 3:
        raise DataError(f"{image.path}: expected (T, H, W), (T, 3, H, W) or (3, T, H, W), found {shape}")
    return numbers


def _as_image(image: FitsImage, numbers: NDArray[Any]) -> NDArray[Any]:
    """View as (H, W) or (H, W, 3)."""
    shape = numbers.shape
    if numbers.ndim == 3 and shape[0] == 3:
        return np.moveaxis(numbers, 0, -1)
    if numbers.ndim == 3 and shape[0] == 1:
        return numbers[0]
    if numbers.ndim != 2:
        raise DataError(f"{image.path}: expected one image, (H, W) or (3, H, W), found {shape}; name a cube by itself")
    return numbers


def _levels(
    images: Sequence[FitsImage], frames: Iterable[tuple[FitsImage, NDArray[Any]]]
) -> tuple[_Levels, tuple[str, ...]]:
    """Decide what black and white are, and say what is unusual."""
    image = images[0]
    middle = 0 if image.dtype.kind == "u" else 2 ** (8 * image.dtype.itemsize - 1)
    whole = image.dtype.kind in "iu" and image.dtype.itemsize <= 4
    if whole and all(other.scale == (1, middle) for other in images):
        missing = any(other.blank is not None for other in images)
        return _Levels(np.dtype(f"u{image.dtype.itemsize}"), missing=missing), image.notes
    counts = range_of_counts((_values(frame, other) for other, frame in frames), str(image.path), image.dtype.kind)
    return _Levels(None, counts), image.notes if counts is None else (counts.remark, *image.notes)


def _values(numbers: NDArray[Any], image: FitsImage) -> NDArray[Any]:
    """Physical values; NaN where they are missing."""
    scale, zero = image.scale
    if image.dtype.kind == "f" and (scale, zero) == (1, 0):
        return numbers.astype(numbers.dtype.newbyteorder("="))
    values = numbers * np.float64(scale) + zero
    if image.blank is not None:
        values[numbers == image.blank] = np.nan
    return values

"""Blur that differs from one part of an image to another: widths of tiles, and deconvolution by a width per pixel.

A scene in depth, or air that is rougher near the ground, blurs parts of an image differently.  Widths of single tiles
are less sure than that of the whole, so they are used only where they differ by more than their uncertainties allow.
A tile without texture says nothing, and has the width of the whole.

How sure a width is takes twice the time of the width, and is asked only where it matters: the width of a tile is one of
those of its reductions, and where all of them agree those that would be chosen do too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..blur.estimation import BlurCandidate, BlurEstimate, choose_blur, find_candidates
from ..core.arrays import FloatArray, check_image, luminance
from ..core.noise import estimate_noise
from ..deconvolution.deconvolve import Deconvolution
from ..runtime.scratch import drop_pages
from ..runtime.threads import ThreadTeam, one_thread_each
from ..runtime.tiling import new_mosaic

# Tiles of fewer pixels a side say too little.
_LEAST_TILE, _MOST_TILES = 240, 3
# Tiles overlap by this share of their distance.
_OVERLAP = 0.25
# Widths vary clearly if the largest exceeds the smallest by this factor, and by so many standard deviations.
_CLEAR_FACTOR, _CLEAR_DEVIATIONS = 1.5, 3.0
# Fine detail of a tile exceeds its noise by this factor, or a width that finds no blur means nothing.
_DETAIL = 2.0
# Neighbouring widths that images are interpolated between differ by this factor, or more where there would be too many.
_STEP, _MOST_WIDTHS = 1.35, 5
# Rows that images are interpolated in at a time.
_STRIP_ROWS = 256


@dataclass(frozen=True)
class BlurMap:
    """Width of the blur by tiles.

    Attributes
    ----------
    sigmas : ndarray, float64, shape (rows, columns)
        Width found in each tile, pixels; that of the whole image where the tile says nothing.
    uncertainties : ndarray, float64, shape (rows, columns)
        Their standard deviations, pixels; infinite where they were not needed to see that widths do not differ.
    varies : bool
        Whether the widths differ clearly.
    """

    sigmas: np.ndarray
    uncertainties: np.ndarray
    varies: bool

    @property
    def removable(self) -> np.ndarray:
        """Widths that are safe to remove: half of the uncertainty is left in; 0 where that was not needed."""
        return np.maximum(self.sigmas - 0.5 * self.uncertainties, 0.0)


def estimate_blur_map(
    image: ArrayLike, whole: BlurEstimate, given_up: Callable[[], bool] | None = None
) -> BlurMap | None:
    """Estimate the blur of overlapping tiles, two or three along each side.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Blurred image.
    whole : BlurEstimate
        Of the whole image.
    given_up : callable, optional
        Asked before each tile whether the rest is of no use any more.

    Returns
    -------
    BlurMap or None
        None if the image is too small for tiles of 240 pixels, or if it was given up.

    Raises
    ------
    DataError
        Wrong shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur.estimation import estimate_blur
    >>> small = np.zeros((256, 256))
    >>> estimate_blur_map(small, estimate_blur(small)) is None
    True
    """
    grey = luminance(check_image(image))
    rows, columns = _spans(grey.shape[0]), _spans(grey.shape[1])
    if len(rows) == 1 or len(columns) == 1:
        return None
    noise, shape = estimate_noise(grey), (len(rows), len(columns))
    found = dict[tuple[int, ...], tuple[BlurCandidate, ...]]()
    with one_thread_each(), ThreadTeam(1) as team:
        for place in np.ndindex(shape):
            if given_up is not None and given_up():
                return None
            tile = np.ascontiguousarray(grey[rows[place[0]], columns[place[1]]])
            candidates = find_candidates(tile, exponent=whole.exponent)
            if any(one.convinces for one in candidates) or (candidates and _fine_detail(tile) > _DETAIL * noise):
                found[place] = candidates
        sigmas, uncertainties = np.full(shape, whole.sigma), np.full(shape, whole.uncertainty)
        agree = _agree(found.values())
        for place, candidates in found.items():
            if given_up is not None and given_up():
                return None
            chosen = _like(whole, candidates) if agree else choose_blur(candidates, None, whole.exponent, team)
            sigmas[place], uncertainties[place] = chosen.sigma, chosen.uncertainty
    spoken = tuple(np.array(list(found), int).reshape(-1, 2).T)
    return BlurMap(sigmas, uncertainties, not agree and _clearly_differ(sigmas[spoken], uncertainties[spoken]))


def sigma_map(tiles: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Width for every pixel, interpolated between the centres of the tiles.

    Parameters
    ----------
    tiles : array_like, shape (rows, columns)
        Width of each tile, pixels.
    shape : tuple of int
        (H, W).

    Returns
    -------
    ndarray, float32, shape (H, W)
        Pixels.

    Examples
    --------
    >>> sigma_map([[1.0, 2.0], [1.0, 2.0]], (480, 480))[0, [0, 240, 479]].round(2).tolist()
    [1.0, 1.5, 2.0]
    """
    values = np.asarray(tiles, np.float32)
    axes = []
    for length, count in zip(shape, values.shape, strict=True):
        centres = [(span.start + span.stop - 1) / 2 for span in _spans(length)]
        axes.append(np.interp(np.arange(length), centres, np.arange(count)).astype(np.float32))
    y, x = np.meshgrid(*axes, indexing="ij")
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def deconvolve_varying(
    attempt: Callable[[float], Deconvolution], sigmas: FloatArray, scratch: Path | None = None
) -> Deconvolution:
    """Deconvolve by a width per pixel: by a few widths, and interpolate between their images.

    Parameters
    ----------
    attempt : callable
        Deconvolves the whole image by one width in pixels.
    sigmas : ndarray, float32, shape (H, W)
        Width for every pixel.
    scratch : Path, optional
        Folder of a file that holds the image; by default it is in memory.

    Returns
    -------
    Deconvolution
        Its ``sigma`` is the mean width; the record of the run is that of the widest.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
    >>> image = np.random.default_rng(0).uniform(size=(32, 32)).astype(np.float32)
    >>> wiener = DeconvolutionParams(method="wiener")
    >>> result = deconvolve_varying(lambda s: deconvolve(image, s, wiener), np.full((32, 32), 1.0, np.float32))
    >>> bool((result.image == deconvolve(image, 1.0, wiener).image).all())
    True
    """
    low, high = float(sigmas.min()), float(sigmas.max())
    steps = int(np.ceil(np.log(max(high, 1e-6) / max(low, 1e-6)) / np.log(_STEP) - 1e-6))
    count = min(steps + 1, _MOST_WIDTHS)
    widths = np.geomspace(low, high, count) if low > 0 else np.linspace(low, high, _MOST_WIDTHS)
    widths = np.unique(widths) if high > low else np.array([high])
    for index, width in enumerate(widths):
        result = attempt(float(width))
        if index == 0:
            image = new_mosaic(result.image.shape, scratch)
        for start in range(0, len(image), _STRIP_ROWS):
            rows = slice(start, start + _STRIP_ROWS)
            # Hat functions: one at their width, zero at its neighbours'.
            share = np.interp(sigmas[rows], widths, np.eye(len(widths))[index]).astype(np.float32)
            image[rows] += result.image[rows] * (share if image.ndim == 2 else share[..., None])
            drop_pages(result.image)
            drop_pages(image)
    return dataclasses.replace(result, image=image, sigma=float(sigmas.mean()))


def _spans(length: int) -> list[slice]:
    """Overlapping stretches of equal length that cover a side."""
    count = min(_MOST_TILES, max(1, int(length / (_LEAST_TILE / (1 + _OVERLAP)))))
    size = min(length, round(length / count * (1 + _OVERLAP)))
    starts = np.linspace(0, length - size, count).round().astype(int)
    return [slice(int(start), int(start) + size) for start in starts]


def _fine_detail(tile: FloatArray) -> float:
    """Deviation of what the mask of the noise estimate lets through; that of the noise where there is nothing else."""
    second = np.array([1, -2, 1], np.float32)
    return float(cv2.sepFilter2D(tile, cv2.CV_32F, second, second).std()) / 6


def _agree(tiles: Iterable[tuple[BlurCandidate, ...]]) -> bool:
    """Whether all widths that may be chosen are too near to each other to differ clearly."""
    convincing = [[one.estimate.sigma for one in tile if one.convinces] for tile in tiles]
    if not all(convincing):
        # One looks sharp.
        return False
    widths = [width for tile in convincing for width in tile]
    return not widths or max(widths) <= _CLEAR_FACTOR * min(widths)


def _like(whole: BlurEstimate, candidates: tuple[BlurCandidate, ...]) -> BlurEstimate:
    """Estimate from the reduction nearest to that which decided of the whole."""
    convincing = (one.estimate for one in candidates if one.convinces)
    return min(convincing, key=lambda estimate: abs(estimate.reduction - whole.reduction))


def _clearly_differ(sigmas: np.ndarray, uncertainties: np.ndarray) -> bool:
    if sigmas.size < 2:
        return False
    most, least = int(sigmas.argmax()), int(sigmas.argmin())
    difference = sigmas[most] - sigmas[least]
    deviation = np.hypot(uncertainties[most], uncertainties[least])
    return bool(sigmas[most] > _CLEAR_FACTOR * sigmas[least] and difference > _CLEAR_DEVIATIONS * deviation)

"""Blur that differs between parts of an image: widths of tiles, and deconvolution by a width for every pixel.

Depth in the scene, or stronger turbulence near the ground, blurs parts of an image differently.  The width of a tile is
less certain than that of the whole image, so tiles are used only if their widths differ by clearly more than their
uncertainties.  A tile without texture is given the width of the whole image.

A tile is reduced at least half as much as the whole image was, if a blur is found so: less reduced, compressed video
shows the blocks of its codec, which look like edges with a narrow blur.

The uncertainty of a width takes twice as long as the width itself and is computed only if it matters: if all plausible
widths of the tiles agree, so do those that would be chosen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..blur.estimation import BlurCandidate, BlurEstimate, choose_blur, find_candidates, removable_width
from ..core.arrays import FloatArray, check_grey
from ..core.noise import estimate_noise
from ..deconvolution.deconvolve import Deconvolution
from ..deconvolution.stopping import Steps
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import iter_frames
from ..runtime.steps import finish
from ..runtime.threads import one_thread_each
from ..runtime.tiling import new_mosaic

# Smallest side of a tile, pixels, and largest number of tiles along a side.
_LEAST_TILE, _MOST_TILES = 240, 3
# Tiles overlap by this share of their distance.
_OVERLAP = 0.25
# Widths differ clearly if the largest exceeds the smallest by this factor and by this many standard deviations.
_CLEAR_FACTOR, _CLEAR_DEVIATIONS = 1.5, 3.0
# A tile in which no blur is found counts as sharp only if its fine detail exceeds the noise by this factor.
_DETAIL, _SECOND = 2.0, np.array([1, -2, 1], np.float32)
# Ratio of neighbouring widths between whose images is interpolated, and largest number of widths.
_STEP, _MOST_WIDTHS = 1.35, 5
# Rows that are interpolated at a time.
_STRIP_ROWS = 256


@dataclass(frozen=True)
class BlurMap:
    """Width of the blur by tiles."""

    # (rows, columns): width of each tile, pixels; that of the whole image if the tile does not determine it.
    sigmas: np.ndarray
    uncertainties: np.ndarray  # (rows, columns): uncertainty of each, pixels; infinite if the widths agree without it
    varies: bool  # whether the widths differ clearly

    @property
    def removable(self) -> np.ndarray:
        """Widths that are safe to remove, pixels; 0 if the uncertainty is infinite."""
        return removable_width(self.sigmas, self.uncertainties)


def estimate_blur_map(image: ArrayLike, whole: BlurEstimate, runtime: Runtime = DEFAULT) -> BlurMap | None:
    """Estimate the blur of overlapping tiles of an image (H, W[, 3]), two or three along each side."""
    return finish(blur_map_steps(image, whole, runtime))


def blur_map_steps(
    image: ArrayLike, whole: BlurEstimate, runtime: Runtime = DEFAULT
) -> Generator[int, None, BlurMap | None]:
    """Estimate the blur of overlapping tiles, one tile per step; see :func:`estimate_blur_map`."""
    grey = check_grey(image)
    rows, columns = _spans(grey.shape[0]), _spans(grey.shape[1])
    if len(rows) == 1 or len(columns) == 1:
        return None
    noise, shape = estimate_noise(grey), (len(rows), len(columns))
    found = dict[tuple[int, ...], tuple[BlurCandidate, ...]]()
    for number, place in enumerate(np.ndindex(shape), 1):
        tile = np.ascontiguousarray(grey[rows[place[0]], columns[place[1]]])
        with one_thread_each():
            candidates = find_candidates(tile, exponent=whole.exponent)
        # Second differences, from which noise is estimated too; in a flat tile they equal the noise.
        fine = cv2.sepFilter2D(tile, cv2.CV_32F, _SECOND, _SECOND).std() / 6
        if any(one.plausible for one in candidates) or (candidates and fine > _DETAIL * noise):
            found[place] = candidates
        yield number
    sigmas, uncertainties = np.full(shape, whole.sigma), np.full(shape, whole.uncertainty)
    agree = _agree(found.values())
    for number, (place, candidates) in enumerate(found.items(), 1):
        if agree:
            plausible = (one.estimate for one in candidates if one.plausible)
            chosen = min(plausible, key=lambda estimate: abs(estimate.reduction - whole.reduction))
        else:
            with one_thread_each():
                chosen = choose_blur(_like(candidates, whole), runtime)
        sigmas[place], uncertainties[place] = chosen.sigma, chosen.uncertainty
        yield number
    known = tuple(np.array(list(found), int).reshape(-1, 2).T)
    return BlurMap(sigmas, uncertainties, not agree and _clearly_differ(sigmas[known], uncertainties[known]))


def sigma_map(tiles: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Interpolate the widths (rows, columns) of tiles between their centres, to a width for every pixel (H, W)."""
    values = np.asarray(tiles, np.float32)
    axes = []
    for length, count in zip(shape, values.shape, strict=True):
        centres = [(span.start + span.stop - 1) / 2 for span in _spans(length)]
        axes.append(np.interp(np.arange(length), centres, np.arange(count)).astype(np.float32))
    y, x = np.meshgrid(*axes, indexing="ij")
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def varying_deconvolution_steps(
    attempt: Callable[[float], Steps[Deconvolution]], sigmas: FloatArray, runtime: Runtime = DEFAULT
) -> Steps[Deconvolution]:
    """Deconvolve by a width for every pixel (H, W): by a few widths, between whose images is interpolated."""
    widths = _widths_between(float(sigmas.min()), float(sigmas.max()))
    for index, width in enumerate(widths):
        result = yield from attempt(float(width))
        if index == 0:
            image = new_mosaic(result.image.shape, runtime.scratch)
        for part, found, sigma in zip(_strips(image), _strips(result.image), _strips(sigmas), strict=True):
            # Linear interpolation: the share is one at this width and falls to zero at the neighbouring ones.
            share = np.interp(sigma, widths, np.eye(len(widths))[index]).astype(np.float32)
            np.add(part, found * share.reshape(*share.shape, *[1] * (found.ndim - 2)), out=part)
    return dataclasses.replace(result, image=image, sigma=float(sigmas.mean()))


def _widths_between(low: float, high: float) -> np.ndarray:
    if low == high:
        return np.array([high])
    if low <= 0:
        return np.linspace(low, high, _MOST_WIDTHS)
    steps = int(np.ceil(np.log(high / low) / np.log(_STEP) - 1e-6))
    return np.unique(np.geomspace(low, high, min(steps + 1, _MOST_WIDTHS)))


def _strips(image: FloatArray) -> Iterator[FloatArray]:
    """Consecutive rows of an image, whose memory is handed back if the image is in a file."""
    return iter_frames(image[start : start + _STRIP_ROWS] for start in range(0, len(image), _STRIP_ROWS))


def _spans(length: int) -> list[slice]:
    """Overlapping spans of equal length that cover a side."""
    count = min(_MOST_TILES, max(1, int(length / (_LEAST_TILE / (1 + _OVERLAP)))))
    size = min(length, round(length / count * (1 + _OVERLAP)))
    starts = np.linspace(0, length - size, count).round().astype(int)
    return [slice(int(start), int(start) + size) for start in starts]


def _agree(tiles: Iterable[tuple[BlurCandidate, ...]]) -> bool:
    """Whether all widths that might be chosen are too close to each other to differ clearly."""
    plausible = [[one.estimate.sigma for one in tile if one.plausible] for tile in tiles]
    if not all(plausible):
        # A tile looks sharp.
        return False
    widths = [width for tile in plausible for width in tile]
    return not widths or max(widths) <= _CLEAR_FACTOR * min(widths)


def _like(candidates: tuple[BlurCandidate, ...], whole: BlurEstimate) -> tuple[BlurCandidate, ...]:
    """Plausible candidates of about the reduction of the whole image; all of them if there is none."""
    return (
        tuple(one for one in candidates if one.plausible and 2 * one.estimate.reduction >= whole.reduction)
        or candidates
    )


def _clearly_differ(sigmas: np.ndarray, uncertainties: np.ndarray) -> bool:
    if sigmas.size < 2:
        return False
    most, least = int(sigmas.argmax()), int(sigmas.argmin())
    difference = sigmas[most] - sigmas[least]
    deviation = np.hypot(uncertainties[most], uncertainties[least])
    return bool(sigmas[most] > _CLEAR_FACTOR * sigmas[least] and difference > _CLEAR_DEVIATIONS * deviation)

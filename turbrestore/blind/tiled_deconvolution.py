"""Deconvolution of an image in overlapping tiles, where the whole would take too much memory.

Width and shape of the blur and the fidelity λ are decided on the whole image.  Each tile is then deconvolved as an
image of its own and faded into its neighbours (:mod:`turbrestore.runtime.tiling`).  The halo of 96 pixels is much wider
than a blur, so the result is close to that of the whole image, but not the same: nonlocal weights and the end of the
iterations are decided tile by tile, and with a periodic boundary each tile is periodic.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image
from ..core.errors import ConfigurationError
from ..deconvolution.deconvolve import (
    Deconvolution,
    DeconvolutionParams,
    DeconvolutionState,
    deconvolve_steps,
    whole_image_params,
)
from ..deconvolution.memory import deconvolution_memory
from ..runtime.memory_size import size_text
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import to_scratch
from ..runtime.tiling import HALO, HaloTile, add_tile, halo_tiles, largest_tile, new_mosaic

# Shortest side that tiles may have, and the step in which sides are tried; pixels.
SMALLEST_SIDE, _SIDE_STEP = 4 * HALO, 32
# More threads than these take no more memory.
MOST_THREADS = 4


def deconvolution_tiles(
    shape: tuple[int, ...], params: DeconvolutionParams, memory: float | None = None
) -> tuple[HaloTile, ...]:
    """Choose the largest tiles whose deconvolution takes no more than the given memory.

    The memory is that of any number of threads, so that the result does not depend on it.

    Parameters
    ----------
    shape : tuple of int
        Of the image, (H, W) or (H, W, 3).
    params : DeconvolutionParams
        ``params.sigma`` is the width to remove.
    memory : float, optional
        Bytes; by default the memory is not limited.

    Returns
    -------
    tuple of HaloTile
        A single one for the whole image if that fits.

    Raises
    ------
    ConfigurationError
        The memory is too small for the smallest tiles.

    Examples
    --------
    >>> params = DeconvolutionParams(sigma=1.5)
    >>> len(deconvolution_tiles((1080, 1920), params)), len(deconvolution_tiles((1080, 1920), params, memory=300e6)) > 1
    (1, True)
    """
    size, longest = (shape[0], shape[1]), max(*shape[:2], SMALLEST_SIDE)
    if memory is None or params.sigma == 0:
        return halo_tiles(size, longest)
    for side in (longest, *range(longest - _SIDE_STEP, SMALLEST_SIDE, -_SIDE_STEP), SMALLEST_SIDE):
        least = deconvolution_memory((*largest_tile(size, side), *shape[2:]), params, MOST_THREADS)
        if least <= memory:
            return halo_tiles(size, side)
    raise ConfigurationError(
        f"memory_limit: expected {size_text(least)} for the deconvolution of tiles of {SMALLEST_SIDE} pixels, found "
        f"{size_text(max(memory, 0.0))}; allow more, or restore a part of the image"
    )


def tiled_deconvolution_steps(
    image: ArrayLike,
    sigma: float,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    tiles: tuple[HaloTile, ...] = (),
) -> Generator[DeconvolutionState, None, Deconvolution]:
    """Deconvolve an image tile by tile.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Blurred image.
    sigma : float
        Width of the blur, pixels.
    params : DeconvolutionParams, optional
        Method and settings; ``params.sigma`` is not used.
    guide : array_like, shape (H, W) or (H, W, 3), optional
        Image that nonlocal weights are computed from; by default ``image``.
    runtime : Runtime
        Threads, device, and the folder of a file that holds the result.
    tiles : tuple of HaloTile
        From :func:`deconvolution_tiles` or :func:`turbrestore.runtime.tiling.halo_tiles`; by default the whole image.

    Yields
    ------
    DeconvolutionState
        After each iteration of each tile.

    Returns
    -------
    Deconvolution
        ``converged`` if all tiles have; ``noise`` is the root mean square over the tiles, and the record of the
        iterations that of the tile which took most.

    Raises
    ------
    DataError
        The shapes differ, or values are not finite.
    StorageError
        The folder has no room for the result.

    Examples
    --------
    >>> from turbrestore.runtime.steps import finish
    >>> image = np.random.default_rng(0).uniform(size=(40, 64)).astype(np.float32)
    >>> wiener, tiles = DeconvolutionParams(method="wiener"), halo_tiles(image.shape, side=44, halo=8)
    >>> len(tiles), finish(tiled_deconvolution_steps(image, 1.0, wiener, tiles=tiles)).image.shape
    (2, (40, 64))
    """
    pixels = check_image(image)
    around = None if guide is None else check_image(guide, "guide")
    if sigma == 0 or len(tiles) < 2:
        whole = yield from deconvolve_steps(pixels, sigma, params, around, runtime)
        return replace(whole, image=to_scratch(whole.image, runtime.scratch))
    params = params or DeconvolutionParams()
    # Each tile chooses its own h for the nonlocal weights, from its guide after sharpening; that of the whole guide
    # before sharpening would be too small (0.3 dB worse on brick).
    params = replace(params, fidelity=whole_image_params(pixels, params, around).fidelity)
    restored, parts = new_mosaic(pixels.shape, runtime.scratch), list[Deconvolution]()
    for tile in tiles:
        guide_part = None if around is None else _part(around, tile)
        part = yield from deconvolve_steps(_part(pixels, tile), sigma, params, guide_part, runtime)
        add_tile(restored, tile, part.image)
        parts.append(replace(part, image=restored))
    noise = float(np.sqrt(np.mean([part.noise**2 for part in parts])))
    slowest = max(parts, key=lambda part: part.iterations)
    return replace(slowest, noise=noise, converged=all(part.converged for part in parts))


def _part(image: FloatArray, tile: HaloTile) -> FloatArray:
    return image[tile.rows, tile.columns]

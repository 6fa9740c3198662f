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
from ..core.noise import NoiseCurve
from ..deconvolution.deconvolve import (
    Deconvolution,
    DeconvolutionParams,
    DeconvolutionState,
    deconvolve_steps,
    whole_image_fidelity,
)
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import to_scratch
from ..runtime.tiling import HALO, HaloTile, add_tile, new_mosaic

# Shortest side that tiles may have, pixels.
SMALLEST_SIDE = 4 * HALO
# More threads than these take no more memory.
MOST_THREADS = 4


def tiled_deconvolution_steps(
    image: ArrayLike,
    sigma: float | ArrayLike,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    tiles: tuple[HaloTile, ...] = (),
    photons: NoiseCurve | None = None,
) -> Generator[DeconvolutionState, None, Deconvolution]:
    """Deconvolve an image tile by tile.

    ``image`` (H, W) or (H, W, 3); ``sigma`` may be a PSF (h, w); ``guide`` (H, W) or (H, W, 3).
    """
    pixels = check_image(image)
    around = None if guide is None else check_image(guide, "guide")
    if not np.any(sigma) or len(tiles) < 2:
        whole = yield from deconvolve_steps(pixels, sigma, params, around, runtime, photons)
        return replace(whole, image=to_scratch(whole.image, runtime.scratch))
    params = params or DeconvolutionParams()
    # Each tile chooses its own h for the nonlocal weights, from its guide after sharpening; that of the whole guide
    # before sharpening would be too small (0.3 dB worse on brick).
    params = replace(params, fidelity=whole_image_fidelity(pixels, params))
    restored, parts = new_mosaic(pixels.shape, runtime.scratch), list[Deconvolution]()
    for tile in tiles:
        guide_part = None if around is None else _part(around, tile)
        part = yield from deconvolve_steps(_part(pixels, tile), sigma, params, guide_part, runtime, photons)
        add_tile(restored, tile, part.image)
        parts.append(replace(part, image=restored))
    noise = float(np.sqrt(np.mean([part.noise**2 for part in parts])))
    slowest = max(parts, key=lambda part: part.iterations)
    return replace(slowest, noise=noise, converged=all(part.converged for part in parts))


def _part(image: FloatArray, tile: HaloTile) -> FloatArray:
    return image[tile.rows, tile.columns]

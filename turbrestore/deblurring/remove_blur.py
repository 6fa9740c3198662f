"""Blind deconvolution: estimate the blur of the fused image, remove it, and check the result.

The width is given or estimated.  A given width is removed whatever the guards say.  From an estimated width on,
attempts with smaller and smaller widths are made until the guards pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..blur.edges import has_black_background
from ..blur.estimation import BlurEstimate, estimate_blur, limit_to_edges
from ..blur.posterior import BlurPosterior, BlurWitnesses, estimate_posterior
from ..blur.psf import Float64Array
from ..core.arrays import FloatArray, check_image, luminance
from ..core.decision import Decision
from ..core.noise import NoiseCurve, estimate_noise
from ..core.noise_spectrum import NoiseSpectrum, white_noise
from ..deconvolution.deconvolve import Deconvolution, DeconvolutionParams, deconvolve_steps, whole_image_fidelity
from ..deconvolution.memory import deconvolution_memory
from ..deconvolution.problem import largest_width, read_blur
from ..deconvolution.stopping import Steps
from ..runtime.device import CPU, find_device
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import to_scratch
from ..runtime.tiling import HALO, HaloTile, add_tile, halo_tiles, largest_tile, new_mosaic
from .decisions import explain_blur, explain_choice, explain_guards, explain_posterior
from .guards import BACK_OFF, GuardParams, GuardReading, evaluate_guards

# Bytes per pixel, and per pixel and channel, of what is computed before and after the deconvolution; the guards take
# most.  Measured, and rounded up; benchmarks/memory.py --stages measures them again.
_BYTES, _CHANNEL_BYTES = 22, 2
# Bytes per pixel and channel of the results of two attempts.
_RESULTS_BYTES = 8
# The widest blur that is found, pixels: the widest that is tried in an image reduced by 8, rounded up.
WIDEST = 21.0
# Most attempts, chosen; if the last one fails, no blur is removed.
_MOST_TRIES = 10
# Shortest side that tiles may have, pixels.
SMALLEST_SIDE = 4 * HALO
# More threads than these, of three channels and the guide, take no more memory.
MOST_THREADS = 4

# What the image alone tells, and what the image and the frames tell; None where it is not asked.
FoundBlur = tuple[BlurEstimate | None, BlurPosterior | None]
# Whether to end a deconvolution early, judged by its image so far.
Refusal = Callable[[FloatArray], bool]


@dataclass(frozen=True)
class Deblurred:
    """A deblurred image and the decisions on the way to it."""

    deconvolution: Deconvolution
    blur: BlurEstimate | None  # none if the width was given
    readings: tuple[GuardReading, ...]  # one for each width that was removed; empty if no blur was removed
    decisions: tuple[Decision, ...]  # on the blur and on the guards
    posterior: BlurPosterior | None = None  # none if the width was given, or nothing is known but the image


def left_blurred(done: Deblurred, image: FloatArray) -> Deblurred:
    """Return the image as it was in place of a deblurred one, on most of whose detail the frames do not agree."""
    assert done.posterior is not None
    reason = "the halves of the clip do not agree on most of the detail that removing one sharpens"
    return replace(
        done,
        deconvolution=replace(done.deconvolution, image=image, sigma=0.0),
        posterior=replace(done.posterior, removed=0.0),
        decisions=(*done.decisions, Decision("blur", explain_choice(0.0), reason)),
    )


def remove_blur_steps(
    image: FloatArray,
    guide: FloatArray,
    deconvolution: DeconvolutionParams | None = None,
    guards: GuardParams | None = None,
    runtime: Runtime = DEFAULT,
    side: int | None = None,
    found: FoundBlur | None = None,
    psf: Float64Array | None = None,
    photons: NoiseCurve | None = None,
    full_scale: tuple[float, float] = (0.0, 1.0),
    noise: NoiseSpectrum | None = None,
) -> Steps[Deblurred]:
    """Remove a blur of given or of estimated width from an image (H, W[, 3]) step by step.

    With ``side`` the image is deconvolved in tiles of at most that side, pixels, which takes less memory.  The blur
    is the one ``found``, by default by the image alone; ``psf`` (h, w) is the point spread function, if it is known.
    ``photons`` is the noise of the image at every level, relative to its mean; ``full_scale`` is black and white, and
    ``noise`` the spectrum of the noise of the image.
    """
    params, guards = deconvolution or DeconvolutionParams(), guards or GuardParams()
    if psf is not None:
        params = replace(params, sigma=read_blur(psf)[1])
    blur, posterior = found or find_blur(image, params, runtime, None, noise)
    if posterior is None:
        sigma, params = blur_to_remove(blur, params)
    else:
        sigma, params = posterior.removed, replace(params, exponent=params.exponent or posterior.exponent)
    size = image.shape[0], image.shape[1]
    in_tiles = () if side is None or find_device(runtime.device) != CPU else halo_tiles(size, side)

    def remove(width: float, refuse: Refusal | None = None) -> Steps[Deconvolution]:
        kernel = width if psf is None or width == 0 else psf
        known = photons, full_scale, noise
        return tiled_deconvolution_steps(image, kernel, params, guide, runtime, in_tiles, *known, refuse)

    if blur is None:
        result = yield from remove(sigma)
        readings: tuple[GuardReading, ...] = ()
        if sigma > 0:
            readings = (evaluate_guards(result.image, image, sigma, guards),)
    else:
        result, readings = yield from guarded_steps(remove, image, sigma, guards)
    on_guards = explain_guards(result.sigma, readings, guards)
    if posterior is not None:
        on_blur = explain_posterior(posterior, result.sigma)
    else:
        given = "asked for" if psf is None else "the point spread function is given"
        on_blur = explain_blur(blur, sigma, given)
    return Deblurred(result, blur, readings, (on_blur, *on_guards), posterior)


def tiled_deconvolution_steps(
    image: ArrayLike,
    sigma: float | ArrayLike,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    tiles: tuple[HaloTile, ...] = (),
    photons: NoiseCurve | None = None,
    full_scale: tuple[float, float] = (0.0, 1.0),
    noise: NoiseSpectrum | None = None,
    refuse: Refusal | None = None,
) -> Steps[Deconvolution]:
    """Deconvolve an image (H, W) or (H, W, 3) in overlapping tiles, by the blur and the fidelity λ of the whole.

    The weights, the end of the iterations and a periodic boundary are those of each tile, so the result differs a bit
    from that of the whole image.  ``sigma`` may be a PSF (h, w); ``guide`` (H, W) or (H, W, 3).  ``refuse`` can end the
    deconvolution of a whole image early; a tile does not tell what the whole is like.
    """
    pixels = check_image(image)
    guide_image = None if guide is None else check_image(guide, "guide")
    known = photons, full_scale, noise
    if not np.any(sigma) or len(tiles) < 2:
        whole = yield from deconvolve_steps(pixels, sigma, params, guide_image, runtime, *known, refuse)
        return replace(whole, image=to_scratch(whole.image, runtime.scratch))
    params = params or DeconvolutionParams()
    # Each tile chooses its own h for the nonlocal weights, from its guide after sharpening; that of the whole guide
    # before sharpening would be too small (0.3 dB worse on brick).
    params = replace(params, fidelity=whole_image_fidelity(pixels, params, read_blur(sigma)[1], noise))
    restored, parts = new_mosaic(pixels.shape, runtime.scratch), list[Deconvolution]()
    for tile in tiles:
        guide_part = None if guide_image is None else guide_image[tile.rows, tile.columns]
        cut = pixels[tile.rows, tile.columns]
        part = yield from deconvolve_steps(cut, sigma, params, guide_part, runtime, *known)
        add_tile(restored, tile, part.image)
        parts.append(replace(part, image=restored))
    level = float(np.sqrt(np.mean([part.noise**2 for part in parts])))
    slowest = max(parts, key=lambda part: part.iterations)
    return replace(slowest, noise=level, converged=all(part.converged for part in parts))


def remove_blur_memory(shape: tuple[int, ...], params: DeconvolutionParams, side: int | None = None) -> float:
    """Return the memory that :func:`remove_blur_steps` takes beside the blurred image and its guide."""
    pixels, channels = shape[0] * shape[1], shape[2] if len(shape) == 3 else 1
    part = shape if side is None else (*largest_tile((shape[0], shape[1]), side), *shape[2:])
    beside = float(pixels * (_BYTES + channels * _CHANNEL_BYTES))
    params = params if params.sigma is not None else replace(params, sigma=WIDEST)
    solved = deconvolution_memory(part, params, MOST_THREADS)
    # The guards look at a whole image while it is deconvolved, at tiles only when all are done.
    together = beside + solved if part == shape else max(beside, solved)
    return float(pixels * channels * _RESULTS_BYTES) + together


def blur_to_remove(
    estimate: BlurEstimate | None, deconvolution: DeconvolutionParams
) -> tuple[float, DeconvolutionParams]:
    """Decide on the width to remove, and complete the settings by the shape of the blur."""
    if deconvolution.sigma is not None or estimate is None:
        return deconvolution.sigma or 0.0, deconvolution
    return estimate.removable, replace(deconvolution, exponent=estimate.exponent)


def guarded_steps(
    attempt: Callable[[float, Refusal], Steps[Deconvolution]],
    blurred: FloatArray,
    sigma: float,
    guards: GuardParams,
) -> Steps[tuple[Deconvolution, tuple[GuardReading, ...]]]:
    """Deconvolve an image (H, W[, 3]) by smaller and smaller widths until the guards pass.

    An attempt ends early where they object by far.
    """
    readings: list[GuardReading] = []

    def refuse(image: FloatArray) -> bool:
        return not guards.within_reach(evaluate_guards(image, blurred, sigma, guards))

    while sigma > 0 and len(readings) < _MOST_TRIES:
        result = yield from attempt(sigma, refuse)
        readings.append(evaluate_guards(result.image, blurred, sigma, guards))
        if readings[-1].passed:
            return result, tuple(readings)
        sigma *= BACK_OFF if len(readings) > 1 else guards.first_back_off(readings[0])
    result = yield from attempt(0.0, refuse)
    return result, tuple(readings)


def find_blur(
    image: FloatArray,
    params: DeconvolutionParams,
    runtime: Runtime,
    witnesses: BlurWitnesses | None,
    noise: NoiseSpectrum | None = None,
) -> FoundBlur:
    """Estimate the blur by the image, and by the frames where there are witnesses."""
    if params.sigma is not None:
        return None, None
    if witnesses is None:
        return estimate_blur(image, exponent=params.exponent, runtime=runtime), None
    grey = luminance(image)
    if witnesses.picture is not None:
        grey = np.ascontiguousarray(grey[witnesses.picture])
    noise = noise or white_noise(estimate_noise(grey))
    evidence, posterior = estimate_posterior(grey, witnesses, noise, runtime, params.exponent)
    if evidence is None:
        return estimate_blur(image, exponent=params.exponent, runtime=runtime), posterior
    widest = min(WIDEST, largest_width(grey.shape))
    posterior = replace(posterior, removed=min(posterior.removed, widest))
    # No scene is steeper behind a Gaussian than a step.  A soft limb needs that bound; elsewhere it would take a blur
    # with wings, whose core is sharp, for a narrow one.
    if posterior.removed == 0 or not has_black_background(grey):
        return evidence.estimate, posterior
    limited = limit_to_edges(replace(evidence.estimate, sigma=posterior.removed, exponent=posterior.exponent), grey)
    if not limited.edge_limited:
        return evidence.estimate, posterior
    removed = limited.sigma if limited.blurred else 0.0
    return evidence.estimate, replace(posterior, removed=removed, exponent=limited.exponent, edge_limited=True)

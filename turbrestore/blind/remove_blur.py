"""Blind deconvolution: estimate the blur of the fused image, remove it, and check what came out."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from ..blur.blur_cues import BlurBounds
from ..blur.estimation import BlurEstimate, estimate_blur
from ..blur.psf import KOLMOGOROV
from ..core.arrays import FloatArray
from ..core.decision import Decision
from ..deconvolution.deconvolve import Deconvolution, DeconvolutionParams, deconvolve
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import to_scratch
from .blur_map import BlurMap, deconvolve_varying, estimate_blur_map, sigma_map
from .guards import GuardParams, GuardReading, deconvolve_guarded, judge


@dataclass(frozen=True)
class Deblurred:
    """A deblurred image and what was decided on the way.

    Attributes
    ----------
    deconvolution : Deconvolution
    blur : BlurEstimate or None
        None where the width was given.
    tiles : BlurMap or None
        Widths of tiles; None where the width was given, nothing is blurred or the image is small.
    readings : tuple of GuardReading
        What the guards saw of every width that was tried; empty where no blur was removed.
    decisions : tuple of Decision
        On the blur and on the guards.
    """

    deconvolution: Deconvolution
    blur: BlurEstimate | None
    tiles: BlurMap | None
    readings: tuple[GuardReading, ...]
    decisions: tuple[Decision, ...]


def remove_blur(
    image: FloatArray,
    guide: FloatArray,
    deconvolution: DeconvolutionParams | None = None,
    guards: GuardParams | None = None,
    bounds: BlurBounds | None = None,
    runtime: Runtime = DEFAULT,
    progress: Callable[[int], None] | None = None,
) -> Deblurred:
    """Deblur an image by the width asked for, else by the width estimated, as far as the guards allow.

    Where the blur clearly differs between tiles of the image, every pixel gets a width of its own.  Tiles are looked at
    in another thread while the image is deblurred by one width, or before that where memory is limited.

    A width asked for is removed whatever the guards say; they are heard all the same.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Blurred image.
    guide : ndarray, float32, shape of ``image``
        What the nonlocal weights are taken from.
    deconvolution : DeconvolutionParams, optional
        Method, and width where it is known.
    guards : GuardParams, optional
        Bounds that the result must keep.
    bounds : BlurBounds, optional
        What an estimated width is kept within.
    runtime : Runtime
        Threads, device, most memory to take, and a folder for the images; without one they stay in memory.
    progress : callable, optional
        Called with the number of iterations done, in an attempt by one width.

    Returns
    -------
    Deblurred

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.
    StorageError
        There is no room for the file.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> chart = resolution_chart(64, 64)
    >>> result = remove_blur(chart, chart, DeconvolutionParams(sigma=0.0))
    >>> result.decisions
    (Decision(subject='blur', choice='none removed', reason='asked for'),)
    """
    folder = runtime.scratch
    deconvolution, guards = deconvolution or DeconvolutionParams(), guards or GuardParams()
    blind = deconvolution.sigma is None
    exponent = deconvolution.exponent or KOLMOGOROV
    blur = estimate_blur(image, exponent=exponent, threads=runtime.workers) if blind else None
    sigma, settings = blur_to_remove(blur, deconvolution, bounds)

    def remove(width: float, progress: Callable[[int], None] | None = None) -> Deconvolution:
        result = deconvolve(image, width, settings, guide, runtime, progress)
        return replace(result, image=to_scratch(result.image, folder))

    tiles, first = None, None
    if blur is not None and blur.blurred and bounds is None:
        if runtime.memory_limit is not None:
            # Both at once may take more than is allowed.
            tiles = estimate_blur_map(image, blur)
        else:
            tiles, first = _map_meanwhile(image, blur, lambda: remove(sigma, progress))
    widths = None if tiles is None or not tiles.varies else sigma_map(tiles.removable, image.shape[:2])
    if widths is not None:
        sigma = float(widths.max())

    def attempt(width: float) -> Deconvolution:
        if widths is not None and width > 0:
            return deconvolve_varying(remove, widths * (width / sigma), folder)
        return first if first is not None and first.sigma == width else remove(width, progress)

    if blind:
        result, readings = deconvolve_guarded(attempt, image, sigma, guards)
    else:
        result = attempt(sigma)
        readings = (judge(result.image, image, sigma, guards),) if sigma > 0 else ()
    decisions = (_on_blur(blur, sigma, tiles), *_on_tiles(tiles), *_on_guards(result, readings, guards))
    return Deblurred(result, blur, tiles, readings, decisions)


def blur_to_remove(
    estimate: BlurEstimate | None, deconvolution: DeconvolutionParams, bounds: BlurBounds | None = None
) -> tuple[float, DeconvolutionParams]:
    """Width of the blur, and settings that know its shape: those asked for, else those estimated.

    Parameters
    ----------
    estimate : BlurEstimate or None
        Needed where ``deconvolution.sigma`` is None.
    deconvolution : DeconvolutionParams
        Settings.
    bounds : BlurBounds, optional
        What an estimated width is kept within.

    Returns
    -------
    sigma : float
        Pixels.
    deconvolution : DeconvolutionParams

    Examples
    --------
    >>> sigma, params = blur_to_remove(None, DeconvolutionParams(sigma=1.5))
    >>> sigma, params.exponent
    (1.5, None)
    """
    if deconvolution.sigma is not None or estimate is None:
        return deconvolution.sigma or 0.0, deconvolution
    sigma = estimate.removable
    if bounds is not None and sigma > 0:
        sigma = min(max(sigma, bounds.low), bounds.high)
    return sigma, replace(deconvolution, exponent=estimate.exponent)


def _map_meanwhile(
    image: FloatArray, blur: BlurEstimate, remove: Callable[[], Deconvolution]
) -> tuple[BlurMap | None, Deconvolution]:
    """Widths of tiles, and the image without a blur of one width.

    Widths keep one core busy, the deconvolution all of them but for pauses; and seldom does the blur vary.
    """
    ended = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        tiles = pool.submit(estimate_blur_map, image, blur, ended.is_set)
        try:
            result = remove()
            return tiles.result(), result
        finally:
            # After an error or an interrupt nobody waits for all tiles.
            ended.set()


def _on_blur(blur: BlurEstimate | None, sigma: float, tiles: BlurMap | None) -> Decision:
    choice = f"{sigma:.2f} pixels removed" if sigma > 0 else "none removed"
    if blur is None:
        return Decision("blur", choice, "asked for")
    if tiles is not None and tiles.varies:
        choice = f"{tiles.removable.min():.2f} to {tiles.removable.max():.2f} pixels removed"
    found = f"{blur.sigma:.2f} ± {blur.uncertainty:.2f} pixels found in the whole image"
    where = "" if blur.reduction == 1 else f", reduced by {blur.reduction}"
    left = ", half of the uncertainty is left in" if sigma > 0 else ", no more than a sharp image has"
    return Decision("blur", choice, found + where + left)


def _on_tiles(tiles: BlurMap | None) -> tuple[Decision, ...]:
    if tiles is None:
        return ()
    choice = "a width for every pixel" if tiles.varies else "one width for the whole image"
    rows, columns = tiles.sigmas.shape
    found = f"{tiles.sigmas.min():.2f} to {tiles.sigmas.max():.2f} pixels in {rows}×{columns} tiles"
    return (Decision("blur by tiles", choice, f"{found}, {'more' if tiles.varies else 'no more'} than chance allows"),)


def _on_guards(result: Deconvolution, readings: tuple[GuardReading, ...], guards: GuardParams) -> tuple[Decision, ...]:
    if not readings:
        return ()
    first, last = readings[0], readings[-1]
    if last.passed:
        choice = "passed" if len(readings) == 1 else f"blur lowered from {first.sigma:.2f} to {last.sigma:.2f} pixels"
    else:
        choice = "failed, kept as asked" if result.sigma > 0 else "failed at every width, no blur removed"
    return (
        Decision(
            "guards",
            choice,
            f"at {first.sigma:.2f} px {first.overshoot:.1%} of the image overshoots (bound {guards.overshoot:.0%}), "
            f"noise of flat regions × {first.noise_gain:.2f} (bound {guards.noise_gain:g})",
        ),
    )

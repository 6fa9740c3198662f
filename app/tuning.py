"""Other settings of the deconvolution, seen at once on a part of the image.

Total variation takes a second on the part, and nonlocal total variation some, so a few steps of total variation are
shown first: with λ scaled by the ratio of their automatic values the two look alike.  Width, shape and λ are those of
the whole image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve_steps, whole_image_fidelity
from turbrestore_cli.deblurring import compared_widths
from turbrestore_cli.options import Machine

from .restoring import Restored

# Side of the part that is shown at once, pixels.
PART = 512
# Iterations of total variation that make a first impression: of 512² pixels it is within .0025 of the end.
_QUICK = 20
# Methods that have a first impression.
SLOW = ("nltv", "tv")

Part = tuple[slice, slice]


def part_around(shape: tuple[int, ...], x: float, y: float, side: int = PART) -> Part:
    """Return the rows and columns of the part with its centre nearest to a point.

    Parameters
    ----------
    shape : tuple of int
        (H, W) or (H, W, 3).
    x, y : float
        Centre, pixels.
    side : int
        Longest side, pixels.

    Returns
    -------
    tuple of slice

    Examples
    --------
    >>> part_around((100, 900), 880, 0)
    (slice(0, 100, None), slice(388, 900, None))
    """
    return _span(shape[0], y, side), _span(shape[1], x, side)


def tuned_params(restored: Restored) -> DeconvolutionParams:
    """Return the settings of the deconvolution with everything that was measured filled in.

    Parameters
    ----------
    restored : Restored

    Returns
    -------
    DeconvolutionParams
    """
    params, found = restored.order.params.deconvolution, restored.restoration
    blur = found.posterior or found.blur
    exponent = params.exponent or (None if blur is None else blur.exponent)
    sigma = 0.0 if found.deconvolution is None else found.deconvolution.sigma
    return dataclasses.replace(params, sigma=round(float(sigma), 3), exponent=exponent)


def automatic_fidelity(restored: Restored, params: DeconvolutionParams) -> float:
    """Return the λ that the whole image has by default.

    Parameters
    ----------
    restored : Restored
    params : DeconvolutionParams

    Returns
    -------
    float
    """
    params, noise = dataclasses.replace(params, fidelity=None), restored.restoration.noise
    return whole_image_fidelity(_fused(restored), params, params.sigma or 0.0, noise)


def impressions(
    restored: Restored, params: DeconvolutionParams, part: Part, abandoned: Callable[[], bool]
) -> Iterator[FloatArray]:
    """Deblur a part of the image: at first quickly, then by the method itself where that takes longer.

    Parameters
    ----------
    restored : Restored
    params : DeconvolutionParams
        With a width.
    part : tuple of slice
        Rows and columns, of the whole frame.
    abandoned : callable
        Asked between two steps whether the result is still wanted; if not, there are no more images.

    Yields
    ------
    ndarray, float32
        The part, deblurred.
    """
    image, guide = _fused(restored), restored.restoration.centroid.image[part]
    lasting = params.fidelity or automatic_fidelity(restored, params)
    settings = [dataclasses.replace(params, fidelity=lasting)]
    if params.method in SLOW:
        quick = dataclasses.replace(params, method="tv", iterations=_QUICK)
        ratio = automatic_fidelity(restored, quick) / automatic_fidelity(restored, params)
        settings.insert(0, dataclasses.replace(quick, fidelity=lasting * ratio))
    for each in settings:
        steps = deconvolve_steps(image[part], each.sigma, each, guide)
        while True:
            if abandoned():
                return
            try:
                next(steps)
            except StopIteration as end:
                yield end.value.image
                break


def sweep(
    restored: Restored, params: DeconvolutionParams, widths: tuple[float, ...]
) -> Iterator[tuple[str, FloatArray]]:
    """Deblur the part of the image with the most detail by each width, as ``turbrestore deconvolve --sweep`` does."""
    order = restored.order.params
    settings = dataclasses.replace(params, sigma=None)
    guide = restored.restoration.centroid.image
    return compared_widths(_fused(restored), guide, widths, settings, order.guards, Machine().runtime())


def _fused(restored: Restored) -> FloatArray:
    filtered = restored.restoration.filtered
    return restored.restoration.centroid.image if filtered is None else filtered.image


def _span(size: int, centre: float, side: int) -> slice:
    length = min(size, side)
    start = min(max(round(centre - length / 2), 0), size - length)
    return slice(start, start + length)

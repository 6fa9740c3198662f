"""A point spread function from its image: a star, a pinhole, or a sampled PSF.

The background is the median of the border, and the noise its median absolute deviation.  What lies above the background
is centred by its centroid, by cubic splines, and cut where it sinks into the
noise; what remains is clipped at 0 and divided by its sum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import check_grey
from ..core.errors import DataError
from ..core.robust import robust_scale
from .psf import Float64Array

# Width of the border whose median is the background, in shares of the side; deviations of the noise above which light
# is that of the point, and least ratio of peak and noise; all chosen.
_BORDER, _SEEN, _CLEAR = 0.1, 3.0, 20.0
# Share of the light that may lie beyond the border, share of the peak that a second point may have, both chosen, and
# radius of the largest PSF, pixels: four times the widest blur that is found.
_LOST, _SECOND, _LARGEST = 0.02, 0.2, 84
# Least side of an image: a border of one pixel leaves 3×3 pixels.
_LEAST_SIDE = 5


def psf_from_image(image: ArrayLike, name: str = "psf") -> Float64Array:
    """Return the point spread function (h, w) with odd sides that an image (H, W) or (H, W, 3) of a point shows."""
    grey = check_grey(image, name).astype(np.float64)
    if min(grey.shape) < _LEAST_SIDE:
        raise DataError(
            f"{name}: expected at least {_LEAST_SIDE}×{_LEAST_SIDE} pixels, found {grey.shape[1]}×{grey.shape[0]}"
        )
    frame = max(1, round(_BORDER * min(grey.shape)))
    rim = np.ones(grey.shape, bool)
    rim[frame:-frame, frame:-frame] = False
    background = float(np.median(grey[rim]))
    noise = robust_scale(grey[rim] - background)
    light = grey - background
    peak = float(light.max())
    if peak <= max(_CLEAR * noise, 1e-6):
        raise DataError(f"{name}: expected a point well above its background, found {peak:.3g} above noise {noise:.2g}")
    if (light >= 0.999 * peak).sum() > max(4, 1e-3 * light.size):
        raise DataError(f"{name}: expected a point that is not saturated, found a plateau; expose it for less time")
    point = _point(light, noise, peak, name)
    kernel = _cut(_centred(light, point))
    return kernel / kernel.sum()


def _point(light: Float64Array, noise: float, peak: float, name: str) -> NDArray[np.bool_]:
    """Pixels of the point: those above the noise that hang together with the peak, and its faint rim around them."""
    from scipy import ndimage

    labels, count = ndimage.label(light > max(_SEEN * noise, 1e-4 * peak), np.ones((3, 3)))
    peaks = np.array(ndimage.maximum(light, labels, range(1, count + 1)))
    brightest = int(peaks.argmax()) + 1
    if (np.delete(peaks, brightest - 1) > _SECOND * peak).any():
        raise DataError(f"{name}: expected one point, found several; cut one of them out")
    point: NDArray[np.bool_] = labels == brightest
    edge = np.ones(light.shape, bool)
    edge[1:-1, 1:-1] = False
    if light[point & edge].sum() > _LOST * light[point].sum():
        raise DataError(f"{name}: expected a point with dark sky around, found light up to the border; cut it larger")
    return ndimage.binary_dilation(point, np.ones((3, 3)), 2)


def _centred(light: Float64Array, point: NDArray[np.bool_]) -> Float64Array:
    """Move the centroid of the point to the middle pixel of an image with odd sides, and remove what is around it."""
    from scipy import ndimage

    odd = [(0, 1 - side % 2) for side in light.shape]
    light, point = np.pad(light, odd), np.pad(point, odd)
    middle = ndimage.center_of_mass(np.where(point, light, 0.0))
    shift = [side // 2 - at for side, at in zip(light.shape, middle, strict=True)]
    moved, seen = ndimage.shift(light, shift), ndimage.shift(point.astype(np.uint8), np.rint(shift), order=0)
    return np.where(seen > 0, np.maximum(moved, 0.0), 0.0)


def _cut(light: Float64Array) -> Float64Array:
    """Cut a square around the middle pixel that holds all but a thousandth of the light."""
    row, column = (side // 2 for side in light.shape)
    largest = min(row, column, _LARGEST)
    for radius in range(1, largest + 1):
        part = light[row - radius : row + radius + 1, column - radius : column + radius + 1]
        if part.sum() >= 0.999 * light.sum():
            return part
    return light[row - largest : row + largest + 1, column - largest : column + largest + 1]

"""Profiles across edges, and the widest blur that they allow.

A limb that darkens smoothly looks like an edge with a wide blur.  A smooth disc on black has hardly any other
gradients, so its marginal likelihood is largest at too large a width.  But no scene is steeper behind a blur than a
step.  Where an image rises through an edge without falling, let R be the share of its rise from −A to A that lies
between −1 and 1 pixel.  For a Gaussian blur the step has the largest R of all scenes that rise, whatever A: a rising
scene is a sum of steps, and one at a distance from the edge adds relatively more to the outer rise.  So R bounds the
width of the blur from above.  Text and texture, whose edges fall again within the blur, have no bound.  Blurs with
wings have a sharp core and are taken for narrow ones: where frames tell the blur, the bound is used only for images
that are evenly dark around a body (:func:`has_black_background`).

Symbols
-------
σ, p : width and exponent of the blur, see :func:`turbrestore.blur.psf.blur_otf`
M(A) : rise of a step behind that blur between −A and A pixels
R = M(1) / M(A), A = 1.75 σ
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.gradient import sobel_gradient
from ..core.noise import estimate_noise
from .psf import GAUSSIAN, half_frequency

# Gradients count from this multiple of the noise, chosen; most samples of all profiles; rows in which edges are looked
# for at a time.
_GRADIENT, _SAMPLES, _ROWS = 4.0, 1 << 18, 64
# Standard deviation of the Gaussian under which gradients are measured, pixels, chosen.
_SMOOTH = 0.7
# Distance up to which edges rise, and A: widths of the blur, and pixels; all chosen.
REACH_SIGMAS, _SMALLEST_REACH = 4.0, 6
_RISE_SIGMAS, _SMALLEST_RISE = 1.75, 2
# Steps count from _STEP times the noise, chosen, and from _STRONG times the percentile _MOST of all steps, chosen on
# simulated discs of 60 to 150 pixels.
_STEP, _MOST, _STRONG = 12.0, 90, 0.6
# Share of the step, and multiple of the noise, by which a rising profile may fall; both chosen: tests fail with half
# and with twice the share.
_EVEN, _EVEN_NOISE = 0.03, 2.0
# Fewest edges that rise, chosen on the same discs, their least share of all strong edges: tests fail at 0.35 and 1; and
# the share of them that bounds a width, chosen.
_FEWEST, _RISING, _STEEP = 30, 0.7, 0.25
# Least share of edges that rise out of a black background: with 0.7, planets with soft bands had no bound; and least
# share of the image that is one.  Both chosen.
_LIMB, _BACKGROUND = 0.2, 0.2
# Black and white are these percentiles.  What exceeds black by less than this multiple of the noise, or by this share
# of the range, which blurs with long tails spread around a body, is black.  All chosen.
_BLACK, _WHITE, _BLACK_NOISE, _TAILS = 1, 99, 4.0, 0.02
# Largest share of the range that the noise of black fills: at 0.27, 11 of 13 grey scenes pass for black, here none.
_NOISY_BLACK = 0.1
# Ratio of one width that is tried to the one before it, chosen.
_RATIO = 1.05
# Softness of photographs, pixels: nothing below is safe to remove; width and uncertainty of a sharp image; all chosen.
SOFT, _SHARP, PIXEL_UNCERTAINTY = 0.8, 0.35, 0.1
# Side of a tile, pixels, chosen.
TILE = 16
# Frequencies over which M is integrated, cycles per pixel: the narrowest blur leaves little beyond.
_FREQUENCIES = np.linspace(0, 4, 1001)


@dataclass(frozen=True, eq=False)
class Edges:
    """Pixels on edges, as rows and columns, and the unit normals towards the brighter side, shape (n, 2)."""

    places: NDArray[np.float32]
    normals: NDArray[np.float32]


def find_edges(image: FloatArray, noise: float) -> Edges:
    """Find the pixels of an image (H, W) at which the gradient is largest along its own direction."""
    places, normals = [np.zeros((0, 2), np.float32)], [np.zeros((0, 2), np.float32)]
    # Rows that the Gaussian, the derivative and the look ahead reach.
    around = round(4 * _SMOOTH) + 2
    for top in range(0, len(image), _ROWS):
        start = max(top - around, 0)
        strip = cv2.GaussianBlur(image[start : top + _ROWS + around], (0, 0), _SMOOTH)
        across, down = sobel_gradient(strip)
        size = np.hypot(across, down)
        y, x = np.mgrid[: strip.shape[0], : strip.shape[1]].astype(np.float32)
        unit = np.stack([down, across]) / np.maximum(size, np.finfo(np.float32).tiny)
        ahead, behind = (cv2.remap(size, x + sign * unit[1], y + sign * unit[0], cv2.INTER_LINEAR) for sign in (1, -1))
        crest = (size >= ahead) & (size > behind) & (size > _GRADIENT * noise)
        crest[: top - start] = crest[top - start + _ROWS :] = False
        rows, columns = np.nonzero(crest)
        places.append(np.stack([rows + start, columns], axis=1).astype(np.float32))
        normals.append(unit[:, rows, columns].T.astype(np.float32))
    return Edges(np.concatenate(places), np.concatenate(normals))


def edge_reach(sigma: float) -> int:
    """Distance, pixels, up to which the edges behind a blur of this width rise."""
    return max(_SMALLEST_REACH, int(np.ceil(REACH_SIGMAS * sigma)))


def find_some_edges(image: FloatArray, noise: float, reach: int) -> Edges:
    """Find edges of an image (H, W), no more than memory allows for the profiles."""
    return _fewer_edges(find_edges(image, noise), _SAMPLES // (2 * reach + 1))


def _fewer_edges(edges: Edges, most: int) -> Edges:
    """Leave out rows of tiles until about as few edges remain as wanted."""
    every = -(-len(edges.places) // most)
    # Only rows with edges are numbered, so that no row that is kept is empty.
    _, rows = np.unique(edges.places[:, 0] // TILE, return_inverse=True)
    kept = rows.ravel() % max(every, 1) == 0
    return Edges(edges.places[kept], edges.normals[kept])


def edge_profiles(image: FloatArray, edges: Edges, reach: int) -> tuple[FloatArray, FloatArray]:
    """Profiles (n, reach + 1) of an image (H, W) along the normals of n edges, on the bright and on the dark side."""
    distances, rim = np.arange(reach + 1, dtype=np.float32), reach + 1
    padded = cv2.copyMakeBorder(image, rim, rim, rim, rim, cv2.BORDER_REFLECT_101)
    values, row = padded.ravel(), padded.shape[1]
    sides = []
    for sign in (1, -1):
        at = edges.places.T[..., None] + sign * edges.normals.T[..., None] * distances + np.float32(rim)
        corner = at.astype(np.intp)
        (down, along), place = at - corner.astype(np.float32), corner[0] * row + corner[1]
        upper, lower = (values[n] + along * (values[n + 1] - values[n]) for n in (place, place + row))
        sides.append(sign * (upper + down * (lower - upper)))
    return sides[0], sides[1]


def largest_fall(profiles: NDArray[Any]) -> NDArray[Any]:
    """Return the largest fall (n,) of each profile (n, k) from any sample to a later one."""
    return (np.maximum.accumulate(profiles, axis=1) - profiles).max(axis=1)


def rising_edges(
    steps: NDArray[Any], falls: NDArray[Any], noise: float, share: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which edges (n,) have strong steps, from this share of those of most edges, and which of them rise."""
    strong = steps > max(share * float(np.percentile(steps, _MOST)), _STEP * noise)
    return strong, strong & (falls < np.maximum(_EVEN * steps, _EVEN_NOISE * noise))


def edge_limit(image: FloatArray, sigma: float, exponent: float) -> tuple[float, float] | None:
    """Width and uncertainty that the edges of an image (H, W) allow; None where they do not rule out the given width.

    The width is the largest that the edges allow to a Gaussian, since wings of a blur cannot be told from a soft limb;
    its uncertainty is the difference to the width that they allow to the shape that was assumed.
    """
    width = _widest_blur(image, GAUSSIAN, sigma)
    if width >= sigma:
        return None
    if width < SOFT:
        return _SHARP, PIXEL_UNCERTAINTY
    return width, _widest_blur(image, exponent, sigma) - width


def _widest_blur(image: FloatArray, exponent: float, widest: float) -> float:
    """Smallest width for which a quarter of the rising edges are too steep, at most ``widest``."""
    noise = estimate_noise(image)
    farthest = edge_reach(widest)
    edges = find_some_edges(image, noise, farthest)
    if len(edges.places) < _FEWEST:
        return widest
    profiles = edge_profiles(image, edges, farthest)
    darkest = _background(image, noise)
    for sigma in np.exp(np.arange(np.log(_SHARP), np.log(widest), np.log(_RATIO))):
        reach = edge_reach(sigma)
        rise = max(_SMALLEST_RISE, int(np.ceil(_RISE_SIGMAS * sigma)))
        bright, dark = (side[:, : reach + 1] for side in profiles)
        steps = bright[:, : rise + 1].max(axis=1) + dark[:, : rise + 1].max(axis=1)
        falls = np.maximum(largest_fall(bright), largest_fall(dark))
        strong, rising = rising_edges(steps, falls, noise, _STRONG)
        if rising.sum() < _RISING * strong.sum():
            rising &= -dark[:, -1] < darkest
        if rising.sum() < max(_FEWEST, _LIMB * strong.sum()):
            continue
        shares = (bright[rising, 1] + dark[rising, 1]) / (bright[rising, rise] + dark[rising, rise])
        step = _step_rise(1, sigma, exponent) / _step_rise(rise, sigma, exponent)
        if np.mean(shares > step) >= _STEEP:
            return float(sigma)
    return widest


def has_black_background(image: FloatArray) -> bool:
    """Whether at least a fifth of an image (H, W) is evenly dark, as around a planet."""
    noise, (black, white) = estimate_noise(image), np.percentile(image, (_BLACK, _WHITE))
    return bool(_BLACK_NOISE * noise <= _NOISY_BLACK * (white - black) and np.isfinite(_background(image, noise)))


def _background(image: FloatArray, noise: float) -> float:
    """Level below which pixels are black, or that of no pixel if there is no black background."""
    black, white = np.percentile(image, (_BLACK, _WHITE))
    level = float(black + max(_BLACK_NOISE * noise, _TAILS * (white - black)))
    return level if np.mean(image < level) >= _BACKGROUND else -np.inf


def _step_rise(distance: int, sigma: float, exponent: float) -> float:
    """M of a step that is seen through pixels, at places that are exact to a pixel."""
    otf = np.exp(-np.log(2) * (_FREQUENCIES / half_frequency(sigma)) ** exponent) * np.sinc(_FREQUENCIES)
    return 4 * distance * float(np.trapezoid(otf * np.sinc(2 * distance * _FREQUENCIES), _FREQUENCIES))

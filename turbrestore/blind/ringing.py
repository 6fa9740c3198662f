"""Ringing along edges: how far a deconvolved image overshoots the plateaus on either side of the edges.

Symbols
-------
f : blurred image; u : deconvolved image; σ : width of the blur that was removed, pixels
p(t), q(t) : u and f at the distance t from an edge, along its normal away from it, so that q rises; on the dark side of
    an edge both are negated
s : step of the edge, the difference of f between its two sides

A ring is a fall of p where q does not fall: behind an edge the image has passed its plateau and returns to it.  A fall
is found whatever the slope of the plateau, so also at the limb of a planet, whose disc grows brighter inwards.  Only
sides along which q rises up to 4σ count: on others, between thin lines, a right result falls as well.  Nor do sides
count whose plateau is so near to black or white that a ring would be clipped, such as the sky around a planet.

Detail that f has lost makes p fall too, but at a different distance behind every edge, whereas rings are alike.
Therefore p and q are averaged over the edges of a tile before the falls are compared.  The weaker edges of a tile are
left out, because rings of its strongest edge would be diluted by theirs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..blur.edges import edge_profiles, fewer_edges, find_edges, largest_fall
from ..core.arrays import FloatArray
from ..core.noise import estimate_noise

# Distance up to which edges are followed: widths of the blur, and pixels.
_REACH_SIGMAS, _SMALLEST_REACH = 4.0, 6
# Distance within which the step of an edge ends, in widths of the blur and in pixels.
_STEP_SIGMAS, _SMALLEST_STEP = 2.5, 3
# Steps count from this multiple of the noise, and from this share of the steps of most edges.
_STEP, _STRONG, _MOST = 12.0, 0.3, 90
# Share of the step, and multiple of the noise, by which q may fall.
_EVEN, _EVEN_NOISE = 0.03, 2.0
# Side of a tile, pixels; fewest sides of edges in it; share of its largest step from which an edge counts.
_TILE, _FEWEST, _ALIKE = 16, 5, 0.6
# Share of the step from which an overshoot is a ring.
_RING = 0.12
# Most samples of all profiles.
_SAMPLES = 1 << 18


def ringing(after: FloatArray, before: FloatArray, sigma: float) -> float:
    """Return the share of strong edges along which a deconvolved image rings.

    ``after`` (H, W); ``before`` (H, W).
    """
    reach = max(_SMALLEST_REACH, int(np.ceil(_REACH_SIGMAS * sigma)))
    noise = estimate_noise(before)
    edges = fewer_edges(find_edges(before, noise), _SAMPLES // (2 * reach + 1))
    if not len(edges.places):
        return 0.0
    of_before, of_after = (edge_profiles(image, edges, reach) for image in (before, after))
    within = max(_SMALLEST_STEP, int(np.ceil(_STEP_SIGMAS * sigma)))
    steps = sum(side[:, : within + 1].max(axis=1) for side in of_before)
    strong = steps > max(_STRONG * float(np.percentile(steps, _MOST)), _STEP * noise)
    falls: list[NDArray[Any]] = []
    counts: list[NDArray[Any]] = []
    for q, p, limit in zip(of_before, of_after, (1, 0), strict=True):
        rises = largest_fall(q) < np.maximum(_EVEN * steps, _EVEN_NOISE * noise)
        chosen = strong & rises & (limit - q.max(axis=1) > _RING * steps)
        fall, count = _falls_by_tile(q[chosen], p[chosen], steps[chosen], edges.places[chosen])
        falls.append(fall)
        counts.append(count)
    number = np.concatenate(counts)
    return float(number[np.concatenate(falls) > _RING].sum() / max(number.sum(), 1))


def _falls_by_tile(
    q: FloatArray, p: FloatArray, steps: FloatArray, places: FloatArray
) -> tuple[NDArray[Any], NDArray[np.int_]]:
    """Fall of the mean p less that of the mean q, relative to the step, and number of edges, of every tile."""
    _, tiles = np.unique(places // _TILE, axis=0, return_inverse=True)
    largest = np.zeros(len(places), np.float32)
    np.maximum.at(largest, tiles.ravel(), steps)
    alike = steps >= _ALIKE * largest[tiles.ravel()]
    _, tiles, counts = np.unique(tiles.ravel()[alike], return_inverse=True, return_counts=True)
    means = []
    for profiles in (p, q):
        total = np.zeros((len(counts), profiles.shape[1]))
        np.add.at(total, tiles, profiles[alike] / steps[alike, None])
        means.append(total / counts[:, None])
    enough = counts >= _FEWEST
    return (largest_fall(means[0]) - largest_fall(means[1]))[enough], counts[enough]

"""Guards: bounds on ringing, overshoot and amplified noise that a deconvolved image must keep.

Symbols
-------
f : blurred image; u : deconvolved image; σ : width of the blur that was removed, pixels
W(x) : window of 4σ around pixel x, at least 8 pixels; ``range(x) = max f − min f`` over W(x)

Ringing is the share of strong edges beside which u passes a plateau of f and returns to it.

Overshoot is the share of pixels with ``u > max f + 0.3 range`` or ``u < min f − 0.3 range`` among those whose range is
at least a tenth of the contrast of f, the area that has edges.  The right width restores the contrast of fine detail,
so u leaves the range of the pixels right next to it: a correctly restored chart does so at every third pixel.  But it
hardly leaves the range of a window wider than the blur.  Too large a width does, in texture too, which has no plateaus.

Noise gain is the ratio, after to before, of the standard deviation of fine detail in the flattest fifth of f.  Pixels
near black or white do not count, because clipping takes the noise away; all of them count if few are left.

``benchmarks/results/guards.md`` lists all three for right and for wrong widths.

Ringing
-------
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

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.edges import REACH_SIGMAS, TILE, edge_profiles, edge_reach, find_some_edges, largest_fall, rising_edges
from ..core.arrays import ROUNDING, FloatArray, check_image, luminance
from ..core.errors import DataError, require_between
from ..core.noise import estimate_noise
from ..runtime.scratch import iter_parts

# Least reach of W(x) on each side, pixels, chosen.
_SMALLEST_WINDOW = 8
# Share of the local range by which an overshoot exceeds it, chosen on the clips of benchmarks/guards.py.
_BEYOND = 0.3
# A range below this share of the contrast of the whole image is taken for noise; chosen.
_LEAST_RANGE = 0.1
# Share of f that is taken for flat, chosen.
_FLAT_SHARE = 0.2
# Distance from black and white, in ranges of f, at which noise is not clipped; least share of such pixels; both chosen.
_CLIPPED, _LEAST_SHARE = 0.05, 0.01
# Standard deviation of the Gaussian that separates fine detail, pixels, chosen.
_DETAIL_WINDOW = 4.0
# Least deviation that a gain is relative to, about that of rounding to 12 bits.
_LEAST_DEVIATION = 1e-4
# Factor on the width of the blur after a failed attempt; its square root after the first if no bound is exceeded by
# more than a slight factor.  Both chosen.
BACK_OFF, _SLIGHT = 0.85, 1.5
# Widest blur whose ringing is judged, pixels: behind a wider one, profiles of four widths cross the next letter, and
# 24 % of the edges of text that is read in full ring.
WIDEST_RINGS = 3.0
# Distance within which the step of an edge ends, in widths of the blur and in pixels; both chosen.
_STEP_SIGMAS, _SMALLEST_STEP = 2.5, 3
# Share of the steps of most edges from which one counts, chosen.
_STRONG = 0.3
# Fewest sides of edges in a tile; share of its largest step from which an edge counts; both chosen.
_FEWEST, _ALIKE = 5, 0.6
# Share of the step from which an overshoot is a ring: in a test bricks ring at half of it, and at twice no limb does.
_RING = 0.12


@dataclass(frozen=True)
class GuardParams:
    """Bounds that a deconvolved image must keep.

    Parameters
    ----------
    ringing : float
        Largest share of strong edges along which the image rings.
    overshoot : float
        Largest share of pixels beyond the local range of the blurred image by 30 % of that range.
    noise_gain : float
        Largest ratio, after to before, of the standard deviation in the flattest fifth of the image.
    """

    ringing: float = 0.15
    overshoot: float = 0.12
    noise_gain: float = 6.0

    def __post_init__(self) -> None:
        require_between("ringing", self.ringing, 0, 1)
        require_between("overshoot", self.overshoot, 0, 1)
        require_between("noise_gain", self.noise_gain, 1, 1000)

    def within_reach(self, reading: GuardReading) -> bool:
        """Return whether no bound is exceeded by more than a slight factor, if one is."""
        return (
            max(
                reading.ringing / max(self.ringing, ROUNDING),
                reading.overshoot / max(self.overshoot, ROUNDING),
                reading.noise_gain / self.noise_gain,
            )
            <= _SLIGHT
        )

    def first_back_off(self, reading: GuardReading) -> float:
        """Return the factor on the width after the first attempt, if that failed."""
        return BACK_OFF**0.5 if self.within_reach(reading) else BACK_OFF


@dataclass(frozen=True)
class GuardReading:
    """What the guards measured on one deconvolved image."""

    sigma: float  # width that was removed, pixels
    ringing: float  # share of strong edges along which the image rings
    overshoot: float  # share of pixels beyond the local range, of those near edges
    noise_gain: float  # ratio of the standard deviations in flat regions, after to before
    passed: bool  # whether all are within their bounds


def evaluate_guards(
    result: ArrayLike, blurred: ArrayLike, sigma: float, params: GuardParams | None = None
) -> GuardReading:
    """Compare a deconvolved image (H, W[, 3]) with the blurred one."""
    params = params or GuardParams()
    after, before = check_image(result, "result"), check_image(blurred, "blurred")
    if after.shape != before.shape:
        raise DataError(f"result: expected the shape {before.shape} of the blurred image, found {after.shape}")
    # One pair of planes at a time, because those of a large image take a good part of the memory.
    pairs = zip(_planes(after), _planes(before), strict=True)
    profiles_stay = sigma <= WIDEST_RINGS
    figures = [
        (ringing(*pair, sigma) if profiles_stay else 0.0, _overshoot(*pair, sigma), _noise_gain(*pair))
        for pair in pairs
    ]
    rings, overshoot, gain = (max(values) for values in zip(*figures, strict=True))
    passed = rings <= params.ringing and overshoot <= params.overshoot and gain <= params.noise_gain
    return GuardReading(float(sigma), rings, overshoot, gain, passed)


def _planes(image: FloatArray) -> Iterator[FloatArray]:
    """Luminance and, for a colour image, a copy of each channel."""
    yield luminance(image)
    for channel in range(3 if image.ndim == 3 else 0):
        plane, done = np.empty(image.shape[:2], np.float32), 0
        for part in iter_parts(image):
            plane[done : done + len(part)] = part[..., channel]
            done += len(part)
        yield plane


def _overshoot(after: FloatArray, before: FloatArray, sigma: float) -> float:
    radius = max(_SMALLEST_WINDOW, round(REACH_SIGMAS * sigma))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    high, low = cv2.dilate(before, window), cv2.erode(before, window)
    contrast = float(np.subtract(*np.percentile(before, (99, 1))))
    margin = high - low
    edges = margin > _LEAST_RANGE * contrast
    margin *= _BEYOND
    np.subtract(after, high, out=high)
    np.subtract(low, after, out=low)
    beyond = np.maximum(high, low, out=high) > margin
    return float((beyond & edges).sum() / max(edges.sum(), 1))


def _noise_gain(after: FloatArray, before: FloatArray) -> float:
    energy = np.square(cv2.Sobel(before, cv2.CV_32F, 1, 0))
    energy += np.square(cv2.Sobel(before, cv2.CV_32F, 0, 1))
    energy = cv2.GaussianBlur(energy, (0, 0), _DETAIL_WINDOW)
    low, high = float(before.min()), float(before.max())
    room = _CLIPPED * (high - low)
    seen = (before > room) & (before < 1 - room)
    seen |= seen.mean() < _LEAST_SHARE
    flat = seen & (energy <= np.quantile(energy[seen], _FLAT_SHARE))
    del energy, seen
    deviations = [
        float(np.std((image - cv2.GaussianBlur(image, (0, 0), _DETAIL_WINDOW))[flat])) for image in (after, before)
    ]
    return deviations[0] / max(deviations[1], _LEAST_DEVIATION)


def ringing(after: FloatArray, before: FloatArray, sigma: float) -> float:
    """Return the share of strong edges along which a deconvolved image (H, W) rings."""
    reach = edge_reach(sigma)
    noise = estimate_noise(before)
    edges = find_some_edges(before, noise, reach)
    if not len(edges.places):
        return 0.0
    of_before, of_after = (edge_profiles(image, edges, reach) for image in (before, after))
    within = max(_SMALLEST_STEP, int(np.ceil(_STEP_SIGMAS * sigma)))
    steps = sum(side[:, : within + 1].max(axis=1) for side in of_before)
    falls: list[NDArray[Any]] = []
    counts: list[NDArray[Any]] = []
    for q, p, limit in zip(of_before, of_after, (1, 0), strict=True):
        _, rising = rising_edges(steps, largest_fall(q), noise, _STRONG)
        chosen = rising & (limit - q.max(axis=1) > _RING * steps)
        fall, count = _falls_by_tile(q[chosen], p[chosen], steps[chosen], edges.places[chosen])
        falls.append(fall)
        counts.append(count)
    number = np.concatenate(counts)
    return float(number[np.concatenate(falls) > _RING].sum() / max(number.sum(), 1))


def _falls_by_tile(
    q: FloatArray, p: FloatArray, steps: FloatArray, places: FloatArray
) -> tuple[NDArray[Any], NDArray[np.int_]]:
    """Fall of the mean p less that of the mean q, relative to the step, and number of edges, of every tile."""
    _, tiles = np.unique(places // TILE, axis=0, return_inverse=True)
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

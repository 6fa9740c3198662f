"""Blind estimation of the width of a blur.

The width is the one at which the image is likeliest, see :mod:`turbrestore.blur.marginal_likelihood`.  (Paper 3 chooses
the width by hand.)  What is decided here is at which scale of the image that likelihood is computed.

Symbols
-------
r : factor by which the image is reduced
n : standard deviation of the noise and the model error of the reduced image, intensity
L : cost of a width, the negative logarithm of the marginal likelihood per gradient

Reduction.  A wide blur is estimated from a reduced image, in which it is about one pixel wide and in which compression
noise, which is not part of the blurred scene, averages out.  Reducing by r averages r×r pixels; the variance of that
box, (r² − 1) / 12, is subtracted from the squared width.  Among the reductions that resolve a blur and leave 60 pixels
a side, the one whose width depends least on the assumed noise decides.  The image itself is preferred if the difference
is small, because a soft scene such as the Moon looks blurred at every reduction; but it is not preferred if its
evidence is weak, because the block edges of a codec look like scene edges with almost no blur.

Noise.  The estimated width depends on the noise that is assumed, n; ``uncertainty`` measures by how much.  s_1 and s_2
are the noise measured between neighbouring pixels, and between means of 2×2 pixels times 2; equal if it is white.
n is larger than the noise of the image: no real blur follows the assumed shape exactly, and high contrast makes the
mismatch larger.  So n² is the sum of the squares of a multiple of s_1 and of a share of the contrast.

Registration interpolates, which smooths the noise of a fused image: s_1 misses a part of it, and the width would come
out too small.  So the multiple grows with s_2 / s_1.  In a clip with little noise this ratio is that of fine detail, so
the multiple grows only where s_1 is a clear share of the contrast.

A fused image is never sharper than its pixels and the interpolation of the registration allow: the smallest width is
0.35 px, which is also the result if a wider blur is hardly more likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_grey
from ..core.errors import require
from ..core.noise import estimate_noise
from ..display.curves import plot_blur
from ..display.preview import preview
from ..runtime.fourier import fast_length
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.threads import ThreadTeam, one_thread_each
from .edges import PIXEL_UNCERTAINTY, SOFT, edge_limit
from .marginal_likelihood import WIDTHS, image_gradients, likeliest_width, width_costs
from .psf import GAUSSIAN, Float64Array, check_exponent, fused_exponent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Factors by which the image is reduced; smallest side of a reduced image and of one that is analysed at all.  Chosen.
_REDUCTIONS = (1, 2, 3, 4, 6, 8)
_SMALLEST_SIDE, _SMALLEST_IMAGE = 60, 16
# Smallest n, about what rounding to 12 bits leaves.  Share of the contrast, and multiples of s_1, both chosen: assuming
# more noise everywhere costs clean clips up to 0.8 dB.
LEAST_NOISE = 1e-4
_MISFIT, _MULTIPLES = 0.025, (1.5, 2.0)
# Ratios of s_2 to s_1, and shares of the contrast, between which the multiple grows; all chosen.
_SMOOTH, _NOISY = (1.5, 2.0), (0.03, 0.05)
# Smallest width that a reduced image resolves, in its own pixels, chosen.
_RESOLVED = 0.6
# Evidence, in units of L, that a blur needs; and the evidence it needs if the image itself is to be preferred over its
# reductions, both chosen, or if it is no wider than ordinary photographs are soft (SOFT pixels).  Fused images without
# blur reach 0.22 there, blurred ones begin at 0.35.
_EVIDENCE, _STRONG_EVIDENCE, _SOFT_EVIDENCE = 0.08, 0.2, 0.23
# Side of the part that is analysed, chosen; rows of positions at which detail is measured at a time, and how far its
# filters reach, 4 and 1 pixels.
PART, _STRIP_ROWS, _REACH = 128, 256, 5
# 125 is a power of five: transforms of this size take almost twice as long as those of 120×120 or of 128×128 pixels.
_SLOW_SIZE = 125
# Factor on the relative uncertainty of the image itself if its evidence is strong; exponent of the preference for
# stronger reduction; both chosen.
_PREFERENCE, _LARGER_REDUCTION = 0.8, 0.15
# Share of the uncertainty that is subtracted from widths up to the first of these; none from the second on, pixels.
# Chosen; benchmarks/decisions/blur.md has fixed shares of the width.
_CAUTION, _NARROW, _WIDE = 0.5, 2.0, 3.0


@dataclass(frozen=True, eq=False)
class BlurEstimate:
    """Estimated blur of an image and the costs it was found from.

    Attributes
    ----------
    sigma : float
        Width of the blur, pixels: standard deviation of the Gaussian whose transfer function passes one half at the
        same frequency; 0 if the image does not determine it.
    uncertainty : float
        Half of the difference between the widths found with half and with twice the noise, pixels; 0.1 for a sharp
        image, infinite if the image does not determine the width.
    exponent : float
        Shape of the blur, see :func:`turbrestore.blur.psf.blur_otf`.
    noise : float
        n of the reduced image, intensity.
    reduction : int
        r.
    evidence : float
        L of a sharp image minus the smallest L.
    widths : ndarray, float64, shape (k,)
        Widths whose cost was computed in the reduced image, in pixels of the image.
    costs : ndarray, float64, shape (k,)
        L of each.
    edge_limited : bool
        Whether the edges of the image rule out the likeliest width; see :func:`turbrestore.blur.edges.edge_limit`.
    """

    sigma: float
    uncertainty: float
    exponent: float
    noise: float
    reduction: int
    evidence: float
    widths: Float64Array
    costs: Float64Array
    edge_limited: bool = False

    def plot(self) -> Figure:
        """Draw the cost of every width.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_blur(self.widths, self.costs, self.sigma, self.uncertainty)

    def _repr_html_(self) -> str:
        known = np.isfinite(self.uncertainty)
        facts = [
            ("width", f"{self.sigma:.2f} ± {self.uncertainty:.2f} pixels" if known else "not determined by the image"),
            ("to remove", f"{self.removable:.2f} pixels"),
            ("evidence", f"{self.evidence:.2f}"),
        ]
        return preview("Blur", facts)

    @property
    def blurred(self) -> bool:
        """Whether the image is blurred by more than its pixels."""
        return self.sigma > WIDTHS[0]

    @property
    def removable(self) -> float:
        """Width that is safe to remove, pixels; see :func:`removable_width`."""
        return float(removable_width(self.sigma, self.uncertainty))


@dataclass(frozen=True, eq=False)
class BlurCandidate:
    """Blur found at one reduction of an image."""

    estimate: BlurEstimate  # its uncertainty is infinite until :func:`choose_blur` has computed it
    part: FloatArray  # (h, w): the part of the reduced image that was analysed
    asked: float | None = None  # exponent that was asked for; None for that of fused frames

    @property
    def plausible(self) -> bool:
        """Whether the reduced image resolves the width, and the evidence for a blur is clear."""
        found = self.estimate
        lowest = likeliest_width(found.costs)
        resolved = lowest < WIDTHS[-1] and (found.reduction == 1 or lowest >= _RESOLVED)
        return resolved and found.evidence >= (_EVIDENCE if found.sigma >= SOFT else _SOFT_EVIDENCE)


def estimate_blur(
    image: ArrayLike, noise: float | None = None, exponent: float | None = None, runtime: Runtime = DEFAULT
) -> BlurEstimate:
    """Estimate the width of the blur of an image.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float, optional
        Standard deviation of the noise, intensity; estimated by default.
    exponent : float, optional
        Shape of the blur, 1 to 2, 2 for a Gaussian; by default that of fused frames, which follows from the width:
        :func:`turbrestore.blur.psf.fused_exponent`.
    runtime : Runtime
        Number of threads, of which at most two are used; it does not change the result.

    Returns
    -------
    BlurEstimate

    Raises
    ------
    DataError
        The shape is wrong, or values are not finite.
    ConfigurationError
        ``noise`` is negative or not finite, or ``exponent`` is outside 1 to 2.

    Examples
    --------
    >>> import cv2
    >>> from turbrestore.synthesis.scenes import SCENES
    >>> blurred = cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), 2.0)
    >>> bool(1.7 < estimate_blur(blurred, exponent=2.0).sigma < 2.3)
    True
    """
    with one_thread_each():
        candidates = find_candidates(image, noise, exponent)
        if not candidates:
            nothing, shape = np.zeros(0), exponent or fused_exponent(0.0)
            return BlurEstimate(0.0, float("inf"), shape, noise or 0.0, 1, 0.0, nothing, nothing)
        found = choose_blur(candidates, runtime)
        return limit_to_edges(found, check_grey(image)) if found.blurred else found


def limit_to_edges(estimate: BlurEstimate, image: FloatArray) -> BlurEstimate:
    """Correct an estimated width that the edges of the image (H, W) rule out."""
    limit = edge_limit(image, estimate.sigma, estimate.exponent)
    if limit is None:
        return estimate
    return replace(estimate, sigma=limit[0], uncertainty=limit[1], exponent=GAUSSIAN, edge_limited=True)


def removable_width(sigma: ArrayLike, uncertainty: ArrayLike) -> Float64Array:
    """Width that is safe to remove: half of the uncertainty is left in up to 2 pixels, nothing from 3 pixels on.

    Removing too wide a blur rings. Narrow ones are found too wide rather than too narrow, because scenes are soft
    themselves; wide ones are found too narrow as it is, by 12 % at 6 pixels.
    """
    width, known = np.asarray(sigma, np.float64), np.isfinite(uncertainty)
    left_in = np.interp(width, [_NARROW, _WIDE], [_CAUTION, 0.0]) * np.where(known, uncertainty, 0.0)
    return np.where(known, np.maximum(width - left_in, 0.0), 0.0)


def find_candidates(
    image: ArrayLike, noise: float | None = None, exponent: float | None = None
) -> tuple[BlurCandidate, ...]:
    """Find the likeliest blur at each reduction of an image, without its uncertainty."""
    grey = check_grey(image)
    usable = noise is None or (np.isfinite(noise) and noise >= 0)
    require(usable, f"noise: expected a finite number of 0 or more, found {noise}")
    if exponent is not None:
        check_exponent(exponent)
    if min(grey.shape) < _SMALLEST_IMAGE or np.ptp(grey) <= LEAST_NOISE:
        return ()
    factors = [factor for factor in _REDUCTIONS if factor == 1 or min(grey.shape) >= factor * _SMALLEST_SIDE]
    multiple = 1.0 if noise is not None else noise_multiple(grey)
    return tuple(_find_candidate(grey, factor, exponent, noise, multiple) for factor in factors)


def choose_blur(candidates: tuple[BlurCandidate, ...], runtime: Runtime = DEFAULT) -> BlurEstimate:
    """Choose the plausible candidate whose width depends least on the assumed noise."""
    # Only the costs at half and at twice the noise are computed in parallel: one candidate takes most of the time.
    with ThreadTeam(min(runtime.workers, 2)) as team:
        plausible = [_with_uncertainty(one, team) for one in candidates if one.plausible]
    if plausible:
        return min(plausible, key=_preference)
    sharp, asked = float(WIDTHS[0]), candidates[0].asked
    shape = fused_exponent(sharp) if asked is None else asked
    return replace(candidates[0].estimate, sigma=sharp, uncertainty=PIXEL_UNCERTAINTY, exponent=shape)


def _preference(estimate: BlurEstimate) -> float:
    """Relative uncertainty of the width, weighted in favour of the image itself if its evidence is strong.

    Otherwise stronger reduction is slightly preferred: if reductions contradict each other, codec blocks or sensor
    noise make the less reduced ones look sharp.
    """
    whole = estimate.reduction == 1 and estimate.evidence >= _STRONG_EVIDENCE
    weight = _PREFERENCE if whole else (estimate.reduction / 2) ** -_LARGER_REDUCTION
    return weight * estimate.uncertainty / estimate.sigma


def _find_candidate(
    grey: FloatArray, factor: int, exponent: float | None, noise: float | None, multiple: float
) -> BlurCandidate:
    reduced = _reduce(grey, factor)
    # A copy, so that the reduced image is freed.
    part = most_detailed(reduced, PART).copy()
    level = assumed_noise(reduced, multiple=multiple) if noise is None else assumed_noise(reduced, noise / factor)
    costs = width_costs(image_gradients(part), _exponents(exponent, factor), level, rises=2)
    evidence, width = float(costs[0] - costs.min()), unreduced_width(likeliest_width(costs), factor)
    widths = factor * WIDTHS[: len(costs)]
    shape = fused_exponent(width) if exponent is None else exponent
    estimate = BlurEstimate(width, float("inf"), shape, level, factor, evidence, widths, costs)
    return BlurCandidate(estimate, part, exponent)


def _with_uncertainty(candidate: BlurCandidate, team: ThreadTeam) -> BlurEstimate:
    found, gradients = candidate.estimate, image_gradients(candidate.part)
    levels = found.noise / 2, 2 * found.noise
    shapes = _exponents(candidate.asked, found.reduction)
    both = team.map(partial(width_costs, gradients, shapes, rises=1), levels)
    less, more = (unreduced_width(likeliest_width(costs), found.reduction) for costs in both)
    return replace(found, uncertainty=abs(more - less) / 2)


def _exponents(exponent: float | None, factor: int) -> Sequence[float]:
    """Exponents of the widths of an image that is reduced by a factor."""
    return [fused_exponent(factor * width) if exponent is None else exponent for width in WIDTHS]


def unreduced_width(width: float, factor: int) -> float:
    """Width in the image of a blur found in the reduced image, without the box of the averaged pixels."""
    return float(np.sqrt(max((factor * width) ** 2 - (factor**2 - 1) / 12, WIDTHS[0] ** 2)))


def _reduce(grey: FloatArray, factor: int) -> FloatArray:
    if factor == 1:
        return np.ascontiguousarray(grey)
    height, width = (size // factor for size in grey.shape)
    return cv2.resize(grey[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


def most_detailed(image: FloatArray, side: int) -> FloatArray:
    """Part of about this side with the largest energy of the Laplacian, of a size whose gradients transform fast."""
    height, width = (_fast_size(min(side, size - 1)) + 1 for size in image.shape)
    best, top, left = -np.inf, 0, 0
    for start in range(0, image.shape[0] - height + 1, _STRIP_ROWS):
        sums = cv2.integral(_detail(image, start, start + _STRIP_ROWS - 1 + height))
        inside = sums[height:, width:] - sums[:-height, width:]
        inside -= sums[height:, :-width]
        inside += sums[:-height, :-width]
        row, column = divmod(int(inside.argmax()), inside.shape[1])
        if inside[row, column] > best:
            best, top, left = inside[row, column], start + row, column
    return image[top : top + height, left : left + width]


def _detail(image: FloatArray, start: int, stop: int) -> FloatArray:
    """Energy of the Laplacian in rows from ``start`` to ``stop``."""
    above = min(start, _REACH)
    rows = image[start - above : stop + _REACH]
    energy = cv2.Laplacian(cv2.GaussianBlur(rows, (0, 0), 1.0), cv2.CV_32F)[above : above + stop - start]
    return np.square(energy, out=energy)


def _fast_size(size: int) -> int:
    """Largest size up to ``size`` whose transform is fast."""
    fast = (n for n in range(size // 2, size + 1) if fast_length(n) == n)
    return max(n for n in fast if n != _SLOW_SIZE)


def noise_multiple(image: FloatArray) -> float:
    """Multiple of the noise that is measured in an image (H, W) and in its reductions."""
    fine = max(estimate_noise(image), LEAST_NOISE)
    halved = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    smooth = np.interp(2 * estimate_noise(halved) / fine, _SMOOTH, (0, 1))
    noisy = np.interp(fine / max(float(image.std()), LEAST_NOISE), _NOISY, (0, 1))
    return float(np.interp(min(smooth, noisy), (0, 1), _MULTIPLES))


def assumed_noise(image: FloatArray, noise: float | None = None, multiple: float = _MULTIPLES[0]) -> float:
    """Return n of an image (H, W)."""
    level = estimate_noise(image) if noise is None else noise
    return max(float(np.hypot(multiple * level, _MISFIT * image.std())), LEAST_NOISE)

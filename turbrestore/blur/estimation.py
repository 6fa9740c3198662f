"""Blind estimation of the width of a blur by the marginal likelihood of a sparse scene.

The gradients of a sharp scene are sparse: few are large, most vanish.  A blur that is too narrow or too wide asks for
gradients that are less sparse, so the likelihood of the image, with the scene integrated out, peaks at the blur it was
taken with.  (Maximising over scene and blur together would not do: that prefers no blur at all.)  Paper 3 picks the
width by hand.

Symbols
-------
y : gradients of the image, one plane along x and one along y, tapered at the border; m values in all
x : gradients of the scene, ``y = k ∗ x + noise``; γ : prior variance of each, ``x_i ~ N(0, γ_i)``
k : point spread function of :func:`turbrestore.blur.psf.blur_otf`; ‖k‖² its energy, σ its width
n : standard deviation of the noise of the image; λ = 2 n², that of y
C : posterior variance of each x

The cost is the variational bound of the negative logarithm of the marginal likelihood (Wipf and Zhang, Revisiting
Bayesian blind deconvolution, JMLR 2014):

    L(σ) = (1/m) min over x and γ of  ‖y − k ∗ x‖² / λ + Σ_i x_i² / γ_i + log(λ + γ_i ‖k‖²)

x is found by conjugate gradients for γ given, and ``γ_i = x_i² + C_i`` with ``C_i = 1 / (‖k‖² / λ + 1 / γ_i)``.

A wide blur is looked for in a reduced image, where it is about a pixel wide again and where the noise of compression,
which is no blurred scene, averages out.  Reducing by r averages r×r pixels, whose variance (r² − 1) / 12 is taken out
again.  Of all reductions that resolve a blur, the one decides whose width depends least on the noise assumed; the image
itself is preferred where the difference is small, for a soft scene such as the Moon looks blurred at every reduction.
It is not where its evidence is weak: blocks of a codec look like edges hardly blurred at all.

n is more than the noise of the image: no real blur follows the family of k exactly, and a scene of high contrast
shows that more.  So n² is the noise and a share of the contrast, squared and added.  The width found depends on n,
which is what ``uncertainty`` measures.

A fused image is never sharper than its pixels and the interpolation in registration: the smallest width found is
0.35 px, and that is also the answer where a wider blur is hardly more likely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..core.arrays import FloatArray, check_image, luminance
from ..core.errors import require
from ..core.noise import estimate_noise
from ..display.plots import plot_blur
from ..display.preview import preview
from ..runtime.jit import compiled
from ..runtime.threads import ThreadTeam, one_thread_each
from .psf import KOLMOGOROV, check_exponent, half_frequency

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Float64Array = NDArray[np.float64]

# Factors by which the image is reduced, and the smallest side that is left.
_REDUCTIONS = (1, 2, 3, 4, 6, 8)
_SMALLEST_SIDE, _SMALLEST_IMAGE = 48, 16
# Widths that are tried, pixels of the reduced image; the first is that of a sharp image.
_WIDTHS = np.array([0.35, 0.45, 0.55, 0.65, 0.8, 0.95, 1.1, 1.3, 1.55, 1.85, 2.2, 2.6])
# A blur of this many pixels of the reduced image is resolved in it.
_RESOLVED = 0.6
# By how much a blurred scene must be likelier than a sharp one, in units of L; and by how much where the blur found is
# no wider than photographs are soft, pixels, or where the image itself is to be preferred.
_EVIDENCE, _STRONG_EVIDENCE = 0.08, 0.2
_SOFT = 0.8
# Of the smallest width, pixels.
_PIXEL_UNCERTAINTY = 0.1
# Side of the part that is looked at, the one with most detail, and of its taper; pixels.
_PART, _TAPER = 128, 8
# Rows of the image that detail is looked for in at a time, no fewer than that part has, and how far it reaches beyond.
_STRIP_ROWS, _REACH = 256, 5
# A power of five: transforms take almost twice as long as those of 120×120 or of 128×128 pixels.
_SLOW_SIZE = 125
# n is this many times the noise, and this share of the contrast.
_NOISE_FACTOR, _MISFIT = 1.5, 0.025
_LEAST_NOISE = 1e-4
# A reduced image has to be surer than the image itself by this factor, if that has strong evidence.
_PREFERENCE = 0.8
# Exponent of the preference for stronger reduction.
_LARGER_REDUCTION = 0.15
# Share of the uncertainty that is not removed.
_CAUTION = 0.5
# Updates of γ, and conjugate gradient steps in each; none where the residual, squared, is this share of the right-hand
# side: for narrow blurs x hardly changes any more in the last updates.
_UPDATES, _STEPS, _TOLERANCE = 8, 8, 1e-8


@dataclass(frozen=True, eq=False)
class BlurEstimate:
    """Estimated blur of an image, with what it was read from.

    Attributes
    ----------
    sigma : float
        Width of the blur, pixels: standard deviation of the Gaussian whose transfer function passes one half at the
        same frequency; 0 where the image says nothing.
    uncertainty : float
        Half of the difference between the widths found with half and with twice the noise, pixels; 0.1 for a sharp
        image, infinite where the image says nothing.
    exponent : float
        Shape of the blur, see :func:`turbrestore.blur.psf.blur_otf`.
    noise : float
        n of the reduced image, intensity.
    reduction : int
        r.
    evidence : float
        How much higher L is for a sharp image.
    widths : ndarray, float64, shape (k,)
        Widths that were tried on the reduced image, in pixels of the image.
    costs : ndarray, float64, shape (k,)
        L of each.
    """

    sigma: float
    uncertainty: float
    exponent: float
    noise: float
    reduction: int
    evidence: float
    widths: Float64Array
    costs: Float64Array

    def plot(self) -> Figure:
        """Draw the cost of every width that was tried.

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
            ("width", f"{self.sigma:.2f} ± {self.uncertainty:.2f} pixels" if known else "not told by the image"),
            ("to remove", f"{self.removable:.2f} pixels"),
            ("evidence", f"{self.evidence:.2f}"),
        ]
        return preview("Blur", facts)

    @property
    def blurred(self) -> bool:
        """Whether a blur was found, and not only the pixels of a sharp image or nothing at all."""
        return self.sigma > _WIDTHS[0]

    @property
    def removable(self) -> float:
        """Width to remove, pixels: less by half of the uncertainty, for too wide rings and too narrow is only soft."""
        return max(self.sigma - _CAUTION * self.uncertainty, 0.0) if self.sigma > 0 else 0.0


@dataclass(frozen=True, eq=False)
class BlurCandidate:
    """Blur found in a reduced image, if it is one that convinces.

    Attributes
    ----------
    estimate : BlurEstimate
        Its uncertainty is infinite as long as it is not known.
    part : ndarray, float32, shape (h, w)
        What was looked at of the reduced image.
    """

    estimate: BlurEstimate
    part: FloatArray

    @property
    def convinces(self) -> bool:
        """Whether the width is resolved, and a scene blurred by it clearly likelier than a sharp one."""
        found = self.estimate
        lowest = _lowest(found.costs)
        resolved = lowest < _WIDTHS[-1] and (found.reduction == 1 or lowest >= _RESOLVED)
        return resolved and found.evidence >= (_EVIDENCE if found.sigma >= _SOFT else _STRONG_EVIDENCE)


def estimate_blur(
    image: ArrayLike, noise: float | None = None, exponent: float = KOLMOGOROV, threads: int = 1
) -> BlurEstimate:
    """Estimate the width of the blur of an image.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float, optional
        Standard deviation of the noise, intensity; estimated by default.
    exponent : float
        Shape of the blur, 1 to 2: 5/3 for images fused from turbulent frames, 2 for a Gaussian.
    threads : int
        At least 1; with two, widths at half and at twice the noise are found side by side, to the same result.

    Returns
    -------
    BlurEstimate

    Raises
    ------
    DataError
        Wrong shape or values that are not finite.
    ConfigurationError
        ``noise`` is negative or not finite, or ``exponent`` outside 1 to 2.

    Examples
    --------
    >>> import cv2
    >>> from turbrestore.synthesis.scenes import SCENES
    >>> blurred = cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), 2.0)
    >>> bool(1.7 < estimate_blur(blurred, exponent=2.0).sigma < 2.3)
    True
    """
    with one_thread_each(), ThreadTeam(threads) as team:
        return choose_blur(find_candidates(image, noise, exponent), noise, exponent, team)


def find_candidates(
    image: ArrayLike, noise: float | None = None, exponent: float = KOLMOGOROV
) -> tuple[BlurCandidate, ...]:
    """Find the likeliest blur of the image and of each of its reductions, but not yet how sure it is.

    Parameters
    ----------
    image, noise, exponent
        See :func:`estimate_blur`.

    Returns
    -------
    tuple of BlurCandidate
        Empty where the image says nothing.

    Raises
    ------
    DataError
        Wrong shape or values that are not finite.
    ConfigurationError
        ``noise`` is negative or not finite, or ``exponent`` outside 1 to 2.

    Examples
    --------
    >>> from turbrestore.synthesis.scenes import SCENES
    >>> blurred = cv2.GaussianBlur(SCENES["camera"](128, 128), (0, 0), 2.0)
    >>> [(one.estimate.reduction, one.convinces) for one in find_candidates(blurred, exponent=2.0)]
    [(1, True), (2, True)]
    """
    grey = luminance(check_image(image))
    require(
        noise is None or (np.isfinite(noise) and noise >= 0),
        f"noise: expected a finite number of 0 or more, found {noise}",
    )
    check_exponent(exponent)
    if min(grey.shape) < _SMALLEST_IMAGE or np.ptp(grey) <= _LEAST_NOISE:
        return ()
    factors = [factor for factor in _REDUCTIONS if factor == 1 or min(grey.shape) >= factor * _SMALLEST_SIDE]
    return tuple(_find_candidate(grey, factor, exponent, noise) for factor in factors)


def choose_blur(
    candidates: tuple[BlurCandidate, ...], noise: float | None, exponent: float, team: ThreadTeam
) -> BlurEstimate:
    """Choose the candidate whose width depends least on the noise assumed.

    Parameters
    ----------
    candidates : tuple of BlurCandidate
        Of :func:`find_candidates`.
    noise : float or None
        As it was given there.
    exponent : float
        Likewise.
    team : ThreadTeam
        Finds widths at half and at twice the noise side by side.

    Returns
    -------
    BlurEstimate

    Examples
    --------
    >>> with ThreadTeam(1) as team:
    ...     choose_blur((), None, KOLMOGOROV, team).sigma
    0.0
    """
    if not candidates:
        return BlurEstimate(0.0, float("inf"), exponent, noise or 0.0, 1, 0.0, np.zeros(0), np.zeros(0))
    # Reductions one after the other: most of the time goes into one of them, and a second thread would disturb it.
    convincing = [_with_uncertainty(one, team) for one in candidates if one.convinces]
    if convincing:
        return min(convincing, key=_doubt)
    return replace(candidates[0].estimate, sigma=float(_WIDTHS[0]), uncertainty=_PIXEL_UNCERTAINTY)


def _doubt(estimate: BlurEstimate) -> float:
    """How much the width depends on the noise; less for the image itself, which has lost nothing, if it is blurred.

    Otherwise stronger reduction is preferred a little: where they contradict each other, blocks of a codec or the grain
    of a sensor make the others look sharp.
    """
    whole = estimate.reduction == 1 and estimate.evidence >= _STRONG_EVIDENCE
    preference = _PREFERENCE if whole else (estimate.reduction / 2) ** -_LARGER_REDUCTION
    return preference * estimate.uncertainty / estimate.sigma


def _find_candidate(grey: FloatArray, factor: int, exponent: float, noise: float | None) -> BlurCandidate:
    reduced = _reduce(grey, factor)
    # A copy, so that the reduced image is not kept.
    part, level = _most_detailed(reduced).copy(), _effective_noise(reduced, factor, noise)
    costs = _costs(_gradients(part), exponent, level, rises=2)
    evidence, width = float(costs[0] - costs.min()), _widen(_lowest(costs), factor)
    tried = factor * _WIDTHS[: len(costs)]
    return BlurCandidate(BlurEstimate(width, float("inf"), exponent, level, factor, evidence, tried, costs), part)


def _with_uncertainty(candidate: BlurCandidate, team: ThreadTeam) -> BlurEstimate:
    found, gradients = candidate.estimate, _gradients(candidate.part)
    levels = found.noise / 2, 2 * found.noise
    sweeps = team.map(lambda level: _costs(gradients, found.exponent, level, rises=1), levels)
    less, more = (_widen(_lowest(sweep), found.reduction) for sweep in sweeps)
    return replace(found, uncertainty=abs(more - less) / 2)


def _effective_noise(reduced: FloatArray, factor: int, noise: float | None) -> float:
    """Noise and misfit of the reduced image."""
    level = estimate_noise(reduced) if noise is None else noise / factor
    return max(float(np.hypot(_NOISE_FACTOR * level, _MISFIT * reduced.std())), _LEAST_NOISE)


def _costs(gradients: _Gradients, exponent: float, noise: float, rises: int) -> Float64Array:
    """L of widths from the smallest on, until it has risen a few times in a row: it has one minimum."""
    costs: list[float] = []
    scene = gradients.planes
    prior = np.full_like(scene, max(float(np.square(scene).mean()), 1e-10))
    for width in _WIDTHS:
        # A little more blur asks for a little other scene: from one to the next, fewer updates go further.
        scene, prior, cost = _fit_scene(gradients, scene, prior, blur=(float(width), exponent), noise=noise)
        costs.append(cost)
        if len(costs) > rises and (np.diff(costs[-rises - 1 :]) > 0).all():
            break
    return np.array(costs)


def _widen(width: float, factor: int) -> float:
    """Width in the image of a blur in the reduced image, without the pixels that were averaged."""
    return float(np.sqrt(max((factor * width) ** 2 - (factor**2 - 1) / 12, _WIDTHS[0] ** 2)))


def _lowest(costs: Float64Array) -> float:
    """Width of the lowest cost, between those tried by a parabola through three."""
    index = int(np.argmin(costs))
    if not 0 < index < len(costs) - 1:
        return float(_WIDTHS[index])
    x = np.log(_WIDTHS[index - 1 : index + 2] / _WIDTHS[index])
    curvature, slope, _ = np.polyfit(x, costs[index - 1 : index + 2], 2)
    return float(_WIDTHS[index] * np.exp(-slope / (2 * curvature)))


def _reduce(grey: FloatArray, factor: int) -> FloatArray:
    if factor == 1:
        return np.ascontiguousarray(grey)
    height, width = (size // factor for size in grey.shape)
    return cv2.resize(grey[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


def _most_detailed(image: FloatArray) -> FloatArray:
    """Part with the largest energy of the Laplacian, of a size whose gradients transform fast."""
    height, width = (_fast_size(min(_PART, size - 1)) + 1 for size in image.shape)
    most, top, left = -np.inf, 0, 0
    # What lies above and to the left, up to each of the last rows.
    sums = np.zeros((1, image.shape[1] + 1))
    for start in range(0, image.shape[0], _STRIP_ROWS):
        sums = _integral(_detail(image, start), sums[-height:])
        inside = sums[height:, width:] - sums[:-height, width:]
        inside -= sums[height:, :-width]
        inside += sums[:-height, :-width]
        row, column = divmod(int(inside.argmax()), inside.shape[1])
        if inside[row, column] > most:
            most, top, left = inside[row, column], max(start + 1 - height, 0) + row, column
    return image[top : top + height, left : left + width]


def _detail(image: FloatArray, start: int) -> FloatArray:
    """Energy of the Laplacian in a strip of rows."""
    above = min(start, _REACH)
    rows = image[start - above : start + _STRIP_ROWS + _REACH]
    energy = cv2.Laplacian(cv2.GaussianBlur(rows, (0, 0), 1.0), cv2.CV_32F)[above : above + _STRIP_ROWS]
    return np.square(energy, out=energy)


def _integral(strip: FloatArray, above: Float64Array) -> Float64Array:
    """Sum up all above and to the left, from the sums of the rows before, which come first."""
    rows = np.pad(np.cumsum(strip, axis=1, dtype=np.float64), ((0, 0), (1, 0)))
    sums = np.vstack([above, rows])
    np.cumsum(sums[len(above) - 1 :], axis=0, out=sums[len(above) - 1 :])
    return sums


def _fast_size(size: int) -> int:
    fast = (n for n in range(size // 2, size + 1) if fft.next_fast_len(n, real=True) == n)
    return max(n for n in fast if n != _SLOW_SIZE)


@dataclass(frozen=True, eq=False)
class _Gradients:
    """y, its Fourier transform, and the frequency of each entry of one.

    The last axis holds the planes along x and along y.  A symmetric kernel does not mix real and imaginary parts, so
    they go through one complex transform.
    """

    planes: FloatArray
    spectrum: FloatArray
    frequency: FloatArray


def _gradients(image: FloatArray) -> _Gradients:
    dx, dy = image[:-1, 1:] - image[:-1, :-1], image[1:, :-1] - image[:-1, :-1]
    rows, columns = (_taper(size) for size in dx.shape)
    planes = np.stack([dx, dy], axis=-1) * np.outer(rows, columns)[..., None]
    frequency = np.hypot(fft.fftfreq(len(rows))[:, None], fft.fftfreq(len(columns)))
    return _Gradients(planes, cv2.dft(planes), frequency.astype(np.float32))


def _taper(size: int) -> FloatArray:
    """Ones that fall to 0 at both ends, where a blurred scene goes on beyond the part that is looked at."""
    steps = np.arange(1, size + 1, dtype=np.float32)
    return np.minimum(np.minimum(steps, steps[::-1]) / (_TAPER + 1), 1)


def _fit_scene(
    gradients: _Gradients, scene: FloatArray, prior: FloatArray, blur: tuple[float, float], noise: float
) -> tuple[FloatArray, FloatArray, float]:
    """Update x and γ for a blur of given width and exponent: both, and L."""
    width, exponent = blur
    otf = np.exp(-np.log(2) * (gradients.frequency / half_frequency(width)) ** exponent).astype(np.float32)
    # The energy of k is that of its spectrum; the inverse transform leaves the division by the size to its input.
    energy, variance = np.float32(np.square(otf).mean()), np.float32(2 * noise**2)
    kernel = np.repeat((otf / np.float32(otf.size))[..., None], 2, axis=2)
    power = kernel * (otf[..., None] / variance)
    right = cv2.dft(kernel * gradients.spectrum, flags=cv2.DFT_INVERSE) / variance
    scene = scene.copy()
    # From one update to the next only γ changes, so this part of the residual is not computed again.
    unexplained = right - cv2.dft(power * cv2.dft(scene), flags=cv2.DFT_INVERSE)
    for _ in range(_UPDATES):
        precision = np.reciprocal(prior)
        posterior = np.reciprocal(energy / variance + precision)
        enough = _TOLERANCE * float(np.vdot(right, posterior * right))
        _solve(power, precision, posterior, scene, unexplained, enough)
        prior = scene**2 + posterior
    blurred = cv2.dft(kernel * cv2.dft(scene), flags=cv2.DFT_INVERSE)
    misfit = np.square(gradients.planes - blurred).sum(dtype=np.float64) / variance
    total = float(misfit + np.sum(scene**2 / prior + np.log(variance + prior * energy), dtype=np.float64))
    return scene, prior, total / scene.size


def _solve(
    power: FloatArray,
    precision: FloatArray,
    preconditioner: FloatArray,
    x: FloatArray,
    unexplained: FloatArray,
    enough: float,
) -> None:
    """Conjugate gradients on ``(KᵀK / λ + 1 / γ) x = Kᵀy / λ``; ``power`` is |K|² / λ in Fourier over the size.

    x and ``unexplained``, ``Kᵀ(y − Kx) / λ``, are changed.
    """
    spectrum, descend = np.empty_like(x), compiled(descend_loops) or _descend
    residual = unexplained
    residual -= precision * x
    direction = preconditioner * residual
    decrease = np.array([np.vdot(residual, direction)], np.float32)
    fixed, moving = (precision.ravel(), preconditioner.ravel()), (direction.ravel(), x.ravel(), residual.ravel())
    for _ in range(_STEPS):
        if decrease[0] <= enough:
            break
        cv2.dft(direction, dst=spectrum)
        np.multiply(spectrum, power, out=spectrum)
        descend(cv2.dft(spectrum, flags=cv2.DFT_INVERSE).ravel(), *fixed, *moving, decrease)
    residual += precision * x


def _descend(
    image: FloatArray,
    precision: FloatArray,
    preconditioner: FloatArray,
    direction: FloatArray,
    x: FloatArray,
    residual: FloatArray,
    decrease: FloatArray,
) -> None:
    """:func:`descend_loops` by NumPy."""
    work = precision * direction
    image += work
    length = decrease[0] / np.vdot(direction, image)
    x += np.multiply(direction, length, out=work)
    residual -= np.multiply(image, length, out=image)
    np.multiply(preconditioner, residual, out=work)
    before, decrease[0] = decrease[0], np.vdot(residual, work)
    direction *= decrease[0] / before
    direction += work


def descend_loops(
    image: FloatArray,
    precision: FloatArray,
    preconditioner: FloatArray,
    direction: FloatArray,
    x: FloatArray,
    residual: FloatArray,
    decrease: FloatArray,
) -> None:
    """One step of conjugate gradients but for its transforms; to be compiled.

    Parameters
    ----------
    image : ndarray, float32, shape (m,)
        ``KᵀK / λ`` of the direction; changed.
    precision, preconditioner : ndarray, float32, shape (m,)
        1 / γ, and C.
    direction, x, residual : ndarray, float32, shape (m,)
        Changed.
    decrease : ndarray, float32, shape (1,)
        ⟨residual, C residual⟩; changed.

    Examples
    --------
    >>> one = np.ones(1, np.float32)
    >>> direction, x, residual, decrease = 2 * one, 0 * one, 2 * one, 4 * one
    >>> descend_loops(2 * one, one, one, direction, x, residual, decrease)
    >>> x, residual, decrease
    (array([1.], dtype=float32), array([0.], dtype=float32), array([0.], dtype=float32))
    """
    curvature, left = np.float32(0), np.float32(0)
    for pixel in range(x.size):
        image[pixel] += precision[pixel] * direction[pixel]
        curvature += direction[pixel] * image[pixel]
    length = decrease[0] / curvature
    for pixel in range(x.size):
        x[pixel] += direction[pixel] * length
        rest = residual[pixel] - image[pixel] * length
        residual[pixel] = rest
        left += preconditioner[pixel] * rest * rest
    share = left / decrease[0]
    decrease[0] = left
    for pixel in range(x.size):
        direction[pixel] = direction[pixel] * share + preconditioner[pixel] * residual[pixel]

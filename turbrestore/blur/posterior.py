"""The blur of a fused image: posterior over air and lens, and the blur that is removed.

Symbols
-------
D/r0, λ/D : strength of the air, and diffraction, pixels
σ_l : width of a Gaussian, which stands for the lens, the pixels, the codec and what registration leaves, pixels
H : transfer function, ``H_air(ν; D/r0, λ/D) exp(−2π² σ_l² ν²)`` (:mod:`turbrestore.blur.short_exposure`)
V : variance of the displacement along one axis, squared pixels
s, s_4, ε : variation of the spectra, and stretch by the registration (:mod:`turbrestore.blur.spectral_variation`)
g : share of the variation that is left where a window covers several isoplanatic patches
τ : displacement that registration leaves, pixels; κ : width of the fused image over that of the mean of the frames
L : cost of a width for the image (:mod:`turbrestore.blur.image_evidence`)

Witnesses
---------
Each gives the likelihood of every hypothesis (D/r0, λ/D, σ_l).  One more hypothesis is air that moves the image and
does not blur it.

1. The displacement: V is that of the hypothesis (Fried 1966), within a factor that the outer scale leaves open.
2. The variation of the spectra.  Expected are ``g s + 0.8 ε² ln² H + j`` and ``g s_4 + 1.36 ε² ln² H + j/4`` with
   ``j = exp(4π² τ² ν²) − 1``: the air, the static blur that registration stretches, and displacement that it misses.
3. The image: ``exp(−κ_m (L − min L))``.  L is a mean over gradients that are neither independent nor exactly modelled,
   so it counts as that of only κ_m of them.  Scenes are soft themselves, which adds to the width in squares.

The air and the lens look alike in 1 and 3, and the air alone varies.

Removal
-------
The mean of ln H under the posterior is the shape.  Its width is multiplied by the factor, 1.1 at most, that loses least
on average over the hypotheses, in decibels: the loss is ``Σ_ν ν^(1 − 2.2) (W H − 1)²`` after the Wiener filter W of the
blur that is removed, for a scene whose power falls as ν^(−2.2).  Too wide a blur amplifies what is left and costs more
than too narrow a one.  Where the image contradicts the posterior, the geometric mean of this width and of the widest
that the image allows is removed.

Constants of the likelihoods were set on simulated clips; ``benchmarks/results/blur_calibration.md`` is of others.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from .image_evidence import EXPONENTS, ImageEvidence
from .psf import half_frequency
from .short_exposure import TILT_SPREAD, displacement_variance, short_exposures
from .spectral_variation import RINGS, SpectralVariation, measure_variation

Float64Array = NDArray[np.float64]

# Hypotheses: D/r0, λ/D and σ_l.
_STRENGTHS = np.geomspace(0.5, 7, 11)
_DIFFRACTIONS = np.geomspace(0.35, 4.5, 11)
_LENSES = np.array([0.2, 0.35, 0.5, 0.7, 0.9, 1.1, 1.35, 1.6, 1.9, 2.3, 2.8, 3.4, 4.2, 5.2, 6.5, 8.0, 10.0])
# Prior: usual λ/D and the standard deviation of its logarithm; share of air that does not blur; weights of the σ_l.
_USUAL_DIFFRACTION, _DIFFRACTION_SPREAD, _NO_BLUR = 1.4, 0.6, 0.05
_LENS_PRIOR = np.array([22, 16, 12, 7, 7, 6, 6, 6, 5, 4.5, 4, 3, 1.5, 1, 0.7, 0.5, 0.3])
# Range of ln V of air that does not blur, V below which a scene stands still, and the least V, squared pixels.
_RANGE_OF_V, _STILL, _LEAST_V = 7.0, 0.03, 1e-3
# g and τ: values, and mean and standard deviation of the logarithm.
_SHARES, _SHARE_PRIOR = np.exp([-2.2, -1.6, -1.1, -0.7, -0.3]), (-1.1, 0.5)
_SHIFTS, _SHIFT_PRIOR = np.array([0.04, 0.1, 0.2, 0.3, 0.45]), (float(np.log(0.12)), 0.7)
# Factors of the stretch and of the shift in s and in s_4; errors of s and s_4 by that of the noise, in units of
# noise over signal; model error, relative and absolute; weight of a ring, as neighbouring rings are not independent.
_STRETCH, _SHIFT, _NOISE_ERROR = (0.8, 1.36), (1.0, 0.25), (0.15, 0.3)
_MODEL_ERROR, _LEAST_ERROR, _RING_WEIGHT = 0.3, 1e-3, 0.35
# Rings that count, as long as the signal exceeds the noise by this factor.
_FIRST_RING, _LAST_RING, _CLEAR = 2, 25, 2.0
# κ_m; softness of scenes, pixels, with weights.
_GRADIENTS = 40.0
_SOFTNESS = ((0.25, 0.36), (0.5, 0.35), (0.8, 0.2), (1.15, 0.07), (1.6, 0.02))
# The most that displacement, variation and image count against a hypothesis, as logarithms: the model of a witness may
# not hold.  Together the two witnesses of the frames outvote the image; alone, the image outvotes either.
_EXCLUDED = (6.0, 8.0, 10.0)
# Fidelity of the Wiener filter and exponent of the power of a scene; factors on the width that are tried.
_FIDELITY, _SCENE = 1500.0, 2.2
# Share of the energy of the scene that is lost whatever is removed.
_LEAST_LOSS = 1e-3
_FACTORS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1)
# Widths below this are those of the pixels and of the interpolation, and are not removed, pixels.
_LEAST_REMOVED = 0.5
_LEAST_TRANSFER = 1e-5
# Widest blur of frames that are not reduced, pixels, and the factors of the others.
_WIDEST, _REDUCTIONS = 3.0, (2, 4)
# Widths that are reported.
_QUANTILES = (0.16, 0.5, 0.84)


@dataclass(frozen=True, eq=False)
class BlurWitnesses:
    """What the frames say about their blur: s and s_4, if they could be measured, V, and how many are independent.

    ``picture`` is the part of the image that the frames show, without bars.
    """

    variation: SpectralVariation | None
    displacement: float
    frames: float
    picture: tuple[slice, slice] | None = None


@dataclass(frozen=True, eq=False)
class BlurPosterior:
    """Posterior of the blur of a fused image.

    Attributes
    ----------
    removed, exponent : float
        Width and shape of the blur to remove, pixels; see :func:`turbrestore.blur.psf.blur_otf`.
    width : ndarray, float64, shape (3,)
        16 %, 50 % and 84 % quantiles of the width, pixels.
    by_displacement, by_variation, by_image : ndarray, float64, shape (3,)
        The same by each witness alone; NaN where it says nothing.
    air : float
        Probability that the air has blurred the image.
    edge_limited : bool
        Whether less is removed because the edges of the image are too steep for more.
    frequencies : ndarray, float64, shape (k,)
        Of the arrays that follow, cycles per pixel.
    transfer, lowest, highest : ndarray, float64, shape (k,)
        Mean transfer function and its 16 % and 84 % quantiles.
    variation, variation_error, expected_variation : ndarray, float64, shape (k,)
        s, its error, and what the posterior expects; NaN where the signal is lost in noise.
    power_variation, power_variation_error, expected_power_variation : ndarray, float64, shape (k,)
        The same of s_4.
    """

    removed: float
    exponent: float
    width: Float64Array
    by_displacement: Float64Array
    by_variation: Float64Array
    by_image: Float64Array
    air: float
    edge_limited: bool
    frequencies: Float64Array
    transfer: Float64Array
    lowest: Float64Array
    highest: Float64Array
    variation: Float64Array
    variation_error: Float64Array
    expected_variation: Float64Array
    power_variation: Float64Array
    power_variation_error: Float64Array
    expected_power_variation: Float64Array


@dataclass(frozen=True, eq=False)
class _Hypotheses:
    """Transfer functions (a, l, rings) of airs and lenses, with their widths and exponents (a, l).

    The last air does not blur.  ``amplitude`` and ``power`` are s and s_4 (a, rings), ``prior`` is the logarithm of the
    prior (a, l), and ``expected_v`` is V (a − 1).
    """

    transfer: Float64Array
    width: Float64Array
    exponent: Float64Array
    amplitude: Float64Array
    power: Float64Array
    prior: Float64Array
    expected_v: Float64Array


def measure_witnesses(frames: FloatArray, flows: FloatArray, displacement: float, independent: float) -> BlurWitnesses:
    """Measure what frames (T, H, W[, 3]) say that are registered by flows (T, H, W, 2), pixels.

    Windows of 64 pixels resolve blurs of up to three pixels; for wider ones, frames are reduced.
    """
    witnesses = BlurWitnesses(measure_variation(frames, flows), displacement, independent)
    for reduction in _REDUCTIONS:
        if blur_posterior(None, witnesses).width[1] <= _WIDEST * reduction / 2:
            break
        reduced = measure_variation(frames, flows, reduction)
        if reduced is None:
            break
        witnesses = BlurWitnesses(reduced, displacement, independent)
    return witnesses


def blur_posterior(
    evidence: ImageEvidence | None, witnesses: BlurWitnesses, ratio: Float64Array | None = None
) -> BlurPosterior:
    """Combine the witnesses of the frames and of the fused image, whose spectrum over that of the mean is ``ratio``.

    Everything is counted in the pixels of the reduced frames, and the result in those of the image.
    """
    known, variation = _hypotheses(), witnesses.variation
    scale = 1 if variation is None else variation.reduction
    of_v = _displacement_likelihood(witnesses.displacement, witnesses.frames, scale)[:, None] + 0 * known.width
    of_s = 0 * known.width if variation is None else _variation_likelihood(variation)
    of_v, of_s = (np.maximum(one, one.max() - most) for one, most in ((of_v, _EXCLUDED[0]), (of_s, _EXCLUDED[1])))
    kappa = _sharper(known, _normalised(known.prior + of_v + of_s), ratio)
    of_image = 0 * known.width if evidence is None else _image_likelihood(evidence, kappa, scale)
    weights = _normalised(known.prior + of_v + of_s + of_image)
    kappa = _sharper(known, weights, ratio)

    def quantiles(likelihood: Float64Array) -> Float64Array:
        if np.ptp(likelihood) == 0:
            return np.full(len(_QUANTILES), np.nan)
        return _quantiles(kappa * scale * known.width, _normalised(known.prior + likelihood))

    curves = np.array([np.interp(RINGS * kappa, RINGS, curve) for curve in known.transfer.reshape(-1, len(RINGS))])
    mean = np.exp(weights.ravel() @ np.log(np.maximum(curves, _LEAST_TRANSFER)))
    width, exponent = _least_loss(curves, weights.ravel(), mean, scale)
    by_image, whole = quantiles(of_image), _quantiles(kappa * scale * known.width, weights)
    width = _less_if_contradicted(width * scale, float(by_image[2]), float(whole[0]))
    low, high = _curve_quantiles(curves, weights.ravel())
    return BlurPosterior(
        removed=width if width >= _LEAST_REMOVED else 0.0,
        exponent=exponent,
        width=whole,
        by_displacement=quantiles(of_v),
        by_variation=quantiles(of_s),
        by_image=by_image,
        air=float(1 - weights[-1].sum()),
        edge_limited=False,
        frequencies=RINGS / scale,
        transfer=mean,
        lowest=low,
        highest=high,
        **_measured_and_expected(variation, weights),
    )


@functools.cache
def _hypotheses() -> _Hypotheses:
    mean, amplitude, power = short_exposures(_STRENGTHS, _DIFFRACTIONS, RINGS)
    count = len(_STRENGTHS) * len(_DIFFRACTIONS)

    def with_none(values: Float64Array, none: float) -> Float64Array:
        return np.concatenate([values.reshape(count, -1), np.full((1, len(RINGS)), none)])

    lens = np.exp(-2 * (np.pi * _LENSES[:, None] * RINGS) ** 2)
    transfer = with_none(mean, 1.0)[:, None] * lens
    width, exponent = _shapes(transfer)
    usual = np.exp(-0.5 * (np.log(_DIFFRACTIONS / _USUAL_DIFFRACTION) / _DIFFRACTION_SPREAD) ** 2)
    air = np.tile((1 - _NO_BLUR) / len(_STRENGTHS) * usual / usual.sum(), len(_STRENGTHS))
    prior = np.append(air, _NO_BLUR)[:, None] * (_LENS_PRIOR / _LENS_PRIOR.sum())
    expected = displacement_variance(_STRENGTHS[:, None], _DIFFRACTIONS).ravel()
    return _Hypotheses(
        transfer, width, exponent, with_none(amplitude, 0.0), with_none(power, 0.0), np.log(prior), expected
    )


def _shapes(transfer: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Width and exponent of transfer functions (..., rings), by their half frequency and a line through ln(−ln H)."""
    depth = -np.log(np.clip(transfer, _LEAST_TRANSFER, 1 - 1e-9)) / np.log(2)
    below = depth >= 1
    # A blur of less than a pixel has no half frequency below that of the grid; it is close to a Gaussian.
    last = np.where(below.any(axis=-1), below.argmax(axis=-1), len(RINGS) - 1)
    last = np.maximum(last, 1)
    high = np.take_along_axis(depth, last[..., None], -1)[..., 0]
    low = np.take_along_axis(depth, np.maximum(last - 1, 1)[..., None], -1)[..., 0]
    apart = np.maximum(np.log(last / np.maximum(last - 1, 1)), 1e-9)
    slope = np.clip(np.log(high / low) / apart, 0.8, 2.5)
    slope = np.where((last > 1) & below.any(axis=-1), slope, 2.0)
    half = RINGS[last] * high ** (-1 / slope)
    usable = (transfer > 0.08) & (transfer < 0.93) & (RINGS > 0)
    x = np.log(np.maximum(RINGS, RINGS[1]) / half[..., None])
    fit = (usable * x * np.log(depth)).sum(axis=-1) / np.maximum((usable * x * x).sum(axis=-1), 1e-9)
    exponent = np.where(usable.sum(axis=-1) >= 2, np.clip(fit, 1.1, 2.0), 2.0)
    return half_frequency(1.0) / half, exponent


def _displacement_likelihood(variance: float, frames: float, scale: int) -> Float64Array:
    """Log likelihood of V, in pixels of the image, for every air in reduced pixels; 0 where V is not known."""
    known = _hypotheses()
    if not np.isfinite(variance):
        return np.zeros(len(known.prior))
    still, measured = variance < _STILL, max(variance, _LEAST_V) / scale**2
    spread = np.hypot(TILT_SPREAD, 1.4 / max(frames, 1.0) ** 0.5)
    of_air = -0.5 * (np.log(measured / known.expected_v) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi))
    return np.append(of_air, np.log(0.5 * still + 0.5 / _RANGE_OF_V))


def _variation_likelihood(measured: SpectralVariation) -> Float64Array:
    """Log likelihood of s and s_4 for every hypothesis, mean over g and τ."""
    known, rings = _hypotheses(), _clear_rings(measured)
    if len(rings) < 2:
        return 0 * known.width
    shares, shifts = (
        -0.5 * ((np.log(values) - middle) / spread) ** 2
        for values, (middle, spread) in ((_SHARES, _SHARE_PRIOR), (_SHIFTS, _SHIFT_PRIOR))
    )
    total = np.full(known.width.shape, -np.inf)
    for share, of_share in zip(_SHARES, shares, strict=True):
        for shift, of_shift in zip(_SHIFTS, shifts, strict=True):
            likelihood = np.full(known.width.shape, of_share + of_shift)
            for kind, (found, error) in enumerate(
                ((measured.amplitude, measured.amplitude_error), (measured.power, measured.power_error))
            ):
                expected = _expected(kind, rings, share, shift, measured.stretch)
                noise = (_NOISE_ERROR[kind] / measured.signal[rings]) ** 2
                variance = error[rings] ** 2 + noise + (_MODEL_ERROR * expected) ** 2 + _LEAST_ERROR**2
                misfit = (found[rings] - expected) ** 2 / variance + np.log(variance)
                likelihood -= _RING_WEIGHT / 2 * misfit.sum(axis=-1)
            total = np.logaddexp(total, likelihood)
    return total


def _expected(kind: int, rings: NDArray[np.int_], share: float, shift: float, stretch: float) -> Float64Array:
    """Return s (kind 0) or s_4 (kind 1) of every hypothesis in some rings."""
    known = _hypotheses()
    air = (known.amplitude, known.power)[kind][:, None, rings]
    stretched = _STRETCH[kind] * stretch**2 * np.log(np.maximum(known.transfer[..., rings], 1e-4)) ** 2
    return share * air + stretched + _SHIFT[kind] * np.expm1((2 * np.pi * shift * RINGS[rings]) ** 2)


def _clear_rings(measured: SpectralVariation) -> NDArray[np.int_]:
    clear = measured.signal > _CLEAR
    lost = np.flatnonzero(~clear[_FIRST_RING:])
    end = _FIRST_RING + lost[0] if len(lost) else len(RINGS)
    return np.arange(_FIRST_RING, min(end, _LAST_RING))


def _image_likelihood(evidence: ImageEvidence, kappa: float, scale: int) -> Float64Array:
    """Log likelihood of the image for every hypothesis, mean over the softness of the scene."""
    known = _hypotheses()
    curves = -np.minimum(_GRADIENTS * (evidence.costs - evidence.costs.min()), _EXCLUDED[2])
    place = np.interp(known.exponent, EXPONENTS, np.arange(len(EXPONENTS)))
    low = np.minimum(place.astype(int), len(EXPONENTS) - 2)
    share, logs = place - low, np.log(evidence.widths)
    total = np.full(known.width.shape, -np.inf)
    for softness, weight in _SOFTNESS:
        seen = np.log(np.hypot(kappa * scale * known.width, softness))
        by_shape = np.array([np.interp(seen, logs, curve, right=-_EXCLUDED[2]) for curve in curves])
        below, above = (np.take_along_axis(by_shape, (low + step)[None], 0)[0] for step in (0, 1))
        total = np.logaddexp(total, np.log(weight) + (1 - share) * below + share * above)
    return total


def _sharper(known: _Hypotheses, weights: Float64Array, ratio: Float64Array | None) -> float:
    """κ, by the half frequencies of the mean transfer function with and without the ratio of the spectra."""
    if ratio is None:
        return 1.0
    mean = np.exp(np.tensordot(weights, np.log(np.maximum(known.transfer, _LEAST_TRANSFER))))
    (before, after), _ = _shapes(np.clip(np.stack([mean, mean * ratio]), _LEAST_TRANSFER, 1 - 1e-9))
    # Blurs of less than a pixel are not resolved by the ratio.
    return float(np.clip(after / before, 0.6, 1.1)) if mean[-1] < 0.5 and (mean * ratio)[-1] < 0.5 else 1.0


def _least_loss(curves: Float64Array, weights: Float64Array, mean: Float64Array, scale: int) -> tuple[float, float]:
    """Width and exponent of the blur whose removal loses least on average, width 0 if removing none does."""
    noise = (2 * np.pi * RINGS / scale) ** 2 / _FIDELITY
    scene = np.append(0.0, RINGS[1:] ** (1 - _SCENE))
    (width,), (exponent,) = _shapes(mean[None])

    def loss(wiener: Float64Array | float) -> float:
        left = (scene * (wiener * curves - 1) ** 2).sum(axis=1)
        return float(weights @ np.log(left + _LEAST_LOSS * scene.sum()))

    best, chosen = loss(1.0), 0.0
    for factor in _FACTORS:
        otf = np.interp(RINGS * factor, RINGS, mean)
        value = loss(otf / (otf**2 + noise))
        if value < best:
            best, chosen = value, factor
    return float(chosen * width), float(exponent)


def _less_if_contradicted(width: float, widest_by_image: float, narrowest: float) -> float:
    """Return the mean, in logarithm, with the widest blur by the image where the posterior has only wider ones."""
    return (width * min(width, widest_by_image)) ** 0.5 if widest_by_image < narrowest else width


def _normalised(logs: Float64Array) -> Float64Array:
    weights = np.exp(logs - logs.max())
    return weights / weights.sum()


def _quantiles(widths: Float64Array, weights: Float64Array) -> Float64Array:
    order = np.argsort(widths, axis=None)
    return np.interp(_QUANTILES, np.cumsum(weights.ravel()[order]), widths.ravel()[order])


def _curve_quantiles(curves: Float64Array, weights: Float64Array) -> tuple[Float64Array, Float64Array]:
    low, _, high = np.array([_quantiles(column, weights) for column in curves.T]).T
    return low, high


def _measured_and_expected(measured: SpectralVariation | None, weights: Float64Array) -> dict[str, Float64Array]:
    """Return s and s_4 as measured and as the posterior expects them, for the usual g and τ."""
    gaps = np.full(len(RINGS), np.nan)
    names = ("variation", "power_variation")
    found = {key: gaps for name in names for key in (name, f"{name}_error", f"expected_{name}")}
    if measured is None:
        return found
    rings = _clear_rings(measured)
    share, shift = float(np.exp(_SHARE_PRIOR[0])), float(np.exp(_SHIFT_PRIOR[0]))
    values = ((measured.amplitude, measured.amplitude_error), (measured.power, measured.power_error))
    for kind, (name, (value, error)) in enumerate(zip(names, values, strict=True)):
        expected = np.tensordot(weights, _expected(kind, rings, share, shift, measured.stretch))
        for key, figure in ((name, value[rings]), (f"{name}_error", error[rings]), (f"expected_{name}", expected)):
            found[key] = gaps.copy()
            found[key][rings] = figure
    return found

"""The blur of a fused image: posterior over air and lens by the theory of what frames and image show.

Symbols
-------
D/r0, λ/D : strength of the air, and diffraction, pixels
σ_l : width of a Gaussian for the blur of the lens, the pixels, the codec and what registration leaves, pixels
H : transfer function, ``H_air(ν; D/r0, λ/D) exp(−2π² σ_l² ν²)`` (:mod:`.witnesses.short_exposure`)
V : variance of the displacement along one axis, squared pixels
s, s_4, ε : variation of the spectra, and stretch by the registration (:mod:`.witnesses.spectral_variation`)
g : share of the variation that is left where a window covers several isoplanatic patches
τ : displacement that registration leaves, pixels; κ : width of the fused image over that of the mean of the frames
L : cost of a width for the image (:mod:`turbrestore.blur.witnesses.image_evidence`)

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

Where the image has two tones, these alone tell the width that is reported and removed
(:mod:`turbrestore.blur.witnesses.two_tones`).  Elsewhere the width that is reported is learnt from simulated
clips, for which this posterior and all that the other witnesses measure are the input.  The width that is removed
follows from a learnt one, from this posterior and from the image alone (:mod:`turbrestore.blur.learnt`).  The exponent
is always that of this posterior.

Constants of the likelihoods were set on simulated clips; ``benchmarks/results/blur_calibration.md`` is of others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.noise_spectrum import NoiseSpectrum
from ..registration.registered_noise import noise_of_frames
from ..runtime.runtime import DEFAULT, Runtime
from .estimation import PART, most_detailed
from .learnt import GRADIENTS, blur_features, learnt_blur
from .psf import Float64Array
from .witnesses.hypotheses import LEAST_TRANSFER, Hypotheses, hypotheses, shapes
from .witnesses.image_evidence import EXPONENTS, ImageEvidence, image_evidence
from .witnesses.short_exposure import TILT_SPREAD
from .witnesses.spectral_variation import RINGS, SpectralVariation, measure_variation
from .witnesses.two_tones import two_tones

# How much less likely the narrowest lens is, as a logarithm, where frames were moved and hence interpolated; chosen.
_INTERPOLATED = 3.0
# Widest blur of frames that are not reduced, pixels, chosen, and the factors of the others: octaves, up to which the
# widest lens of the hypotheses is resolved.
_WIDEST, _REDUCTIONS = 3.0, (2, 4)
# Widths that are reported: median and a standard deviation.
_QUANTILES = (0.16, 0.5, 0.84)
# Range of ln V of air that does not blur, V below which a scene counts as static, and the least V, squared pixels.
# These and all below were set on simulated clips.
_RANGE_OF_V, _STILL, _LEAST_V = 7.0, 0.03, 1e-3
# g and τ: values, and mean and standard deviation of the logarithm.
_SHARES, SHARE_PRIOR = np.exp([-2.2, -1.6, -1.1, -0.7, -0.3]), (-1.1, 0.5)
_SHIFTS, SHIFT_PRIOR = np.array([0.04, 0.1, 0.2, 0.3, 0.45]), (float(np.log(0.12)), 0.7)
# Factors of the stretch and of the shift in s, where j is exact, and in s_4; errors of s and s_4 by that of the noise,
# in units of noise over signal; model error, relative and absolute; weight of a ring, as neighbouring rings are not
# independent.
_STRETCH, _SHIFT, _NOISE_ERROR = (0.8, 1.36), (1.0, 0.25), (0.15, 0.3)
_MODEL_ERROR, _LEAST_ERROR, _RING_WEIGHT = 0.3, 1e-3, 0.35
# Rings that count, from the first to which the window does not spread the mean, as long as the signal exceeds the noise
# by this factor.
_FIRST_RING, _LAST_RING, _CLEAR = 2, 25, 2.0
# Softness of scenes, pixels, with weights; κ_m is :data:`turbrestore.blur.learnt.GRADIENTS`.
_SOFTNESS = ((0.25, 0.36), (0.5, 0.35), (0.8, 0.2), (1.15, 0.07), (1.6, 0.02))
# The most that displacement, variation and image count against a hypothesis, as logarithms: the model of a witness may
# not hold.  Together the two witnesses of the frames outvote the image; alone, the image outvotes either.
EXCLUDED = (6.0, 8.0, 10.0)


@dataclass(frozen=True, eq=False)
class BlurWitnesses:
    """What the frames say about their blur."""

    displacement: float  # V, squared pixels; NaN where it is not known
    independent_frames: float
    picture: tuple[slice, slice] | None = None  # part of the image that the frames show, without bars
    variation: SpectralVariation | None = None  # s and s_4, if they could be measured
    diffraction: float | None = None  # λ/D of known optics, pixels
    spread: float | None = None  # standard deviation of ln V, if V is what a measured D/r0 makes
    frame_noise: NoiseSpectrum | None = None  # of a frame


@dataclass(frozen=True, eq=False)
class BlurPosterior:
    """What is known of the blur of a fused image."""

    # Width and shape of the blur to remove, pixels; see :func:`turbrestore.blur.psf.blur_otf`.
    removed: float
    exponent: float
    width: Float64Array  # (3,): 16 %, 50 % and 84 % quantiles of the width, pixels
    # (3,): the same by each witness alone; NaN where it says nothing.
    by_displacement: Float64Array
    by_variation: Float64Array
    by_image: Float64Array
    by_tones: Float64Array
    air: float  # probability that the air has blurred the image
    edge_limited: bool  # whether less is removed because the edges of the image are too steep for more


def measure_witnesses(frames: FloatArray, flows: FloatArray, mean: FloatArray, known: BlurWitnesses) -> BlurWitnesses:
    """Add to what is known what frames (T, H, W[, 3]) say that are registered by flows (T, H, W, 2), pixels.

    ``mean`` (H, W[, 3]) is the mean of the registered frames.
    Windows of 64 pixels resolve blurs of up to three pixels; for wider ones, frames are reduced.
    """
    noise = noise_of_frames(frames, flows, mean)
    witnesses = replace(known, variation=measure_variation(frames, flows, noise), frame_noise=noise)
    for reduction in _REDUCTIONS:
        if blur_posterior(None, witnesses).width[1] <= _WIDEST * reduction / 2:
            break
        reduced = measure_variation(frames, flows, noise, reduction)
        if reduced is None:
            break
        witnesses = replace(witnesses, variation=reduced)
    return witnesses


def estimate_posterior(
    image: FloatArray,
    witnesses: BlurWitnesses,
    noise: NoiseSpectrum,
    runtime: Runtime = DEFAULT,
    exponent: float | None = None,
    cautious: bool = False,
) -> tuple[ImageEvidence | None, BlurPosterior]:
    """Estimate the blur of an image (H, W) of some noise; none is removed where it shows nothing.

    ``exponent`` is that of the transfer function, if it is given.  Where the image has two tones, they tell the width
    for that exponent.  Elsewhere the width is chosen for the exponent of the posterior, and is 0 where a loss is
    expected; what the image alone tells then has a say if the scene may have two tones.  ``cautious`` leaves that out,
    for callers who weigh it themselves.
    """
    evidence, variation = image_evidence(image, runtime), witnesses.variation
    ratio = None if variation is None else variation.with_power(image)
    by_theory = blur_posterior(evidence, witnesses, ratio)
    if evidence is None:
        return None, by_theory
    widths = [by_theory.by_displacement, by_theory.by_variation, by_theory.by_image, by_theory.width]
    facts = by_theory.air, by_theory.exponent, witnesses.displacement, witnesses.independent_frames
    features = blur_features(image, np.array(widths), variation, ratio, evidence, noise, facts)
    alone = evidence.estimate.sigma if evidence.estimate.blurred else 0.0
    shape = exponent or by_theory.exponent
    part = image if max(image.shape) <= 2 * PART else most_detailed(image, 2 * PART)
    tones = two_tones(part, noise, shape)
    if tones is not None and tones.clear:
        told = tones.quantiles
        return evidence, replace(by_theory, removed=tones.width, exponent=shape, width=told, by_tones=told)
    found = learnt_blur(features, by_theory.width, alone)
    removed = found.cautious if cautious else found.chosen(tones)
    return evidence, replace(by_theory, removed=removed, exponent=shape, width=found.width)


def blur_posterior(
    evidence: ImageEvidence | None, witnesses: BlurWitnesses, ratio: Float64Array | None = None
) -> BlurPosterior:
    """Combine the witnesses of the frames and of the fused image, whose spectrum over that of the mean is ``ratio``.

    Everything is counted in the pixels of the reduced frames, and the result in those of the image.
    """
    variation, diffraction = witnesses.variation, witnesses.diffraction
    scale = 1 if variation is None else variation.reduction
    grid = hypotheses(None if diffraction is None else diffraction / scale)
    prior = grid.prior.copy()
    # NaN counts as moving.
    if not witnesses.displacement < _STILL:
        prior[:, 0] -= _INTERPOLATED
    nothing = np.zeros_like(grid.width)
    of_air = displacement_likelihood(
        grid, witnesses.displacement, witnesses.independent_frames, scale, witnesses.spread
    )
    of_v = np.broadcast_to(of_air[:, None], grid.width.shape)
    of_s = nothing if variation is None else variation_likelihood(grid, variation)
    of_v, of_s = (np.maximum(one, one.max() - most) for one, most in ((of_v, EXCLUDED[0]), (of_s, EXCLUDED[1])))
    kappa = _sharper(grid, _normalised(prior + of_v + of_s), ratio)
    of_image = nothing if evidence is None else image_likelihood(grid, evidence, kappa, scale)
    weights = _normalised(prior + of_v + of_s + of_image)
    kappa = _sharper(grid, weights, ratio)

    def quantiles(likelihood: Float64Array) -> Float64Array:
        if np.ptp(likelihood) == 0:
            return np.full(len(_QUANTILES), np.nan)
        return _quantiles(kappa * scale * grid.width, _normalised(prior + likelihood))

    curves = np.array([np.interp(RINGS * kappa, RINGS, curve) for curve in grid.transfer.reshape(-1, len(RINGS))])
    mean = np.exp(weights.ravel() @ np.log(np.maximum(curves, LEAST_TRANSFER)))
    return BlurPosterior(
        removed=0.0,
        exponent=float(shapes(mean[None])[1][0]),
        width=_quantiles(kappa * scale * grid.width, weights),
        by_displacement=quantiles(of_v),
        by_variation=quantiles(of_s),
        by_image=quantiles(of_image),
        by_tones=np.full(len(_QUANTILES), np.nan),
        air=float(1 - weights[-1].sum()),
        edge_limited=False,
    )


def _sharper(grid: Hypotheses, weights: Float64Array, ratio: Float64Array | None) -> float:
    """κ, by the half frequencies of the mean transfer function with and without the ratio of the spectra."""
    if ratio is None:
        return 1.0
    mean = np.exp(np.tensordot(weights, np.log(np.maximum(grid.transfer, LEAST_TRANSFER))))
    (before, after), _ = shapes(np.clip(np.stack([mean, mean * ratio]), LEAST_TRANSFER, 1 - 1e-9))
    # Blurs of less than a pixel are not resolved by the ratio.
    return float(np.clip(after / before, 0.6, 1.1)) if mean[-1] < 0.5 and (mean * ratio)[-1] < 0.5 else 1.0


def _normalised(logs: Float64Array) -> Float64Array:
    weights = np.exp(logs - logs.max())
    return weights / weights.sum()


def _quantiles(widths: Float64Array, weights: Float64Array) -> Float64Array:
    order = np.argsort(widths, axis=None)
    return np.interp(_QUANTILES, np.cumsum(weights.ravel()[order]), widths.ravel()[order])


def displacement_likelihood(
    grid: Hypotheses, variance: float, independent_frames: float, scale: int, spread: float | None = None
) -> Float64Array:
    """Log likelihood of V, in pixels of the image, for every air in reduced pixels; 0 where V is not finite.

    ``spread`` is the standard deviation of ln V; by default that of an unknown outer scale.
    """
    if not np.isfinite(variance):
        return np.zeros(len(grid.prior))
    still, measured = variance < _STILL, max(variance, _LEAST_V) / scale**2
    if spread is None:
        spread = float(np.hypot(TILT_SPREAD, 1.4 / max(independent_frames, 1.0) ** 0.5))
    of_air = -0.5 * (np.log(measured / grid.expected_v) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi))
    return np.append(of_air, np.log(0.5 * still + 0.5 / _RANGE_OF_V))


def variation_likelihood(grid: Hypotheses, measured: SpectralVariation) -> Float64Array:
    """Log likelihood of s and s_4 for every hypothesis, mean over g and τ."""
    rings = clear_rings(measured)
    if len(rings) < 2:
        return np.zeros_like(grid.width)
    shares, shifts = (
        -0.5 * ((np.log(values) - middle) / spread) ** 2
        for values, (middle, spread) in ((_SHARES, SHARE_PRIOR), (_SHIFTS, SHIFT_PRIOR))
    )
    total = np.full(grid.width.shape, -np.inf)
    for share, of_share in zip(_SHARES, shares, strict=True):
        for shift, of_shift in zip(_SHIFTS, shifts, strict=True):
            likelihood = np.full(grid.width.shape, of_share + of_shift)
            for kind, (found, error) in enumerate(
                ((measured.amplitude, measured.amplitude_error), (measured.power, measured.power_error))
            ):
                predicted = expected(grid, kind, rings, share, shift, measured.stretch)
                noise = (_NOISE_ERROR[kind] / measured.signal[rings]) ** 2
                variance = error[rings] ** 2 + noise + (_MODEL_ERROR * predicted) ** 2 + _LEAST_ERROR**2
                misfit = (found[rings] - predicted) ** 2 / variance + np.log(variance)
                likelihood -= _RING_WEIGHT / 2 * misfit.sum(axis=-1)
            total = np.logaddexp(total, likelihood)
    return total


def expected(
    grid: Hypotheses, kind: int, rings: NDArray[np.int_], share: float, shift: float, stretch: float
) -> Float64Array:
    """Return s (kind 0) or s_4 (kind 1) of every hypothesis in some rings."""
    air = (grid.amplitude, grid.power)[kind][:, None, rings]
    stretched = _STRETCH[kind] * stretch**2 * np.log(np.maximum(grid.transfer[..., rings], 1e-4)) ** 2
    return share * air + stretched + _SHIFT[kind] * np.expm1((2 * np.pi * shift * RINGS[rings]) ** 2)


def clear_rings(measured: SpectralVariation) -> NDArray[np.int_]:
    """Return the rings from the first on in which the signal exceeds the noise."""
    clear = measured.signal > _CLEAR
    lost = np.flatnonzero(~clear[_FIRST_RING:])
    end = _FIRST_RING + lost[0] if len(lost) else len(RINGS)
    return np.arange(_FIRST_RING, min(end, _LAST_RING))


def image_likelihood(grid: Hypotheses, evidence: ImageEvidence, kappa: float, scale: int) -> Float64Array:
    """Log likelihood of the image for every hypothesis, mean over the softness of the scene."""
    curves = -np.minimum(GRADIENTS * (evidence.costs - evidence.costs.min()), EXCLUDED[2])
    place = np.interp(grid.exponent, EXPONENTS, np.arange(len(EXPONENTS)))
    low = np.minimum(place.astype(int), len(EXPONENTS) - 2)
    share, logs = place - low, np.log(evidence.widths)
    total = np.full(grid.width.shape, -np.inf)
    for softness, weight in _SOFTNESS:
        seen = np.log(np.hypot(kappa * scale * grid.width, softness))
        by_shape = np.array([np.interp(seen, logs, curve, right=-EXCLUDED[2]) for curve in curves])
        below, above = (np.take_along_axis(by_shape, (low + step)[None], 0)[0] for step in (0, 1))
        total = np.logaddexp(total, np.log(weight) + (1 - share) * below + share * above)
    return total

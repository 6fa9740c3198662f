"""Likelihood of every hypothesis on the blur by the displacement, by the variation of the spectra, and by the image.

Symbols and witnesses as in :mod:`turbrestore.blur.posterior`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .hypotheses import Hypotheses
from .image_evidence import EXPONENTS, ImageEvidence
from .short_exposure import TILT_SPREAD
from .spectral_variation import RINGS, SpectralVariation

Float64Array = NDArray[np.float64]

# V below which a scene stands still, squared pixels; range of ln V of air that does not blur, and the least V.
STILL = 0.03
_RANGE_OF_V, _LEAST_V = 7.0, 1e-3
# g and τ: values, and mean and standard deviation of the logarithm.
_SHARES, SHARE_PRIOR = np.exp([-2.2, -1.6, -1.1, -0.7, -0.3]), (-1.1, 0.5)
_SHIFTS, SHIFT_PRIOR = np.array([0.04, 0.1, 0.2, 0.3, 0.45]), (float(np.log(0.12)), 0.7)
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
EXCLUDED = (6.0, 8.0, 10.0)


def displacement_likelihood(
    known: Hypotheses, variance: float, frames: float, scale: int, spread: float | None = None
) -> Float64Array:
    """Log likelihood of V, in pixels of the image, for every air in reduced pixels; 0 where V is not known.

    ``spread`` is the standard deviation of ln V; by default that of an unknown outer scale.
    """
    if not np.isfinite(variance):
        return np.zeros(len(known.prior))
    still, measured = variance < STILL, max(variance, _LEAST_V) / scale**2
    if spread is None:
        spread = float(np.hypot(TILT_SPREAD, 1.4 / max(frames, 1.0) ** 0.5))
    of_air = -0.5 * (np.log(measured / known.expected_v) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi))
    return np.append(of_air, np.log(0.5 * still + 0.5 / _RANGE_OF_V))


def variation_likelihood(known: Hypotheses, measured: SpectralVariation) -> Float64Array:
    """Log likelihood of s and s_4 for every hypothesis, mean over g and τ."""
    rings = clear_rings(measured)
    if len(rings) < 2:
        return 0 * known.width
    shares, shifts = (
        -0.5 * ((np.log(values) - middle) / spread) ** 2
        for values, (middle, spread) in ((_SHARES, SHARE_PRIOR), (_SHIFTS, SHIFT_PRIOR))
    )
    total = np.full(known.width.shape, -np.inf)
    for share, of_share in zip(_SHARES, shares, strict=True):
        for shift, of_shift in zip(_SHIFTS, shifts, strict=True):
            likelihood = np.full(known.width.shape, of_share + of_shift)
            for kind, (found, error) in enumerate(
                ((measured.amplitude, measured.amplitude_error), (measured.power, measured.power_error))
            ):
                predicted = expected(known, kind, rings, share, shift, measured.stretch)
                noise = (_NOISE_ERROR[kind] / measured.signal[rings]) ** 2
                variance = error[rings] ** 2 + noise + (_MODEL_ERROR * predicted) ** 2 + _LEAST_ERROR**2
                misfit = (found[rings] - predicted) ** 2 / variance + np.log(variance)
                likelihood -= _RING_WEIGHT / 2 * misfit.sum(axis=-1)
            total = np.logaddexp(total, likelihood)
    return total


def expected(
    known: Hypotheses, kind: int, rings: NDArray[np.int_], share: float, shift: float, stretch: float
) -> Float64Array:
    """Return s (kind 0) or s_4 (kind 1) of every hypothesis in some rings."""
    air = (known.amplitude, known.power)[kind][:, None, rings]
    stretched = _STRETCH[kind] * stretch**2 * np.log(np.maximum(known.transfer[..., rings], 1e-4)) ** 2
    return share * air + stretched + _SHIFT[kind] * np.expm1((2 * np.pi * shift * RINGS[rings]) ** 2)


def clear_rings(measured: SpectralVariation) -> NDArray[np.int_]:
    """Return the rings from the first on in which the signal exceeds the noise."""
    clear = measured.signal > _CLEAR
    lost = np.flatnonzero(~clear[_FIRST_RING:])
    end = _FIRST_RING + lost[0] if len(lost) else len(RINGS)
    return np.arange(_FIRST_RING, min(end, _LAST_RING))


def image_likelihood(known: Hypotheses, evidence: ImageEvidence, kappa: float, scale: int) -> Float64Array:
    """Log likelihood of the image for every hypothesis, mean over the softness of the scene."""
    curves = -np.minimum(_GRADIENTS * (evidence.costs - evidence.costs.min()), EXCLUDED[2])
    place = np.interp(known.exponent, EXPONENTS, np.arange(len(EXPONENTS)))
    low = np.minimum(place.astype(int), len(EXPONENTS) - 2)
    share, logs = place - low, np.log(evidence.widths)
    total = np.full(known.width.shape, -np.inf)
    for softness, weight in _SOFTNESS:
        seen = np.log(np.hypot(kappa * scale * known.width, softness))
        by_shape = np.array([np.interp(seen, logs, curve, right=-EXCLUDED[2]) for curve in curves])
        below, above = (np.take_along_axis(by_shape, (low + step)[None], 0)[0] for step in (0, 1))
        total = np.logaddexp(total, np.log(weight) + (1 - share) * below + share * above)
    return total

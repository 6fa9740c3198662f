"""Hypotheses on the blur of a fused image: airs and lenses, their transfer functions and what is expected of them.

Symbols as in :mod:`turbrestore.blur.posterior`.  Where the optics are known, λ/D is theirs, and D/r0 is finer divided.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..psf import Float64Array, half_frequency
from .short_exposure import displacement_variance, short_exposures
from .spectral_variation import RINGS

# Hypotheses: D/r0, λ/D, about two standard deviations of its prior on either side, and σ_l; all chosen.
_STRENGTHS = np.geomspace(0.5, 7, 11)
_DIFFRACTIONS = np.geomspace(0.35, 4.5, 11)
_LENSES = np.array([0.2, 0.35, 0.5, 0.7, 0.9, 1.1, 1.35, 1.6, 1.9, 2.3, 2.8, 3.4, 4.2, 5.2, 6.5, 8.0, 10.0])
# D/r0 for one known λ/D, chosen.
_FINE_STRENGTHS = np.geomspace(0.5, 7, 41)
# Prior, chosen: usual λ/D and the deviation of its logarithm; share of air that does not blur; weights of the σ_l.
_USUAL_DIFFRACTION, _DIFFRACTION_SPREAD, _NO_BLUR = 1.4, 0.6, 0.05
_LENS_PRIOR = np.array([22, 16, 12, 9, 9, 9, 8, 7, 5, 4.5, 4, 3, 1.5, 1, 0.7, 0.5, 0.3])
# Least H of which a logarithm is taken, chosen.
LEAST_TRANSFER = 1e-5


@dataclass(frozen=True, eq=False)
class Hypotheses:
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


@functools.lru_cache(16)
def hypotheses(diffraction: float | None = None) -> Hypotheses:
    """Return all hypotheses, or those of one known λ/D, pixels."""
    strengths = _STRENGTHS if diffraction is None else _FINE_STRENGTHS
    diffractions = _DIFFRACTIONS if diffraction is None else np.array([diffraction])
    mean, amplitude, power = short_exposures(strengths, diffractions, RINGS)
    count = len(strengths) * len(diffractions)

    def with_none(values: Float64Array, none: float) -> Float64Array:
        return np.concatenate([values.reshape(count, -1), np.full((1, len(RINGS)), none)])

    lens = np.exp(-2 * (np.pi * _LENSES[:, None] * RINGS) ** 2)
    transfer = with_none(mean, 1.0)[:, None] * lens
    width, exponent = shapes(transfer)
    usual = np.exp(-0.5 * (np.log(diffractions / _USUAL_DIFFRACTION) / _DIFFRACTION_SPREAD) ** 2)
    air = np.tile((1 - _NO_BLUR) / len(strengths) * usual / usual.sum(), len(strengths))
    prior = np.append(air, _NO_BLUR)[:, None] * (_LENS_PRIOR / _LENS_PRIOR.sum())
    expected = displacement_variance(strengths[:, None], diffractions).ravel()
    return Hypotheses(
        transfer, width, exponent, with_none(amplitude, 0.0), with_none(power, 0.0), np.log(prior), expected
    )


def shapes(transfer: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Width and exponent of transfer functions (..., rings), by their half frequency and a line through ln(−ln H)."""
    depth = -np.log(np.clip(transfer, LEAST_TRANSFER, 1 - 1e-9)) / np.log(2)
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

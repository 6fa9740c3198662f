"""Short exposures through Kolmogorov turbulence: their mean transfer function, and how much they vary.

Symbols
-------
D : diameter of the aperture; r0 : Fried parameter; λ/D : diffraction, here in pixels
u : spatial frequency over that at which diffraction ends, ``u = ν λ/D``
H : mean transfer function of exposures without tilt, diffraction included
s, s_4 : variation of amplitudes and of powers, see :mod:`turbrestore.blur.witnesses.spectral_variation`

All three are functions of u and D/r0 alone.  ``short_exposure.csv`` holds them for a circular aperture, as means over a
thousand phase screens; ``python benchmarks/blur_calibration.py --table`` makes it.

The tilt that is taken out moves the image by ``c (D/r0)^(5/3) (λ/D)²`` squared pixels along an axis.  c is 0.182 for an
infinite outer scale, and 0.083 to 0.156 for one of 20 to 1000 apertures (:mod:`turbrestore.seeing.tilt_theory`).
"""

from __future__ import annotations

import functools
from importlib.resources import files

import numpy as np

from ..psf import Float64Array

# c for an outer scale between 20 and 1000 apertures: geometric mean, and standard deviation of its logarithm, in which
# the outer scale has a share of 0.32, and the error of a measured displacement the rest.
TILT, TILT_SPREAD = 0.114, 0.4
# Least s and s_4 whose logarithm is taken: the table has less at u = 0 only, by rounding.
_LEAST = 1e-7


def short_exposures(
    strengths: Float64Array, diffractions: Float64Array, frequencies: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return H, s and s_4 (strengths, diffractions, frequencies) for D/r0, λ/D in pixels, and cycles per pixel.

    s and s_4 are interpolated in log D/r0, and keep their last value beyond u = 1, where H is 0.
    """
    known, u, table = _table()
    results = []
    for number, values in enumerate(table):
        logs = values if number == 0 else np.log(np.maximum(values, _LEAST))
        place = np.clip(np.interp(np.log(strengths), np.log(known), np.arange(len(known))), 0, len(known) - 1)
        low = np.minimum(place.astype(int), len(known) - 2)
        share = (place - low)[:, None]
        curves = (1 - share) * logs[low] + share * logs[low + 1]
        at = diffractions[:, None] * frequencies
        last = 0.0 if number == 0 else None
        sampled = np.array([np.interp(at, u, curve, right=last) for curve in curves])
        results.append(sampled if number == 0 else np.exp(sampled))
    return results[0], results[1], results[2]


def displacement_variance(strength: Float64Array, diffraction: Float64Array) -> Float64Array:
    """Variance of the displacement along one axis, squared pixels.

    Examples
    --------
    >>> displacement_variance(np.array([1.0]), np.array([2.0])).round(3).tolist()
    [0.456]
    """
    return TILT * strength ** (5 / 3) * diffraction**2


@functools.cache
def _table() -> tuple[Float64Array, Float64Array, Float64Array]:
    """Values of D/r0 and of u, and H, s and s_4 as an array (3, D/r0, u)."""
    text = files("turbrestore.blur.witnesses").joinpath("short_exposure.csv").read_text("utf-8")
    rows = np.array([[float(cell) for cell in line.split(",")] for line in text.splitlines()[1:]])
    strengths, u = np.unique(rows[:, 0]), np.unique(rows[:, 1])
    return strengths, u, rows[:, 2:].reshape(len(strengths), len(u), 3).transpose(2, 0, 1)

"""Theory of imaging through turbulence and reference implementations that only tests need."""

import numpy as np
from scipy import special

from turbrestore.synthesis.atmosphere import phase_spectrum
from turbrestore.synthesis.phase_screen import Turbulence, draw_screen, sample_lattice

# D_φ(r) = 6.884 (r/r0)^(5/3).
STRUCTURE = 2 * (24 / 5 * special.gamma(6 / 5)) ** (5 / 6)


def structure_function(separation, r0, outer_scale, inner_scale=0.0):
    """Structure function of the phase, ``D_φ(r) = 4π ∫ Φ(f) (1 − J0(2π f r)) f df``, rad².

    Without an inner scale it is 6.884 (r/r0)^(5/3) for r far below L0, and twice the variance far above.
    """
    r = np.asarray(separation, np.float64)
    f = frequencies(outer_scale, inner_scale, float(np.min(r[r > 0], initial=outer_scale)) / 30)
    power = phase_spectrum(f, r0, outer_scale, inner_scale) * f
    values = [np.trapezoid(power * (1 - special.j0(2 * np.pi * f * s)) * f, np.log(f)) for s in r.ravel()]
    return 4 * np.pi * np.reshape(values, r.shape)


def frequencies(outer_scale, inner_scale, finest):
    """Logarithmic grid from where the spectrum is flat to where it, or its factor in an integral, has vanished."""
    highest = 1 / finest if inner_scale == 0 else min(1 / finest, 4 / inner_scale)
    return np.geomspace(1e-3 / outer_scale, max(highest, 10 / outer_scale), 6000)


def sample_path(screen, x, y):
    """Difference of optical path of a phase screen at any points, m: lattice plus every plane wave."""
    u, v = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    phases = np.multiply.outer(u, screen.frequencies[:, 0]) + np.multiply.outer(v, screen.frequencies[:, 1])
    smooth = (np.exp(-2j * np.pi * phases) @ screen.waves).real
    (flat,) = sample_lattice(screen, [screen.path], u.reshape(1, -1), v.reshape(1, -1))
    return np.asarray(smooth + flat.reshape(u.shape), np.float32)


def small_turbulence(params, seed, points, across):
    """Path whose square lattices have few points a side, with some across an aperture: cheap to draw."""
    rng, layers = np.random.default_rng(seed), params.path()
    screens = []
    for layer in layers:
        aperture, scales = layer.shrink * params.aperture, (params.outer_scale, params.inner_scale)
        optics = {"wavelength": params.wavelength, "aperture": aperture}
        screens.append(draw_screen(points, aperture / across, layer.r0, *scales, rng, **optics))
    return Turbulence(params, layers, tuple(screens))


def tilt_covariance(layers, aperture, wavelength, outer_scale, inner_scale=0.0, angle=(0.0, 0.0), lag=0.0):
    """Covariance of the tilts about x and about y of two points of the scene, the second seen ``lag`` later, rad².

    Each layer adds ``(2λ/πD)² 16π ∫ Φ(f) (J2(πγDf)/πγDf)² (J0(2πfs) ∓ J2(2πfs) cos 2ψ) f df``, where s at angle ψ is
    the distance of the two cones in the drifting layer: Noll's (1976) filter of Zernike tilt, and Taylor's frozen flow.
    """
    total = np.zeros(2)
    for layer in layers:
        diameter = layer.shrink * aperture
        f = frequencies(outer_scale, inner_scale, diameter / 30)
        x = np.pi * diameter * f
        power = phase_spectrum(f, layer.r0, outer_scale, inner_scale) * (special.jv(2, x) / x) ** 2 * f
        shift = np.multiply(angle, layer.distance) - np.multiply(layer.velocity, lag)
        s, psi = np.hypot(*shift), np.arctan2(shift[1], shift[0])
        even, odd = special.j0(2 * np.pi * f * s), special.jv(2, 2 * np.pi * f * s) * np.cos(2 * psi)
        total += [np.trapezoid(power * bessel * f, np.log(f)) for bessel in (even - odd, even + odd)]
    return total * 16 * np.pi * (2 * wavelength / (np.pi * aperture)) ** 2


def diffraction_mtf(frequency, aperture, wavelength):
    """Modulation transfer function of a circular aperture at the angular frequencies ν, cycles/rad.

    ``(2/π) (arccos u − u √(1 − u²))`` with u = λν/D; 0 beyond u = 1.
    """
    u = np.clip(np.abs(frequency) * wavelength / aperture, 0, 1)
    return 2 / np.pi * (np.arccos(u) - u * np.sqrt(1 - u**2))


def long_exposure_mtf(frequency, aperture, wavelength, r0):
    """Fried's (1966) long-exposure transfer function: diffraction times ``exp(−3.44 (λν/r0)^(5/3))``, for L0 = ∞."""
    spread = frequency * wavelength / r0
    return diffraction_mtf(frequency, aperture, wavelength) * np.exp(-STRUCTURE / 2 * spread ** (5 / 3))


def short_exposure_mtf(frequency, aperture, wavelength, r0):
    """Fried's (1966) short-exposure transfer function: ``exp(−3.44 (λν/r0)^(5/3) (1 − (λν/D)^(1/3)))`` instead.

    It takes tilt and the rest of the phase to be independent; at D/r0 = 2 the exact mean is up to 0.04 larger.
    """
    rest = np.maximum(1 - np.cbrt(frequency * wavelength / aperture), 0)
    exponent = STRUCTURE / 2 * (frequency * wavelength / r0) ** (5 / 3) * rest
    return diffraction_mtf(frequency, aperture, wavelength) * np.exp(-exponent)

"""Physical parameters of a turbulent path, and what theory predicts from them.

Symbols
-------
L : distance from the aperture to the scene; z : distance of a layer from the aperture, m.
D : diameter of the circular aperture, m.  λ : wavelength, m.  k = 2π/λ.
Cn² : refractive-index structure constant, m^(-2/3).
r0 : Fried parameter, m; of a spherical wave unless said otherwise.
L0, l0 : outer and inner scale, m.
f : spatial frequency, cycles per metre.  ν : angular frequency, cycles per radian.
Φ : power spectrum of the phase, rad² m².  D_φ : structure function of the phase, rad².
γ : 1 − z/L, by which the cone from the aperture to a point of the scene has shrunk at a layer.

Conventions
-----------
Φ(f) = 0.0229 r0^(-5/3) (f² + 1/L0²)^(-11/6) exp(−(f/f_m)²), f_m = 5.92/(2π l0): von Kármán's spectrum with the inner
scale of Tatarskii (Schmidt, *Numerical Simulation of Optical Wave Propagation*, 2010, section 9.2).

Tilt is that of the plane fitted to the phase over the aperture by least squares (Zernike tilt).  Its variance about
one axis is 0.182 (D/r0)^(5/3) (λ/D)² for L0 = ∞ and l0 = 0: 4/π² times Noll's 0.449 (D/r0)^(5/3) rad².  The mean
gradient (angle of arrival) has 0.170 instead.  A finite outer scale takes much of it away, and slowly: for a plane wave
the constant is 0.112 at L0 = 50 D, 0.149 at 500 D and 0.170 at 10⁴ D.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from ..core.errors import ConfigurationError, require, require_between

Float64Array = NDArray[np.float64]
Wave = Literal["spherical", "plane"]

# 0.4230 in r0^(-5/3) = 0.423 k² ∫ Cn² dz follows from D_φ = 2.914 k² r^(5/3) ∫ Cn² dz = 6.884 (r/r0)^(5/3).
_FRIED = 0.423
_STRUCTURE = 2 * (24 / 5 * special.gamma(6 / 5)) ** (5 / 6)
_SPECTRUM = (_STRUCTURE / 2) * special.gamma(11 / 6) ** 2 / (2 * np.pi ** (11 / 3))
# D/r0 of a spherical wave.
STRENGTHS = {"weak": 1.2, "medium": 2.5, "strong": 5.0}
# Intervals of the quadrature over log frequency.
_QUADRATURE = 6000


@dataclass(frozen=True)
class Layer:
    """Thin layer of turbulence that drifts with the wind.

    Attributes
    ----------
    distance : float
        z, from the aperture, m.
    shrink : float
        γ = 1 − z/L.
    r0 : float
        Fried parameter of a plane wave through this layer alone, m, at the wavelength of the path.
    velocity : (float, float)
        Wind (x to the right, y down) across the line of sight, m/s.
    """

    distance: float
    shrink: float
    r0: float
    velocity: tuple[float, float]


@dataclass(frozen=True)
class PhaseScreenParams:
    """A horizontal path of constant Cn², and the optics that look along it.

    At most one of ``cn2``, ``r0`` and ``d_over_r0`` is given (none means D/r0 = 2.5), and at most one of ``ifov`` and
    ``nyquist`` (none means nyquist = 1).

    Parameters
    ----------
    distance : float
        From the aperture to the scene, m.
    aperture : float
        Diameter of the aperture, m.
    wavelength : float
        At which r0 holds and grey scenes are seen, m.
    channel_wavelengths : (float, float, float)
        Of red, green and blue, m.
    cn2 : float, optional
        Refractive-index structure constant, m^(-2/3).
    r0 : float, optional
        Fried parameter of a spherical wave from the scene, m.
    d_over_r0 : float, optional
        Aperture over r0.
    inner_scale : float
        Size of the smallest eddies, m; 0 is none.
    outer_scale : float
        Size of the largest, m.
    layers : int
        Thin layers that stand for the path.
    wind : tuple of float
        Speed across the line of sight, m/s: one for all layers, or one a layer from the aperture on (on the command
        line the option is given once for each).
    wind_direction : tuple of float
        Degrees from the right downwards: one for all layers, or one a layer.
    ifov : float, optional
        Angle of a pixel, rad.
    nyquist : float, optional
        λ/2D over the angle of a pixel: 1 samples the optics just finely enough, 0.5 half as finely.
    pupil_samples : int
        Samples across the aperture.
    field_spacing : int
        Pixels between the field points that have a point spread function of their own.
    """

    distance: float = 2000.0
    aperture: float = 0.1
    wavelength: float = 550e-9
    channel_wavelengths: tuple[float, float, float] = (610e-9, 540e-9, 460e-9)
    cn2: float | None = None
    r0: float | None = None
    d_over_r0: float | None = None
    inner_scale: float = 0.005
    outer_scale: float = 5.0
    layers: int = 5
    wind: tuple[float, ...] = (1.0,)
    wind_direction: tuple[float, ...] = (0.0,)
    ifov: float | None = None
    nyquist: float | None = None
    pupil_samples: int = 32
    field_spacing: int = 16

    def __post_init__(self) -> None:
        require_between("distance", self.distance, 1, 1e6, "m")
        require_between("aperture", self.aperture, 1e-4, 100, "m")
        for wavelength in (self.wavelength, *self.channel_wavelengths):
            require_between("wavelength", wavelength, 1e-7, 1e-4, "m")
        self._check_strength()
        require_between("outer_scale", self.outer_scale, 2 * self.aperture, 1e6, "m, twice the aperture or more")
        require_between("inner_scale", self.inner_scale, 0, self.aperture, "m, the aperture at most")
        require_between("layers", self.layers, 1, 50)
        for name, values in (("wind", self.wind), ("wind_direction", self.wind_direction)):
            require(
                len(values) in (1, self.layers),
                f"{name}: expected one value, or one for each of {self.layers} layers, found {len(values)}",
            )
            for value in values:
                require_between(name, value, -1000, 1000)
        self._check_sampling()

    def _check_strength(self) -> None:
        given = {name: getattr(self, name) for name in ("cn2", "r0", "d_over_r0")}
        given = {name: value for name, value in given.items() if value is not None}
        require(len(given) <= 1, f"{', '.join(given)}: expected at most one of cn2, r0 and d_over_r0")
        for name, value in given.items():
            _positive(name, value)
        require_between("d_over_r0", self.strength, 1e-3, 50)

    def _check_sampling(self) -> None:
        require(self.ifov is None or self.nyquist is None, "ifov, nyquist: expected at most one of them")
        finest, coarsest = (self.wavelength / (2 * self.aperture * factor) for factor in (10, 0.05))
        if self.ifov is not None:
            require_between("ifov", self.ifov, finest, coarsest, "rad")
        if self.nyquist is not None:
            require_between("nyquist", self.nyquist, 0.05, 10)
        require_between("field_spacing", self.field_spacing, 2, 1000, "pixels")
        least = int(np.ceil(2 * self.psf_radius))
        require_between("pupil_samples", self.pupil_samples, max(least, 8), 256, f"at D/r0 = {self.strength:.3g}")

    @property
    def fried(self) -> float:
        """r0 of a spherical wave, m."""
        if self.cn2 is not None:
            return fried_parameter(self.cn2, self.distance, self.wavelength)
        if self.r0 is not None:
            return self.r0
        return self.aperture / (STRENGTHS["medium"] if self.d_over_r0 is None else self.d_over_r0)

    @property
    def strength(self) -> float:
        """D/r0."""
        return self.aperture / self.fried

    @property
    def pixel_angle(self) -> float:
        """Angle of a pixel, rad."""
        if self.ifov is not None:
            return self.ifov
        factor = 1.0 if self.nyquist is None else self.nyquist
        return self.wavelength / (2 * self.aperture * factor)

    @property
    def psf_radius(self) -> float:
        """Half the width of the window that holds a point spread function, in λ/D: rings of diffraction, and seeing."""
        return 4 + 1.5 * self.strength

    def path(self) -> tuple[Layer, ...]:
        """Layers of the path, nearest to the aperture first.

        Returns
        -------
        tuple of Layer
        """
        speeds = np.broadcast_to(self.wind, self.layers)
        angles = np.deg2rad(np.broadcast_to(self.wind_direction, self.layers))
        velocities = [(float(s * np.cos(a)), float(s * np.sin(a))) for s, a in zip(speeds, angles, strict=True)]
        return path_layers(self.distance, self.fried, velocities)

    def tilt_rms(self) -> float:
        """Give the standard deviation of the displacement along one axis that theory expects, pixels.

        Returns
        -------
        float

        Examples
        --------
        >>> round(PhaseScreenParams(d_over_r0=2.5).tilt_rms(), 2)
        1.48
        """
        scales = (self.outer_scale, self.inner_scale)
        variances = tilt_covariance(self.path(), self.aperture, self.wavelength, *scales)
        return float(np.sqrt(variances[0])) / self.pixel_angle


def fried_parameter(cn2: float, distance: float, wavelength: float, wave: Wave = "spherical") -> float:
    """Fried parameter of a path of constant Cn²: ``r0 = (0.423 k² Cn² L c)^(-3/5)``.

    c is 1 for a plane wave and 3/8, the mean of γ^(5/3), for a spherical wave from a point of the scene (Fried 1966).

    Parameters
    ----------
    cn2 : float
        m^(-2/3).
    distance : float
        L, m.
    wavelength : float
        λ, m.
    wave : {"spherical", "plane"}

    Returns
    -------
    float
        m.

    Raises
    ------
    ConfigurationError
        A value is not positive.

    Examples
    --------
    >>> round(fried_parameter(1e-15, 2000.0, 550e-9), 4)
    0.1071
    """
    for name, value in (("cn2", cn2), ("distance", distance), ("wavelength", wavelength)):
        _positive(name, value)
    share = {"spherical": 3 / 8, "plane": 1.0}[wave]
    return float((_FRIED * (2 * np.pi / wavelength) ** 2 * cn2 * distance * share) ** (-3 / 5))


def path_layers(
    distance: float, r0: float, velocities: Sequence[tuple[float, float]], wave: Wave = "spherical"
) -> tuple[Layer, ...]:
    """Cut a path of constant Cn² into equal slices, one thin layer in the middle of each.

    Parameters
    ----------
    distance : float
        L, m.
    r0 : float
        Fried parameter of the whole path, m.
    velocities : sequence of (float, float)
        Wind of each layer, nearest to the aperture first, m/s.
    wave : {"spherical", "plane"}

    Returns
    -------
    tuple of Layer
        ``Σ γ^(5/3) r0_i^(-5/3)`` is r0^(-5/3): each layer is as strong as its slice.

    Raises
    ------
    ConfigurationError
        A length is not positive, or there is no layer.

    Examples
    --------
    >>> layers = path_layers(1000.0, 0.05, [(1.0, 0.0)] * 2)
    >>> [layer.distance for layer in layers], round(sum((l.shrink / l.r0) ** (5 / 3) for l in layers) ** -0.6, 6)
    ([250.0, 750.0], 0.05)
    """
    _positive("distance", distance)
    _positive("r0", r0)
    count = len(velocities)
    require(count >= 1, "velocities: expected at least one layer, found none")
    edges = 1 - np.arange(count + 1) / count
    shares = edges[:-1] ** (8 / 3) - edges[1:] ** (8 / 3) if wave == "spherical" else np.full(count, 1 / count)
    layers = []
    for index, (share, velocity) in enumerate(zip(shares, velocities, strict=True)):
        z = distance * (index + 0.5) / count
        shrink = 1 - z / distance if wave == "spherical" else 1.0
        layers.append(Layer(z, shrink, float(r0 * shrink * share ** (-3 / 5)), velocity))
    return tuple(layers)


def phase_spectrum(frequency: ArrayLike, r0: float, outer_scale: float, inner_scale: float) -> Float64Array:
    """Von Kármán's power spectrum of the phase, Φ.

    Parameters
    ----------
    frequency : array_like
        f, cycles/m.
    r0, outer_scale, inner_scale : float
        m; an inner scale of 0 is none.

    Returns
    -------
    ndarray, float64, shape of ``frequency``
        rad² m²: its integral over the plane is the variance of the phase.

    Examples
    --------
    >>> float(phase_spectrum(1.0, 0.1, 1e6, 0.0).round(3))
    1.063
    """
    f2 = np.square(np.asarray(frequency, np.float64))
    cut = (2 * np.pi * inner_scale / 5.92) ** 2
    return _SPECTRUM * r0 ** (-5 / 3) * (f2 + outer_scale**-2) ** (-11 / 6) * np.exp(-f2 * cut)


def structure_function(separation: ArrayLike, r0: float, outer_scale: float, inner_scale: float = 0.0) -> Float64Array:
    """Structure function of the phase, ``D_φ(r) = 4π ∫ Φ(f) (1 − J0(2π f r)) f df``.

    Without an inner scale it is 6.884 (r/r0)^(5/3) for r far below L0, and twice the variance far above.

    Parameters
    ----------
    separation : array_like
        r, m.
    r0, outer_scale, inner_scale : float
        m.

    Returns
    -------
    ndarray, float64, shape of ``separation``
        rad².

    Examples
    --------
    >>> float(structure_function(0.1, 0.1, 1e5).round(1))
    6.8
    """
    r = np.asarray(separation, np.float64)
    f = _frequencies(outer_scale, inner_scale, float(np.min(r[r > 0], initial=outer_scale)) / 30)
    power = phase_spectrum(f, r0, outer_scale, inner_scale) * f
    values = [np.trapezoid(power * (1 - special.j0(2 * np.pi * f * s)) * f, np.log(f)) for s in r.ravel()]
    return 4 * np.pi * np.reshape(values, r.shape)


def tilt_covariance(
    layers: Sequence[Layer],
    aperture: float,
    wavelength: float,
    outer_scale: float,
    inner_scale: float = 0.0,
    angle: tuple[float, float] = (0.0, 0.0),
    lag: float = 0.0,
) -> Float64Array:
    """Covariance of the tilts of two points of the scene, the second seen ``lag`` later.

    Each layer adds ``(2λ/πD)² 16π ∫ Φ(f) (J2(πγDf)/πγDf)² (J0(2πfs) ∓ J2(2πfs) cos 2ψ) f df``, where s at angle ψ is
    how far apart the two cones meet the drifting layer: Noll's (1976) filter of Zernike tilt, and Taylor's frozen flow.

    Parameters
    ----------
    layers : sequence of Layer
    aperture : float
        D, m.
    wavelength : float
        λ, at which the layers' r0 holds, m.
    outer_scale, inner_scale : float
        m.
    angle : (float, float)
        From the first point to the second (x, y), rad.
    lag : float
        s.

    Returns
    -------
    ndarray, float64, shape (2,)
        Of the tilts about x and about y, rad²; with no angle and no lag the variances.

    Examples
    --------
    >>> one = (Layer(0.0, 1.0, 0.04, (0.0, 0.0)),)
    >>> variance = tilt_covariance(one, 0.1, 550e-9, outer_scale=1e6)[0]
    >>> round(float(variance) / ((0.1 / 0.04) ** (5 / 3) * (550e-9 / 0.1) ** 2), 3)
    0.181
    """
    total = np.zeros(2)
    for layer in layers:
        diameter = layer.shrink * aperture
        f = _frequencies(outer_scale, inner_scale, diameter / 30)
        x = np.pi * diameter * f
        power = phase_spectrum(f, layer.r0, outer_scale, inner_scale) * (special.jv(2, x) / x) ** 2 * f
        shift = np.multiply(angle, layer.distance) - np.multiply(layer.velocity, lag)
        s, psi = np.hypot(*shift), np.arctan2(shift[1], shift[0])
        even, odd = special.j0(2 * np.pi * f * s), special.jv(2, 2 * np.pi * f * s) * np.cos(2 * psi)
        total += [np.trapezoid(power * bessel * f, np.log(f)) for bessel in (even - odd, even + odd)]
    return total * 16 * np.pi * (2 * wavelength / (np.pi * aperture)) ** 2


def diffraction_mtf(frequency: ArrayLike, aperture: float, wavelength: float) -> Float64Array:
    """Modulation transfer function of a circular aperture without aberrations.

    Parameters
    ----------
    frequency : array_like
        ν, cycles/rad.
    aperture, wavelength : float
        m.

    Returns
    -------
    ndarray, float64, shape of ``frequency``
        ``(2/π) (arccos u − u √(1 − u²))`` with u = λν/D; 0 beyond u = 1.

    Examples
    --------
    >>> diffraction_mtf([0.0, 0.5 / 5.5e-6, 2e5], 0.1, 550e-9).round(3)
    array([1.   , 0.391, 0.   ])
    """
    u = np.clip(np.abs(np.asarray(frequency, np.float64)) * wavelength / aperture, 0, 1)
    return 2 / np.pi * (np.arccos(u) - u * np.sqrt(1 - u**2))


def long_exposure_mtf(frequency: ArrayLike, aperture: float, wavelength: float, r0: float) -> Float64Array:
    """Fried's (1966) long-exposure transfer function: diffraction times ``exp(−3.44 (λν/r0)^(5/3))``.

    Parameters
    ----------
    frequency : array_like
        ν, cycles/rad.
    aperture, wavelength, r0 : float
        m.

    Returns
    -------
    ndarray, float64, shape of ``frequency``
        For an infinite outer scale; in general the exponent is ``−D_φ(λν)/2``.

    Examples
    --------
    >>> float(long_exposure_mtf(0.5 / 5.5e-6, 0.1, 550e-9, r0=0.05).round(4))
    0.0125
    """
    spread = np.asarray(frequency, np.float64) * wavelength / r0
    return diffraction_mtf(frequency, aperture, wavelength) * np.exp(-_STRUCTURE / 2 * spread ** (5 / 3))


def short_exposure_mtf(frequency: ArrayLike, aperture: float, wavelength: float, r0: float) -> Float64Array:
    """Fried's (1966) short-exposure transfer function, in the near field.

    Diffraction times ``exp(−3.44 (λν/r0)^(5/3) (1 − (λν/D)^(1/3)))``.  It takes tilt and what is left of the phase for
    independent; at D/r0 = 2 the exact mean lies up to 0.04 above it, at middle frequencies.

    Parameters
    ----------
    frequency : array_like
        ν, cycles/rad.
    aperture, wavelength, r0 : float
        m.

    Returns
    -------
    ndarray, float64, shape of ``frequency``

    Examples
    --------
    >>> float(short_exposure_mtf(0.5 / 5.5e-6, 0.1, 550e-9, r0=0.05).round(4))
    0.1922
    """
    nu = np.abs(np.asarray(frequency, np.float64))
    left = 1 - np.cbrt(nu * wavelength / aperture)
    exponent = _STRUCTURE / 2 * (nu * wavelength / r0) ** (5 / 3) * np.maximum(left, 0)
    return diffraction_mtf(nu, aperture, wavelength) * np.exp(-exponent)


def _frequencies(outer_scale: float, inner_scale: float, finest: float) -> Float64Array:
    """Logarithmic grid from where the spectrum is flat to where it, or what it is multiplied by, has vanished."""
    highest = 1 / finest if inner_scale == 0 else min(1 / finest, 4 / inner_scale)
    return np.geomspace(1e-3 / outer_scale, max(highest, 10 / outer_scale), _QUADRATURE)


def _positive(name: str, value: float) -> None:
    if not 0 < value < np.inf:
        raise ConfigurationError(f"{name}: expected a positive number, found {value:g}")

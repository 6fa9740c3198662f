"""Physical parameters of a turbulent path, and theory that follows from them.

Symbols
-------
L : distance from the aperture to the scene; z : distance of a layer from the aperture, m.
D : diameter of the circular aperture, m.  λ : wavelength, m.  k = 2π/λ.
Cn² : refractive-index structure constant, m^(-2/3).
r0 : Fried parameter of a spherical wave unless stated otherwise, m.
L0, l0 : outer and inner scale, m.
f : spatial frequency, cycles per metre.
Φ : power spectrum of the phase, rad² m².
γ : 1 − z/L, by which the cone from the aperture to a point of the scene has narrowed at a layer.

Conventions
-----------
Φ(f) = 0.0229 r0^(-5/3) (f² + 1/L0²)^(-11/6) exp(−(f/f_m)²), f_m = 5.92/(2π l0): von Kármán's spectrum with the inner
scale of Tatarskii (Schmidt, *Numerical Simulation of Optical Wave Propagation*, 2010, section 9.2).

Tilt is that of the plane fitted to the phase over the aperture by least squares (Zernike tilt).  Its variance about
one axis is 0.182 (D/r0)^(5/3) (λ/D)² for L0 = ∞ and l0 = 0: 4/π² times Noll's 0.449 (D/r0)^(5/3) rad².  The mean
gradient (angle of arrival) has 0.170 instead.  A finite outer scale reduces it considerably: for a plane wave the
constant is 0.112 at L0 = 50 D, 0.149 at 500 D and 0.170 at 10⁴ D.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import ConfigurationError, require, require_between

Float64Array = NDArray[np.float64]

# The structure function 2.914 k² r^(5/3) ∫ Cn² dz = 6.884 (r/r0)^(5/3) implies r0^(-5/3) = 0.423 k² ∫ Cn² dz.
_FRIED = 0.423
_STRUCTURE = 2 * (24 / 5 * math.gamma(6 / 5)) ** (5 / 6)
_SPECTRUM = (_STRUCTURE / 2) * math.gamma(11 / 6) ** 2 / (2 * np.pi ** (11 / 3))
# Names of D/r0 of a spherical wave, chosen.
STRENGTHS = {"weak": 1.2, "medium": 2.5, "strong": 5.0}
# Nodes of the quadrature over log frequency: with an eighth of them the variance of the tilt changes by less than 1e-9.
_QUADRATURE = 6000


@dataclass(frozen=True)
class Layer:
    """Thin layer of turbulence that drifts with the wind."""

    distance: float  # z, from the aperture, m
    shrink: float  # γ = 1 − z/L
    r0: float  # Fried parameter of a plane wave through this layer alone, at the wavelength of the path, m
    velocity: tuple[float, float]  # wind (x to the right, y down) across the line of sight, m/s


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
        Wavelength of r0 and of grey scenes, m.
    channel_wavelengths : (float, float, float)
        Wavelengths of red, green and blue, m.
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
        Number of thin layers that represent the path.
    wind : tuple of float
        Speed across the line of sight, m/s: one for all layers, or one a layer from the aperture on (on the command
        line the option is given once for each).
    wind_direction : tuple of float
        Degrees from the right downwards: one for all layers, or one a layer.
    ifov : float, optional
        Angle of a pixel, rad.
    nyquist : float, optional
        λ/2D over the angle of a pixel: 1 is critical sampling of the optics, 0.5 half as fine.
    pupil_samples : int
        Samples across the aperture.
    field_spacing : int
        Pixels between the field points at which point spread functions are computed.
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
        """Half width of the window of a point spread function, in λ/D: diffraction rings plus seeing."""
        return 4 + 1.5 * self.strength

    def path(self) -> tuple[Layer, ...]:
        """Cut the path of constant Cn² into equal slices, with one thin layer in the middle of each.

        Returns
        -------
        tuple of Layer
            Nearest to the aperture first; ``Σ γ^(5/3) r0_i^(-5/3)`` is r0^(-5/3), because each layer is as strong as
            its slice.

        Examples
        --------
        >>> layers = PhaseScreenParams(distance=1000.0, r0=0.05, layers=2).path()
        >>> [layer.distance for layer in layers], round(sum((l.shrink / l.r0) ** (5 / 3) for l in layers) ** -0.6, 6)
        ([250.0, 750.0], 0.05)
        """
        speeds = np.broadcast_to(self.wind, self.layers)
        angles = np.deg2rad(np.broadcast_to(self.wind_direction, self.layers))
        edges = 1 - np.arange(self.layers + 1) / self.layers
        shares = edges[:-1] ** (8 / 3) - edges[1:] ** (8 / 3)
        layers = []
        for index, (share, speed, angle) in enumerate(zip(shares, speeds, angles, strict=True)):
            z = self.distance * (index + 0.5) / self.layers
            shrink = 1 - z / self.distance
            r0 = float(self.fried * shrink * share ** (-3 / 5))
            layers.append(Layer(z, shrink, r0, (float(speed * np.cos(angle)), float(speed * np.sin(angle)))))
        return tuple(layers)

    def tilt_rms(self) -> float:
        """Compute the expected standard deviation of the displacement along one axis, pixels.

        Returns
        -------
        float

        Examples
        --------
        >>> round(PhaseScreenParams(d_over_r0=2.5).tilt_rms(), 2)
        1.48
        """
        scales = (self.outer_scale, self.inner_scale)
        return float(np.sqrt(tilt_variance(self.path(), self.aperture, self.wavelength, *scales))) / self.pixel_angle


def fried_parameter(cn2: float, distance: float, wavelength: float, cone: float = 3 / 8) -> float:
    """Fried parameter of a path of constant Cn²: ``r0 = (0.423 k² Cn² L c)^(-3/5)`` (Fried 1966)."""
    for name, value in (("cn2", cn2), ("distance", distance), ("wavelength", wavelength)):
        _positive(name, value)
    return float((_FRIED * (2 * np.pi / wavelength) ** 2 * cn2 * distance * cone) ** (-3 / 5))


def phase_spectrum(frequency: ArrayLike, r0: float, outer_scale: float, inner_scale: float) -> Float64Array:
    """Von Kármán's power spectrum of the phase, Φ."""
    f2 = np.square(np.asarray(frequency, np.float64))
    cut = (2 * np.pi * inner_scale / 5.92) ** 2
    return _SPECTRUM * r0 ** (-5 / 3) * (f2 + outer_scale**-2) ** (-11 / 6) * np.exp(-f2 * cut)


def tilt_variance(
    layers: Sequence[Layer], aperture: float, wavelength: float, outer_scale: float, inner_scale: float = 0.0
) -> float:
    """Variance of the tilt about one axis.

    Each layer adds ``(2λ/πD)² 16π ∫ Φ(f) (J2(πγDf)/πγDf)² f df``, with Noll's (1976) filter of Zernike tilt.
    """
    from scipy.special import jv

    total = 0.0
    for layer in layers:
        diameter = layer.shrink * aperture
        # From where the spectrum is flat to where the integrand has vanished.
        highest = 30 / diameter if inner_scale == 0 else min(30 / diameter, 4 / inner_scale)
        f = np.geomspace(1e-3 / outer_scale, max(highest, 10 / outer_scale), _QUADRATURE)
        x = np.pi * diameter * f
        power = phase_spectrum(f, layer.r0, outer_scale, inner_scale) * (jv(2, x) / x) ** 2 * f
        total += float(np.trapezoid(power * f, np.log(f)))
    return total * 16 * np.pi * (2 * wavelength / (np.pi * aperture)) ** 2


def _positive(name: str, value: float) -> None:
    if not 0 < value < np.inf:
        raise ConfigurationError(f"{name}: expected a positive number, found {value:g}")

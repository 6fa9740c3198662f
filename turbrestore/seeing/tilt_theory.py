"""Differential tilt of a turbulent path: the theory that turns displacements into Cn², r0 and D/r0.

Symbols
-------
L : distance from the aperture to the scene; z : place on the path, from the aperture, m.
D : diameter of the aperture, m.  λ : wavelength, m.  k = 2π/λ.  ψ : angle of a pixel, rad.
γ : width of the cone of light at z over D: 1 − z/L for a spherical wave, 1 for a plane wave.
f : spatial frequency at z, cycles/m; f_a is its component along axis a.
Φ : spectrum of the phase of a slice of thickness dz, rad² m².
b : side of the window over which a displacement is the mean, pixels.  Δ : separation of two blocks, pixels.

Derivation
----------
A wave of phase ``exp(2πi f·x)`` tilts the wavefront by λ f_a, of which the share ``R = 8 J2(πγfD)/(πγfD)²`` is in the
plane fitted over the aperture (Zernike tilt; Noll 1976), and γ of that is seen as angle of arrival.  The mean over a
block of b pixels filters the displacement by ``sinc(f_x ψzb) sinc(f_y ψzb)``.  Two blocks that lie Δ pixels apart
differ in displacement along axis a by

    D_a(Δ) = 2 ∫ dz γ² λ² ∫ f_a² Φ(f) R² sinc² sinc² (1 − cos 2πψz f·Δ) d²f / ψ²   (mean square, pixels²).

The difference vanishes at low frequency: unlike the whole displacement, D does not depend on the outer scale, on a
shaken camera, or on what the mean geometry takes away.  It is proportional to Cn², so the variance of the blocks about
their mean, which is half the mean of D over their pairs, gives Cn² with no other constant.

The whole displacement has the variance ``0.182 (D/r0)^(5/3) (λ/D)²`` without an outer scale; with one of 20 D to
1000 D the constant is 0.083 to 0.156 for a plane wave.  Without the distance, this is all that can be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigurationError, require, require_between
from ..synthesis.atmosphere import Layer, fried_parameter, phase_spectrum, tilt_variance

Float64Array = NDArray[np.float64]

PATHS = ("spherical", "plane")
# Mean of γ^(5/3) over the path.
MEAN_CONE = {"spherical": 3 / 8, "plane": 1.0}
# Nodes along the path, over the angle of a quarter of the plane, and over log frequency: twice as many change the
# differences of three paths by at most 0.6 %.
_SLICES, _ANGLES, _FREQUENCIES = 16, 24, 300
# Larger than any that matters to differences over a field of view, m.
_NO_OUTER_SCALE = 1e6
# Outer scales, in apertures, between which that of an unknown path is taken to lie: least, usual and largest; chosen.
_OUTER_SCALES = (20.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Optics:
    """Camera and path of a clip.

    Parameters
    ----------
    pixel_scale : float
        ψ, rad.
    aperture : float
        D, m.
    wavelength : float
        λ, m.
    distance : float, optional
        L, from the aperture to the scene, m: with it Cn² is known, and D/r0 much better.
    path : {"spherical", "plane"}
        Spherical where the turbulence fills the path to the scene, plane where the scene lies far beyond it; then
        ``distance`` is the length of the turbulent path.

    Raises
    ------
    ConfigurationError
        A value is out of range.

    Examples
    --------
    >>> Optics(pixel_scale=2.75e-6, aperture=0.1, wavelength=550e-9, distance=2000.0).path
    'spherical'
    """

    pixel_scale: float
    aperture: float
    wavelength: float = 550e-9
    distance: float | None = None
    path: Literal["spherical", "plane"] = "spherical"

    def __post_init__(self) -> None:
        require_between("pixel_scale", self.pixel_scale, 1e-10, 0.1, "rad")
        require_between("aperture", self.aperture, 1e-4, 100, "m")
        require_between("wavelength", self.wavelength, 1e-7, 1e-4, "m")
        if self.distance is not None:
            require_between("distance", self.distance, 1, 1e6, "m")
        require(self.path in PATHS, f"path: expected one of {', '.join(PATHS)}, found {self.path!r}")

    @property
    def diffraction(self) -> float:
        """λ/D, pixels."""
        return self.wavelength / (self.aperture * self.pixel_scale)


def known_optics(
    pixel_scale: float | None,
    aperture: float | None,
    wavelength: float,
    distance: float | None,
    path: Literal["spherical", "plane"] = "spherical",
) -> Optics | None:
    """Join what is known of the optics; None if nothing is."""
    if pixel_scale is None and aperture is None and distance is None:
        return None
    if pixel_scale is None or aperture is None:
        given = {"distance": distance, "pixel_scale": pixel_scale, "aperture": aperture}
        name = next(name for name, value in given.items() if value is not None)
        missing = "the angle of a pixel" if pixel_scale is None else "the aperture"
        raise ConfigurationError(f"{name}: expected {missing} as well, found none; r0 needs both")
    return Optics(pixel_scale, aperture, wavelength, distance, path)


def displacement_differences(optics: Optics, spacing: float, counts: tuple[int, int], window: float) -> Float64Array:
    """Mean square difference of the displacements of blocks, for a Cn² of 1 m^(-2/3).

    Returns (rows, columns, 2).
    """
    from scipy.special import jv

    require(optics.distance is not None, "distance: expected that of the scene, found none")
    distance = float(optics.distance or 0.0)
    nodes, weights = np.polynomial.legendre.leggauss(_SLICES)
    angles = (np.arange(_ANGLES) + 0.5) * (np.pi / 2 / _ANGLES)
    total = np.zeros((*counts, 2))
    for z, thickness in zip(distance * (nodes + 1) / 2, distance * weights / 2, strict=True):
        cone = (1 - z / distance if optics.path == "spherical" else 1.0) * optics.aperture
        pixel = optics.pixel_scale * z
        f = np.geomspace(1e-3 / (pixel * spacing * max(counts) + cone), 30 / cone, _FREQUENCIES)
        x, y = (f[:, None] * part(angles) for part in (np.cos, np.sin))
        phase = np.pi * cone * f
        response = cone / optics.aperture * optics.wavelength * 8 * jv(2, phase) / phase**2
        r0 = fried_parameter(1.0, thickness, optics.wavelength, 1.0)
        # d²f = f df dangle, and df = f d(log f).
        power = response**2 * phase_spectrum(f, r0, _NO_OUTER_SCALE, 0.0) * f**2 * np.log(f[1] / f[0])
        mean = (2 * np.pi / _ANGLES * power)[:, None] * (np.sinc(x * pixel * window) * np.sinc(y * pixel * window)) ** 2
        rows, columns = (
            np.cos(2 * np.pi * pixel * spacing * np.arange(count)[:, None] * part.ravel())
            for count, part in zip(counts, (y, x), strict=True)
        )
        for axis, component in enumerate((x, y)):
            density = (component**2 * mean).ravel()
            total[..., axis] += 2 * (density.sum() - (rows * density) @ columns.T)
    return total / optics.pixel_scale**2


def strength_of_tilt(variance: float, optics: Optics) -> tuple[float, float, float]:
    """D/r0 from the whole displacement, when the distance is not known."""
    found = []
    for scale in (_OUTER_SCALES[1], _OUTER_SCALES[2], _OUTER_SCALES[0]):
        aperture = optics.aperture
        one = tilt_variance((Layer(0.0, 1.0, aperture, (0.0, 0.0)),), aperture, optics.wavelength, scale * aperture)
        found.append(float((variance * optics.pixel_scale**2 / one) ** (3 / 5)))
    return found[0], found[1], found[2]

"""The pupil of the camera: the phase over it, and the resulting point spread functions.

Symbols
-------
D, λ, γ, z : as in :mod:`turbrestore.synthesis.atmosphere`.  S : phase screen, m.
θ : field angle, rad.  ρ : position in the pupil, m.  v : wind of a layer, m/s.  t : time, s.
φ_θ(ρ) = (2π/λ) Σ_layers S(γρ + zθ − vt) : phase over the pupil, for spherical waves.
h_θ(u) : point spread function ``|∫ exp(iφ_θ − 2πi ρ·u/λ) dρ|²`` of the phase without its tilt; sums to 1.
h_0, h_k : mean of the h_θ in some turbulence, and their principal components; the h_k sum to 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from .atmosphere import Float64Array, PhaseScreenParams
from .phase_screen import Turbulence, sample_lattice

ComplexArray = NDArray[np.complex64]

# The waves have little curvature over the pupil; components below this share of the largest are left out; chosen.
_BEND_TOLERANCE = 1e-3
# Times and places from which components are found, least share of the variance that they keep, and most of them; all
# chosen.
_SAMPLED_INSTANTS, _SAMPLED_POINTS = 16, 32
_KEPT_VARIANCE, _MOST_COMPONENTS = 0.99, 32


@dataclass(frozen=True, eq=False)
class Pupil:
    """Samples of a circular aperture, and the curvature of the plane waves of each screen over it."""

    mask: NDArray[np.bool_]  # (N, N): mask of the P samples inside the aperture
    # (P,): positions ρ of these samples, m.
    x: Float64Array
    y: Float64Array
    planes: FloatArray  # (3, P): orthonormal basis of piston and tilts
    # For each layer, ``exp(−2πi γ f·ρ)`` of each wave without its piston and tilt, as a product of two factors.
    bends: tuple[tuple[NDArray[np.complex128], FloatArray], ...]


def pupil_mask(params: PhaseScreenParams) -> NDArray[np.bool_]:
    """Mask of the samples of the grid over the pupil that lie inside the aperture.

    Returns (N, N).
    """
    axis = _axis(params)
    return np.hypot(axis[:, None], axis) <= 0.5


def sample_pupil(turbulence: Turbulence) -> Pupil:
    """Sample the aperture and the plane waves of the screens over it."""
    params = turbulence.params
    mask = pupil_mask(params)
    axis = _axis(params) * params.aperture
    x, y = (grid[mask] for grid in np.meshgrid(axis, axis))
    planes = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))[0].T
    bends = []
    for layer, screen in zip(turbulence.layers, turbulence.screens, strict=True):
        waves = np.exp(-2j * np.pi * layer.shrink * (screen.frequencies @ np.stack([x, y])))
        waves -= (waves @ planes.T) @ planes
        weighed = waves * np.abs(screen.waves)[:, None]
        sizes, basis = _principal_directions(np.concatenate([weighed.real, weighed.imag]))
        basis = basis[sizes > _BEND_TOLERANCE * sizes[0]]
        bends.append((waves @ basis.T, basis.astype(np.float32)))
    return Pupil(mask, x, y, planes.astype(np.float32), tuple(bends))


def tilt_free_path(
    turbulence: Turbulence, pupil: Pupil, x: Float64Array, y: Float64Array, drift: Float64Array
) -> FloatArray:
    """Difference of optical path over the pupil without its piston and tilt, at several field points.

    ``x, y`` (F,); ``drift`` (layers, 2); returns (F, P).
    """
    total = np.zeros((len(x), len(pupil.x)), np.float32)
    for number, (layer, screen) in enumerate(zip(turbulence.layers, turbulence.screens, strict=True)):
        scale = layer.distance * turbulence.params.pixel_angle
        centres = np.stack([scale * x - drift[number, 0], scale * y - drift[number, 1]], axis=1)
        at_x, at_y = (centres[:, :1] + layer.shrink * pupil.x, centres[:, 1:] + layer.shrink * pupil.y)
        total += sample_lattice(screen, [screen.path], at_x, at_y)[0]
        bends, basis = pupil.bends[number]
        turned = np.exp(-2j * np.pi * (centres @ screen.frequencies.T)) * screen.waves
        total += (turned @ bends).real.astype(np.float32) @ basis
    return np.subtract(total, (total @ pupil.planes.T) @ pupil.planes, dtype=np.float32)


def point_spread_functions(
    path: FloatArray, mask: NDArray[np.bool_], wavelength: float, params: PhaseScreenParams
) -> FloatArray:
    """Point spread functions of differences of optical path over the pupil, sampled by the pixels of the camera.

    If pixels are coarser than λ/2D, the intensity is averaged over each of them.
    ``path`` (F, P); ``mask`` (N, N); returns (F, K, K).
    """
    transform, parts = _transform(wavelength, params)
    field = np.zeros((len(path), *mask.shape), np.complex64)
    field[:, mask] = np.exp(path * np.complex64(2j * np.pi / wavelength))
    spread = transform @ field @ transform.T
    intensity = spread.real**2 + spread.imag**2
    width = len(transform) // parts
    if parts > 1:
        intensity = intensity.reshape(-1, width, parts, width, parts).sum(axis=(2, 4))
    return intensity / intensity.sum(axis=(1, 2), keepdims=True)


def psf_basis(
    turbulence: Turbulence, pupil: Pupil, wavelength: float, shape: tuple[int, ...], rng: np.random.Generator
) -> FloatArray:
    """Mean of the point spread functions at random places of the screens, and their principal components.

    Returns (1 + r, K, K): the mean sums to 1, the components are orthonormal, and each sums to 0.
    """
    half_height, half_width = (size / 2 for size in shape[:2])
    samples = []
    for _ in range(_SAMPLED_INSTANTS):
        drift = rng.uniform(0, 1000, (len(turbulence.layers), 2))
        x, y = rng.uniform(-1, 1, (2, _SAMPLED_POINTS)) * [[half_width], [half_height]]
        path = tilt_free_path(turbulence, pupil, x, y, drift)
        samples.append(point_spread_functions(path, pupil.mask, wavelength, turbulence.params))
    stack = np.concatenate(samples).astype(np.float64)
    mean = stack.mean(axis=0)
    centred = (stack - mean).reshape(len(stack), -1)
    sizes, components = _principal_directions(centred)
    shares = np.cumsum(sizes**2) / max(np.sum(sizes**2), np.finfo(np.float64).tiny)
    rank = min(int(np.searchsorted(shares, _KEPT_VARIANCE)) + 1, _MOST_COMPONENTS)
    return np.concatenate([mean[None], components[:rank].reshape(rank, *mean.shape)]).astype(np.float32)


def _axis(params: PhaseScreenParams) -> Float64Array:
    """Positions of the samples along a side of the pupil, in diameters."""
    return (np.arange(params.pupil_samples) + 0.5) / params.pupil_samples - 0.5


def _transform(wavelength: float, params: PhaseScreenParams) -> tuple[ComplexArray, int]:
    """Matrix from the samples of the pupil to the window of the image, and the number of its rows per pixel."""
    pixel = params.pixel_angle
    widest = max(params.wavelength, *params.channel_wavelengths)
    radius = max(int(np.ceil(params.psf_radius * widest / params.aperture / pixel)), 1)
    # An odd number of parts includes the middle of the pixel.
    parts = 2 * int(np.ceil((pixel / (params.wavelength / (2 * params.aperture)) - 1 - 1e-9) / 2)) + 1
    count = (2 * radius + 1) * parts
    angles = (np.arange(count) - (count - 1) / 2) * (pixel / parts)
    axis = _axis(params) * params.aperture
    return np.exp(-2j * np.pi / wavelength * np.outer(angles, axis)).astype(np.complex64), parts


def _principal_directions(rows: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Singular values of a matrix above zero, largest first, and their right singular vectors."""
    wide = rows.shape[0] < rows.shape[1]
    # The smaller Gram matrix is many times faster than the decomposition, and accurate to 1e-6 of the largest value.
    values, vectors = np.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)
    kept = np.flatnonzero(values > 1e-12 * max(values[-1], np.finfo(np.float64).tiny))[::-1]
    sizes, vectors = np.sqrt(values[kept]), vectors[:, kept]
    return sizes, (vectors / sizes).T @ rows if wide else vectors.T

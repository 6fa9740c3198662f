"""Random phase screens of von Kármán statistics, as differences of optical path.

Symbols
-------
Φ : power spectrum of :func:`turbrestore.synthesis.atmosphere.phase_spectrum`; f : frequency, cycles/m.
P : period of the lattice, m.  w(f) = 1 − exp(−(f P/2)⁴) : share of Φ that the lattice carries.

A Fourier lattice of period P has no frequencies below 1/P, and around 1/P the spectrum is so steep that the value in
the middle of a cell does not represent the cell.  The spectrum is therefore divided.  w Φ, which is smooth on the scale
1/P, is assigned to a lattice (filtered white noise), and the rest, (1 − w) Φ, to plane waves.  Every wave represents
one stratum of the plane (ring × sector): it has the power of the stratum and a frequency drawn inside it with density
Φ.  The expected structure function is therefore exact, unlike that of the usual sub-harmonics at fixed frequencies
(Lane, Glindemann and Dainty 1992).  The waves never repeat.  The lattice repeats after P, and its axes are rotated
against the wind so that the same points are not seen again.

The lattice is interpolated bilinearly.  On the default path, whose lattice points are γD/32 apart, this removes 14 % of
the structure function over one such step, 3 % over four, and nothing over sixteen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, special
from scipy.interpolate import make_interp_spline

from ..core.arrays import FloatArray
from ..core.errors import require
from .atmosphere import Float64Array, Layer, PhaseScreenParams, phase_spectrum

# The lattice takes over from the waves about two cells from the origin, by the fourth power; both chosen.
_CROSSOVER = 2.0
_STEEPNESS = 4
# Strata of the waves, chosen: the expected structure function is exact for any number.  Points along a side of the
# lattice, chosen as well.
_RINGS_PER_DECADE = 7
_SECTORS = 12
_SMALLEST_SCREEN, _LARGEST_SCREEN = 512, 2048
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
# Waves vary so slowly over the field of view that a spline through every 8th pixel is accurate to 1e-3.
_WAVE_SPACING = 8


@dataclass(frozen=True, eq=False)
class PhaseScreen:
    """Difference of optical path over an unbounded plane, and its slope averaged over an aperture."""

    path: FloatArray  # (n, n): lattice part, m
    # (2, n, n): tilt (x, y) of the plane fitted to the lattice part over the aperture around each point, rad.
    slopes: FloatArray
    spacing: float  # between lattice points, m
    axes: Float64Array  # (2, 2): rows are the unit vectors of the lattice in the coordinates of the scene
    frequencies: Float64Array  # (m, 2): of the plane waves, cycles/m, in the coordinates of the scene
    # (m,): amplitudes, m: the wave is ``Re(a exp(−2πi f·x))``, that is Re a cos + Im a sin.
    waves: NDArray[np.complex128]
    # (2, m): amplitudes of the tilts of the waves over the aperture, in the same form, rad.
    wave_slopes: NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Turbulence:
    """Layers of a path, each with a phase screen."""

    params: PhaseScreenParams
    layers: tuple[Layer, ...]
    screens: tuple[PhaseScreen, ...]

    def drift(self, time: float) -> Float64Array:
        """Displacement of each layer by the wind.

        Returns (layers, 2).
        """
        return np.array([layer.velocity for layer in self.layers]) * time


def draw_screen(
    size: int,
    spacing: float,
    r0: float,
    outer_scale: float,
    inner_scale: float,
    rng: np.random.Generator,
    *,
    wavelength: float,
    aperture: float,
    turn: float = 0.0,
) -> PhaseScreen:
    """Draw a phase screen."""
    require(size >= 8, f"size: expected at least 8 points, found {size}")
    period = size * spacing
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along, across = fft.rfftfreq(size, spacing), fft.fftfreq(size, spacing)[:, None]
    f = np.hypot(along, across)
    power = phase_spectrum(f, r0, outer_scale, inner_scale) * _lattice_share(f, period)
    amplitude = (np.sqrt(power) * (size / period * wavelength / (2 * np.pi))).astype(np.float32)
    spectrum = fft.rfft2(rng.standard_normal((size, size), dtype=np.float32)) * amplitude
    path = fft.irfft2(spectrum, s=(size, size))
    spectrum *= (2j * np.pi * _tilt_response(f * aperture)).astype(np.complex64)
    slopes = np.empty((2, size, size), np.float32)
    for axis in range(2):
        component = (axes[0, axis] * along + axes[1, axis] * across).astype(np.float32)
        slopes[axis] = fft.irfft2(spectrum * component, s=(size, size))
    frequencies, waves = _draw_waves(period, r0, outer_scale, inner_scale, rng)
    waves *= wavelength / (2 * np.pi)
    response = _tilt_response(np.hypot(*frequencies.T) * aperture)
    wave_slopes = -2j * np.pi * frequencies.T * response * waves
    return PhaseScreen(path, slopes, spacing, axes, frequencies, waves, wave_slopes)


def draw_turbulence(params: PhaseScreenParams, shape: tuple[int, ...], rng: np.random.Generator) -> Turbulence:
    """Draw a phase screen for every layer, larger than the field of view, so that nothing repeats within it."""
    layers, scales, screens = params.path(), (params.outer_scale, params.inner_scale), []
    for number, layer in enumerate(layers):
        diameter = layer.shrink * params.aperture
        width = float(np.hypot(shape[0], shape[1])) * params.pixel_angle * layer.distance + diameter
        finest = max(diameter / params.pupil_samples, params.inner_scale / 4, width / _LARGEST_SCREEN)
        size = max(_SMALLEST_SCREEN, fft.next_fast_len(int(width / finest), real=True))
        turn = np.arctan2(layer.velocity[1], layer.velocity[0]) + (number + 1) * _GOLDEN_ANGLE
        screens.append(
            draw_screen(
                size, finest, layer.r0, *scales, rng, wavelength=params.wavelength, aperture=diameter, turn=turn
            )
        )
    return Turbulence(params, layers, tuple(screens))


def tilt_flow(turbulence: Turbulence, x: Float64Array, y: Float64Array, drift: Float64Array) -> FloatArray:
    """Compute the displacement by tilt on a grid of pixels.

    ``drift`` (layers, 2); returns (h, w, 2).
    """
    angle = turbulence.params.pixel_angle
    (node_x, to_x), (node_y, to_y) = _spline(x), _spline(y)
    flow = np.zeros((len(y), len(x), 2), np.float32)
    smooth = np.zeros((2, len(node_y), len(node_x)))
    for layer, screen, shift in zip(turbulence.layers, turbulence.screens, drift, strict=True):
        scale = layer.distance * angle
        at_x, at_y = np.broadcast_arrays(scale * x - shift[0], (scale * y - shift[1])[:, None])
        for axis, slope in enumerate(sample_lattice(screen, screen.slopes, at_x, at_y)):
            flow[..., axis] += np.float32(layer.shrink) * slope
        across = np.exp(-2j * np.pi * np.outer(screen.frequencies[:, 0], scale * node_x - shift[0]))
        down = np.exp(-2j * np.pi * np.outer(scale * node_y - shift[1], screen.frequencies[:, 1]))
        for axis in range(2):
            smooth[axis] += layer.shrink * ((down * screen.wave_slopes[axis]) @ across).real
    for axis in range(2):
        flow[..., axis] += to_y @ smooth[axis].astype(np.float32) @ to_x.T
    return flow / np.float32(angle)


def sample_lattice(
    screen: PhaseScreen, planes: Iterable[FloatArray], x: Float64Array, y: Float64Array
) -> list[FloatArray]:
    """Interpolate planes on the lattice, bilinear and periodic.

    ``planes`` (n, n) each; ``x, y`` (a, b); returns (a, b) each.
    """
    size = len(screen.path)
    maps = []
    for axis in screen.axes / screen.spacing:
        position = axis[0] * x + axis[1] * y
        # Whole periods are subtracted in double precision; single precision is enough for the remainder.
        position -= size * np.floor(position.flat[0] / size)
        maps.append(position.astype(np.float32))
    return [cv2.remap(plane, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for plane in planes]


def _tilt_response(cycles: Float64Array) -> Float64Array:
    """Share of a wave's slope in the plane fitted over an aperture, ``8 J2(πfD)/(πfD)²`` (Noll 1976), from f D."""
    x = np.maximum(np.pi * cycles, 1e-2)
    # J2 by recurrence, because SciPy has fast routines for J0 and J1 only.
    return 8 * (2 * special.j1(x) / x - special.j0(x)) / x**2


def _lattice_share(f: Float64Array, period: float) -> Float64Array:
    return -np.expm1(-((f * period / _CROSSOVER) ** _STEEPNESS))


def _draw_waves(
    period: float, r0: float, outer_scale: float, inner_scale: float, rng: np.random.Generator
) -> tuple[Float64Array, NDArray[np.complex128]]:
    """Frequencies and amplitudes (rad), one wave for each stratum of half the plane, which suffices for real waves."""
    # Beyond the last ring the waves have less than 1e-7 of Φ; within the first Φ is flat and causes no tilt.
    last = 2 * _CROSSOVER / period
    first = min(0.05 / outer_scale, last / 10)
    count = int(np.ceil(_RINGS_PER_DECADE * np.log10(last / first)))
    edges = np.concatenate([[0.0], np.geomspace(first, last, count)])
    f = np.concatenate([[0.0], np.geomspace(first / 100, last, 4000)])
    density = 2 * np.pi * f * phase_spectrum(f, r0, outer_scale, inner_scale) * (1 - _lattice_share(f, period))
    below = np.concatenate([[0.0], np.cumsum(np.diff(f) * (density[1:] + density[:-1]) / 2)])
    at_edges = np.interp(edges, f, below)
    power = np.diff(at_edges)[:, None] / _SECTORS
    shape = (count, _SECTORS)
    radius = np.interp(at_edges[:-1, None] + rng.random(shape) * np.diff(at_edges)[:, None], below, f)
    angle = (np.arange(_SECTORS) + rng.random(shape)) * np.pi / _SECTORS
    frequencies = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    amplitudes = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * np.sqrt(power)
    return frequencies, amplitudes.ravel()


def _spline(pixels: Float64Array) -> tuple[Float64Array, FloatArray]:
    """Nodes that span the pixels, and the matrix of cubic spline interpolation from the nodes to the pixels."""
    count = max(4, int(np.ceil(np.ptp(pixels) / _WAVE_SPACING)) + 1)
    nodes = np.linspace(pixels[0], max(pixels[-1], pixels[0] + 1), count)
    return nodes, make_interp_spline(nodes, np.eye(count))(pixels).astype(np.float32)

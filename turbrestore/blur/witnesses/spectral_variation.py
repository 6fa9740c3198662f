"""How much the spectra of registered frames vary: what the air does to their blur, whatever the scene.

Symbols
-------
X, H_t, N_t : spectra of the scene, of the blur of frame t and of its noise in a window; ``F_t = X H_t + N_t``
s : ``Var F / |E F|² = E|H|² / |E H|² − 1``, what the mean of the frames loses against single frames (von der Lühe,
    J. Opt. Soc. Am. A 1, 510, 1984)
s_4 : ``Var |F|² / (E |F|²)²``, the same of powers, which a shift of a window does not change
ε : root mean square of the derivatives of the flow, by which registration stretches a blur

The scene cancels in both ratios.  Both are means over a ring of frequencies and over windows that are weighted by their
power.  The ratios must not contain the noise.  At the highest frequencies, at which no signal is left, whatever varies
is noise, and white noise is interpolated by the registration, which tells the rest of its spectrum.  Smooth noise has
more at low frequencies, as the flat parts of the frames show (:mod:`turbrestore.registration.registered_noise`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...core.noise_spectrum import NoiseSpectrum
from ...registration.warp import sample_splines
from ...runtime.image_stacks import spline_planes
from ...runtime.scratch import drop_pages
from ..psf import Float64Array

# Side of a window, and pixels around it that are left out at the border of the image; both chosen.
SIDE, _BORDER = 64, 16
# Most windows along an axis, and most frames, for their cost.
_WINDOWS, _FRAMES = 5, 48
# Fewest frames that are compared, chosen.
_FEWEST = 4
# Frames by whose flows white noise is warped, and highest rings, at which no signal is left; both chosen.
_NOISE_FRAMES, _NOISE_RINGS = 4, 4
# Least power of the noise: a standard deviation of 10⁻⁴ under the window, about what rounding to 12 bits leaves.
_LEAST_NOISE = 1e-8 * SIDE**2 * 9 / 64
# Frequencies of the rings, cycles per pixel.
RINGS: Float64Array = np.arange(SIDE // 2 + 1) / SIDE
# The derivative of a flow is taken behind a Gaussian of this standard deviation, pixels, chosen.
_SMOOTH = 2.0


@dataclass(frozen=True, eq=False)
class SpectralVariation:
    """Variation of the spectra of registered frames.  Arrays have one value for each of ``RINGS``.

    ``amplitude`` is s and ``power`` is s_4, with their standard errors; ``signal`` is the ratio of the power of the
    scene to that of the noise in a frame, ``mean_power`` the power of the mean of the frames without its noise, and
    ``stretch`` is ε; ``noise_power`` is the power of the noise of one of the
    ``frames``, which were reduced by the factor ``reduction`` before.
    """

    amplitude: Float64Array
    amplitude_error: Float64Array
    power: Float64Array
    power_error: Float64Array
    signal: Float64Array
    mean_power: Float64Array
    noise_power: Float64Array
    stretch: float
    frames: int
    reduction: int

    def with_power(self, image: FloatArray) -> Float64Array:
        """Amplitude spectrum of an image of the same scene over that of the mean of the frames."""
        own = window_power(luminance(image), self.reduction) - self.noise_power / self.frames
        ratio = np.sqrt(np.clip(np.maximum(own, 1e-12) / np.maximum(self.mean_power, 1e-12), 0.04, 25.0))
        lost = np.flatnonzero(self.signal[2:] < 2)
        if len(lost):
            # Where noise is stronger than the scene, the last ratio that is known goes on.
            ratio[2 + lost[0] :] = ratio[1 + lost[0]]
        return ratio


def measure_variation(
    frames: FloatArray, flows: FloatArray, noise: NoiseSpectrum, reduction: int = 1
) -> SpectralVariation | None:
    """Measure how the spectra of frames (T, H, W[, 3]) vary that are registered by flows (T, H, W, 2), pixels.

    ``noise`` is that of a registered frame.  None if there are fewer than four frames that show a window, or if the
    reduced image has no room for one.
    """
    height, width = (length // reduction for length in frames.shape[1:3])
    corners = _corners(height, width)
    if len(frames) < _FEWEST or not corners:
        return None
    picked = np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).round().astype(int)
    rng, sums, stretches, responses = np.random.default_rng(0), [], [], []
    every = -(-len(picked) // _NOISE_FRAMES)
    for top, left in corners:
        spectra, white = [], []
        for count, number in enumerate(picked):
            found = _around(frames[number], flows[number], top, left, reduction)
            if found is None:
                continue
            plane, flow = found
            spectra.append(_spectrum(_warped(plane, flow)))
            if count % every == 0:
                white.append(_spectrum(_warped(rng.standard_normal(plane.shape).astype(np.float32), flow)))
                smooth = cv2.GaussianBlur(flow, (0, 0), _SMOOTH)
                stretches.append(float(np.mean([np.square(np.diff(smooth, axis=axis)).mean() for axis in (0, 1)])))
        if len(spectra) >= _FEWEST and white:
            sums.append(_sums(np.array(spectra)))
            responses.append(_by_ring(np.square(np.abs(np.array(white))).mean(axis=0)))
        drop_pages(frames)
        drop_pages(flows)
    if not sums:
        return None
    response = np.mean(responses, axis=0)
    # Means of pixels keep the power of the noise for each area, and spectra here are not normalised.
    smooth_noise = noise.certain.at(RINGS / reduction) / reduction**2 * np.square(window_weights()).sum()
    white_noise = response * float(np.median((np.mean(sums, axis=0)[0] / response)[-_NOISE_RINGS:]))
    power = np.maximum(np.maximum(white_noise, smooth_noise), _LEAST_NOISE)
    return _ratios(np.array(sums), power, len(picked), float(np.mean(stretches)), reduction)


def window_power(image: FloatArray, reduction: int = 1) -> Float64Array:
    """Mean power spectrum of an image (H, W) over the windows of :func:`measure_variation`, by ring."""
    height, width = (length // reduction for length in image.shape)
    parts = [
        _reduced(image, top, left, SIDE, reduction)[_BORDER:-_BORDER, _BORDER:-_BORDER]
        for top, left in _corners(height, width)
    ]
    return np.mean([_by_ring(np.square(np.abs(_transform(_windowed(part))))) for part in parts], axis=0)


def _corners(height: int, width: int) -> list[tuple[int, int]]:
    """Corners of windows spread evenly over an image, with a border around each."""

    def starts(length: int) -> list[int]:
        room = length - SIDE - 2 * _BORDER
        if room < 0:
            return []
        count = min(_WINDOWS, 1 + room // (SIDE // 2))
        return [int(_BORDER + start) for start in np.linspace(0, room, count).round()]

    return [(top, left) for top in starts(height) for left in starts(width)]


def _reduced(stack: FloatArray, top: int, left: int, side: int, factor: int) -> FloatArray:
    """Part of an image around a window, reduced by a factor: the window and its border."""
    rows, columns = (slice((start - _BORDER) * factor, (start + side + _BORDER) * factor) for start in (top, left))
    part = np.ascontiguousarray(stack[rows, columns])
    if factor == 1:
        return part
    return cv2.resize(part, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)


def _around(
    frame: FloatArray, flow: FloatArray, top: int, left: int, factor: int
) -> tuple[FloatArray, FloatArray] | None:
    """Luminance of a frame in and around what a window shows, and the flow from there, both in reduced pixels.

    The place of the part takes the whole pixels of the mean flow, which a camera may add.  None beyond the frame.
    """
    moved = _reduced(flow, top, left, SIDE, factor) / np.float32(factor)
    whole = np.rint(cv2.mean(moved)[:2])
    row, column = top + int(whole[1]), left + int(whole[0])
    ends = ((row, frame.shape[0]), (column, frame.shape[1]))
    if any(start < _BORDER or (start + SIDE + _BORDER) * factor > length for start, length in ends):
        return None
    return luminance(_reduced(frame, row, column, SIDE, factor)), moved - whole.astype(np.float32)


def _warped(plane: FloatArray, flow: FloatArray) -> FloatArray:
    """Warp a part of a frame, which has been checked as a whole."""
    return sample_splines(spline_planes(plane), flow)


def _spectrum(plane: FloatArray) -> NDArray[np.complex64]:
    return _transform(_windowed(plane[_BORDER:-_BORDER, _BORDER:-_BORDER]))


def _transform(window: FloatArray) -> NDArray[np.complex64]:
    return cv2.dft(window, flags=cv2.DFT_COMPLEX_OUTPUT).view(np.complex64)[..., 0]


def _windowed(part: FloatArray) -> FloatArray:
    return (part - part.mean()) * window_weights()


@functools.cache
def window_weights() -> FloatArray:
    """Weights (SIDE, SIDE) of a window, which fall to zero beyond it."""
    profile = np.hanning(SIDE + 2)[1:-1].astype(np.float32)
    return np.outer(profile, profile)


@functools.cache
def _rings() -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Ring of every frequency of a window, and the number of frequencies in each ring."""
    nu = np.fft.fftfreq(SIDE)
    ring = np.rint(np.hypot(nu[:, None], nu) * SIDE).astype(int).ravel()
    return ring, np.bincount(ring, minlength=len(RINGS))[: len(RINGS)]


def _by_ring(values: NDArray[np.float32]) -> Float64Array:
    ring, count = _rings()
    return np.bincount(ring, values.ravel(), minlength=len(RINGS))[: len(RINGS)] / count


def _sums(spectra: NDArray[np.complex64]) -> Float64Array:
    """Sum up one window, so that the ratios follow once the noise is known; rows of values by ring."""
    count, power = len(spectra), np.square(np.abs(spectra))
    mean_power, spread = power.mean(axis=0), power.var(axis=0, ddof=1)
    variance = spectra.var(axis=0, ddof=1)
    coherent = np.square(np.abs(spectra.mean(axis=0))) - variance / count
    square = np.square(mean_power) - spread / count
    return np.array([_by_ring(part) for part in (variance, coherent, mean_power, square, spread)])


def _ratios(sums: Float64Array, noise: Float64Array, frames: int, stretch: float, reduction: int) -> SpectralVariation:
    """Ratios of the sums over windows (n, 5, rings), and their errors by leaving out one window after the other."""
    number = len(sums)

    def ratios(mean: Float64Array) -> Float64Array:
        variance, coherent, power, square, spread = mean
        signal = power - noise
        amplitude = (variance - noise) / np.maximum(coherent, 1e-12)
        # Var |F|² of signal and noise is that of the signal, plus 2 n E|XH|² + n².
        of_power = (spread - 2 * noise * signal - noise**2) / np.maximum(square - 2 * noise * signal - noise**2, 1e-12)
        return np.array([amplitude, of_power])

    amplitude, power = ratios(sums.mean(axis=0))
    errors = np.full((2, len(RINGS)), 0.5)
    if number > 1:
        rest = np.array([ratios((sums.sum(axis=0) - part) / (number - 1)) for part in sums])
        errors = np.sqrt((number - 1) * rest.var(axis=0))
    mean = sums.mean(axis=0)
    return SpectralVariation(
        amplitude, errors[0], power, errors[1], mean[2] / noise - 1, mean[1], noise, stretch**0.5, frames, reduction
    )

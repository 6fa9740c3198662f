"""How much wider one image is blurred than another, read from spectra without knowing the scene.

A temporal mean is one long exposure of an integrative sensor (papers 1 and 2), and second moments of blur add:
``cov(blur of the mean) = cov(blur of a frame) + cov(displacement)``.  At low frequency the spectra of two images of one
scene differ by ``−log(P₁ / P₂) = D k²``, for any scene.

Symbols
-------
P₁, P₂, n₁, n₂ : mean power spectra of the windowed tiles of two images, and their noise floors, squared intensity.
k : frequency, radians per pixel.
D : variance of the first blur less that of the second, per axis, squared pixels; q = D k², the exponent.
δ² : variance per axis by which the window smears a spectrum, squared radians per pixel.
β, v : parameters of a smooth model spectrum, ``log P = a − β log k − v k²``.

The fit compares ``(P₁ − n₁) e^{q/2}`` with ``(P₂ − n₂) e^{−q/2}``, here ``grown`` and ``shrunk``, so no logarithm is
taken of noise and the estimate has no bias at low signal.  Rings hold the frequencies of about one length |k|.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_grey
from ..core.errors import DataError, require
from ..registration.flow import MIN_SIDE
from ..runtime.fourier import rfft2

Float64Array = NDArray[np.float64]

# Side of the tiles, which overlap by half, pixels, chosen: displacements of 2 px leave power at low frequencies only.
_TILE = 64
# Lowest frequency, periods in a tile: the Hann window spreads the mean brightness over less than 1.5.  Highest, cycles
# per pixel, chosen: above, interpolation has changed the spectrum.
_LOWEST, _HIGHEST = 1.5, 0.35
# Relative error of the spectrum of a tile besides noise, from structure blurred across its border; chosen.
_MISFIT = 0.2
# Values of the spectrum that count as one independent value: under a Hann window the power of neighbours is correlated
# by 4/9 and 1/36 per axis.
_CORRELATED = 1 + 2 * (4 / 9 + 1 / 36)
# Larger exponents only say that nothing of a frequency is left: less than e⁻⁸, or 0.03 %.
_LARGEST_EXPONENT = 8.0
# Newton steps of the fit, and their largest size, squared pixels; both chosen.
_NEWTON_STEPS, _LARGEST_STEP = 12, 4.0
# Smaller noise is hidden by the rounding of float32, intensity.
_LEAST_NOISE = 1e-6
# A ring with less than this share of the strongest power shows no slope, chosen.
_WEAK = 1e-4
# An estimate of larger variance, pixels to the fourth, is reported as no estimate; chosen.
_NO_ESTIMATE = 100.0
# Keep divisions defined where a spectrum is zero; far below any signal.
_TINY = 1e-15


class RelativeBlur(NamedTuple):
    """How much wider the first of two images is blurred than the second."""

    variance: float  # D, squared pixels; negative if the first is sharper
    deviation: float  # its standard deviation; infinite if the images do not determine it


def relative_blur(first: ArrayLike, second: ArrayLike, noise: float | tuple[float, float]) -> RelativeBlur:
    """Difference of the second moments of the blurs of two images of one scene.

    Weights follow from the noise floors, from the misfit of a tile and, where the exponent is large, from the departure
    of a blur from a Gaussian, because only its low frequencies depend on the second moment alone.  The deviation is
    estimated from the residuals.

    Parameters
    ----------
    first, second : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float or tuple of two floats
        Standard deviation of the white noise in both images, or in each, intensity.

    Returns
    -------
    RelativeBlur

    Raises
    ------
    DataError
        Shapes do not agree, or an image is smaller than 16 pixels.
    ConfigurationError
        A noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (128, 128)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> soft, softer = (cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414))
    >>> round(relative_blur(softer, soft, noise=1e-4).variance, 1)
    1.0
    """
    one, two = (check_grey(image, name) for image, name in ((first, "first"), (second, "second")))
    if one.shape != two.shape:
        raise DataError(f"second: expected the shape of first {one.shape}, found {two.shape}")
    floors = [_noise_floor(level) for level in (noise if isinstance(noise, tuple) else (noise, noise))]
    tiles = _Tiles.of(one.shape)
    signals = [tiles.power(image) - floor for image, floor in zip((one, two), floors, strict=True)]
    return _fit(signals, floors, tiles)


@dataclass(frozen=True, eq=False)
class _Tiles:
    """Where the windowed tiles of an image are, and the frequencies of their spectra that are used."""

    # First row and first column of the tiles.
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    window: FloatArray  # (h, w): Hann window, of unit energy
    used: NDArray[np.intp]  # (f,): flat indices in the half-plane that a real transform gives
    squared: Float64Array  # (f,): k²
    ring: NDArray[np.intp]  # (f,): number of the ring of each

    @classmethod
    def of(cls, shape: tuple[int, ...]) -> _Tiles:
        """Lay tiles over images of a shape."""
        if min(shape) < MIN_SIDE:
            raise DataError(f"image: expected at least {MIN_SIDE} pixels a side, found shape {tuple(shape)}")
        size = height, width = min(_TILE, shape[0]), min(_TILE, shape[1])
        rows, columns = (_starts(length, side) for length, side in zip(shape, size, strict=True))
        window = np.outer(_hann(height), _hann(width))
        window /= np.sqrt(np.sum(window**2))
        ky, kx = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
        radius = np.hypot(kx, ky)
        # Half of the plane suffices, because the power spectrum of an image is symmetric.
        inside = ((kx > 0) | (ky > 0)) & (radius * min(size) >= _LOWEST) & (radius <= _HIGHEST)
        used = np.flatnonzero(inside)
        ring = np.unique(np.rint(radius.flat[used] * min(size)), return_inverse=True)[1]
        return cls(rows, columns, window.astype(np.float32), used, (2 * np.pi * radius.flat[used]) ** 2, ring)

    @property
    def count(self) -> int:
        """Number of tiles."""
        return len(self.rows) * len(self.columns)

    def power(self, image: FloatArray) -> Float64Array:
        """Mean power spectrum (f,) of the tiles of an image (H, W); white noise of variance 1 gives 1."""
        # The mean brightness is subtracted first, because float32 has seven digits only.
        tiles = np.lib.stride_tricks.sliding_window_view(image - image.mean(), self.window.shape)
        power = np.zeros(len(self.used))
        # One row of tiles at a time: all windowed and transformed tiles take fifteen times the memory of the image.
        for row in self.rows:
            spectrum = rfft2(tiles[row, self.columns] * self.window).reshape(len(self.columns), -1)[:, self.used]
            power += np.sum(spectrum.real**2 + spectrum.imag**2, axis=0, dtype=np.float64)
        return power / self.count

    def of_rings(self, values: Float64Array) -> Float64Array:
        """Means over the rings, shape (rings,), of values (f,)."""
        return np.bincount(self.ring, values) / np.bincount(self.ring)

    def widening(self, signals: list[Float64Array]) -> Float64Array:
        """Factor (f,) by which the smear of the window changes k² in an exponent.

        A smear by δ² per axis turns P into P + δ²/2 ΔP, and the logarithm of a ratio −D k² into −D (k² + δ²/2 (4 + 2 k
        d/dk log P₁P₂)).
        """
        k2 = self.of_rings(self.squared)
        smear = 4 / 3 * np.pi**2 / self.window.size
        slopes = sum(_log_slope(self.of_rings(signal), k2) for signal in signals)
        # The correction is of first order, so it is not trusted beyond a half.
        return np.clip(1 + smear * (2 + slopes) / k2, 1 / 2, 3 / 2)[self.ring]


def _fit(signals: list[Float64Array], floors: list[float], tiles: _Tiles) -> RelativeBlur:
    """Fit D to two spectra (f,) without their noise floors by Newton's method."""
    design = tiles.squared * tiles.widening(signals)
    D = 0.0
    for _ in range(_NEWTON_STEPS):
        q = np.clip(D * design, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
        grown, shrunk = signals[0] * np.exp(q / 2), signals[1] * np.exp(-q / 2)
        weight, signal = (part[tiles.ring] for part in _weights(grown, shrunk, q, floors, tiles))
        information = np.sum(weight * signal * design**2) + 1e-9
        pull = weight * (shrunk - grown) * design
        D += float(np.clip(pull.sum() / information, -_LARGEST_STEP, _LARGEST_STEP))
    # The scatter of few values is itself uncertain, and the expected one rests on assumptions: take half of each.
    variance = _CORRELATED**2 * (np.sum(pull**2) / information**2 + 1 / information) / 2
    return RelativeBlur(D, float(np.sqrt(variance))) if variance < _NO_ESTIMATE else RelativeBlur(0.0, np.inf)


def _weights(
    grown: Float64Array, shrunk: Float64Array, q: Float64Array, floors: list[float], tiles: _Tiles
) -> tuple[Float64Array, Float64Array]:
    """Weights of ``shrunk − grown`` in the fit, and the signal that both sides have in common, for every ring.

    The weight is the inverse variance of ``log grown − log shrunk`` divided by the signal.
    """
    grown, shrunk, q = (tiles.of_rings(values) for values in (grown, shrunk, q))
    independent = np.maximum(np.bincount(tiles.ring) / _CORRELATED**2, 1.0)
    noise_one, noise_two = floors[0] * np.exp(q / 2), floors[1] * np.exp(-q / 2)
    # The image with less noise shows the signal better.
    share = noise_two / (noise_one + noise_two)
    error = np.hypot(share * noise_one, (1 - share) * noise_two) / np.sqrt(tiles.count * independent)
    # A ring of pure noise seems to contain some signal by chance.
    signal = np.maximum(share * grown + (1 - share) * shrunk - 2 * error, _TINY)
    noise = 2 * signal * (noise_one + noise_two) + noise_one**2 + noise_two**2
    # A blur is Gaussian at low frequency only: an exponent is wrong by about its square.
    variance = (_MISFIT**2 * signal**2 + noise) / tiles.count + (q**2 * signal) ** 2
    return signal / variance, signal


def _log_slope(power: Float64Array, k2: Float64Array) -> Float64Array:
    """Logarithmic slope k d/dk of ``log P = a − β log k − v k²``, fitted where there is signal; 0 if there is none."""
    weak = np.flatnonzero(power <= _WEAK * power.max(initial=0.0))
    end = weak[0] if len(weak) else len(power)
    if end < 4:  # three parameters, and one value that they might miss
        return np.zeros_like(k2)
    terms = np.stack([np.ones_like(k2), -np.log(k2) / 2, -k2], axis=1)[:end]
    # The number of values in a ring is proportional to k.
    weights = np.sqrt(np.sqrt(k2[:end]))
    solution = np.linalg.lstsq(terms * weights[:, None], np.log(power[:end]) * weights, rcond=None)[0]
    return -solution[1] - 2 * solution[2] * k2


def _noise_floor(noise: float) -> float:
    """Power that white noise adds to a spectrum."""
    require(np.isfinite(noise) and noise >= 0, f"noise: expected a finite number of 0 or more, found {noise}")
    return max(noise, _LEAST_NOISE) ** 2


def _hann(size: int) -> Float64Array:
    return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)


def _starts(length: int, size: int) -> NDArray[np.intp]:
    count = 1 + int(np.ceil((length - size) / (size / 2)))
    return np.linspace(0, length - size, count).round().astype(np.intp)

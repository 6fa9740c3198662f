"""Power spectra of windowed tiles: their places, noise floor and window smear, and the weights of fits to them.

Symbols
-------
P, n : power spectrum of a tile and its noise floor, squared intensity.
k : frequency, radians per pixel; δ² : variance per axis by which the window smears a spectrum.
D : difference of the covariances of two blurs, squared pixels; q = kᵀDk, the exponent by which two spectra differ.
β, v : parameters of a smooth model spectrum, ``log P = a − β log k − v k²``.

A ring holds the frequencies of about one length |k|; a cell is a ring, or its part in a range of directions.

Fits compare ``(P₁ − n₁) e^{q/2}`` with ``(P₂ − n₂) e^{−q/2}``, so no logarithm is taken of noise.  The code calls these
two sides ``grown`` and ``shrunk``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import DataError, require, require_between
from ..runtime.fourier import rfft2

Float64Array = NDArray[np.float64]

# Values of the spectrum that count as one independent value: under a Hann window the power of neighbours is correlated
# by 4/9 and 1/36 per axis.
CORRELATED = 1 + 2 * (4 / 9 + 1 / 36)
# Larger exponents only say that nothing of a frequency is left.
LARGEST_EXPONENT = 8.0
# Newton steps of a fit, and their largest size, squared pixels.
NEWTON_STEPS, LARGEST_STEP = 12, 4.0
# Smaller noise is hidden by the rounding of float32, intensity.
_LEAST_NOISE = 1e-6


@dataclass(frozen=True)
class CueParams:
    """Settings of the comparison of spectra."""

    # Side of the square tiles, pixels; neighbouring tiles overlap by half. An image smaller than a tile is one tile.
    tile: int = 48
    lowest: float = 1.5  # lowest frequency used, periods in a tile; below 1.5 the mean brightness of the tile leaks in
    highest: float = 0.35  # highest frequency used, cycles per pixel
    # Relative error of the spectrum of a tile besides noise, from structure blurred across its border.
    misfit: float = 0.2
    # Error of an exponent as a share of its square, because a blur is Gaussian at low frequency only.
    departure: float = 0.1

    def __post_init__(self) -> None:
        require(int(self.tile) == self.tile, f"tile: expected a whole number of pixels, found {self.tile}")
        require_between("tile", self.tile, 16, 4096, "pixels")
        require_between("lowest", self.lowest, 1.5, 8, "periods in a tile")
        require_between("highest", self.highest, 0.1, 0.5, "cycles per pixel")
        require_between("misfit", self.misfit, 0.01, 1)
        require_between("departure", self.departure, 0, 10)


@dataclass(frozen=True, eq=False)
class TileGrid:
    """Positions of the tiles of an image."""

    # First row and first column of the tiles.
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    size: tuple[int, int]  # height and width of a tile, pixels
    shape: tuple[int, int]  # height and width of the image, pixels


@dataclass(frozen=True, eq=False)
class TileSpectra:
    """Power spectra of the windowed tiles of images of one size, at the frequencies used."""

    grid: TileGrid
    window: FloatArray  # (h, w): Hann window of the tiles, of unit energy
    used: NDArray[np.intp]  # (f,): flat indices of the frequencies in the half-plane that a real transform gives
    # (f,): the frequencies, radians per pixel.
    kx: Float64Array
    ky: Float64Array

    @classmethod
    def of(cls, shape: tuple[int, ...], params: CueParams) -> TileSpectra:
        """Lay tiles over images of a shape."""
        if min(shape) < 16:
            raise DataError(f"image: expected at least 16 pixels a side, found shape {tuple(shape)}")
        height, width = (min(int(params.tile), length) for length in shape)
        rows, columns = (_starts(length, size) for length, size in zip(shape, (height, width), strict=True))
        grid = TileGrid(rows, columns, (height, width), (shape[0], shape[1]))
        window = np.outer(_hann(height), _hann(width))
        window /= np.sqrt(np.sum(window**2))
        ky, kx = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
        radius = np.hypot(kx, ky)
        # Half of the plane suffices, because the power spectrum of an image is symmetric.
        half = (kx > 0) | (ky > 0)
        inside = half & (radius * min(height, width) >= params.lowest) & (radius <= params.highest)
        used = np.flatnonzero(inside)
        return cls(grid, window.astype(np.float32), used, 2 * np.pi * kx.flat[used], 2 * np.pi * ky.flat[used])

    def power(self, image: FloatArray) -> FloatArray:
        """Compute the power spectra of the tiles; white noise of variance 1 gives 1.

        ``image`` (H, W); returns (tiles, f).
        """
        # The mean brightness is subtracted first, because float32 has seven digits only.
        tiles = np.lib.stride_tricks.sliding_window_view(image - image.mean(), self.grid.size)
        power = np.empty((len(self.grid.rows), len(self.grid.columns), len(self.used)), image.dtype)
        # One row of tiles at a time: all windowed and transformed tiles take fifteen times the memory of the image.
        for row, found in zip(self.grid.rows, power, strict=True):
            spectrum = rfft2(tiles[row, self.grid.columns] * self.window).reshape(len(found), -1)[:, self.used]
            np.add(spectrum.real**2, spectrum.imag**2, out=found)
        return power.reshape(-1, len(self.used))

    def cells(self, sectors: int = 1) -> tuple[FloatArray, Float64Array, Float64Array]:
        """Divide the spectrum into rings and sectors.

        Returns ``averaging`` (f, cells), ``k2`` (cells,), ``counts`` (cells,).
        """
        k = np.hypot(self.kx, self.ky)
        ring = np.rint(k / (2 * np.pi) * min(self.grid.size))
        sector = np.floor(np.arctan2(self.ky, self.kx) / np.pi * sectors) % sectors
        _, cell = np.unique(ring * sectors + sector, return_inverse=True)
        counts = np.bincount(cell).astype(np.float64)
        averaging = np.zeros((len(k), len(counts)), np.float32)
        averaging[np.arange(len(k)), cell] = 1 / counts[cell]
        return averaging, np.bincount(cell, k**2) / counts, np.maximum(counts / CORRELATED**2, 1.0)

    @property
    def smear(self) -> float:
        """Variance per axis by which the window smears a spectrum, squared radians per pixel."""
        return float(4 / 3 * np.pi**2 / (self.grid.size[0] * self.grid.size[1]))

    def widening(self, powers: list[Float64Array], k2: Float64Array) -> Float64Array:
        """Factor by which the smear of the window changes k² in an exponent.

        A smear by a variance δ² per axis turns P into P + δ²/2 ΔP, and the logarithm of a ratio −D k² into −D (k² +
        δ²/2 (4 + 2 k d/dk log P₁P₂)).
        ``powers`` (rings,) each; ``k2`` (rings,); returns (rings,).
        """
        slopes = sum(_log_slope(power, k2) for power in powers)
        return np.clip(1 + self.smear * (2 + slopes) / k2, 0.5, 1.5)


def noise_floor(noise: float) -> float:
    """Power that white noise adds to a spectrum."""
    require(np.isfinite(noise) and noise >= 0, f"noise: expected a finite number of 0 or more, found {noise}")
    return max(noise, _LEAST_NOISE) ** 2


def fit_weights(
    cells: tuple[Float64Array, Float64Array, Float64Array],
    floors: tuple[float, float],
    repeats: float | Float64Array,
    cell_size: float | Float64Array,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Weights of ``shrunk − grown`` in a fit of the exponent q, and the signal that both sides have in common.

    The weight is the inverse variance of ``log grown − log shrunk`` divided by the signal.  ``cells`` are ``grown``,
    ``shrunk`` and q, shape (..., cells), means of ``cell_size`` values, each a mean of ``repeats`` independent ones.
    """
    grown, shrunk, q = cells
    noise_one, noise_two = floors[0] * np.exp(q / 2), floors[1] * np.exp(-q / 2)
    # The image with less noise shows the signal better.
    share = (noise_two + 1e-30) / (noise_one + noise_two + 2e-30)
    error = np.hypot(share * noise_one, (1 - share) * noise_two) / np.sqrt(repeats * cell_size)
    # A cell of pure noise seems to contain some signal by chance.
    signal = np.maximum(share * grown + (1 - share) * shrunk - 2 * error, 1e-15)
    noise = 2 * signal * (noise_one + noise_two) + noise_one**2 + noise_two**2
    variance = (params.misfit**2 * signal**2 + noise) / repeats + (params.departure * q**2 * signal) ** 2
    return signal / variance, signal


def _log_slope(power: Float64Array, k2: Float64Array) -> Float64Array:
    """Logarithmic slope k d/dk of ``log P = a − β log k − v k²``, fitted where there is signal; 0 if there is none."""
    weak = np.flatnonzero(power <= 1e-4 * power.max(initial=0.0))
    end = weak[0] if len(weak) else len(power)
    if end < 4:
        return np.zeros_like(k2)
    terms = np.stack([np.ones_like(k2), -0.5 * np.log(k2), -k2], axis=1)[:end]
    # The number of values in a ring is proportional to k.
    weights = k2[:end] ** 0.25
    solution = np.linalg.lstsq(terms * weights[:, None], np.log(power[:end]) * weights, rcond=None)[0]
    return -solution[1] - 2 * solution[2] * k2


def _hann(size: int) -> Float64Array:
    return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)


def _starts(length: int, size: int) -> NDArray[np.intp]:
    count = 1 + int(np.ceil((length - size) / (size / 2)))
    return np.linspace(0, length - size, count).round().astype(np.intp)

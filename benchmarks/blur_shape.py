"""Shape of the blur of fused frames, where the truth is known.

Run ``TURBRESTORE_DATA=DIR python benchmarks/blur_shape.py [NAME ...]``.  For each simulated clip it prints the transfer
function from the truth to the filtered image, the cross-spectrum over the power of the truth, at some frequencies;
and the highest PSNR that deconvolution reaches with blurs of several exponents, each at its best width.
"""

from __future__ import annotations

import sys

import numpy as np
from clips import find_clips
from scipy import fft

from turbrestore import RestoreParams, restore
from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.core.errors import TurbrestoreError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.metrics import align, compare

FREQUENCIES = (1 / 16, 1 / 8, 3 / 16, 1 / 4, 3 / 8)
DIRECTIONS = (0, 45, 90, 135)
EXPONENTS = (1.0, 1.2, 1.4, 5 / 3)
# Pixels, about a tenth apart.
SIGMAS = (0.3, 0.35, 0.42, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.32, 1.46, 1.6, 1.8, 2.0)
_RINGS = 32


def main() -> int:
    """Print the table."""
    columns = [f"ν = {frequency:g}" for frequency in FREQUENCIES]
    columns += [f"1/8 at {degrees}°" for degrees in DIRECTIONS] + [f"p = {exponent:.3g}" for exponent in EXPONENTS]
    print(f"| clip | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    try:
        for name, load in find_clips(sys.argv[1:] or ["ao_*", "purdue1_*", "quick_*"]).items():
            clip = load()
            if clip.truth is None:
                continue
            stages = restore(clip.frames, RestoreParams(until="filter"))
            transfer = transfer_function(stages.image, clip.truth)
            cells = [f"{transfer[round(frequency * _RINGS)]:.2f}" for frequency in FREQUENCIES]
            cells += [f"{share:.2f}" for share in by_direction(stages.image, clip.truth)]
            for exponent in EXPONENTS:
                sigma, figure = best_width(stages.image, clip.truth, stages.centroid.image, exponent)
                cells.append(f"{figure:.2f} ({sigma:g})")
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
    except TurbrestoreError as error:
        print(f"blur_shape: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def transfer_function(image: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the share of the truth's amplitude that is left in the image, in rings 1/32 cycles per pixel apart."""
    first, second, fy, fx = _spectra(image, truth)
    ring = np.rint(np.hypot(fy, fx) * _RINGS).astype(int).ravel()
    cross = np.bincount(ring, (first * second.conj()).real.ravel())
    return (cross / np.bincount(ring, np.square(np.abs(second)).ravel())).astype(np.float32)


def by_direction(image: FloatArray, truth: FloatArray) -> list[float]:
    """Return the share of the truth's amplitude around ν = 1/8, for waves along 0°, 45°, 90° and 135°."""
    first, second, fy, fx = _spectra(image, truth)
    radius, angle = np.hypot(fy, fx), np.degrees(np.arctan2(fy, fx)) % 180
    near, shares = np.abs(radius - 1 / 8) < 1 / 32, []
    for direction in DIRECTIONS:
        sector = near & (np.abs((angle - direction + 90) % 180 - 90) <= 22.5)
        cross, power = (first * second.conj()).real[sector].sum(), np.square(np.abs(second[sector])).sum()
        shares.append(float(cross / power))
    return shares


def _spectra(image: FloatArray, truth: FloatArray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Align both images and return their windowed spectra and the frequencies."""
    a, t = align(image, truth)
    window = np.outer(np.hanning(a.shape[0]), np.hanning(a.shape[1]))
    first, second = (fft.fft2((one - one.mean()) * window) for one in (a, t))
    return first, second, fft.fftfreq(a.shape[0])[:, None], fft.fftfreq(a.shape[1])[None]


def best_width(image: FloatArray, truth: FloatArray, guide: FloatArray, exponent: float) -> tuple[float, float]:
    """Increase the width until the PSNR falls; return the best width and its PSNR."""
    best = (0.0, compare(luminance(image), truth).psnr)
    for sigma in SIGMAS:
        result = deconvolve(image, sigma, DeconvolutionParams(exponent=exponent), guide=guide)
        figure = compare(result.image, truth).psnr
        if figure < best[1] - 0.3:
            break
        best = max(best, (sigma, figure), key=lambda pair: pair[1])
    return best


if __name__ == "__main__":
    sys.exit(main())

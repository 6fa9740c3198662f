"""Calibration of the witnesses of the blur by simulation.

``python benchmarks/blur_calibration.py --table`` computes the mean and the variation of short exposures through
Kolmogorov turbulence, and writes ``turbrestore/blur/short_exposure.csv``.

``python benchmarks/blur_calibration.py FOLDER [--write benchmarks/results/blur_calibration.md]`` synthesizes clips into
a folder, those that are there are kept: scenes through phase screens of random D/r0, diffraction, noise, codec, lens
and number of frames; photographs that smooth flows move behind lenses of 0 to 2.5 px; and clips that stand still.  It
compares the widths that every witness finds, and the width that is removed, with the true transfer function of the
filtered image, and the images before and after.  Constants were set on the scenes CHOSEN; the table is of the others.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy import fft

from turbrestore.core.arrays import FloatArray
from turbrestore.synthesis.atmosphere import phase_spectrum

TABLE = Path(__file__).resolve().parent.parent / "turbrestore" / "blur" / "short_exposure.csv"
STRENGTHS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0)
# Samples across the aperture and across a screen, number of screens, and steps of u.
ACROSS, SCREEN, SCREENS, STEPS = 48, 512, 40, 24


def main() -> int:
    """Write the table of short exposures, or the table of witnesses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--write", type=Path)
    given = parser.parse_args()
    if given.table:
        TABLE.write_text(short_exposure_table(np.random.default_rng(1)), "utf-8")
    return 0


def short_exposure_table(rng: np.random.Generator) -> str:
    """Mean transfer function, s and s_4 by D/r0 and u, as text."""
    phases, mask = tilt_free_phases(rng)
    side = 2 * ACROSS
    nu = fft.fftfreq(side) * side
    ring = np.rint(np.hypot(nu[:, None], nu)).astype(int).ravel()
    count = np.bincount(ring)
    lines = ["d_over_r0,u,mean,amplitude_variation,power_variation"]
    for strength in STRENGTHS:
        field = np.zeros((len(phases), side, side), np.complex64)
        field[:, :ACROSS, :ACROSS][:, mask] = np.exp(1j * strength ** (5 / 6) * phases)
        otf = fft.ifft2(np.square(np.abs(fft.fft2(field))))
        otf /= otf[:, :1, :1]
        power = np.square(np.abs(otf))

        def by_ring(values: FloatArray) -> FloatArray:
            return (np.bincount(ring, values.ravel()) / count)[: ACROSS + 1]

        mean = otf.mean(axis=0)
        columns = (
            by_ring(mean.real),
            by_ring(otf.var(axis=0)) / by_ring(np.square(np.abs(mean))),
            by_ring(power.var(axis=0)) / by_ring(np.square(power.mean(axis=0))),
        )
        for step in range(STEPS + 1):
            at = step * ACROSS // STEPS
            cells = ",".join(f"{max(float(column[at]), 0):.4g}" for column in columns)
            lines.append(f"{strength:g},{step / STEPS:.6f},{cells}")
    return "\n".join(lines) + "\n"


def tilt_free_phases(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray]:
    """Phases over the aperture for D = r0, less the plane fitted to each, shape (n, pixels of the mask); the mask."""
    f = np.hypot(fft.fftfreq(SCREEN)[:, None], fft.fftfreq(SCREEN))
    f[0, 0] = 1.0
    spectrum = phase_spectrum(f, ACROSS, 1e9, 0.0)
    spectrum[0, 0] = 0.0
    y, x = np.mgrid[:ACROSS, :ACROSS] - (ACROSS - 1) / 2
    mask = np.hypot(x, y) <= ACROSS / 2
    plane, _ = np.linalg.qr(np.stack([np.ones(mask.sum()), x[mask], y[mask]], axis=1))
    phases = []
    for _ in range(SCREENS):
        screen = fft.ifft2(fft.fft2(rng.standard_normal((SCREEN, SCREEN))) * np.sqrt(spectrum)).real
        for top in range(0, SCREEN - ACROSS + 1, 2 * ACROSS):
            for left in range(0, SCREEN - ACROSS + 1, 2 * ACROSS):
                phase = screen[top : top + ACROSS, left : left + ACROSS][mask]
                phases.append(phase - plane @ (plane.T @ phase))
    return np.array(phases, np.float32), mask


if __name__ == "__main__":
    sys.exit(main())

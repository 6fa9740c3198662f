"""What the guards read on right and on wrong widths of the blur.

    python benchmarks/guards.py

Scenes of 192×192 pixels are blurred by a Gaussian, get noise of .002 and are deconvolved (Wiener) by the true width and
by widths that are too large.  Exit code 1 if the true width is refused anywhere but on brick, the texture of which a
blur of 2 px takes away altogether, or if twice the true width passes on most scenes.
"""

from __future__ import annotations

import sys

import numpy as np

from turbrestore.blind.guards import GuardReading, judge
from turbrestore.blur.psf import GAUSSIAN, blur_otf
from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.synthesis.scenes import SCENES

NAMES = ("chart", "words", "camera", "cat", "page", "grass", "brick")
SIGMAS = (1.0, 2.0, 3.0)
FACTORS = (0.8, 1.0, 1.3, 1.6, 2.0)
SIDE, NOISE = 192, 0.002
WIENER = DeconvolutionParams(method="wiener", exponent=GAUSSIAN)


def blurred(scene: FloatArray, sigma: float) -> FloatArray:
    """Scene behind a Gaussian blur, with noise."""
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, sigma, GAUSSIAN)
    noise = np.random.default_rng(0).normal(0, NOISE, scene.shape)
    return (np.fft.irfft2(spectrum, scene.shape) + noise).astype(np.float32)


def cell(reading: GuardReading) -> str:
    """Overshoot, noise gain, and a mark where a guard objects."""
    return f"{reading.overshoot:.3f} {reading.noise_gain:.1f}{'' if reading.passed else ' ✗'}"


def main() -> int:
    """Print the table."""
    print("| scene | blur, px | the scene itself | " + " | ".join(f"{factor} × width" for factor in FACTORS) + " |")
    print("|---" * (3 + len(FACTORS)) + "|")
    refused, let_through = 0, []
    for name in NAMES:
        scene = luminance(SCENES[name](SIDE, SIDE))
        for sigma in SIGMAS:
            image = blurred(scene, sigma)
            readings = [judge(deconvolve(image, k * sigma, WIENER).image, image, k * sigma) for k in FACTORS]
            print(
                f"| {name} | {sigma:g} | {cell(judge(scene, image, sigma))} | " + " | ".join(map(cell, readings)) + " |"
            )
            refused += name != "brick" and not readings[FACTORS.index(1.0)].passed
            let_through.append(readings[-1].passed)
    print(
        f"\ntrue widths refused: {refused}; twice the true width let through: {sum(let_through)} of {len(let_through)}"
    )
    return int(refused > 0 or np.mean(let_through) > 0.5)


if __name__ == "__main__":
    sys.exit(main())

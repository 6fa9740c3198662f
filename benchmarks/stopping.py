"""How close the image at which deconvolution stops is to that of two thousand iterations.

Run ``python benchmarks/stopping.py``; it prints a table and exits with 1 when a PSNR differs by more than the bound.
``--sizes 512`` looks at larger images and ``--widths 0.7 3`` at other blurs, for which there is no bound: a narrow blur
with little noise leaves images of more than 40 dB, where a tenth of a level of 8 bits is tenths of a dB, and earlier
images are often better.  The blur is known, and light comes from beyond the border.

``--clips`` takes what the pipeline deblurs instead: the filtered images of simulated clips, with the blur estimated;
``--clips "smooth_*"`` those whose names match.  The bound holds for all of them.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys

import numpy as np
from clips import Clip, find_clips
from scipy import fft

from turbrestore.blur.estimation import BlurEstimate, estimate_blur
from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deconvolution.deconvolve import METHODS, DeconvolutionParams, deconvolve
from turbrestore.metrics import psnr
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.synthesis.scenes import SCENES

NAMES, NOISES = ("camera", "chart", "words", "brick"), (0.002, 0.01, 0.03)
WIDTHS, SIZES, BORDER, MOST = (1.5,), (64, 128, 256), 16, 2000
BOUND_DB = 0.05


def make_images(name: str, size: int, width: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Scene, and what is seen of it through a blur of turbulence with noise."""
    larger = SCENES[name](size + 2 * BORDER, size + 2 * BORDER)
    blurred = fft.irfft2(blur_otf(larger.shape, width, KOLMOGOROV) * fft.rfft2(larger), s=larger.shape)
    blurred += np.random.default_rng(0).normal(0, noise, larger.shape)
    inside = (slice(BORDER, BORDER + size),) * 2
    return larger[inside], blurred[inside].astype(np.float32)


def compare_scene(method: str, name: str, size: int, width: float, noise: float) -> float:
    """Print a row of the table; PSNR that stopping gains or, below 0, loses, dB."""
    truth, seen = make_images(name, size, width, noise)
    params = DeconvolutionParams(method=method, exponent=KOLMOGOROV)
    return _compare(f"{method} | {name} | {size}² | {width} | {noise}", truth, seen, width, params)


def compare_clip(name: str, clip: Clip) -> float:
    """Likewise of the filtered image of a clip, with the centroid as guide."""
    done = restore(clip.frames, RestoreParams(until="filter"))
    seen, blur = done.filtered.image, estimate_blur(done.filtered.image)
    params = DeconvolutionParams()
    case = f"{params.method} | {name} | {seen.shape[1]}×{seen.shape[0]} | {blur.removable:.2f} | as filtered"
    return _compare(case, clip.truth, seen, blur, params, done.centroid.image)


def _compare(
    case: str,
    truth: np.ndarray,
    seen: np.ndarray,
    blur: float | BlurEstimate,
    params: DeconvolutionParams,
    guide: np.ndarray | None = None,
) -> float:
    stopped = deconvolve(seen, blur, params, guide)
    exhaustive = deconvolve(seen, blur, dataclasses.replace(params, iterations=MOST, tolerance=0), guide)
    best = psnr(exhaustive.image, truth)
    gained = psnr(stopped.image, truth) - best
    print(f"| {case} | {best:.2f} | {gained:+.3f} | {stopped.iterations} |", flush=True)
    return gained


def main() -> int:
    """Print the table; 1 if a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="N", help="pixels a side")
    parser.add_argument("--widths", type=float, nargs="+", default=WIDTHS, metavar="PX", help="widths of the blur")
    parser.add_argument("--clips", nargs="*", metavar="PATTERN", help="filtered images of clips instead")
    asked = parser.parse_args()
    print("| method | scene | size | blur | noise | PSNR | stopped, dB | iterations |")
    print("|---" * 8 + "|")
    if asked.clips is not None:
        loaded = ((name, load()) for name, load in find_clips(asked.clips).items())
        stated = differences = [abs(compare_clip(name, clip)) for name, clip in loaded if clip.truth is not None]
        if not differences:
            print("stopping: no clip that matches has a truth; name others", file=sys.stderr)
            return 2
        where = "of these"
    else:
        cases = itertools.product(METHODS, NAMES, asked.sizes, asked.widths, NOISES)
        found = {case: abs(compare_scene(*case)) for case in cases}
        differences = list(found.values())
        stated = [value for case, value in found.items() if case[2] in SIZES and case[3] in WIDTHS]
        where = "at up to 256² and 1.5 px"
    print(f"\nLargest difference {max(differences):.3f} dB; bound {where}: {BOUND_DB}")
    return int(any(value > BOUND_DB for value in stated))


if __name__ == "__main__":
    sys.exit(main())

"""Estimators of the width of an unknown blur, on scenes blurred by known Gaussians.

Run ``python benchmarks/blur.py``.  It prints a table of three estimators on ten scenes, and exits with 1 if the one in
use misses its bounds.

* likelihood: :func:`turbrestore.blur.estimation.estimate_blur`, the one in use;
* spectrum: fit of ``c − 2 log ν − 4π²σ²ν²`` to the logarithm of the radial power spectrum, where it clearly exceeds
  the noise;
* re-blur: median ratio of the gradients at edges before and after another blur (Zhuo and Sim 2011).
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
from provenance import publish_printed
from scipy import fft

from turbrestore.blur.estimation import estimate_blur
from turbrestore.blur.psf import GAUSSIAN
from turbrestore.core.arrays import FloatArray
from turbrestore.core.noise import estimate_noise
from turbrestore.synthesis.scenes import SCENES

SIDE = 256
NAMES = ("camera", "brick", "grass", "gravel", "chart", "words", "page", "coins", "moon", "astronaut")
WIDTHS = (0.0, 0.8, 1.4, 2.2, 3.5, 6.0)
NOISES = (0.002, 0.02)
# Relative errors of the blurred cases: median and 90th percentile of the size, and largest overestimate.  The last is
# found in fine detail with white noise, which looks like the smooth noise of fused frames.
BOUNDS = (0.10, 0.25, 0.45)


HEAD = """# Estimators of the blur width

Printed by `python benchmarks/blur.py`.

Ten scenes blurred by Gaussians of 0 to 6 px, noise .002 or .02. Errors are shares of the truth."""


def main() -> int:
    """Print the table."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in ESTIMATORS}
    seconds = dict.fromkeys(ESTIMATORS, 0.0)
    for index, (name, sigma, noise) in enumerate(itertools.product(NAMES, WIDTHS, NOISES)):
        image = blurred(name, sigma, noise, index)
        cells = []
        for estimator, estimate in ESTIMATORS.items():
            start = time.perf_counter()
            width = estimate(image)
            seconds[estimator] += time.perf_counter() - start
            found[estimator].append((sigma, width))
            cells.append(f"{width:.2f}")
        print(f"| {name} | {sigma} | {noise} | " + " | ".join(cells) + " |", file=sys.stderr, flush=True)
    print("| estimator | median error | 90th percentile | largest overestimate | widest if sharp | s per image |")
    print("|---|---|---|---|---|---|")
    broken = False
    for estimator, pairs in found.items():
        errors = np.array([width / sigma - 1 for sigma, width in pairs if sigma > 0])
        sharp = max(width for sigma, width in pairs if sigma == 0)
        figures = (float(np.median(abs(errors))), float(np.quantile(abs(errors), 0.9)), float(errors.max()))
        cells = " | ".join(f"{100 * figure:.0f} %" for figure in figures)
        print(f"| {estimator} | {cells} | {sharp:.2f} px | {seconds[estimator] / len(pairs):.2f} |")
        if estimator == "likelihood":
            broken = any(figure > bound for figure, bound in zip(figures, BOUNDS, strict=True))
    return int(broken)


def blurred(name: str, sigma: float, noise: float, seed: int) -> FloatArray:
    """Return a grey scene, blurred and noisy."""
    scene = SCENES[name](SIDE, SIDE)
    scene = scene.mean(axis=-1) if scene.ndim == 3 else scene
    scene = cv2.GaussianBlur(scene, (0, 0), sigma) if sigma else scene
    return (scene + np.random.default_rng(seed).normal(0, noise, scene.shape)).astype(np.float32)


def likelihood(image: FloatArray) -> float:
    """Estimate the width as the package does."""
    return estimate_blur(image, exponent=GAUSSIAN).sigma


def spectrum(image: FloatArray) -> float:
    """Estimate the width by a fit of the radial power spectrum."""
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    power = np.abs(fft.fft2((image - image.mean()) * window)) ** 2 / np.sum(window**2)
    radius = np.hypot(fft.fftfreq(image.shape[0])[:, None], fft.fftfreq(image.shape[1]))
    ring = np.rint(128 * radius).astype(int)
    counts, sums = np.bincount(ring.ravel()), np.bincount(ring.ravel(), power.ravel())
    frequency, mean = np.arange(3, 64) / 128, (sums / counts)[3:64]
    floor = estimate_noise(image) ** 2
    clear = np.cumprod(mean > 8 * floor).astype(bool)
    if clear.sum() < 4:
        return 0.0
    design = np.stack([np.ones(clear.sum()), -((2 * np.pi * frequency[clear]) ** 2)], axis=1)
    weight = np.sqrt(counts[3:64][clear])
    target = np.log(mean[clear] - floor) + 2 * np.log(frequency[clear])
    solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
    return float(np.sqrt(max(solution[1], 0)))


def reblur(image: FloatArray, extra: float = 1.5) -> float:
    """Estimate the width by the ratio of gradients at strong edges after another blur: ``√(σ² + s²) / σ``."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    first, second = (_gradient(one) for one in (smooth, cv2.GaussianBlur(smooth, (0, 0), extra)))
    edges = first >= np.quantile(first, 0.95)
    ratio = float(np.median(first[edges] / np.maximum(second[edges], 1e-9)))
    total = extra**2 / max(ratio**2 - 1, 1e-9)
    return float(np.sqrt(max(total - 1, 0)))


def _gradient(image: FloatArray) -> FloatArray:
    return np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1))


ESTIMATORS: dict[str, Callable[[FloatArray], float]] = {
    "likelihood": likelihood,
    "spectrum": spectrum,
    "re-blur": reblur,
}

if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))

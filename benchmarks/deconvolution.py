"""Time and memory of the deconvolution: nonlocal weights, an iteration, and the whole stage.

Run ``python benchmarks/deconvolution.py``; it prints tables and exits with 1 when a bound is broken.  Ratios are to
work that any implementation has to do, measured in the same process and in turn: comparing every pixel with those of
its search window, shift by shift, and four Fourier transforms of a real image, as many as an iteration needs.
Iterations and transforms use more threads where the image is large, and no more than two cores.  Of repeated runs the
fastest counts, because others may use the machine, and of iterations the median.  Peak memory is that of a child
process, which starts with that of its parent, so it is measured first.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
from revisions import take_two_cores
from scipy import fft

from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deblurring.remove_blur import remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve_steps
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import nonlocal_weights
from turbrestore.deconvolution.problem import MARGIN_SIGMAS
from turbrestore.runtime.steps import finish
from turbrestore.runtime.threads import available_cores
from turbrestore.synthesis.scenes import SCENES

SIZES = (256, 384, 512, 768, 1024)
STATED = 512
WEIGHTS_BOUND_S, ITERATION_BOUND_MS, EXPONENT_BOUND = 2.5, 25.0, 1.1
STAGE_BOUNDS_S = {256: 1.0, 512: 4.0}
# Of a child that removes the blur of such a frame, MB.
LARGE, MEMORY_BOUND = (1080, 1920), 1300
# Of the image; and how much of the scene lies beyond its border, pixels.
NOISE, WIDTH, BORDER = 0.003, 1.2, 16


def make_image(height: int, width: int) -> np.ndarray:
    """Part of a larger scene with a blur of turbulence, and some noise."""
    side = max(height, width) + 2 * BORDER
    scene = SCENES["camera"](side, side)[: height + 2 * BORDER, : width + 2 * BORDER]
    blurred = fft.irfft2(fft.rfft2(scene) * blur_otf(scene.shape, WIDTH, KOLMOGOROV), s=scene.shape)
    seen = blurred[BORDER : BORDER + height, BORDER : BORDER + width]
    return (seen + np.random.default_rng(0).normal(0, NOISE, seen.shape)).astype(np.float32)


def fastest(function: Callable[[], object], runs: int) -> float:
    """Seconds of the fastest of some runs."""
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def compare_shifts(image: np.ndarray) -> np.ndarray:
    """Distances of all patches of 5×5 pixels to those of half of the shifts of 21×21 pixels; the least of each."""
    least = np.full(image.shape, np.inf, np.float32)
    for dy in range(11):
        for dx in range(-10 if dy else 1, 11):
            distances = cv2.boxFilter(np.square(image - np.roll(image, (-dy, -dx), (0, 1))), -1, (5, 5))
            np.minimum(least, distances, out=least)
    return least


def weigh(image: np.ndarray) -> tuple[float, float]:
    """Seconds of the weights, and of comparing shifts."""
    return fastest(lambda: nonlocal_weights(image), 3), fastest(lambda: compare_shifts(image), 3)


def iterate(image: np.ndarray, iterations: int = 12) -> tuple[float, float]:
    """Median seconds of an iteration of the stage, on the threads that it takes, and of four transforms on as many."""
    ends: list[float] = []
    params = DeconvolutionParams(exponent=KOLMOGOROV, iterations=iterations, tolerance=0)
    finish(deconvolve_steps(image, WIDTH, params), lambda _: ends.append(time.perf_counter()))
    shape = tuple(fft.next_fast_len(size + 2 * int(np.ceil(MARGIN_SIGMAS * WIDTH)), real=True) for size in image.shape)
    spectrum = fft.rfft2(np.ones(shape, np.float32))
    taken = []
    # The stage takes one thread where transforms are short: whichever is faster.
    for workers in (1, available_cores()):
        with fft.set_workers(workers):
            taken.append(fastest(lambda: [fft.rfft2(fft.irfft2(spectrum, s=shape)) for _ in range(2)], iterations))
    return float(np.median(np.diff(ends))), min(taken)


def exponent(seconds: list[float]) -> float:
    """Power of the number of pixels that the times grow with."""
    return float(np.polyfit(2 * np.log(SIZES), np.log(seconds), 1)[0])


def peak_memory() -> float:
    """Peak resident memory, MB, of a child process that removes the blur of a large frame."""
    done = subprocess.run([sys.executable, __file__, "--child"], capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout)["peak_mb"])


def run_child() -> None:
    """Remove the blur of a frame of 1920×1080 and print the peak resident memory of this process.

    After sixty iterations all earlier images are kept that the last one is compared with.
    """
    image = make_image(*LARGE)
    finish(remove_blur_steps(image, image, DeconvolutionParams(iterations=60, tolerance=0)))
    # Linux counts kilobytes, macOS bytes.
    unit = 1024 if sys.platform != "darwin" else 1024 * 1024
    print(json.dumps({"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}))


def time_parts() -> bool:
    """Print the times of weights and iterations over the sizes; whether all bounds hold."""
    weights, steps = [], []
    print("| size | weights, s | to comparing shifts | iteration, ms | to four transforms |\n|---|---|---|---|---|")
    for size in SIZES:
        image = make_image(size, size)
        (weighing, shifts), (step, transforms) = weigh(image), iterate(image)
        weights.append(weighing)
        steps.append(step)
        ratios = f"{weighing:.2f} | {weighing / shifts:.2f} | {1e3 * step:.1f} | {step / transforms:.1f}"
        print(f"| {size}² | {ratios} |", flush=True)
    growth = exponent(weights), exponent(steps)
    print(f"| exponent | {growth[0]:.2f} | | {growth[1]:.2f} | |")
    print(f"| bound at {STATED}² | {WEIGHTS_BOUND_S} | | {ITERATION_BOUND_MS:.0f} | |\n")
    stated = SIZES.index(STATED)
    fast = weights[stated] <= WEIGHTS_BOUND_S and 1e3 * steps[stated] <= ITERATION_BOUND_MS
    return fast and max(growth) <= EXPONENT_BOUND


def whole_stage(height: int, width: int, runs: int = 2) -> float:
    """Seconds of the whole stage."""
    image = make_image(height, width)
    return fastest(lambda: finish(remove_blur_steps(image, image)), runs)


def time_stage() -> bool:
    """Print the seconds of the whole stage; whether the bounds hold."""
    print("| size | whole stage, s | bound |\n|---|---|---|")
    held = True
    for size, bound in STAGE_BOUNDS_S.items():
        seconds = whole_stage(size, size)
        print(f"| {size}² | {seconds:.2f} | {bound:.1f} |", flush=True)
        held &= seconds <= bound
    print(f"| {LARGE[1]}×{LARGE[0]} | {whole_stage(*LARGE, runs=1):.1f} | |\n", flush=True)
    return held


def measure_memory() -> bool:
    """Print the peak memory at 1920×1080; whether the bound holds."""
    peak = peak_memory()
    print(f"Peak at {LARGE[1]}×{LARGE[0]}: {peak:.0f} MB (bound {MEMORY_BOUND}).\n", flush=True)
    return peak <= MEMORY_BOUND


def main() -> int:
    """Print all tables; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_child()
        return 0
    take_two_cores()
    held = [measure_memory(), time_parts(), time_stage()]
    return int(not all(held))


if __name__ == "__main__":
    sys.exit(main())

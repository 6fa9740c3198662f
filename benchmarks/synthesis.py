"""Cost of phase-screen synthesis against frames and pixels, as a ratio to a plain warp and blur, and peak memory.

Run ``python benchmarks/synthesis.py``; it prints tables and exits with 1 when a bound is broken.  Every cost is
CPU time, taken beside that of ``cv2.remap`` and ``cv2.GaussianBlur`` on frames of the same size in the same
process, because machines differ and drift; exponents are fitted to the costs.  Peak memory is that of a child process.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import cv2
import numpy as np

from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.scenes import resolution_chart

SECONDS_BOUND, MEMORY_BOUND_MB = 30.0, 1000.0
FRAME_EXPONENT_BOUND, PIXEL_EXPONENT_BOUND = 1.05, 1.2
FRAMES, SIZE = 120, 256
# Long enough that the warp and blur of one measurement take tenths of a second.
BASELINE_PIXELS = 200 * 256**2


def synthesis_seconds(count: int, size: int) -> tuple[float, float, float]:
    """Elapsed seconds for ``count`` frames, CPU seconds, and those for all but the first few frames.

    The first frames wait for the screens and the basis of the blur.
    """
    scene = resolution_chart(size, size)
    begun, used = time.perf_counter(), time.process_time()
    frames = phase_screen_frames(scene, count, np.random.default_rng(0))
    next(frames)
    settled = time.process_time()
    for _ in frames:
        pass
    return time.perf_counter() - begun, time.process_time() - used, time.process_time() - settled


def baseline_seconds(size: int) -> float:
    """CPU seconds that one warp and blur of a frame takes, the smallest of three means."""
    scene = resolution_chart(size, size)
    y, x = np.mgrid[:size, :size].astype(np.float32)
    repeats = max(1, BASELINE_PIXELS // size**2)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = []
    for _ in range(3):
        begun = time.process_time()
        for _ in range(repeats):
            cv2.GaussianBlur(cv2.remap(scene, x + 0.3, y - 0.3, cv2.INTER_LINEAR), (0, 0), 1.5)
        times.append((time.process_time() - begun) / repeats)
    cv2.setNumThreads(threads)
    return min(times)


def exponent(sizes: list[int], costs: list[float]) -> float:
    """Slope of cost against size, both logarithmic."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def frame_table() -> tuple[float, float]:
    """Print cost against frames; elapsed seconds of the longest clip, and the exponent."""
    print("| frames of 256×256 | elapsed, s | CPU, s | ratio to one warp and blur each |\n|---|---|---|---|")
    counts, costs, elapsed = [30, 60, FRAMES], [], 0.0
    for count in counts:
        plain = baseline_seconds(SIZE)
        elapsed, used, _ = synthesis_seconds(count, SIZE)
        costs.append(used)
        print(f"| {count} | {elapsed:.1f} | {used:.1f} | {used / plain / count:.0f} |")
    return elapsed, exponent(counts, costs)


def pixel_table() -> float:
    """Print cost of a frame against pixels; the exponent."""
    print("\n| size | CPU, s a frame | one warp and blur, ms | ratio |\n|---|---|---|---|")
    # Threads have begun some frames when the first is handed over, the same number at every size.
    sizes, costs, count = [128, 192, 256, 384], [], 17
    for size in sizes:
        plain = baseline_seconds(size)
        costs.append(synthesis_seconds(count, size)[2] / (count - 1))
        print(f"| {size}×{size} | {costs[-1]:.3f} | {plain * 1e3:.2f} | {costs[-1] / plain:.0f} |")
    return exponent([size**2 for size in sizes], costs)


def peak_memory(count: int) -> float:
    """Peak resident memory, MB, of a child process that makes ``count`` frames."""
    command = [sys.executable, __file__, "--child", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout)["peak_mb"])


def run_child(count: int) -> None:
    """Make frames, keep none, and print the peak resident memory of this process."""
    synthesis_seconds(count, SIZE)
    # Linux counts kilobytes, macOS bytes.
    unit = 1024 if sys.platform != "darwin" else 1024 * 1024
    print(json.dumps({"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}))


def main() -> int:
    """Print the tables; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--child", type=int)
    options = parser.parse_args()
    if options.child is not None:
        run_child(options.child)
        return 0
    seconds, by_frames = frame_table()
    by_pixels = pixel_table()
    memory = peak_memory(FRAMES)
    bounds = [
        (f"seconds for {FRAMES} frames of {SIZE}×{SIZE}", seconds, SECONDS_BOUND),
        ("exponent of cost against frames", by_frames, FRAME_EXPONENT_BOUND),
        ("exponent of cost against pixels", by_pixels, PIXEL_EXPONENT_BOUND),
        ("peak memory, MB", memory, MEMORY_BOUND_MB),
    ]
    print("\n| figure | found | bound |\n|---|---|---|")
    for name, found, bound in bounds:
        print(f"| {name} | {found:.3g} | {bound:g} |")
    return int(any(found > bound for _, found, bound in bounds))


if __name__ == "__main__":
    sys.exit(main())

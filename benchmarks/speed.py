"""Time of a whole restoration against the bare flow calls it makes, memory against frames, and time of the help.

Run ``python benchmarks/speed.py``; it prints a table and exits with 1 when a bound is broken.  Both times are taken in
the same process, in turn, because machines differ and drift; peak memory is that of child processes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from turbrestore.flow import FlowParams, iterate_flows
from turbrestore.frame_source import FrameSource
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

TIME_BOUND, MEMORY_BOUND_MB, HELP_BOUND = 1.6, 50.0, 6.0
THREADS = 2


def help_ratio(runs: int) -> tuple[float, float]:
    """Median seconds of ``turbrestore --help``, and its ratio to starting Python and importing NumPy."""

    def seconds(code: str) -> float:
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
        return time.perf_counter() - begun

    pairs = [
        (seconds("from turbrestore_cli.__main__ import main; main(['--help'])"), seconds("import numpy"))
        for _ in range(runs)
    ]
    return float(np.median([a for a, _ in pairs])), float(np.median([a / b for a, b in pairs]))


def make_frames(count: int, size: int) -> np.ndarray:
    """Frames of the chart under smooth random flow, blurred by 1 to 2 pixels."""
    rng = np.random.default_rng(0)
    flows = smooth_flows(count, size, size, rng, SmoothFlowParams(rms=1.5))
    scene = resolution_chart(size, size)
    return np.stack([distort(scene, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows])


def time_ratio(count: int, size: int, runs: int) -> tuple[float, float, float]:
    """Median seconds of a restoration, of its flow calls alone, and the median of their ratios."""
    frames = make_frames(count, size)
    params = RestoreParams(flow=FlowParams(threads=THREADS))
    whole, bare = [], []
    for _ in range(runs):
        begun = time.perf_counter()
        restoration = restore(frames, params)
        whole.append(time.perf_counter() - begun)
        passes = len(restoration.centroid.mean_flow_sizes)
        calls = passes * restoration.train + params.filter.inner_iterations * count - restoration.train
        begun = time.perf_counter()
        stream = (frames[index % count] for index in range(calls))
        for _ in iterate_flows(restoration.mean, stream, params.flow):
            pass
        bare.append(time.perf_counter() - begun)
    ratios = [a / b for a, b in zip(whole, bare, strict=True)]
    return float(np.median(whole)), float(np.median(bare)), float(np.median(ratios))


def peak_memory(count: int, size: int) -> float:
    """Peak resident memory, MB, of a child process that restores ``count`` frames made as they are read."""
    command = [sys.executable, __file__, "--child", str(count), "--size", str(size)]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    return float(json.loads(done.stdout)["peak_mb"])


def run_child(count: int, size: int) -> None:
    """Restore a repeated clip of 100 frames and print the peak resident memory of this process."""
    frames = np.rint(make_frames(100, size) * 255).astype(np.uint8)

    def pixels(numbers: range) -> Iterator[np.ndarray]:
        for number in numbers:
            yield frames[number % len(frames)]

    source = FrameSource(
        name="repeated", format="array", file_shape=(count, size, size), full_scale=255, bit_depth=8, pixels=pixels
    )
    restore(source, RestoreParams(train=60))
    # Linux counts kilobytes, macOS bytes.
    unit = 1024 if sys.platform != "darwin" else 1024 * 1024
    print(json.dumps({"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}))


def main() -> int:
    """Print both tables; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--child", type=int)
    options = parser.parse_args()
    if options.child is not None:
        run_child(options.child, options.size)
        return 0
    whole, bare, ratio = time_ratio(options.frames, options.size, options.runs)
    print("| frames | size | whole, s | flow calls alone, s | ratio | bound |\n|---|---|---|---|---|---|")
    print(f"| {options.frames} | {options.size} | {whole:.1f} | {bare:.1f} | {ratio:.2f} | {TIME_BOUND} |\n")
    few, many = peak_memory(260, 128), peak_memory(2060, 128)
    print("| filtered frames | peak memory, MB | growth, MB | bound |\n|---|---|---|---|")
    print(f"| 200 | {few:.0f} | | |\n| 2,000 | {many:.0f} | {many - few:.1f} | {MEMORY_BOUND_MB:.0f} |")
    help_seconds, help_cost = help_ratio(9)
    print("\n| --help, s | ratio to importing NumPy | bound |\n|---|---|---|")
    print(f"| {help_seconds:.2f} | {help_cost:.2f} | {HELP_BOUND:.0f} |")
    return int(help_cost > HELP_BOUND or ratio > TIME_BOUND or many - few > MEMORY_BOUND_MB)


if __name__ == "__main__":
    sys.exit(main())

"""Milliseconds of every stage on the CPU and on a device, transfers, a whole restoration, and agreement.

    python benchmarks/device.py --device cuda --size 1080 1920 --frames 100 --runs 1 --write FILE

prints a Markdown document, writes it, and exits with 1 where device and CPU differ by more than 0.02 dB or 0.02 px.
Without ``--device`` it takes a GPU where torch sees one, else torch on the CPU.  Times are the best of some runs, all
in one process; they include the transfer to the device and back.

Bytes are those that a stage cannot do without: every array that a step takes and gives, once for each step, 4 bytes a
number, and none of the intermediate results.  The bandwidth that they are held against is that of copying 256 MB.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from provenance import publish

from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve_steps
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams, nonlocal_weights
from turbrestore.deconvolution.nonlocal_prior.torch_nonlocal import torch_nonlocal_penalty
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import FilterParams, filter_frames
from turbrestore.metrics import psnr
from turbrestore.pipeline import restore
from turbrestore.registration.flow import FlowParams, estimate_flow
from turbrestore.registration.flow_methods.tvl1 import TvL1Params, prepare_tvl1, tvl1_flows
from turbrestore.registration.warp import warp
from turbrestore.runtime.device import CPU, find_device
from turbrestore.runtime.image_stacks import load, store
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.runtime.threads import available_cores
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

DECIBELS, PIXELS = 0.02, 0.02
FRAMES, SIGMA = 8, 1.5
MANY = 30


@dataclass(frozen=True)
class Clip:
    """A scene, frames of it, and flows from the mean of the frames to each."""

    scene: FloatArray
    frames: FloatArray
    flows: FloatArray


@dataclass(frozen=True)
class Stage:
    """Run it on a device; ``numbers`` a pixel that it takes and gives; divide by ``count`` for one frame."""

    name: str
    run: Callable[[str], object]
    numbers: float
    count: int = 1


def make_clip(height: int, width: int) -> Clip:
    """Make frames of a photograph under smooth random flow of 1.5 px."""
    rng = np.random.default_rng(0)
    scene = SCENES["camera"](height, width)
    flows = smooth_flows(FRAMES, height, width, rng, SmoothFlowParams(rms=1.5))
    return Clip(scene, distort(scene, flows, rng, blur=SIGMA, noise=0.01), flows)


def stages(clip: Clip, device: str) -> list[Stage]:
    """List what is measured, up to the iterations of the deconvolution."""
    grey, image = 255 * clip.frames, clip.frames.mean(axis=0)
    references = {name: prepare_tvl1(grey.mean(axis=0), device=name) for name in (CPU, device)}
    params, dynamics = TvL1Params(), identify(clip.flows)
    warps = float(tvl1_flows(grey[:1], references[CPU]).warps[0])
    # Flow, its extrapolation and the dual variable come and go in a sweep, and four maps of the data term come; a warp
    # takes coefficients, reference, gradient and flow and gives those maps and a median.  A pyramid adds a third.
    flow = 4 / 3 * warps * (20 * params.sweeps + 15)

    def weigh(name: str) -> object:
        if name == CPU:
            return nonlocal_weights(image)
        return torch_nonlocal_penalty(image, NonlocalParams(h=0.1), name).root.cpu()

    def fuse(name: str) -> object:
        settings, runtime = FilterParams(inner_iterations=1), Runtime(device=name)
        return filter_frames(clip.frames, image, dynamics, settings, known_flows=clip.flows, runtime=runtime)

    return [
        Stage("flow (tvl1)", lambda name: tvl1_flows(grey, references[name]), flow, FRAMES),
        # Pixels and flow come, pixels go; coefficients come and go between.
        Stage("warp", lambda name: warp(image, clip.flows[0], device=name), 6),
        # A frame and two flows come; eight maps, image and variance come, the last two go.
        Stage("filter, statistics and flow state included", fuse, 17, FRAMES),
        # Distances to all pixels of the window are written and read.
        Stage("nonlocal weights", weigh, 2 * NonlocalParams().search ** 2),
    ]


def milliseconds(run: Callable[[], object], runs: int) -> float:
    """Best time of a few runs after one that is not counted."""
    run()
    times = []
    for _ in range(runs):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return 1e3 * min(times)


def solver(clip: Clip, device: str, runs: int) -> tuple[float, float]:
    """Milliseconds of an iteration of nltv, and numbers a pixel that it takes and gives."""
    image = clip.frames.mean(axis=0)

    params = DeconvolutionParams(iterations=MANY, tolerance=0.0)
    times = []
    for _ in range(runs):
        ends: list[float] = []
        steps = deconvolve_steps(image, SIGMA, params, runtime=Runtime(device=device))
        finish(steps, lambda _, ends=ends: ends.append(time.perf_counter()))
        times.append(1e3 * float(np.median(np.diff(ends))))

    edges = len(nonlocal_weights(image).heads) / image.size
    # The dual variable comes and goes, twice what it is made of; three maps of the edges come twice; four transforms.
    return min(times), 14 * edges + 16


def copy_bandwidth(device: str) -> float:
    """Bytes a second that copying moves, reading and writing."""
    if device == CPU:
        a = np.zeros(2**26, np.float32)
        b = np.ones_like(a)
        return 2e3 * a.nbytes / milliseconds(lambda: np.copyto(b, a), 5)
    import torch

    source = torch.zeros(2**26, device=device)
    target = torch.ones_like(source)

    def copy() -> None:
        for _ in range(10):
            target.copy_(source)
        # Reading a number waits for the device.
        target[0].item()

    return 10 * 2e3 * 4 * 2**26 / milliseconds(copy, 5)


def transfers(clip: Clip, device: str) -> list[str]:
    """Bandwidth of bringing a flow to the device and back, and what both take."""
    flow = np.ascontiguousarray(clip.flows[0])
    there = load(flow, device)

    def to_the_device() -> None:
        # Reading a number waits for the device.
        load(flow, device)[0, 0, 0].item()

    rows = []
    for name, run in (("to the device", to_the_device), ("back", lambda: store(there))):
        taken = milliseconds(run, 5)
        rows.append(f"| {name} | {flow.nbytes / 1e6:.1f} | {taken:.2f} | {flow.nbytes / 1e6 / taken:.1f} |")
    return ["\n| a flow | MB | ms | GB/s |", "|---|---:|---:|---:|", *rows]


def whole(clip: Clip, device: str, count: int) -> list[str]:
    """Seconds of a restoration by tvl1 on the device, by stage, after a small one that compiles what has to be."""
    rng, runtime = np.random.default_rng(1), Runtime(device=device)
    params = RestoreParams(flow=FlowParams(method="tvl1"))
    noise = (0.01 * rng.standard_normal(clip.scene.shape)).astype(np.float32)
    moved = (np.roll(noise, (37 * k, 91 * k), (0, 1)) for k in range(count))
    frames = np.stack([np.clip(clip.frames[k % FRAMES] + grain, 0, 1) for k, grain in enumerate(moved)])
    restore(frames[:12, :256, :256], params, runtime)
    begun = time.perf_counter()
    restored = restore(frames, params, runtime)
    taken = time.perf_counter() - begun
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in restored.seconds.items())
    return [f"\nA restoration of {count} frames on {device} takes {taken:.1f} s: {stages}."]


def agreement(clip: Clip, device: str) -> tuple[float, float, float]:
    """Difference of a restoration in dB, and of its flows in pixels, mean and largest."""
    params, image = RestoreParams(flow=FlowParams(method="tvl1")), clip.frames.mean(axis=0)
    runtimes = [Runtime(device=name) for name in (CPU, device)]
    here, there = (restore(clip.frames, params, runtime) for runtime in runtimes)
    flows = [estimate_flow(image, clip.frames, params.flow, runtime) for runtime in runtimes]
    apart = np.linalg.norm(flows[0] - flows[1], axis=-1)
    return psnr(there.image, clip.scene) - psnr(here.image, clip.scene), float(apart.mean()), float(apart.max())


def document(size: tuple[int, int], device: str, runs: int, count: int) -> tuple[str, bool]:
    """Markdown of the table, and whether device and CPU agree."""
    clip = make_clip(*size)
    bandwidth = copy_bandwidth(device)
    lines = [
        "# Computing on a device\n",
        "What `python benchmarks/device.py --write benchmarks/results/device.md` measures: every stage on the CPU "
        "and on the device, against the bandwidth of copying.\n",
        f"{size[1]}×{size[0]}; {name_of(device)} copies {bandwidth / 1e9:.1f} GB/s; {available_cores()} cores.\n",
        "| stage, one frame or iteration | CPU, ms | device, ms | ratio | GB/s | share of copying |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    rows = []
    for stage in stages(clip, device):
        times = [milliseconds(lambda s=stage, n=name: s.run(n), runs) / stage.count for name in (CPU, device)]
        rows.append((stage.name, *times, stage.numbers))
    here, (there, numbers) = solver(clip, CPU, runs)[0], solver(clip, device, runs)
    for name, on_cpu, on_device, a_pixel in [*rows, ("iteration of nltv", here, there, numbers)]:
        moved = 4e3 * a_pixel * clip.scene.size / on_device
        cells = f"{on_cpu:.1f} | {on_device:.1f} | {on_cpu / on_device:.2f} | {moved / 1e9:.1f}"
        lines.append(f"| {name} | {cells} | {moved / bandwidth:.0%} |")
    lines += [*transfers(clip, device), *whole(clip, device, count)]
    decibels, mean, largest = agreement(clip, device)
    good = abs(decibels) <= DECIBELS and mean <= PIXELS
    lines.append(f"\nRestoration {decibels:+.4f} dB; flows {mean:.5f} px apart, {largest:.3f} at most.")
    lines.append(f"Within {DECIBELS} dB and {PIXELS} px: {'yes' if good else 'NO'}.")
    return "\n".join(lines) + "\n", good


def name_of(device: str) -> str:
    """Name of the GPU, or of the device."""
    import torch

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else f"torch {torch.__version__} on the CPU"


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--size", type=int, nargs=2, default=(256, 256), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--frames", type=int, default=24, help="frames of the whole restoration")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args()
    device = find_device(options.device or "auto")
    text, good = document(options.size, "cpu:0" if device == CPU else device, options.runs, options.frames)
    publish(text, options.write)
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())

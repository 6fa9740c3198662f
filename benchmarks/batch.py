"""How long a batch takes, beside the same clips restored one after the other.

    python benchmarks/batch.py --clips 60

prints the wall time of single runs of one thread in one process, that of ``turbrestore batch`` with as many processes
as there are cores (its start included), and their ratio to an even share of the single runs; it exits with 1 when that
is above the bound, or when a result differs.  Where something else runs meanwhile, processor time tells more.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from turbrestore.io.video import write_video
from turbrestore.runtime.threads import available_cores
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows
from turbrestore_cli.__main__ import main as turbrestore

BOUND = 1.15


@dataclass(frozen=True)
class Taken:
    """Wall and processor time of the single runs and of the batch, s, and whether the images are the same."""

    single: float
    single_cpu: float
    batch: float
    batch_cpu: float
    same: bool


def main() -> int:
    """Measure and compare; 1 where the batch takes too long or a result differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=60)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--size", type=int, default=128)
    options = parser.parse_args()
    taken, cores = measure(options.clips, options.frames, options.size), min(available_cores(), options.clips)
    ratio = taken.batch / (taken.single / cores)
    print(f"{options.clips} clips, {cores} processes: the same images: {taken.same}")
    print(f"wall time: single {taken.single:.1f} s, batch {taken.batch:.1f} s, ratio to an even share {ratio:.2f}")
    print(f"processor time: single {taken.single_cpu:.1f} s, batch {taken.batch_cpu:.1f} s")
    return int(not taken.same or ratio > BOUND)


def measure(clips: int, frames: int, size: int) -> Taken:
    """Restore clips one after the other, and by ``turbrestore batch``."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "clips").mkdir()
        (place / "single").mkdir()
        for number in range(clips):
            make_clip(place / "clips" / f"{number:03}.mkv", number, frames, size)
        names = sorted(path.stem for path in (place / "clips").iterdir())
        restore(place, names[0], "warm.png")
        start, before = time.perf_counter(), _processor_time()
        for name in names:
            restore(place, name, f"single/{name}.png")
        single, own = time.perf_counter() - start, _processor_time() - before
        start, before = time.perf_counter(), _processor_time()
        code = turbrestore(["batch", str(place / "clips"), "--out", str(place / "out"), "--threads", "1", "--quiet"])
        wall, theirs = time.perf_counter() - start, _processor_time() - before
        same = code == 0 and all(
            (place / f"single/{name}.png").read_bytes() == (place / f"out/{name}.png").read_bytes() for name in names
        )
    return Taken(single, own, wall, theirs, same)


def _processor_time() -> float:
    """Seconds that this process and those that it has ended have taken."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def make_clip(path: Path, seed: int, count: int, size: int) -> None:
    """Write a clip of a scene that moves smoothly."""
    rng = np.random.default_rng(seed)
    scene = SCENES["chart"](size, size)
    flows = smooth_flows(count, size, size, rng, SmoothFlowParams())
    write_video(path, distort(scene, flows, rng, blur=1.0, noise=0.01), 25)


def restore(place: Path, name: str, output: str) -> None:
    """Restore one clip with one thread."""
    words = ["restore", str(place / "clips" / f"{name}.mkv"), str(place / output), "--threads", "1", "--quiet"]
    if turbrestore(words):
        sys.exit(f"{name}: not restored")


if __name__ == "__main__":
    sys.exit(main())

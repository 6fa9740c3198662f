"""A clip of big frames in tiles that are shared among processes, beside the same clip in one piece.

    python benchmarks/big_frames.py --width 7680 --height 4320 --workers 4

prints, for each number of processes: the wall time; the processor time of all tasks; the share of the wall time,
between the first task and the last of centroid and filter, in which a process had a task; what travelled, the bytes of
tasks and results; the most memory of a process of Dask and of the command; and the PSNR of the filtered image beside
that of whole frames.  It exits with 1 where tiles lose more than the bound or numbers of processes differ by a bit.
Where something else runs on the machine, processor time and shares tell more than wall time.
"""

from __future__ import annotations

import argparse
import pickle
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.io.video import open_frames
from turbrestore.metrics import psnr
from turbrestore.pipeline import restore
from turbrestore.restoration_run import TileMap
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.scenes import SCENES
from turbrestore_cli.cluster import connected, over_workers

BOUND_DB = 0.05
# Pixels nearer to the border than this are not in every frame.
BORDER = 16
# Side of the scenes that the frames are laid out with, and the factor by which the drawn flows are enlarged.
SCENE, COARSE = 480, 4


@dataclass
class Watched:
    """What is seen of the tasks of a run."""

    processor: float = 0.0
    memory: int = 0
    traffic: int = 0
    stages: list[list[tuple[float, float]]] = field(default_factory=list)

    def busy(self, workers: int) -> float:
        """Share of the time of the stages in which a process had a task."""
        worked = sum(end - start for stage in self.stages for start, end in stage)
        passed = sum(max(end for _, end in stage) - min(start for start, _ in stage) for stage in self.stages)
        return worked / (workers * passed)

    def over(self, map_tiles: TileMap) -> TileMap:
        """Make a map that works as ``map_tiles`` and is watched."""

        def watched(function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
            self.stages.append([])
            for result, start, end, processor, memory, sent in map_tiles(partial(_timed, function), tasks):
                self.stages[-1].append((start, end))
                self.processor += processor
                self.memory = max(self.memory, memory)
                self.traffic += sent
                yield result

        return watched


def _timed(function: Callable[[Any], Any], task: Any) -> tuple[Any, float, float, float, int, int]:
    start, before = time.time(), time.process_time()
    result = function(task)
    end, processor = time.time(), time.process_time() - before
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return result, start, end, processor, memory, _size(task) + _size(result)


def _size(value: Any) -> int:
    """Bytes of a value and its arrays when it travels."""
    buffers: list[pickle.PickleBuffer] = []
    head = len(cloudpickle.dumps(value, 5, buffer_callback=buffers.append))
    return head + sum(buffer.raw().nbytes for buffer in buffers)


def make_clip(path: Path, count: int, height: int, width: int) -> FloatArray:
    """Write 8-bit grey frames that move smoothly, one after the other; return the scene."""
    rng, names = np.random.default_rng(5), ("camera", "brick", "coins", "page")
    scenes = [np.asarray(SCENES[name](SCENE, SCENE), np.float32) for name in names]
    scene = np.empty((height, width), np.float32)
    for row, top in enumerate(range(0, height, SCENE)):
        for column, left in enumerate(range(0, width, SCENE)):
            piece = scenes[(row + 3 * column) % 4][: height - top, : width - left]
            scene[top : top + SCENE, left : left + SCENE] = piece
    soft = cv2.GaussianBlur(scene, (0, 0), 1.2)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    frames = np.lib.format.open_memmap(path, "w+", np.uint8, (count, height, width))
    flow = np.zeros((2, height // COARSE, width // COARSE), np.float32)
    for frame in frames:
        noise = rng.standard_normal(flow.shape, np.float32)
        new = np.stack([cv2.GaussianBlur(component, (0, 0), 4.0) for component in noise])
        flow = 0.8 * flow + 0.6 * 1.5 * new / new.std()
        along = [cv2.resize(component, (width, height), interpolation=cv2.INTER_CUBIC) for component in flow]
        moved = cv2.remap(soft, columns + along[0], rows + along[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        frame[...] = np.clip(np.rint(255 * (moved + 0.01 * rng.standard_normal(moved.shape, np.float32))), 0, 255)
    frames.flush()
    return scene


def main() -> int:
    """Print the table; 1 where tiles lose more than the bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1088)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--tile", type=int, default=1088)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    options = parser.parse_args()
    params = RestoreParams(until="filter")
    images: list[FloatArray] = []
    inner = slice(BORDER, -BORDER)
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.npy"
        truth = make_clip(clip, options.frames, options.height, options.width)[inner, inner]

        def run(tile: int | None, map_tiles: TileMap | None) -> tuple[float, float, float]:
            start, before = time.perf_counter(), time.process_time()
            found = restore(open_frames(clip), params, Runtime(threads=1, tile=tile), map_tiles=map_tiles)
            assert found.filtered is not None
            images.append(found.filtered.image.copy())
            wall, own = time.perf_counter() - start, time.process_time() - before
            return wall, own, psnr(images[-1][inner, inner], truth)

        for workers in options.workers:
            watched = Watched()
            with connected(None, workers, quiet=True) as client:
                client.wait_for_workers(workers)
                wall, own, quality = run(options.tile, watched.over(over_workers(client)))
            print(
                f"{workers} processes: {wall:.0f} s, {quality:.3f} dB; "
                f"processor time: tasks {watched.processor:.0f} s, command {own:.0f} s; "
                f"tasks {100 * watched.busy(workers):.0f} % of the time of the processes; "
                f"traffic {watched.traffic / 1e9:.2f} GB; memory: process {watched.memory / 1e9:.1f} GB, "
                f"command {_peak() / 1e9:.1f} GB",
                flush=True,
            )
        same = all(np.array_equal(images[0], image) for image in images)
        wall, own, whole = run(None, None)
        print(f"whole frames: {wall:.0f} s, {whole:.3f} dB; processor time {own:.0f} s; memory {_peak() / 1e9:.1f} GB")
    between = psnr(images[0][inner, inner], images[-1][inner, inner])
    print(
        f"tiles: gain {quality - whole:+.3f} dB (bound {-BOUND_DB:g}), {between:.1f} dB between both; same bits: {same}"
    )
    return 0 if same and quality - whole >= -BOUND_DB else 1


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    sys.exit(main())

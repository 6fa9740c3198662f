"""Restore frames in a process of its own, by whichever revision of the package comes first on the path.

An earlier revision has the public names of ``turbrestore`` alone in common with the present tree, so nothing else is
imported.  ``--child`` takes a task as JSON (see :func:`run`), and the figures are printed as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import turbrestore as tr

# Frames and side of what is restored first, so that all that is loaded, compiled and started once has been.
WARM_FRAMES, WARM_SIDE = 24, 64


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Restore a clip, or steady it; seconds of the clock and of the processor, and those of every stage.

    The task names a file of 8-bit or float ``frames`` (.npy), and may ask for the ``count`` of frames, which are
    repeated in order, a ``preset``, ``threads``, frames to ``train`` and ``passes`` of the centroid, for a file of
    ``images`` (.npz) to write, or for a ``steady`` video.
    """
    stored = np.load(task["frames"])
    source = repeated(stored, task.get("count", len(stored)))
    params, runtime = tr.preset(task.get("preset", "standard")), tr.Runtime(threads=task.get("threads", 0))
    if "passes" in task:
        params = replace(params, centroid=tr.CentroidParams(iterations=task["passes"]))
    small = stored[:WARM_FRAMES, :WARM_SIDE, :WARM_SIDE]
    stages, train = dict[str, float](), 0
    if task.get("steady"):
        deque(tr.steady_frames(small / np.float32(255), runtime=runtime), 0)
        begun, worked = time.perf_counter(), time.process_time()
        deque(tr.steady_frames(source, runtime=runtime), 0)
    else:
        tr.restore(repeated(small, len(small)), params, runtime)
        params = replace(params, train=task.get("train"))
        begun, worked = time.perf_counter(), time.process_time()
        restoration = tr.restore(source, params, runtime)
        stages, train = dict(restoration.seconds), restoration.train
        if "images" in task:
            np.savez(Path(task["images"]), filtered=restoration.filtered.image, result=restoration.image)
    seconds, cpu = time.perf_counter() - begun, time.process_time() - worked
    return {"seconds": seconds, "cpu": cpu, "stages": stages, "train": train}


def repeated(stored: np.ndarray, count: int) -> Any:
    """Return a clip that repeats a few frames."""
    if count == len(stored):
        return tr.FrameSource.from_array(stored)

    def pixels(numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for number in numbers:
            yield stored[number % len(stored)]

    shape = (count, *stored.shape[1:])
    return tr.FrameSource("repeated", "array", shape, full_scale=255, bit_depth=8, pixels=pixels)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--child", metavar="JSON", required=True)
    print(json.dumps(run(json.loads(parser.parse_args().child))))

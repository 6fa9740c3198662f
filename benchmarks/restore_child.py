"""Restore frames in a process of its own, by whichever revision of the package comes first on the path.

An earlier revision has the public names of ``turbrestore`` alone in common with the present tree, so nothing else is
imported.  ``--child`` takes a task as JSON (see :func:`run`), and the figures are printed as JSON.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import turbrestore as tr


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Restore a clip.

    The task names a file of 8-bit or float ``frames`` (.npy), and may ask for the ``count`` of frames, which are
    repeated in order, for ``train`` and ``passes`` of the centroid, for a file of ``images`` (.npz) to write, and for
    the ``deconvolution`` by itself.
    """
    stored = np.load(task["frames"])
    source = repeated(stored, task.get("count", len(stored)))
    params = tr.RestoreParams(train=task.get("train"))
    if "passes" in task:
        params = tr.RestoreParams(train=task.get("train"), centroid=tr.CentroidParams(iterations=task["passes"]))
    # What is loaded, compiled and started once.
    tr.restore(repeated(stored[:4, :32, :32], 4))
    begun, worked = time.perf_counter(), time.process_time()
    restoration = tr.restore(source, params)
    # Linux counts kilobytes, macOS bytes.
    unit = 1024 if sys.platform != "darwin" else 1024 * 1024
    figures: dict[str, Any] = {
        "seconds": time.perf_counter() - begun,
        "cpu": time.process_time() - worked,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        "stages": restoration.seconds,
        "calls": (len(restoration.centroid.mean_flow_sizes) - 1) * restoration.train
        + params.filter.inner_iterations * len(source),
    }
    if task.get("deconvolution"):
        begun = time.perf_counter()
        tr.deconvolve(restoration.filtered.image, restoration.deconvolution.sigma, guide=restoration.centroid.image)
        figures["deconvolution"] = time.perf_counter() - begun
    if "images" in task:
        np.savez(Path(task["images"]), filtered=restoration.filtered.image, result=restoration.image)
    return figures


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

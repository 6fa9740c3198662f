"""How well the stated deviation of every pixel bounds the error, as a Markdown table.

Run ``python benchmarks/uncertainty.py`` with ``TURBRESTORE_DATA``: the simulated clips are restored, their middle of
160 pixels a side, and compared with the scene at their mean geometry.  Rows marked "scene itself" are of clips for
which that is not known (no ``truth_centroid.png``), so their error includes how the mean geometry bends the scene.
With ``--halves`` both halves of each clip are restored too: they are independent, so their difference has the
deviations of both, and the geometry of both besides.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.io.images.image_files import read_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.pipeline import restore
from turbrestore.results import Restoration
from turbrestore.runtime.runtime import Runtime

SIDE, BORDER = 160, 12
INSIDE = np.s_[BORDER:-BORDER, BORDER:-BORDER]


def middle(path: Path) -> tuple[FrameSource, tuple[slice, slice]]:
    """Open the middle of a clip, and say where it lies."""
    source = open_frames(path)
    top, left = ((size - SIDE) // 2 for size in source.shape[1:3])
    return source.select(roi=(left, top, SIDE, SIDE)), np.s_[top : top + SIDE, left : left + SIDE]


def figures(error: FloatArray, deviation: FloatArray) -> str:
    """Root mean square of the error, the share of pixels within two deviations, and the rank correlation."""
    size, stated = np.abs(error[INSIDE]).ravel(), deviation[INSIDE].ravel()
    known = np.isfinite(stated)
    rank = spearmanr(size[known], stated[known])[0]
    within = np.mean(size[known] <= 2 * stated[known])
    return f"{np.sqrt(np.mean(size**2)):.4f} | {np.median(stated):.4f} | {within:.3f} | {rank:.2f}"


def restored(source: FrameSource) -> tuple[Restoration, float]:
    """Restore with one thread; also the share of the time that seeing and uncertainty take."""
    begun = time.perf_counter()
    restoration = restore(source, runtime=Runtime(threads=1))
    added = restoration.seconds["seeing"] + restoration.seconds["uncertainty"]
    return restoration, added / (time.perf_counter() - begun)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--halves", action="store_true", help="restore both halves too")
    halves, folder = parser.parse_args().halves, os.environ.get("TURBRESTORE_DATA")
    if folder is None:
        sys.exit("TURBRESTORE_DATA is not set: no clips whose scene is known")
    print("| clip | error, rms | deviation, median | within two | rank correlation | share of the time |")
    print("|---|---|---|---|---|---|")
    for path in sorted(Path(folder, "simulated").glob("*/clip.mkv")):
        source, place = middle(path)
        bent = path.with_name("truth_centroid.png")
        truth = luminance(read_image(bent if bent.exists() else path.with_name("truth.png")).image)[place]
        name = path.parent.name if bent.exists() else f"{path.parent.name}, scene itself"
        restoration, share = restored(source)
        assert restoration.uncertainty is not None
        row = figures(luminance(restoration.image) - truth, restoration.uncertainty)
        print(f"| {name} | {row} | {share:.3f} |", flush=True)
        if halves:
            half = len(source) // 2
            one, other = (restored(source.select(frames=part))[0] for part in ((0, half), (half, None)))
            assert one.uncertainty is not None and other.uncertainty is not None
            row = figures(luminance(one.image) - luminance(other.image), np.hypot(one.uncertainty, other.uncertainty))
            print(f"| {path.parent.name}, difference of halves | {row} | |", flush=True)


if __name__ == "__main__":
    main()

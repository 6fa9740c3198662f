"""What each choice in the alternating filter buys, as PSNR before deconvolution.

Run ``python benchmarks/filter.py``.  Clips: one synthetic sequence made here, and the simulated clips under the folder
that ``TURBRESTORE_DATA`` names, where they exist.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from provenance import publish_printed

from turbrestore.core.arrays import FloatArray
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import FilterParams, filter_frames
from turbrestore.io.images.image_files import read_image
from turbrestore.io.video import open_frames
from turbrestore.memory_plan import training_share
from turbrestore.metrics import compare
from turbrestore.registration.centroid import find_centroid
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import distort, smooth_flows

DEFAULT = FilterParams()
VARIANTS = {
    "default": DEFAULT,
    "block 1": replace(DEFAULT, block=1),
    "block 32": replace(DEFAULT, block=32),
    "inner 1": replace(DEFAULT, inner_iterations=1),
    "inner 3": replace(DEFAULT, inner_iterations=3),
    "sharpness 0": replace(DEFAULT, sharpness=0.0),
    "sharpness 2": replace(DEFAULT, sharpness=2.0),
    "sharpness 3": replace(DEFAULT, sharpness=3.0),
    "drop": replace(DEFAULT, residual="drop"),
    "drop, sharpness 0": replace(DEFAULT, residual="drop", sharpness=0.0),
}


def synthetic() -> tuple[FloatArray, FloatArray]:
    """Frames of the chart with changing blur, and the chart."""
    rng = np.random.default_rng(0)
    scene = resolution_chart(192, 192)
    flows = smooth_flows(120, 192, 192, rng)
    flows -= flows.mean(axis=0)
    frames = [distort(scene, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows]
    return np.stack(frames), scene


def simulated(names: list[str]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Frames and truth of the clips under TURBRESTORE_DATA."""
    root = Path(os.environ.get("TURBRESTORE_DATA", "")) / "simulated"
    folders = sorted(path.parent for path in root.glob("*/truth.png"))
    return {
        folder.name: (open_frames(folder / "clip.mkv").read(), read_image(folder / "truth.png").image)
        for folder in folders
        if not names or folder.name in names
    }


HEAD = """# Choices of the alternating filter

Printed by `TURBRESTORE_DATA=DIR python benchmarks/filter.py`.

PSNR, dB, before deconvolution. The first row is made by the script; the others are clips of three simulators with 120
frames of 256×256."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clips", nargs="*", help="names of simulated clips; all by default")
    names = parser.parse_args().clips
    columns = ["temporal mean", "centroid", *VARIANTS]
    print(f"| clip | {' | '.join(columns)} |\n|{'---|' * (len(columns) + 1)}")
    for name, (frames, truth) in {"synthetic chart": synthetic(), **simulated(names)}.items():
        train = training_share(len(frames), frames.shape[1:])
        centroid = find_centroid(frames[:train])
        dynamics = identify(centroid.flows)
        images = [frames.mean(axis=0), centroid.image]
        images += [
            filter_frames(frames, centroid.image, dynamics, params, known_flows=centroid.flows).image
            for params in VARIANTS.values()
        ]
        print(f"| {name} | {' | '.join(f'{compare(image, truth).psnr:.2f}' for image in images)} |", flush=True)


if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))

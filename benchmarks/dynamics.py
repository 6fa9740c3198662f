"""What the flow of a frame is worth to the image: measured, of the flow model, or true.

    python benchmarks/dynamics.py --write benchmarks/results/dynamics.md

PSNR after deblurring against the scene at the mean geometry, of clips made here by phase screens: three scenes at
medium turbulence, with noise, and with 30 % of the frames missing or half of the scene flat.  The true flow is a bound
on what any model of the motion could give to the image.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from provenance import publish

from turbrestore.core.arrays import FloatArray
from turbrestore.deblurring.remove_blur import remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import FilterParams, filter_frames
from turbrestore.metrics import compare
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import warp
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.scenes import SCENES

NAMES, COUNT, SIDE, BORDER = ("camera", "brick", "chart"), 60, 160, 8
NOISES = (0.01, 0.05, 0.12)
KINDS = ("as is", "missing", "half flat")
MISSING = 0.3
COLUMNS = ("measured flow", "flow of the model", "true flow")

Row = dict[str, float]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strength", nargs="+", choices=STRENGTHS, default=["medium"])
    parser.add_argument("--scenes", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args()
    rows: dict[tuple[str, ...], Row] = {}
    for strength, kind, noise, name in product(options.strength, KINDS, NOISES, options.scenes):
        key = strength, kind, f"{noise:g}", name
        rows[key] = measure(strength, kind, noise, name)
        print(*key, rows[key], file=sys.stderr, flush=True)
    publish(document(rows), options.write)
    return 0


def measure(strength: str, kind: str, noise: float, name: str) -> Row:
    """PSNR, dB, of each column."""
    frames, flows, truth = clip(strength, kind, noise, name)
    whole = restore(frames)
    # One width for all flows, so that they alone make the difference; none where the mean is the result.
    sigma = 0.0 if whole.deconvolution is None else whole.deconvolution.sigma
    blur = DeconvolutionParams(sigma=sigma, exponent=None if whole.blur is None else whole.blur.exponent)
    drop, once = FilterParams(residual="drop"), FilterParams(inner_iterations=1)
    fused = filter_frames(frames, whole.centroid.image, identify(flows), once, known_flows=flows).image
    images = {
        "measured flow": whole.image,
        "flow of the model": restore(frames, RestoreParams(filter=drop, deconvolution=blur)).image,
        "true flow": finish(remove_blur_steps(fused, whole.centroid.image, blur)).deconvolution.image,
    }
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    return {column: compare(image[inner], truth[inner]).psnr for column, image in images.items()}


def clip(strength: str, kind: str, noise: float, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frames, the flows to them from the scene at their mean geometry, and that scene."""
    scene = SCENES[name](SIDE, SIDE)
    if kind == "half flat":
        scene[:, SIDE // 2 :] = scene[:, SIDE // 2 :].mean()
    seen = list(phase_screen_frames(scene, COUNT, np.random.default_rng(7), PhaseScreenParams(STRENGTHS[strength])))
    rng = np.random.default_rng(8)
    if kind == "missing":
        seen = [seen[index] for index in sorted(rng.permutation(COUNT)[round(MISSING * COUNT) :])]
    frames = np.stack([frame.image for frame in seen])
    frames = np.clip(frames + rng.normal(0, noise, frames.shape), 0, 1).astype(np.float32)
    back = invert_flow(np.mean([frame.flow for frame in seen], axis=0))
    flows = np.stack([compose_flows(frame.flow, back) for frame in seen])
    return frames, flows, warp(scene, back)


def document(rows: dict[tuple[str, ...], Row]) -> str:
    """Markdown of all rows and of their means."""
    lines = [
        "# Dynamics\n",
        "What `python benchmarks/dynamics.py --write benchmarks/results/dynamics.md` measures: PSNR "
        f"after deblurring, dB, against the scene at the mean geometry; phase screens, {COUNT} frames of {SIDE} pixels "
        f"a side, of which 'missing' lacks {100 * MISSING:.0f} %.  turbrestore registers frames by the measured flow.  "
        "The other columns are differences to it: of the flow of the model as the paper prints it, and of the true "
        "flow, which no model of the motion can surpass.  All are deblurred by the width that turbrestore removes.\n",
        "| turbulence | frames | noise | scene | measured flow | flow of the model | true flow |",
        "|---|---|---:|---|---:|---:|---:|",
        *(f"| {' | '.join(key)} | {_cells(row)} |" for key, row in rows.items()),
        "\n## Means\n",
        "| turbulence | frames | noise | measured flow | flow of the model | true flow |",
        "|---|---|---:|---:|---:|---:|",
        *_means(rows),
    ]
    return "\n".join(lines) + "\n"


def _means(rows: dict[tuple[str, ...], Row]) -> Iterator[str]:
    for group in dict.fromkeys(key[:-1] for key in rows):
        inside = [row for key, row in rows.items() if key[:-1] == group]
        mean = {column: float(np.mean([row[column] for row in inside])) for column in COLUMNS}
        yield f"| {' | '.join(group)} | {_cells(mean)} |"


def _cells(row: Row) -> str:
    return " | ".join([f"{row[COLUMNS[0]]:.2f}", *(f"{row[column] - row[COLUMNS[0]]:+.2f}" for column in COLUMNS[1:])])


if __name__ == "__main__":
    sys.exit(main())

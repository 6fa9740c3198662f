"""What limits a result: the same clips restored as they are, with the true motion, with the true blur, and without end.

    python benchmarks/oracles.py --write benchmarks/results/oracles.md

Scenes that no constant was set on are blurred and moved by smooth random flows, with one thing at a time made worse.
The versions that are compared are told the true motion or the true blur.  Clips of every simulator of
:mod:`blur_simulators` follow, with seeds on which nothing was trained.  ``--quick`` takes one scene, and one clip of
each simulator.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from blur_calibration import registered, transfer_function
from blur_clips import part_of
from blur_simulators import simulate
from clips import DRAWN_SCENES
from methods.deblurring import deblurred, known, levels_of
from provenance import publish

from turbrestore.blur.witnesses.hypotheses import shapes
from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import warp
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SCENES, SIDE, BORDER = DRAWN_SCENES[:3], 176, 12
FRAMES = (8, 15, 30, 60, 120)
COLUMNS = ("mean", "turbrestore", "true flow", "true blur", "both", "unlimited frames", "against the scene")
SIMULATORS = {
    "screens": "phase screens",
    "kernels": "sums of random short exposures",
    "lens": "blurred scenes, still or moved by smooth flows",
    "mixed": "blur that differs from place to place",
    "near": "blur of 3 to 8 px that differs from place to place",
    "close": "sums of short exposures, 2 to 7.5 px wide",
    "chamber": "words in a heat chamber, 2.5 to 8 px wide",
    "none": "no turbulence",
}
# First seed, and number of clips of each simulator.
UNSEEN, CLIPS = 9000, 5
SIMULATED = ("mean", "filtered", "turbrestore", "true blur")


@dataclass(frozen=True)
class Case:
    """Number of frames, displacement and blur in pixels, noise as a share of white."""

    count: int = 30
    displacement: float = 1.5
    blur: float = 1.2
    noise: float = 0.01


BASE = Case()
CASES = {
    "base": BASE,
    "8 frames": replace(BASE, count=8),
    "displacement 4 px": replace(BASE, displacement=4.0),
    "blur 2.5 px": replace(BASE, blur=2.5),
    "noise 0.05": replace(BASE, noise=0.05),
}

Row = dict[str, float]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one scene, at most 15 frames, one simulated clip each")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args()
    scenes, most = (SCENES[:1], 15) if options.quick else (SCENES, FRAMES[-1])
    cases = CASES | {f"{count} frames": replace(BASE, count=count) for count in FRAMES}
    rows: dict[str, Row] = {}
    for title, case in cases.items():
        found = [measure(scene, replace(case, count=min(case.count, most))) for scene in scenes]
        rows[title] = {column: float(np.mean([row[column] for row in found])) for column in COLUMNS}
        print(title, rows[title], file=sys.stderr, flush=True)
    clips = 1 if options.quick else CLIPS
    simulated = {title: by_simulator(name, clips) for name, title in SIMULATORS.items()}
    publish(document(rows, scenes, simulated, clips), options.write)
    return 0


def measure(scene: str, case: Case) -> Row:
    """PSNR, dB, of each column."""
    frames, flows, truth, original = clip(scene, case)
    whole = restore(frames)
    filtered = whole.centroid.image if whole.filtered is None else whole.filtered.image
    sigma = 0.0 if whole.deconvolution is None else whole.deconvolution.sigma
    same = DeconvolutionParams(sigma=sigma, exponent=None if whole.posterior is None else whole.posterior.exponent)
    merged = np.mean([warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)], axis=0, dtype=np.float32)
    limit = cv2.GaussianBlur(truth, (0, 0), case.blur)
    levels = levels_of(frames)
    images = {
        "mean": whole.mean,
        "turbrestore": whole.image,
        "true flow": deblurred(merged, levels, same).image,
        "true blur": deblurred(filtered, levels, blur_of(filtered, registered(truth, filtered)), *known(whole)).image,
        "both": deblurred(merged, levels, blur_of(merged, truth)).image,
        "unlimited frames": deblurred(limit, levels, blur_of(limit, truth)).image,
    }
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    row = {column: compare(image[inner], truth[inner]).psnr for column, image in images.items()}
    return row | {"against the scene": compare(whole.image[inner], original[inner]).psnr}


def by_simulator(name: str, count: int) -> Row:
    """Mean PSNR, dB, of each column over clips of a simulator, after the best gain and offset."""
    rows = list[list[float]]()
    for seed in itertools.count(UNSEEN):
        drawn = simulate(seed, name)
        # A title that was burned in is no part of the scene.
        if drawn.hidden.any():
            continue
        whole = restore(drawn.frames)
        filtered = whole.centroid.image if whole.filtered is None else whole.filtered.image
        truth = registered(drawn.truth, filtered)
        told = deblurred(filtered, levels_of(drawn.frames), blur_of(filtered, truth), *known(whole)).image
        rows.append([compare(image, truth).psnr_fit for image in (whole.mean, filtered, whole.image, told)])
        if len(rows) == count:
            return dict(zip(SIMULATED, np.mean(rows, axis=0), strict=True))
    raise AssertionError


def clip(scene: str, case: Case) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Frames, the flows to them from the scene at their mean geometry, that scene, and the scene itself."""
    rng = np.random.default_rng(zlib.crc32(f"oracles {scene}".encode()))
    original = part_of(scene, (SIDE, SIDE), rng, 2 * SIDE)
    moved = smooth_flows(case.count, SIDE, SIDE, rng, SmoothFlowParams(rms=case.displacement))
    frames = distort(original, moved, rng, case.blur, case.noise)
    back = invert_flow(moved.mean(axis=0))
    return frames, np.stack([compose_flows(flow, back) for flow in moved]), warp(original, back), original


def blur_of(image: FloatArray, truth: FloatArray) -> DeconvolutionParams:
    """Width and shape that fit the transfer function from the truth to the image."""
    (width,), (exponent,) = shapes(transfer_function(image, truth)[None])
    return DeconvolutionParams(sigma=float(width), exponent=float(exponent))


def document(rows: dict[str, Row], scenes: tuple[str, ...], simulated: dict[str, Row], clips: int) -> str:
    """Markdown of all tables."""
    return "\n".join(
        [
            "# What limits a result\n",
            "What `python benchmarks/oracles.py --write benchmarks/results/oracles.md` measures: PSNR, dB, means over "
            f"the scenes {', '.join(scenes)} ({SIDE}×{SIDE} pixels), blurred and then moved by smooth random flows: "
            f"{BASE.count} frames, displacement {BASE.displacement} px, blur {BASE.blur} px, noise {BASE.noise}, if "
            "the row does not say otherwise.  All columns but the last compare with the scene at the mean geometry of "
            "the frames.\n",
            "- **true flow**: mean of the frames registered by their true flows, deblurred by the width that "
            "turbrestore removes.\n"
            "- **true blur**: filtered image of turbrestore, deblurred by the width and shape of its true transfer "
            "function, which is fitted to the truth; without weights by brightness and the checks that follow.\n"
            "- **both**: both; all that so many frames can give to this deconvolution.\n"
            "- **unlimited frames**: the blurred scene without noise, deblurred by its true blur.\n"
            "- **against the scene**: turbrestore, compared with the scene itself: what the mean geometry of so few "
            "frames leaves bent.\n",
            "## One thing made worse at a time\n",
            *_table(rows, CASES),
            "\n## More frames\n",
            *_table(rows, [f"{count} frames" for count in FRAMES]),
            "\n## Other turbulence and other cameras\n",
            f"Means over {clips} clips of each simulator, whose scene, number of frames, noise and codec are drawn at "
            "random; the networks that tell the blur were trained on other clips of the same simulators.  PSNR, dB, "
            "is after the best gain and offset; *true blur* is as above.\n",
            *_table(simulated, simulated, SIMULATED),
            "",
        ]
    )


def _table(rows: dict[str, Row], titles: Iterable[str], columns: tuple[str, ...] = COLUMNS) -> Iterator[str]:
    yield f"| clip | {' | '.join(columns)} |"
    yield f"|---|{'---:|' * len(columns)}"
    for title in titles:
        yield f"| {title} | {' | '.join(f'{rows[title][column]:.2f}' for column in columns)} |"


if __name__ == "__main__":
    sys.exit(main())

"""What each choice of the defaults is worth, and what the blind estimate costs: PSNR of clips with known truth.

    TURBRESTORE_DATA=DIR python benchmarks/ablation.py --write benchmarks/results/ablation.md

prints a Markdown document and writes it.  Clips are those of ``benchmarks/quality.py`` that have a truth; ``--clips``
takes names or patterns.  ``--noise`` adds white noise of that standard deviation to the clips and cuts
them to [0, 1].
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from clips import Clip, find_clips
from provenance import arguments, publish

from turbrestore.blur.estimation import estimate_blur
from turbrestore.blur.psf import GAUSSIAN
from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.filtering.alternating import FilterParams
from turbrestore.metrics import compare
from turbrestore.pipeline import Restoration, RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams

DEFAULT = RestoreParams()
# Run anew from the frames.
VARIANTS = {
    "no contrast normalisation": replace(DEFAULT, flow=FlowParams(contrast_window=0.0)),
    "flow as measured": replace(DEFAULT, flow=FlowParams(confidence=False)),
    "single centroid": replace(DEFAULT, centroid=CentroidParams(mode="single")),
    "residual dropped": replace(DEFAULT, filter=FilterParams(residual="drop")),
    "no sharpness weights": replace(DEFAULT, filter=FilterParams(sharpness=0.0)),
    "β = 1/2": replace(DEFAULT, filter=FilterParams(sharpness=0.5)),
    "β = 2": replace(DEFAULT, filter=FilterParams(sharpness=2.0)),
}
# Run anew from the filtered image, with the blur that the default has found.
Method = Literal["nltv", "tv", "wiener"]
DEBLURRED: dict[str, Method] = {"TV": "tv", "Wiener": "wiener"}
# Pixels, a fifth apart.
SIGMAS = (0.0, 0.29, 0.35, 0.42, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1, 2.5, 3.0, 3.6, 4.3, 5.2)

Row = dict[str, float]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="names or patterns; all by default")
    parser.add_argument("--noise", type=float, default=0.0, metavar="SIGMA", help="noise to add, intensity")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args()
    rows: dict[str, Row] = {}
    try:
        for name, load in find_clips(options.clips).items():
            clip = load()
            added = np.random.default_rng(0).normal(0.0, options.noise, clip.frames.shape)
            clip = replace(clip, frames=np.clip(clip.frames + added, 0, 1).astype(np.float32))
            if clip.truth is not None:
                rows[name] = measure(clip, clip.truth)
                print(f"{name}: {rows[name]}", file=sys.stderr, flush=True)
    except TurbrestoreError as error:
        print(f"ablation: {error}", file=sys.stderr)
        return error.exit_code
    text = document(rows)
    publish(text, options.write)
    return 0


def measure(clip: Clip, truth: FloatArray) -> Row:
    """PSNR, dB, of the default and each variant; the blur found and the best one, pixels."""

    def score(image: FloatArray) -> float:
        return compare(image, truth).psnr

    whole = restore(clip.frames)
    row = {"default": score(whole.image)}
    row |= {name: score(restore(clip.frames, params).image) for name, params in VARIANTS.items()}
    filtered, removed, shape = stages(whole)

    def deblurred(sigma: float, method: Method = "nltv", exponent: float = shape) -> float:
        params = DeconvolutionParams(method=method, exponent=exponent)
        return score(deconvolve(filtered, sigma, params, guide=whole.centroid.image).image)

    row |= {name: deblurred(removed, method) for name, method in DEBLURRED.items()}
    row["Gaussian blur"] = deblurred(estimate_blur(filtered, exponent=GAUSSIAN).removable, exponent=GAUSSIAN)
    row["not deblurred"] = score(filtered)
    best, by_hand = best_sigma(deblurred, removed)
    # The default may happen to lie between two values of the grid, and above both.
    if by_hand < row["default"]:
        best, by_hand = removed, row["default"]
    return row | {"best σ": by_hand, "σ removed": removed, "σ by hand": best}


def best_sigma(score: Callable[[float], float], start: float) -> tuple[float, float]:
    """Climb the grid of blurs from the one next to ``start``; the best blur and its score."""
    index = int(np.argmin(np.abs(np.subtract(SIGMAS, start))))
    seen = {index: score(SIGMAS[index])}
    for step in (1, -1):
        place = index
        while 0 <= place + step < len(SIGMAS):
            seen[place + step] = score(SIGMAS[place + step])
            if seen[place + step] <= seen[place]:
                break
            place += step
    best = max(seen, key=seen.__getitem__)
    return SIGMAS[best], seen[best]


def document(rows: dict[str, Row]) -> str:
    """Markdown of both tables."""
    variants = ["default", *VARIANTS, *DEBLURRED, "Gaussian blur", "not deblurred"]
    lines = [
        "# Ablation\n",
        f"What `TURBRESTORE_DATA=DIR python benchmarks/ablation.py{arguments()}` measures, on clips of "
        "`benchmarks/quality.py` that have a truth.\n",
        "## What each choice is worth\n",
        "PSNR, dB, of the default, and the change when one choice is changed: negative where the default is "
        "better.  TV and Wiener use the width that the default removes; 'Gaussian blur' estimates and removes a "
        "Gaussian.\n",
        f"| clip | {' | '.join(variants)} |",
        f"|---|{'---:|' * len(variants)}",
    ]
    for name, row in _with_mean(rows).items():
        changes = [f"{row[variant] - row['default']:+.2f}" for variant in variants[1:]]
        lines.append(f"| {name} | {row['default']:.2f} | {' | '.join(changes)} |")
    lines += [
        "\n## The cost of the blind estimate\n",
        "The same filtered image deblurred with the σ that is best for PSNR, among values a fifth apart, against the σ "
        "that is removed blindly.\n",
        "| clip | σ removed, px | best σ, px | default, dB | best, dB | cost, dB |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, row in _with_mean(rows).items():
        sigmas = f"{row['σ removed']:.2f} | {row['σ by hand']:.2f}"
        cost = row["best σ"] - row["default"]
        lines.append(f"| {name} | {sigmas} | {row['default']:.2f} | {row['best σ']:.2f} | {cost:.2f} |")
    return "\n".join(lines) + "\n"


def stages(restoration: Restoration) -> tuple[FloatArray, float, float]:
    """Return the filtered image, and the width and the exponent of the blur that was removed from it."""
    if restoration.filtered is None or restoration.deconvolution is None or restoration.posterior is None:
        raise RuntimeError("the whole chain did not run")
    return restoration.filtered.image, restoration.deconvolution.sigma, restoration.posterior.exponent


def _with_mean(rows: dict[str, Row]) -> dict[str, Row]:
    if not rows:
        return rows
    first = next(iter(rows.values()))
    return {**rows, "**mean**": {name: float(np.mean([row[name] for row in rows.values()])) for name in first}}


if __name__ == "__main__":
    sys.exit(main())

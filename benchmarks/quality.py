"""PSNR of every stage on simulated clips, with the blur given by hand, against bounds.

Run ``TURBRESTORE_DATA=DIR python benchmarks/quality.py``.  It prints a table and exits with 1 when a bound is broken or
a stage is worse than the one before; without the data it says so and exits with 0.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from turbrestore.deconvolution import DeconvolutionParams
from turbrestore.images import read_image
from turbrestore.metrics import compare
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.video import open_frames

# Clip: sigma by hand, pixels, and the least PSNR of the result, dB.
BOUNDS = {
    "ao_camera_medium": (1.0, 27.5),
    "purdue1_camera_medium": (1.2, 28.5),
    "purdue1_chart_medium": (1.2, 19.5),
    "ao_brick_weak": (0.8, 33.0),
}


def main() -> int:
    """Print the table."""
    root = Path(os.environ.get("TURBRESTORE_DATA", "")) / "simulated"
    if not root.is_dir():
        print("TURBRESTORE_DATA names no folder with simulated clips; nothing to measure")
        return 0
    print(
        "| clip | sigma | mean | centroid | filtered | deconvolved | bound | seconds |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    failed = False
    for name, (sigma, bound) in BOUNDS.items():
        params = RestoreParams(deconvolution=DeconvolutionParams(sigma=sigma))
        restoration = restore(open_frames(root / name / "clip.mkv"), params)
        if restoration.filtered is None:
            return 1
        truth = read_image(root / name / "truth.png").image
        images = (restoration.mean, restoration.centroid.image, restoration.filtered.image, restoration.image)
        figures = [compare(image, truth).psnr for image in images]
        mean, centroid, filtered, deconvolved = figures
        failed |= not (mean < centroid <= filtered < deconvolved and deconvolved >= bound)
        seconds = sum(restoration.seconds.values())
        cells = " | ".join(f"{figure:.2f}" for figure in figures)
        print(f"| {name} | {sigma} | {cells} | {bound} | {seconds:.1f} |", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

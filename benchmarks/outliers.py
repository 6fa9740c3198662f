"""What single frames that show something else cost: a bird, flashes, a glint, a frame that slipped.

    TURBRESTORE_DATA=DIR python benchmarks/outliers.py

PSNR before deconvolution of the mean, the centroid and the filtered image, of clips as they are and spoilt.  Clips:
synthetic ones made here, and the simulated clips under the folder that ``TURBRESTORE_DATA`` names.  Exit code 1 if the
filtered image of a spoilt clip loses more than 1 dB anywhere.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from clips import Clip, find_clips
from provenance import publish_printed

from turbrestore.core.arrays import FloatArray
from turbrestore.metrics import compare
from turbrestore.pipeline import Restoration, RestoreParams, restore

PATTERNS = ("smooth_chart", "smooth_camera", "ao_*", "purdue1_*", "quick_*")
LARGEST_LOSS = 1.0


def spoil(frames: FloatArray) -> FloatArray:
    """Add a bird to a tenth of the frames, two flashes and a glint, and displace a frame by ten pixels."""
    spoilt, count = frames.copy(), len(frames)
    height, width = frames.shape[1:3]
    bird = range(count // 8, count // 8 + count // 10)
    for step, index in enumerate(bird):
        cv2.circle(spoilt[index], (int((step + 0.5) / len(bird) * width), int(0.4 * height)), width // 28, 0.05, -1)
    spoilt[count // 4] = np.clip(spoilt[count // 4] + 0.35, 0, 1)
    spoilt[count // 4 + 1] = np.clip(1.5 * spoilt[count // 4 + 1], 0, 1)
    cv2.circle(spoilt[count // 3], (width // 2, height // 4), width // 10, 1.0, -1)
    spoilt[count // 2 - 1] = np.roll(spoilt[count // 2 - 1], (8, -6), (0, 1))
    return spoilt


def figures(restoration: Restoration, clip: Clip) -> list[float]:
    """PSNR of mean, centroid and filtered image, dB."""
    images = (restoration.mean, restoration.centroid.image, restoration.image)
    return [compare(image, clip.truth).psnr for image in images]


HEAD = """# Outliers

Printed by `TURBRESTORE_DATA=DIR python benchmarks/outliers.py`.

PSNR, dB, before deconvolution, of clips as they are and spoilt: a bird crosses a tenth of the frames, one frame is
brighter by .35 and one by half, a glint covers a disc in one, and one slips by ten pixels."""


def main() -> int:
    """Print the table."""
    print("| clip | mean | centroid | filtered | spoilt: mean | spoilt: centroid | spoilt: filtered |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    worst = 0.0
    for name, load in find_clips(PATTERNS).items():
        clip = load()
        clean, spoilt = (
            figures(restore(frames, RestoreParams(until="filter")), clip)
            for frames in (clip.frames, spoil(clip.frames))
        )
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in clean + spoilt) + " |", flush=True)
        worst = max(worst, clean[-1] - spoilt[-1])
    print(f"\nlargest loss of the filtered image: {worst:.2f} dB (bound {LARGEST_LOSS} dB)")
    return int(worst > LARGEST_LOSS)


if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))

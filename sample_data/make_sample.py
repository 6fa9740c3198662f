"""Make the sample clip and its ground truth.

Run ``python sample_data/make_sample.py``.  The scene is the project's own resolution chart.  Smooth random flows bend
it, a blur that changes from frame to frame softens it, and noise is added; the clip is written as 8-bit FFV1.
"""

from pathlib import Path

import numpy as np

from turbrestore.io.images import write_image
from turbrestore.io.video import write_video
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

FOLDER = Path(__file__).parent
HEIGHT, WIDTH, FRAMES, RATE = 192, 256, 48, 25
MOTION = SmoothFlowParams(rms=1.8, correlation_length=14.0, persistence=0.8)
BLURS = (0.9, 2.0)
NOISE = 0.01


def main() -> None:
    """Write ``chart.mkv`` and ``chart_truth.png`` beside this script."""
    rng = np.random.default_rng(2026)
    scene = resolution_chart(HEIGHT, WIDTH)
    flows = smooth_flows(FRAMES, HEIGHT, WIDTH, rng, MOTION)
    # Over a long time the displacement averages to zero; a clip this short needs help to show the true geometry.
    flows -= flows.mean(axis=0)
    blurs = rng.uniform(*BLURS, FRAMES)
    frames = [
        distort(scene, flow[None], rng, blur=blur, noise=NOISE)[0] for flow, blur in zip(flows, blurs, strict=True)
    ]
    write_video(FOLDER / "chart.mkv", frames, RATE, bit_depth=8, overwrite=True)
    write_image(FOLDER / "chart_truth.png", scene, 8, overwrite=True)


if __name__ == "__main__":
    main()

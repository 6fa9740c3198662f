"""Make the picture of the README from the sample clip.

Run ``python docs/make_figures.py``.
"""

from pathlib import Path

import cv2
import numpy as np

import turbrestore as tr

ROOT = Path(__file__).parents[1]
SHOWN_FRAME = 20


def main() -> None:
    """Write ``docs/images/before_after.png``: a frame beside the restored image, twice as large."""
    source = tr.open_frames(ROOT / "sample_data" / "chart.mkv")
    before = source.read(SHOWN_FRAME, SHOWN_FRAME + 1)[0]
    after = tr.restore(source).image
    gap = np.ones((before.shape[0], 8), np.float32)
    pair = cv2.resize(np.hstack([before, gap, after]), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    tr.write_image(ROOT / "docs" / "images" / "before_after.png", pair, 8, overwrite=True)


if __name__ == "__main__":
    main()

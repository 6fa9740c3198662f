"""Pictures of what restoration does: middle frame, temporal mean, result, and the truth or peers where there are any.

    python benchmarks/panels.py docs/images/panels.png --clips 'screens_*' smooth_cat
    TURBRESTORE_DATA=DIR python benchmarks/panels.py real.png --clips real/otis_door real/moon_pss1

Writes one PNG with a row for each clip; names are those of ``benchmarks/quality.py``, or ``real/NAME`` for the whole
of a stored clip.  Stored clips are not free to be copied: keep pictures of them to yourself.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from clips import data_folder, find_clips

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames
from turbrestore.pipeline import Restoration, restore

HEIGHT, GAP = 256, 6
# Large clips are read through a window, so that detail stays visible.
LARGEST_SIDE = 640


def stored(place: Path) -> tuple[list[FloatArray], Restoration]:
    """Middle frame, mean, result and peers of a stored clip."""
    clip = next(path for path in sorted(place.iterdir()) if path.stem == "clip")
    height, width = open_frames(clip).shape[1:3]
    side_x, side_y = min(width, LARGEST_SIDE), min(height, LARGEST_SIDE)
    source = open_frames(clip, roi=((width - side_x) // 2, (height - side_y) // 2, side_x, side_y))
    restoration, middle = restore(source), len(source) // 2
    images = [source.read(middle, middle + 1)[0], restoration.mean, restoration.image]
    return [*images, *(read_image(peer).image for peer in sorted(place.glob("peer_*.png")))], restoration


def rows(names: Sequence[str]) -> Iterator[tuple[str, list[FloatArray], Restoration]]:
    """Images of each clip."""
    root = data_folder()
    whole = [name for name in names if name.startswith("real/")]
    if whole and root is None:
        sys.exit("panels: expected TURBRESTORE_DATA to name a folder of clips; set it")
    for name in whole:
        yield name, *stored(Path(str(root), name))
    others = [name for name in names if name not in whole]
    for name, load in (find_clips(others) if others else {}).items():
        clip = load()
        restoration = restore(clip.frames)
        images = [clip.frames[len(clip.frames) // 2], restoration.mean, restoration.image]
        yield name, images if clip.truth is None else [*images, clip.truth], restoration


def row(images: Sequence[FloatArray]) -> FloatArray:
    """Images side by side, equally high."""
    parts = []
    for image in images:
        grey = luminance(image)
        size = round(grey.shape[1] * HEIGHT / grey.shape[0]), HEIGHT
        area = cv2.INTER_AREA if grey.shape[0] > HEIGHT else cv2.INTER_CUBIC
        parts += [cv2.resize(grey, size, interpolation=area), np.ones((HEIGHT, GAP), np.float32)]
    return np.hstack(parts[:-1])


def main() -> int:
    """Restore and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--clips", nargs="+", required=True)
    options = parser.parse_args()
    lines = []
    for name, images, restoration in rows(options.clips):
        lines.append(row(images))
        print(name)
        for decision in restoration.decisions:
            print(f"  {decision}", flush=True)
    width = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, GAP), (0, width - line.shape[1])), constant_values=1) for line in lines]
    write_image(options.picture, np.vstack(padded), 8, overwrite=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

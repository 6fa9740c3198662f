"""Clips as people record them: light that changes, walkers, overlays, bars, small parts of the scale.

    python benchmarks/recordings.py

prints the peak signal-to-noise ratio of the result, of the filtered image and of the temporal mean of every clip, after
the best gain and offset.  ``robustness.py --groups recordings`` asks that no result is worse than the mean.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import restore

COUNT, SIDE = 32, 112
# Decibels by which a result may be worse than the mean.
SLACK = 0.2
T, Y = np.arange(COUNT)[:, None, None], np.arange(SIDE)[None, :, None]


def as_8_bits(frames: FloatArray) -> np.ndarray:
    """Frames of a camera of 8 bits."""
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)


def counts(frames: FloatArray, span: float, black: float = 0) -> np.ndarray:
    """Frames that span some counts of 16 bits."""
    noise = 2 * np.random.default_rng(1).standard_normal(frames.shape) if black else 0
    return np.rint(np.clip(black + span * frames + noise, 0, 65535)).astype(np.uint16)


def walked(frames: FloatArray, share: float) -> np.ndarray:
    """Somebody with sharp edges covers a pixel in ``share`` of the frames."""
    person = np.full((30, 12), 0.1, np.float32)
    person[:6, 3:9], person[9:12] = 0.9, 0.4
    result = frames.copy()
    for number, frame in enumerate(result):
        left = round(number * 12 / (share * COUNT))
        if left + 12 <= SIDE:
            frame[60:90, left : left + 12] = person
    return as_8_bits(result)


def marked(frames: FloatArray) -> np.ndarray:
    """Draw a reticle and a running clock."""
    result = as_8_bits(frames)
    for number, frame in enumerate(result):
        cv2.line(frame, (36, 56), (76, 56), 255, 1)
        cv2.line(frame, (56, 36), (56, 76), 255, 1)
        cv2.putText(frame, f"{number:02d}", (8, 104), cv2.FONT_HERSHEY_SIMPLEX, 0.3, 255, 1)
    return result


PHASE = np.random.default_rng(3).uniform(0, 2 * np.pi, COUNT)[:, None, None]
KINDS: dict[str, Callable[[FloatArray], np.ndarray]] = {
    "steady": as_8_bits,
    "exposure ±10 %": lambda f: as_8_bits(0.8 * f * (1 + 0.1 * np.sin(T / 4))),
    "exposure ±25 %": lambda f: as_8_bits(0.8 * f * (1 + 0.25 * np.sin(T / 4))),
    "mains": lambda f: as_8_bits(0.8 * f * (1 + 0.2 * np.sin(2 * np.pi * Y / 70 + PHASE))),
    "cloud": lambda f: as_8_bits(f * (1 - 0.3 * ((T > 15) & (T < 25)))),
    "stray light": lambda f: as_8_bits(0.7 * f + 0.1 + 0.08 * np.sin(T / 5)),
    "walker 15 %": lambda f: walked(f, 0.15),
    "walker 22 %": lambda f: walked(f, 0.22),
    "walker 30 %": lambda f: walked(f, 0.3),
    "12 bits in 16": lambda f: counts(f, 4095),
    "1/64 of the scale": lambda f: counts(f, 1023),
    "1/160 of the scale": lambda f: counts(f, 409),
    "200 thermal counts": lambda f: counts(f, 200, 7000),
    "2000 thermal counts": lambda f: counts(f, 2000, 7000),
}
MOVING: dict[str, Callable[[FloatArray], np.ndarray]] = {
    "shaken": as_8_bits,
    "reticle": marked,
}


def clips() -> Iterator[tuple[str, np.ndarray, FloatArray]]:
    """Name, frames and truth of every clip."""
    from conftest import make_sequence

    rng = np.random.default_rng(2)
    places = 28 + np.rint(np.clip(rng.normal(0, 7, (COUNT, 2)), -20, 20)).astype(int)
    for scene in ("camera", "chart"):
        still = make_sequence(9, COUNT, SIDE, scene, blur=0.8, noise=0.008, rms=1.2)
        for kind, record in KINDS.items():
            yield f"{scene}, {kind}", record(still.frames), still.scene
        large = make_sequence(10, COUNT, SIDE + 58, scene, blur=0.8, noise=0.008, rms=0.8)
        pairs = zip(large.frames, places, strict=True)
        frames = np.stack([frame[y : y + SIDE, x : x + SIDE] for frame, (x, y) in pairs])
        x, y = np.rint(places.mean(axis=0)).astype(int)
        for kind, record in MOVING.items():
            yield f"{scene}, {kind}", record(frames), large.scene[y : y + SIDE, x : x + SIDE]


def figures() -> Iterator[tuple[str, float, float, float]]:
    """Name, and ratios of result, filtered image and mean, of every clip."""
    for name, frames, truth in clips():
        found = restore(FrameSource.from_array(frames))
        images = (found.image, found.mean if found.filtered is None else found.filtered.image, found.mean)
        yield name, *(compare(image, truth).psnr_fit for image in images)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    for row in figures():
        print("{}: result {:.2f}, filtered {:.2f}, mean {:.2f}".format(*row), flush=True)

"""Gain of steadied frames: still scenes, and scenes with moving objects, through phase screens.

For a still scene it says as well how much nearer to the truth the image of ``restore`` is than the frames from 60 on,
and for one with objects, how much nearer the background of the same clip without them is.

python benchmarks/steady.py camera chart --frames 80 --size 256
python benchmarks/steady.py camera --frames 42 --size 192 --moving 3
"""

from __future__ import annotations

import argparse
import time
from itertools import islice, zip_longest

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.pipeline import restore
from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.video import steady_frames
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.moving_objects import MovingObject, draw_objects, with_objects
from turbrestore.synthesis.scenes import SCENES

# Pixels around the objects that belong neither to them nor to the background.
RIM = np.ones((9, 9), np.uint8)
# Frames after which the memory is compared with the image of all frames.
FILLED = 60


def decibels(image: FloatArray, truth: FloatArray, part: np.ndarray) -> float:
    """PSNR of a part of an image."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1) - truth)[part] ** 2)))


def compare(name: str, options: argparse.Namespace) -> str:
    """One row of the table."""
    scene, params = SCENES[name](options.size, options.size), PhaseScreenParams(d_over_r0=STRENGTHS[options.strength])
    objects = draw_objects(options.moving, scene.shape, np.random.default_rng([options.seed, 1]))

    def filmed(passing: tuple[MovingObject, ...]) -> list[FloatArray]:
        air = np.random.default_rng(options.seed)
        return [frame.image for frame in phase_screen_frames(scene, options.frames, air, params, objects=passing)]

    frames = filmed(objects)
    empty = steady_frames(filmed(()), runtime=Runtime(threads=1)) if objects else ()
    started, gains, late, losses = time.process_time(), [], [], []
    for frame in steady_frames(frames, runtime=Runtime(threads=1)):
        truth, mask = with_objects(scene, objects, frame.number)
        parts = [np.ones_like(mask), cv2.dilate(mask.astype(np.uint8), RIM) == 0, mask]
        seen = frames[frame.number]
        pairs = [(decibels(frame.image, truth, part), decibels(seen, truth, part)) for part in parts if part.any()]
        if frame.number >= FILLED:
            late.append(pairs[0][0])
        gains.append([ours - theirs for ours, theirs in pairs])
        losses += [decibels(still.image, truth, parts[1]) - pairs[1][0] for still in islice(empty, 1)]
    seconds = (time.process_time() - started) / options.frames / (2 if objects else 1)
    # An object may be out of sight in some frames.
    columns = zip_longest(*gains, fillvalue=np.nan)
    shown = islice(columns, 3 if objects else 1)
    cells = " | ".join(f"{np.nanmean(column):.2f}, {np.nanmin(column):.2f}" for column in shown)
    if objects:
        cells += f" | {np.mean(losses):.2f}"
    elif late:
        still = decibels(restore(np.stack(frames)).image, scene, np.ones(scene.shape, bool))
        cells += f" | {still - float(np.mean(late)):.2f}"
    return f"| {name} | {cells} | {seconds:.3f} |"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", choices=sorted(SCENES))
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--moving", type=int, default=0)
    parser.add_argument("--strength", choices=sorted(STRENGTHS), default="medium")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    parts = ("whole", "background", "objects") if options.moving else ("whole",)
    lacking = "behind a clip without objects" if options.moving else "behind restore"
    names = [*(f"{part}: mean and least gain, dB" for part in parts), f"{lacking}, dB", "seconds of CPU a frame"]
    print(f"| scene | {' | '.join(names)} |\n|---|{'---|' * len(names)}")
    for name in options.scenes:
        print(compare(name, options), flush=True)


if __name__ == "__main__":
    main()

"""Gain of steadied video: own clips of the kinds that people film, and cameras that move.

Town, traffic, sports, façades, lattices and foliage are filmed through phase screens of D/r0 1 to 4 and compressed with
H.264. The camera turns, so that the air of a wide scene stays where it is while the camera moves; objects move in the
scene.
Cameras that stand, creep, pan, stop, nod, zoom and shake film photographs through smooth displacements, without blur,
which show how far the picture lies from its place.  Settings are chosen on the clips of ``chosen``; those of
``reported`` have other pictures, air, paths and periods.

python benchmarks/steady.py reported --write benchmarks/results/steady.md
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from provenance import with_origin

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.io.containers.encoding import Encoding
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import restore
from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.drawn_scenes import DRAWN
from turbrestore.synthesis.moving_objects import MovingObject, draw_objects, with_objects
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

ONE = Runtime(threads=1)
COMPRESSED = Encoding(codec="h264", crf=18)
# Pixels of the border that are left out, side of the tiles whose shifts are measured, and frames after which a result
# is compared with the image that ``restore`` makes of all frames.
BORDER, TILE, FILLED = 8, 60, 60


@dataclass(frozen=True)
class Clip:
    """What is filmed, how the camera moves, and through which air."""

    scene: str | tuple[int, int]  # picture, or the width and height of a window of a façade, pixels
    camera: str
    seed: int
    d_over_r0: float = 0.0  # of phase screens
    moving: int = 0  # objects
    wind: float = 2.0  # m/s
    rms: float = 0.0  # of smooth displacements, pixels

    @property
    def size(self) -> tuple[int, int, int]:
        """Frames, height and width."""
        return (72, 160, 288) if self.d_over_r0 else (60, 144, 176)


CLIPS = {
    "chosen": {
        "town": Clip("camera", "stand", 1, 2.0),
        "traffic": Clip("brick", "stand", 2, 1.5, moving=3),
        "sports": Clip("astronaut", "pan", 3, 2.5, moving=2),
        "façade": Clip((12, 18), "stand", 4, 3.0),
        "foliage": Clip("grass", "creep", 5, 1.5, wind=4.0),
        "person": Clip("astronaut", "hand", 6, 1.2),
        "camera stands": Clip("camera", "stand", 1, rms=1.0),
        "creeps": Clip("camera", "creep", 2, rms=1.0),
        "pans": Clip("camera", "pan", 3, rms=1.0),
        "stops": Clip("astronaut", "stop", 4, rms=0.8),
        "nods": Clip("camera", "nod", 5, rms=0.8),
        "zooms": Clip("astronaut", "zoom", 6, rms=0.8),
        "hand-held": Clip("camera", "hand", 7, rms=0.8),
        "façade, smooth": Clip((12, 18), "stand", 8, rms=0.8),
        "no air": Clip("camera", "hand", 9),
    },
    # Seeds begin with the version for which they were drawn, 0.4.
    "reported": {
        "town": Clip("street", "stand", 441, 2.5),
        "town, pan": Clip("street", "slow pan", 442, 1.5),
        "traffic": Clip("sign", "stand", 443, 1.2, moving=3),
        "traffic, creeping": Clip("coffee", "slow creep", 444, 3.0, moving=2, wind=4.0),
        "sports": Clip("cat", "stand", 445, 2.0, moving=3, wind=4.0),
        "sports, hand-held": Clip("rocket", "hand", 446, 1.5, moving=2),
        "façade": Clip((15, 11), "stand", 447, 2.0),
        "façade, pan": Clip((10, 16), "pan", 448, 1.2),
        "foliage": Clip("gravel", "stand", 449, 4.0, wind=4.0),
        "foliage, zoom": Clip("gravel", "zoom", 450, 1.5),
        "camera stands": Clip("coffee", "stand", 441, rms=1.0),
        "creeps": Clip("cat", "slow creep", 442, rms=1.0),
        "pans": Clip("coffee", "fast pan", 443, rms=0.8),
        "stops": Clip("rocket", "stops", 444, rms=0.8),
        "nods": Clip("coffee", "slow nod", 445, rms=0.8),
        "zooms": Clip("cat", "zoom and roll", 446, rms=0.8),
        "hand-held": Clip("rocket", "hand", 447, rms=0.8),
        "façade, smooth": Clip((15, 11), "stand", 448, rms=0.8),
        "façade, creeping": Clip((10, 16), "creep", 449, rms=0.8),
        "lattice of 4 pixels": Clip((4, 5), "slow pan", 451, 1.2),
        "lattice of 6 pixels": Clip((6, 9), "pan", 452, 1.5),
        "lattice of 8 pixels": Clip((8, 7), "slow pan", 453, 2.0),
        "lattice of 12 pixels": Clip((12, 10), "brisk pan", 454, 2.5),
        "no air": Clip("coffee", "hand", 450),
    },
}


def path(name: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Place (x, y), turn and logarithm of the zoom of every frame."""
    k, result = np.arange(count) - count / 2, np.zeros((count, 4))
    shake = cv2.GaussianBlur(rng.standard_normal((count, 2)), (1, 0), sigmaX=0.01, sigmaY=1.5)
    stops = np.cumsum(np.where(np.abs(np.abs(k) - 14) < 7, 2.0, 0.0))
    paths = {
        "stand": (),
        "creep": (0.15 * k, 0.05 * k),
        "slow creep": (0.05 * k, -0.08 * k),
        "pan": (0.6 * k, -0.2 * k),
        "slow pan": (-0.4 * k, 0 * k),
        "brisk pan": (1.0 * k, 0.3 * k),
        "fast pan": (2.5 * k, 0.4 * k),
        "stop": (1.5 * np.clip(k, -20, 5), 0 * k),
        "stops": (stops - stops.mean(), 0 * k),
        "nod": (0 * k, 4 * np.sin(k / 5)),
        "slow nod": (3 * np.sin(k / 9), 2 * np.sin(k / 7)),
        "zoom": (0 * k, 0 * k, 0 * k, 0.003 * k),
        "zoom and roll": (0 * k, 0 * k, 0.001 * k, 0.002 * k),
        "hand": tuple(4 * shake.T / shake.std()),
    }
    for column, values in enumerate(paths[name]):
        result[:, column] = values
    return result


def picture(name: str | tuple[int, int], height: int, width: int) -> FloatArray:
    """Photo, drawn scene, or a wall with regular windows; grey, and no sharper than a lens leaves it."""
    if isinstance(name, str):
        return cv2.GaussianBlur(luminance((SCENES | DRAWN)[name](height, width)), (0, 0), 0.7)
    y, x = np.mgrid[: 4 * height, : 4 * width] / 4
    window = (x % name[0] > 0.3 * name[0]) & (y % name[1] > 0.35 * name[1])
    wall = np.where((y > height / 2 - 50) & (x > width / 2 - 70), np.where(window, 0.25, 0.65), 0.85)
    return cv2.resize(wall.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)


def view(scene: FloatArray, place: np.ndarray, size: tuple[int, int], flags: int = cv2.INTER_CUBIC) -> FloatArray:
    """Part of a wide scene that the camera shows."""
    x, y, turn, zoom = place
    a, b = np.exp(-zoom) * np.cos(turn), np.exp(-zoom) * np.sin(turn)
    linear = np.array([[a, -b], [b, a]])
    offset = np.array(scene.shape[::-1]) / 2 + [x, y] - linear @ (np.array(size[::-1]) / 2 - 0.5)
    matrix = np.column_stack([linear, offset - 0.5])
    return cv2.warpAffine(scene, matrix, size[::-1], flags=flags | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT)


def film(clip: Clip) -> tuple[list[FloatArray], list[FloatArray], list[np.ndarray]]:
    """Frames, their truth, and where objects are."""
    (count, height, width), rng = clip.size, np.random.default_rng(clip.seed)
    places = path(clip.camera, count, rng)
    reach = np.abs(places[:, :2]).max(0) + [12, 12] + 0.5 * np.abs(places[:, 2:]).max() * width
    wide = height + 2 * int(reach[1]), width + 2 * int(reach[0])
    scene = picture(clip.scene, *wide)
    objects = draw_objects(clip.moving, wide, np.random.default_rng([clip.seed, 1]))
    made = [with_objects(scene, objects, number) for number in range(count)]
    truth = [view(image, place, (height, width)) for (image, _), place in zip(made, places, strict=True)]
    masks = [
        view(mask.astype(np.float32), place, (height, width), cv2.INTER_LINEAR) > 0.5
        for (_, mask), place in zip(made, places, strict=True)
    ]
    if clip.d_over_r0:
        seen = through_screens(scene, clip, objects, rng)
        return compressed([view(*pair, (height, width)) for pair in zip(seen, places, strict=True)]), truth, masks
    params = SmoothFlowParams(rms=max(clip.rms, 1e-3), correlation_length=20.0)
    flows = smooth_flows(count, height, width, rng, params)
    flows -= flows.mean(axis=0)
    return [distort(one, flow[None], rng, noise=0.005)[0] for one, flow in zip(truth, flows, strict=True)], truth, masks


def through_screens(
    scene: FloatArray, clip: Clip, objects: Sequence[MovingObject], rng: np.random.Generator
) -> list[FloatArray]:
    """Wide scene through the air."""
    params = PhaseScreenParams(d_over_r0=clip.d_over_r0, wind=(clip.wind,), wind_direction=(30.0,))
    made = phase_screen_frames(scene, clip.size[0], rng, params, runtime=ONE, objects=objects)
    return [frame.image for frame in made]


def compressed(frames: Sequence[FloatArray]) -> list[FloatArray]:
    """Frames as a video file gives them."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "clip.mp4")
        write_video(file, iter(frames), 30.0, encoding=COMPRESSED)
        return [luminance(frame) for frame in open_frames(file).read()]


def decibels(image: FloatArray, truth: FloatArray, part: np.ndarray | None = None) -> float:
    """PSNR without the border, or of a part."""
    error = (np.clip(image, 0, 1) - truth) ** 2
    inner = error[BORDER:-BORDER, BORDER:-BORDER]
    return float(-10 * np.log10(np.mean(inner if part is None else error[part])))


def shifts(images: Sequence[FloatArray], truth: Sequence[FloatArray], side: int | None = None) -> np.ndarray:
    """Distance of whole frames, or of their tiles, from the truth, pixels."""
    height, width = (length - 2 * BORDER for length in truth[0].shape)
    rows, columns = (1, 1) if side is None else (height // side, width // side)
    found = []
    for image, other in zip(images, truth, strict=True):
        for row, column in np.ndindex(rows, columns):
            top, left = BORDER + row * height // rows, BORDER + column * width // columns
            part = np.s_[top : top + height // rows, left : left + width // columns]
            # phaseCorrelate may write to its images.
            pair = [np.float32(one[part]).copy() for one in (other, image)]
            window = cv2.createHanningWindow(pair[0].shape[::-1], cv2.CV_32F)
            found.append(np.hypot(*cv2.phaseCorrelate(*pair, window)[0]))
    return np.array(found)


def flicker(images: Sequence[FloatArray], truth: Sequence[FloatArray]) -> float:
    """Mean change from frame to frame over that of the truth, where that changes."""
    ours, theirs = (np.mean([np.abs(b - a).mean() for a, b in pairwise(one)]) for one in (images, truth))
    return float(ours / theirs) if theirs > 1e-4 else np.nan


def compare(name: str, clip: Clip) -> str:
    """One row of the table."""
    frames, truth, masks = film(clip)
    started = time.process_time()
    params = SteadyParams() if clip.d_over_r0 else SteadyParams(sigma=0)
    ours = [np.clip(frame.image, 0, 1) for frame in steady_frames(frames, params, ONE)]
    seconds = (time.process_time() - started) / len(frames)
    before, after = ([decibels(*pair) for pair in zip(images, truth, strict=True)] for images in (frames, ours))
    gains = np.subtract(after, before)
    side = TILE if isinstance(clip.scene, tuple) else None
    lags = [np.quantile(shifts(images, truth, side), 0.9) for images in (frames, ours)]
    moved = [
        decibels(image, other, mask) - decibels(seen, other, mask)
        for image, seen, other, mask in zip(ours, frames, truth, masks, strict=True)
        if mask.sum() > 50
    ]
    still = np.nan
    if clip.camera == "stand" and not clip.moving and clip.d_over_r0:
        still = decibels(restore(np.stack(frames), runtime=ONE).image, truth[0]) - float(np.mean(after[FILLED:]))
    cells = [
        *(f"{value:.1f}" for value in (np.mean(before), np.mean(after), np.median(gains), gains.min())),
        *(f"{value:.2f}" for value in (flicker(frames, truth), flicker(ours, truth), *lags)),
        f"{np.mean(moved or np.nan):.1f}",
        f"{still:.1f}",
        f"{seconds:.3f}",
    ]
    return f"| {name} | {clip.d_over_r0 or ''} | {' | '.join(cells).replace('nan', '')} |"


COLUMNS = (
    *(
        "clip",
        "D/r0",
        "input, dB",
        "steady, dB",
        "median gain, dB",
        "least gain, dB",
        "flicker of the input",
        "flicker",
    ),
    *("shift of the input, px", "shift, px", "gain of objects, dB", "behind `restore`, dB", "seconds of CPU a frame"),
)
NOTE = """
Flicker is the mean change from frame to frame over that of the truth, where the truth changes.  Shift is the distance
from the truth that 90 % of the frames keep, of façades and lattices that 90 % of their tiles keep; of patterns that
repeat it may be many periods.  `restore` makes one image of all frames, which is compared with the frames from 60 on.
"""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", choices=sorted(CLIPS))
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    rows = [f"| {' | '.join(COLUMNS)} |", f"|---|{'---:|' * (len(COLUMNS) - 1)}"]
    print("\n".join(rows))
    for name in options.only or CLIPS[options.clips]:
        rows.append(compare(name, CLIPS[options.clips][name]))
        print(rows[-1], flush=True)
    if options.write is not None:
        command = f"`python benchmarks/steady.py {options.clips}`"
        text = "\n".join([f"Steadied video, {command}", NOTE, *rows, ""])
        options.write.write_text(with_origin(text), encoding="utf-8")


if __name__ == "__main__":
    main()

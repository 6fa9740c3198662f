"""Gain of steadied frames while the camera moves, and how far the picture lies from its place.

Photographs and façades are filmed by cameras that stand, creep, pan, stop, nod, zoom or shake, through smooth
displacements.  Settings are chosen on the clips of ``chosen``; those of ``reported`` have other pictures, paths and
periods.

python benchmarks/steady_cameras.py reported --write benchmarks/results/steady_cameras.md
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import skimage.data

from turbrestore.core.arrays import FloatArray
from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

HEIGHT, WIDTH, COUNT, LARGE = 144, 176, 60, 400
MARGIN = np.s_[8:-8, 8:-8]
# Scene, a photo or the period of a façade; path of the camera; displacement, pixels RMS; seed.
CLIPS: dict[str, dict[str, tuple[str | tuple[int, int], str, float, int]]] = {
    "chosen": {
        "still": ("camera", "stand", 1.0, 1),
        "creep": ("camera", "creep", 1.0, 2),
        "pan": ("camera", "pan", 1.0, 3),
        "stop": ("astronaut", "stop", 0.8, 4),
        "nod": ("camera", "nod", 0.8, 5),
        "zoom": ("astronaut", "zoom", 0.8, 6),
        "hand": ("camera", "hand", 0.8, 7),
        "facade": ((12, 18), "stand", 0.8, 8),
        "quiet": ("camera", "hand", 0.0, 9),
    },
    "reported": {
        "still": ("coffee", "stand", 1.0, 11),
        "creep": ("chelsea", "slow creep", 1.0, 12),
        "pan": ("coffee", "fast pan", 0.8, 13),
        "stop": ("rocket", "stops", 0.8, 14),
        "nod": ("coffee", "slow nod", 0.8, 15),
        "zoom": ("chelsea", "zoom and roll", 0.8, 16),
        "hand": ("rocket", "hand", 0.8, 17),
        "facade": ((15, 11), "stand", 0.8, 18),
        "facade, pan": ((10, 16), "creep", 0.8, 19),
        "quiet": ("coffee", "hand", 0.0, 20),
    },
}


def path(name: str, rng: np.random.Generator) -> np.ndarray:
    """Place (x, y), turn and logarithm of the zoom of every frame."""
    k, result = np.arange(COUNT) - COUNT / 2, np.zeros((COUNT, 4))
    shake = cv2.GaussianBlur(rng.standard_normal((COUNT, 2)), (1, 0), sigmaX=0.01, sigmaY=1.5)
    stops = np.cumsum(np.where(np.abs(np.abs(k) - 14) < 7, 2.0, 0.0))
    paths = {
        "creep": (0.15 * k, 0.05 * k),
        "slow creep": (0.05 * k, -0.08 * k),
        "pan": (0.6 * k, -0.2 * k),
        "fast pan": (2.5 * k, 0.4 * k),
        "stop": (1.5 * np.clip(k, -20, 5), 0 * k),
        "stops": (stops - stops.mean(), 0 * k),
        "nod": (0 * k, 4 * np.sin(k / 5)),
        "slow nod": (3 * np.sin(k / 9), 2 * np.sin(k / 7)),
        "zoom": (0 * k, 0 * k, 0 * k, 0.003 * k),
        "zoom and roll": (0 * k, 0 * k, 0.001 * k, 0.002 * k),
        "hand": tuple(4 * shake.T / shake.std()),
        "stand": (),
    }
    for column, values in enumerate(paths[name]):
        result[:, column] = values
    return result


def picture(name: str | tuple[int, int]) -> FloatArray:
    """Photo, or a wall with regular windows."""
    if isinstance(name, str):
        photo = np.asarray(getattr(skimage.data, name)(), np.float32) / 255
        grey = photo if photo.ndim == 2 else photo.mean(-1)
        side = min(grey.shape)
        return cv2.GaussianBlur(
            cv2.resize(grey[:side, :side], (LARGE, LARGE), interpolation=cv2.INTER_AREA), (0, 0), 0.7
        )
    y, x = np.mgrid[: 4 * LARGE, : 4 * LARGE] / 4
    window = (x % name[0] > 0.3 * name[0]) & (y % name[1] > 0.35 * name[1])
    wall = np.where((y > LARGE / 2 - 50) & (x > LARGE / 2 - 70), np.where(window, 0.25, 0.65), 0.85)
    return cv2.resize(wall.astype(np.float32), (LARGE, LARGE), interpolation=cv2.INTER_AREA)


def film(scene: FloatArray, places: np.ndarray) -> list[FloatArray]:
    """Truth of every frame."""
    frames = []
    for x, y, turn, zoom in places:
        a, b = np.exp(-zoom) * np.cos(turn), np.exp(-zoom) * np.sin(turn)
        linear = np.array([[a, -b], [b, a]])
        offset = np.array([LARGE / 2 + x, LARGE / 2 + y]) - linear @ [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        frames.append(cv2.warpAffine(scene, np.column_stack([linear, offset]), (WIDTH, HEIGHT), flags=flags))
    return frames


def decibels(image: FloatArray, truth: FloatArray) -> float:
    """PSNR without the border."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1) - truth)[MARGIN] ** 2)))


def compare(name: str, clip: tuple[str | tuple[int, int], str, float, int]) -> str:
    """One row of the table."""
    scene, camera, rms, seed = clip
    rng = np.random.default_rng(seed)
    truth = film(picture(scene), path(camera, rng))
    flows = smooth_flows(COUNT, HEIGHT, WIDTH, rng, SmoothFlowParams(rms=max(rms, 1e-3), correlation_length=20.0))
    flows -= flows.mean(axis=0)
    frames = [distort(one, flow[None], rng, noise=0.005)[0] for one, flow in zip(truth, flows, strict=True)]
    steadied = steady_frames(frames, SteadyParams(sigma=0), Runtime(threads=1))
    ours = [np.clip(frame.image, 0, 1) for frame in steadied]
    before, after = ([decibels(*pair) for pair in zip(images, truth, strict=True)] for images in (frames, ours))
    gains = np.subtract(after, before)
    window = cv2.createHanningWindow((WIDTH - 16, HEIGHT - 16), cv2.CV_32F)
    # phaseCorrelate may write to its images.
    pairs = [(one[MARGIN].copy(), other[MARGIN].copy()) for one, other in zip(truth, ours, strict=True)]
    shifts = np.array([cv2.phaseCorrelate(*pair, window)[0] for pair in pairs])
    lag = float(np.hypot(*np.median(shifts[-20:], axis=0)))
    cells = f"{np.mean(before):.1f} | {np.mean(after):.1f} | {np.median(gains):.1f} | {gains.min():.1f} | {lag:.2f}"
    return f"| {name} | {cells} |"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", choices=sorted(CLIPS))
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    names = ["input, dB", "steady, dB", "median gain, dB", "least gain, dB", "shift of the last 20 frames, px"]
    rows = [f"| clip | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
    print("\n".join(rows))
    for name in options.only or CLIPS[options.clips]:
        rows.append(compare(name, CLIPS[options.clips][name]))
        print(rows[-1], flush=True)
    if options.write is not None:
        command = f"`python benchmarks/steady_cameras.py {options.clips}`"
        options.write.write_text("\n".join([f"Steadied video of cameras that move, {command}", "", *rows, ""]))


if __name__ == "__main__":
    main()

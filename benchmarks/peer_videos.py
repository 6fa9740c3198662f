"""Videos of ``peers.py``: frame by frame against the truth, and how much they flicker.

One video is made here: a square that moves before a photograph, through smooth random flows.  Others lie under
``TURBRESTORE_DATA``: ``dynamic/NAME/clip.mp4`` with ``truth.mp4`` and the published output of a network as
``peer_NAME.mp4``.  A network that is there runs on the video that is made here; it takes minutes for larger ones.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from clips import data_folder
from methods.packages import run_package
from methods.sobolev import sobolev_flow
from methods.usage import processor_seconds
from peer_tables import Figures
from scipy.ndimage import uniform_filter1d

from turbrestore.core.arrays import FloatArray
from turbrestore.io.video import open_frames
from turbrestore.metrics import psnr
from turbrestore.steady.video import steady_frames
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import distort, smooth_flows

# Frames, pixels a side of the video that is made here, and which frames are compared: all takes minutes.
MADE, COUNT, SIDE, EVERY = "moving square", 30, 256, 3
SMOOTHED = 5

# Each takes frames and returns as many.
VIDEO_METHODS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "input": lambda frames: frames,
    f"mean of {SMOOTHED} frames": lambda frames: uniform_filter1d(frames, SMOOTHED, axis=0, mode="nearest"),
    "Sobolev flow": sobolev_flow,
    "turbrestore": lambda frames: np.stack([frame.image for frame in steady_frames(frames)]),
}


def measure_videos(networks: Mapping[str, Path]) -> dict[str, dict[str, Figures]]:
    """Figures of every video by every method; ``networks`` are interpreters of the packages that have one."""
    results: dict[str, dict[str, Figures]] = {}
    for name, frames, truth, published in _videos():
        results[name] = {}
        for method, run in VIDEO_METHODS.items():
            begun = processor_seconds()
            video = np.clip(run(frames), 0, 1)
            spent = {"seconds": round(processor_seconds() - begun, 2)}
            results[name][method] = score_video(video, truth) | spent
        for method, python in networks.items() if name == MADE else ():
            video, used = run_package(method, frames, python)
            results[name][f"{method} (network)"] = score_video(video, truth) | {"seconds": used["seconds"]}
        results[name] |= {f"{method} (network)": score_video(video, truth) for method, video in published.items()}
        print(f"{name}: {results[name]}", file=sys.stderr, flush=True)
    return results


def score_video(video: FloatArray, truth: FloatArray) -> Figures:
    """PSNR and SSIM, means over every third frame, and the flicker of all frames relative to the truth.

    Both have the shape (T, H, W) or (T, H, W, 3).  A video that is cropped is compared with the middle of the truth, as
    networks crop by the same number of pixels on opposite sides.
    """
    from skimage.metrics import structural_similarity

    top, left = ((truth.shape[axis] - video.shape[axis]) // 2 for axis in (1, 2))
    truth = truth[:, top : top + video.shape[1], left : left + video.shape[2]]
    grey = [frames if frames.ndim == 3 else frames.mean(axis=-1) for frames in (video, truth)]
    pairs = [*zip(*grey, strict=True)][::EVERY]
    flicker = np.abs(np.diff(video, axis=0)).mean() / np.abs(np.diff(truth, axis=0)).mean()
    return {
        "psnr": round(float(np.mean([psnr(a, t) for a, t in zip(video[::EVERY], truth[::EVERY], strict=True)])), 3),
        "ssim": round(float(np.mean([structural_similarity(a, t, data_range=1.0) for a, t in pairs])), 4),
        "flicker": round(float(flicker), 3),
    }


def moving_square(count: int = COUNT, side: int = SIDE) -> tuple[FloatArray, FloatArray]:
    """Frames of a square that moves before a photograph, and the same without turbulence."""
    rng = np.random.default_rng(5)
    scene, size = SCENES["camera"](side, side), side // 8
    truth = np.repeat(scene[None], count, axis=0)
    for number, frame in enumerate(truth):
        left = round(size + number * (side - 3 * size) / count)
        frame[side // 2 : side // 2 + size, left : left + size] = 0.9
    flows = smooth_flows(count, side, side, rng)
    flows -= flows.mean(axis=0)
    frames = [distort(t, flow[None], rng, blur=1.0, noise=0.01)[0] for t, flow in zip(truth, flows, strict=True)]
    return np.stack(frames), truth


def _videos() -> Iterator[tuple[str, FloatArray, FloatArray, dict[str, FloatArray]]]:
    """Name, frames, truth and outputs of networks."""
    yield MADE, *moving_square(), {}
    root = data_folder()
    for path in sorted(root.glob("dynamic/*/truth.mp4")) if root is not None else []:
        frames, truth = _read(path.with_name("clip.mp4")), _read(path)
        published = {file.stem.removeprefix("peer_"): _read(file) for file in sorted(path.parent.glob("peer_*.mp4"))}
        yield path.parent.name, frames, truth, published


def _read(path: Path) -> FloatArray:
    return open_frames(path, frames=(0, COUNT)).read()

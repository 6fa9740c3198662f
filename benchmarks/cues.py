"""Accuracy of the cues from blur, as Markdown tables.

Run ``python benchmarks/cues.py``; with ``--size 128 --frames 40`` it takes a few seconds.  Sequences: two scenes whose
blur varies in space and time (σ .6 to 2.4 px), noise .01, without and with displacements of 1.5 px.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np
import skimage.data
from scipy.special import ndtr

from turbrestore.blur_moments.cues import displacement_variance, relative_blur
from turbrestore.blur_moments.frame_blur import frame_blur
from turbrestore.core.arrays import FloatArray
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

NOISE = 0.01
SHARPEST, SOFTEST = 0.6, 2.4
# Correlation length of the blur field, pixels: the blur is roughly constant within a tile of 48 pixels.
CORRELATION = 40.0


def scenes(size: int) -> dict[str, FloatArray]:
    """Return the drawn chart and a photograph."""
    photo = cv2.resize(skimage.data.camera(), (size, size), interpolation=cv2.INTER_AREA)
    return {"chart": resolution_chart(size, size), "camera": photo.astype(np.float32) / 255}


def sequence(scene: FloatArray, count: int, rms: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Frames with blur that varies in space and time, and the blur variance of each pixel of each frame."""
    height, width = scene.shape
    flows = smooth_flows(count, height, width, rng, SmoothFlowParams(rms=rms))
    flows -= flows.mean(axis=0)
    # A flow of unit deviation is used as a smooth random field here.
    fields = smooth_flows(count, height, width, rng, SmoothFlowParams(1.0, CORRELATION, 0.5))[..., 0]
    sigma = SHARPEST + (SOFTEST - SHARPEST) * ndtr(fields)
    levels = np.linspace(SHARPEST, SOFTEST, 13)
    stack = np.stack([cv2.GaussianBlur(scene, (0, 0), level) for level in levels])
    position = np.interp(sigma**2, levels**2, np.arange(13.0))
    below = np.minimum(position.astype(np.intp), 11)
    frames = []
    for flow, lower, share in zip(flows, below, (position - below).astype(np.float32), strict=True):
        soft, softer = (np.take_along_axis(stack, index[None], axis=0)[0] for index in (lower, lower + 1))
        blurred = soft + share * (softer - soft)
        frames.append(warp(blurred, invert_flow(flow)) if rms else blurred)
    noisy = np.stack(frames) + rng.normal(0, NOISE, sigma.shape)
    return noisy.astype(np.float32), (sigma**2).astype(np.float32)


def print_frame_blur(size: int, count: int) -> None:
    """Print how well the blur of the frames is measured, where tiles have structure."""
    print("| scene | displacement, px | tiles measured | correlation with the truth | slope |\n|---|---|---|---|---|")
    for name, scene in scenes(size).items():
        for rms in (0.0, 1.5):
            frames, variance = sequence(scene, count, rms, np.random.default_rng(0))
            blur = frame_blur(frames, NOISE)
            seen = np.broadcast_to(np.median(blur.deviation, axis=0) < 0.5, blur.relative.shape)
            true = np.stack([cv2.GaussianBlur(v, (0, 0), 11) for v in variance])
            true = true[:, blur.grid.rows + blur.grid.size[0] // 2][:, :, blur.grid.columns + blur.grid.size[1] // 2]
            true, found = (true - true.mean(axis=0))[seen], blur.relative[seen]
            figures = f"{seen.mean():.2f} | {np.corrcoef(true, found)[0, 1]:.3f} | {np.polyfit(true, found, 1)[0]:.2f}"
            print(f"| {name} | {rms} | {figures} |", flush=True)


def print_displacement(size: int, count: int) -> None:
    """Print the measured displacement variance and that of the flows."""
    header = "| scene | σ of displacement, px | true variance | found | deviation | found / true |"
    print(f"\n{header}\n|{'---|' * 6}")
    for name, scene in scenes(size).items():
        for rms in (0.5, 1.0, 1.5, 2.0, 2.5):
            rng = np.random.default_rng(0)
            flows = smooth_flows(count, size, size, rng, SmoothFlowParams(rms=rms))
            found = displacement_variance(distort(scene, flows, rng, blur=0.8, noise=NOISE), NOISE)
            true = float(flows.var(axis=0, ddof=1).mean())
            figures = f"{true:.3f} | {found.variance:.3f} | {found.deviation:.3f} | {found.variance / true:.2f}"
            print(f"| {name} | {rms} | {figures} |", flush=True)


def print_relative(size: int) -> None:
    """Print the measured σ of a known relative blur."""
    print("\n| scene | σ₁, σ₂, px | σ of relative blur | found | deviation |\n|---|---|---|---|---|")
    for name, scene in scenes(size).items():
        for soft, softer in ((0.7, 1.0), (1.0, 1.5), (1.0, 2.0), (1.5, 1.7), (2.0, 3.0)):
            rng = np.random.default_rng(0)
            one, two = (cv2.GaussianBlur(scene, (0, 0), s) + rng.normal(0, NOISE, scene.shape) for s in (softer, soft))
            found = relative_blur(one, two, NOISE)
            true, sigma = np.sqrt(softer**2 - soft**2), np.sqrt(found.variance)
            print(f"| {name} | {softer}, {soft} | {true:.3f} | {sigma:.3f} | {found.deviation / (2 * sigma):.3f} |")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    print_frame_blur(options.size, options.frames)
    print_displacement(options.size, options.frames)
    print_relative(options.size)
    frames = np.random.default_rng(0).normal(0.5, 0.1, (120, 256, 256)).astype(np.float32)
    start = time.perf_counter()
    frame_blur(frames, NOISE)
    print(f"\nBlur of 120 frames of 256×256: {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()

"""What blur says: accuracy of the cues, and what weights from them are worth, as Markdown tables.

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
from turbrestore.blur_moments.frame_blur import FrameBlur, frame_blur
from turbrestore.blur_moments.fusion import fuse_frames, fusion_rule, fusion_weights, laplacian_energy
from turbrestore.blur_moments.tile_spectra import tile_map
from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.metrics import psnr
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.warp import invert_flow, warp
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

NOISE = 0.01
SHARPEST, SOFTEST = 0.6, 2.4
# Of the blur field, pixels: tiles of 48 pixels see one blur each, more or less.
CORRELATION = 40.0
BORDER = 24


def scenes(size: int) -> dict[str, FloatArray]:
    """Return the drawn chart and a photograph."""
    photo = cv2.resize(skimage.data.camera(), (size, size), interpolation=cv2.INTER_AREA)
    return {"chart": resolution_chart(size, size), "camera": photo.astype(np.float32) / 255}


def sequence(scene: FloatArray, count: int, rms: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Frames with blur that varies in space and time, and the blur variance of each pixel of each frame."""
    height, width = scene.shape
    flows = smooth_flows(count, height, width, rng, SmoothFlowParams(rms=rms))
    flows -= flows.mean(axis=0)
    # A flow of unit deviation serves as a smooth random field here.
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


def register(frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames warped onto their mean twice, by flows of mean 0, and those flows."""
    registered = frames
    for _ in range(2):
        flows = estimate_flow(registered.mean(axis=0), frames)
        flows -= flows.mean(axis=0)
        registered = np.stack([warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)])
    return registered, flows


def fused_images(frames: FloatArray, variance: FloatArray, blur: FrameBlur) -> dict[str, FloatArray]:
    """Fusions of registered frames by several weights."""
    mean = frames.mean(axis=0)
    energy = laplacian_energy(mean, NOISE / np.sqrt(len(frames)))
    extra = np.stack([tile_map(tile, blur.grid) for tile in blur.extra])
    inverse = 1 / (energy / 4 * extra**2 + NOISE**2)
    weighted = fuse_frames(frames, fusion_rule(blur, energy, NOISE))
    again = laplacian_energy(weighted, NOISE / 3)
    known = fusion_weights(variance - variance.min(axis=0), energy, NOISE)
    return {
        "mean": mean,
        "inverse variance": (inverse / inverse.sum(axis=0) * frames).sum(axis=0),
        "these": weighted,
        "these, energy of the result": fuse_frames(frames, fusion_rule(blur, again, NOISE)),
        "true blur": (known * frames).sum(axis=0),
    }


def sharpened(image: FloatArray, scene: FloatArray) -> float:
    """PSNR after Wiener deconvolution with the best of several σ and λ."""
    padded = cv2.copyMakeBorder(image.astype(np.float32), BORDER, BORDER, BORDER, BORDER, cv2.BORDER_REFLECT)
    inside = slice(BORDER, -BORDER), slice(BORDER, -BORDER)
    return max(
        inner_psnr(
            deconvolve(
                padded, sigma, DeconvolutionParams(method="wiener", fidelity=fidelity, boundary="periodic")
            ).image[inside],
            scene,
        )
        for sigma in (0.6, 0.8, 1.0, 1.3, 1.6, 2.0)
        for fidelity in (30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)
    )


def inner_psnr(image: FloatArray, scene: FloatArray) -> float:
    """PSNR without the border, which frames may not have seen."""
    inside = slice(BORDER, -BORDER), slice(BORDER, -BORDER)
    return psnr(image[inside], scene[inside])


def print_fusion(size: int, count: int) -> None:
    """Print the worth of weights, and how well the blur of the frames is known."""
    header: list[str] = []
    for name, scene in scenes(size).items():
        for rms in (0.0, 1.5):
            frames, variance = sequence(scene, count, rms, np.random.default_rng(0))
            blur = frame_blur(frames, NOISE)
            seen = np.broadcast_to(np.median(blur.deviation, axis=0) < 0.5, blur.relative.shape)
            true = np.stack([cv2.GaussianBlur(v, (0, 0), 11) for v in variance])
            true = true[:, blur.grid.rows + blur.grid.size[0] // 2][:, :, blur.grid.columns + blur.grid.size[1] // 2]
            correlation = np.corrcoef((true - true.mean(axis=0))[seen], blur.relative[seen])[0, 1]
            if rms:
                frames, flows = register(frames)
                variance = np.stack([warp(v, flow) for v, flow in zip(variance, flows, strict=True)])
                blur = frame_blur(frames, NOISE)
            images = fused_images(frames, variance, blur)
            if not header:
                header = [*images, *(f"{key}, sharpened" for key in images)]
                print(f"| scene | warp, px | correlation | {' | '.join(header)} |\n|{'---|' * (len(header) + 3)}")
            figures = [inner_psnr(image, scene) for image in images.values()]
            figures += [sharpened(image, scene) for image in images.values()]
            print(f"| {name} | {rms} | {correlation:.3f} | {' | '.join(f'{x:.1f}' for x in figures)} |", flush=True)


def print_displacement(size: int, count: int) -> None:
    """Print displacement variance found over that of the flows."""
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
    """Print σ of a known relative blur."""
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
    print_fusion(options.size, options.frames)
    print_displacement(options.size, options.frames)
    print_relative(options.size)
    frames = np.random.default_rng(0).normal(0.5, 0.1, (120, 256, 256)).astype(np.float32)
    start = time.perf_counter()
    frame_blur(frames, NOISE)
    print(f"\nBlur of 120 frames of 256×256: {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()

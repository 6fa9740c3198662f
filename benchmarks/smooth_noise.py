"""What noise that is smooth in space costs: noise reduction, zoom, grain, demosaicing, codecs.

    python benchmarks/smooth_noise.py

Exit code 1 if a result gains less than half of what the Wiener filter gains over the mean.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from blur_clips import h264, part_of
from provenance import publish_printed

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.sequence import CameraParams

COUNT, SIDE, BORDER = 36, 192, 12
LEAST_SHARE = 0.5
HEAD = """# Noise that is smooth in space
Printed by `python benchmarks/smooth_noise.py`.

PSNR, dB, of the mean, of the filtered image and of the result, after the best gain and offset, and that of the filtered
image behind the Wiener filter that is made of its own spectrum and of that of the scene; share of the gain of the last
over the mean that the result has."""


def smooth(frames: FloatArray, rng: np.random.Generator, width: float, noise: float) -> FloatArray:
    """Add noise of some deviation behind a Gaussian of some width, pixels."""
    grain = np.stack([cv2.GaussianBlur(one, (0, 0), width) for one in rng.standard_normal(frames.shape)])
    return frames + noise * grain / grain.std()


def tinted(frames: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Add smooth noise of 4 % to three colours."""
    return smooth(np.repeat(frames[..., None], 3, axis=-1), rng, 1.0, 0.04)


def reduced(frames: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Reduce noise of 4 % as a camera does, and store it as H.264."""
    noisy = np.float32(frames + 0.04 * rng.standard_normal(frames.shape))
    return h264(np.stack([cv2.bilateralFilter(frame, 5, 0.12, 1.5) for frame in noisy]), 24)


def demosaiced(frames: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Interpolate the colours of a Bayer pattern behind noise of 4 %."""
    raw = np.rint(255 * np.clip(frames + 0.04 * rng.standard_normal(frames.shape), 0, 1)).astype(np.uint8)
    return np.stack([cv2.cvtColor(frame, cv2.COLOR_BayerRG2RGB) for frame in raw]).astype(np.float32) / 255


# Scene, D/r0, and what is done to the frames.
VARIANTS: dict[str, tuple[str, float, Callable[[FloatArray, np.random.Generator], FloatArray]]] = {
    "0.7 px, 2 %": ("astronaut", 1.5, partial(smooth, width=0.7, noise=0.02)),
    "0.7 px, 8 %": ("coffee", 2.5, partial(smooth, width=0.7, noise=0.08)),
    "1.2 px, 1 %": ("rocket", 2.0, partial(smooth, width=1.2, noise=0.01)),
    "1.2 px, 4 %": ("cat", 1.5, partial(smooth, width=1.2, noise=0.04)),
    "1.8 px, 3 %": ("camera", 2.0, partial(smooth, width=1.8, noise=0.03)),
    "2.5 px, 2 %": ("coins", 1.5, partial(smooth, width=2.5, noise=0.02)),
    "2.5 px, 6 %": ("page", 1.5, partial(smooth, width=2.5, noise=0.06)),
    "three colours": ("astronaut", 2.0, tinted),
    "reduced, H.264": ("coffee", 2.0, reduced),
    "demosaiced": ("camera", 1.5, demosaiced),
}


def wiener(image: FloatArray, truth: FloatArray) -> FloatArray:
    """Filter an image so that its rings of frequency are as those of the truth by least squares."""
    window = np.outer(np.hanning(len(image)), np.hanning(image.shape[1]))
    spectra = [np.fft.fft2((one - one.mean()) * window) for one in (image, truth)]
    nu = np.hypot(np.fft.fftfreq(len(image))[:, None], np.fft.fftfreq(image.shape[1]))
    ring = np.rint(nu * len(image)).astype(int).ravel()
    crossed, power = (np.bincount(ring, (spectra[0].conj() * one).real.ravel()) for one in spectra[::-1])
    filtered = np.fft.fft2(image) * np.interp(nu * len(image), np.arange(len(power)), crossed / power)
    return np.float32(np.fft.ifft2(filtered).real)


def main() -> int:
    """Print the table."""
    print(
        "| noise | scene | mean | filtered | result | filtered, Wiener | share of its gain |\n|---|---|" + 5 * "---:|"
    )
    worst = np.inf
    for number, (name, (scene_name, strength, spoil)) in enumerate(VARIANTS.items()):
        rng = np.random.default_rng(number)
        scene = part_of(scene_name, (SIDE, SIDE), rng, 400)
        air, camera = PhaseScreenParams(d_over_r0=strength), CameraParams(photons=np.inf, read_noise=0.0)
        made = list(phase_screen_frames(scene, COUNT, rng, air, camera))
        truth = warp(scene, invert_flow(np.mean([frame.flow for frame in made], axis=0, dtype=np.float32)))
        frames = spoil(np.stack([frame.image for frame in made]), rng)
        found = restore(FrameSource.from_array(np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)))
        fused = luminance(found.mean if found.filtered is None else found.filtered.image)
        core = np.s_[BORDER:-BORDER, BORDER:-BORDER]
        images = luminance(found.mean), fused, luminance(found.image), wiener(fused, truth)
        mean, filtered, result, best = (compare(image[core], truth[core]).psnr_fit for image in images)
        share = (result - mean) / (best - mean)
        worst = min(worst, share)
        cells = (f"{figure:.1f}" for figure in (mean, filtered, result, best))
        print(f"| {name} | {scene_name} | {' | '.join(cells)} | {share:.2f} |", flush=True)
    return int(worst < LEAST_SHARE)


if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))

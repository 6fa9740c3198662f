"""Calibration of the witnesses of the blur by simulation.

``python benchmarks/blur_calibration.py --table`` computes the mean and the variation of short exposures through
Kolmogorov turbulence, and writes ``turbrestore/blur/witnesses/short_exposure.csv``.

``python benchmarks/blur_calibration.py FOLDER [--write benchmarks/results/blur_calibration.md]`` synthesizes clips into
a folder, those that are there are kept: scenes through phase screens of random D/r0, diffraction, noise, codec, lens
and number of frames; photographs that smooth flows move behind lenses of 0 to 2.5 px; and clips that do not move.  It
compares the widths that every witness finds, and the width that is removed, with the true transfer function of the
filtered image, and the images before and after.  Constants were set on the scenes CHOSEN; the table is of the others.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from blur_clips import Case, cases, make_clip
from provenance import publish
from scipy import fft

from turbrestore.blur.posterior import BlurWitnesses, measure_witnesses
from turbrestore.blur.witnesses.hypotheses import shapes
from turbrestore.blur.witnesses.spectral_variation import RINGS, SIDE
from turbrestore.core.arrays import FloatArray
from turbrestore.deblurring.remove_blur import find_blur, remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import DEFAULT
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.atmosphere import phase_spectrum

TABLE = Path(__file__).resolve().parent.parent / "turbrestore" / "blur" / "witnesses" / "short_exposure.csv"
STRENGTHS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0)
# Pixels that are compared: the border is left out.
CORE = np.s_[14:-14, 14:-14]
# Samples across the aperture and across a screen, number of screens, and steps of u.
ACROSS, SCREEN, SCREENS, STEPS = 48, 512, 40, 24


def main() -> int:
    """Write the table of short exposures, or the table of witnesses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--part", choices=("c", "r"), default="r", help="chosen or reported scenes")
    parser.add_argument("--write", type=Path)
    given = parser.parse_args()
    if given.table:
        TABLE.write_text(short_exposure_table(np.random.default_rng(1)), "utf-8")
    if given.folder is None:
        return 0
    given.folder.mkdir(exist_ok=True)
    with get_context("spawn").Pool(2) as pool:
        figures = list(pool.imap(partial(measure_case, given.folder), cases(given.part)))
    text = table_of(figures)
    publish(text, given.write)
    return 0


@dataclass(frozen=True)
class Figures:
    """Widths in pixels by every witness, what is removed, and PSNR in dB and contrast before and after."""

    kind: str
    true: float
    width: float
    removed: float
    by_image: float
    by_displacement: float
    by_variation: float
    filtered: float
    image_alone: float
    posterior: float
    right: float
    contrast: float


def measure_case(folder: Path, case: Case) -> Figures:
    """Deblur the filtered image of a clip by the image alone, by the posterior, and by the right blur."""
    held = np.load(make_clip(case, folder))
    frames, flows, image = held["frames"].astype(np.float32) / 255, held["flows"].astype(np.float32), held["filtered"]
    seeing = float(held["seeing"].squeeze())
    moved = float(np.mean(np.square(flows))) if np.isnan(seeing) else seeing
    witnesses = measure_witnesses(frames, flows, image, BlurWitnesses(moved, float(len(frames))))
    truth = held["truth"] if case.kind == "quiet" else registered(held["truth"], image)
    (width,), (exponent,) = shapes(transfer_function(image, truth)[None])
    blur = find_blur(image, DeconvolutionParams(), DEFAULT, witnesses)
    results = {
        "alone": finish(remove_blur_steps(image, image)),
        "posterior": finish(remove_blur_steps(image, image, found=blur)),
        "right": finish(
            remove_blur_steps(image, image, DeconvolutionParams(sigma=float(width), exponent=float(exponent)))
        ),
    }
    found = results["posterior"].posterior
    images = {name: result.deconvolution.image for name, result in results.items()} | {"filtered": image}
    quality = {name: psnr(one[CORE], truth[CORE]) for name, one in images.items()}
    return Figures(
        case.kind,
        float(width),
        float(found.width[1]),
        results["posterior"].deconvolution.sigma,
        *(float(one[1]) for one in (found.by_image, found.by_displacement, found.by_variation)),
        *(quality[name] for name in ("filtered", "alone", "posterior", "right")),
        float(images["posterior"][CORE].std() / truth[CORE].std()),
    )


def table_of(figures: list[Figures]) -> str:
    """Errors of the widths where the blur exceeds .6 px, and the images, by kind of clip."""
    lines = [
        "# Calibration of the blur",
        "",
        "Made by `python benchmarks/blur_calibration.py FOLDER --write benchmarks/results/blur_calibration.md`.",
        "",
        "Relative errors of widths above .6 px: bias, and median and 90 % quantile of the size.",
        "",
        "| clips | displacement | variation | image | posterior |",
        "|---|---|---|---|---|",
    ]
    kinds = {
        "air": "phase screens",
        "lens": "moved, behind lenses of 0 to 2.5 px",
        "quiet": "still, sharp or defocused",
    }
    for kind, title in kinds.items():
        wide = [one for one in figures if one.kind == kind and one.true > 0.6]
        cells = []
        for name in ("by_displacement", "by_variation", "by_image", "width"):
            errors = np.array([getattr(one, name) / one.true - 1 for one in wide])
            middle, high = np.quantile(np.abs(errors), (0.5, 0.9))
            cells.append(f"{np.median(errors):+.0%}, {middle:.0%}, {high:.0%}")
        lines.append(f"| {len(wide)}, {title} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "PSNR in the mean geometry, dB; clips more than .2 dB below their filtered image; contrast right to 5 %.",
        "",
        "| clips | filtered | image alone | posterior | right blur | below, alone | below, posterior | contrast |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, title in kinds.items():
        some = [one for one in figures if one.kind == kind]
        names = ("filtered", "image_alone", "posterior", "right")
        means = [f"{np.mean([getattr(one, name) for one in some]):.1f}" for name in names]
        below = [str(sum(getattr(one, name) < one.filtered - 0.2 for one in some)) for name in names[1:3]]
        contrast = f"{np.mean([abs(one.contrast - 1) < 0.05 for one in some]):.0%}"
        lines.append(f"| {len(some)}, {title} | " + " | ".join([*means, *below, contrast]) + " |")
    return "\n".join(lines) + "\n"


def registered(truth: FloatArray, image: FloatArray) -> FloatArray:
    """Truth in the geometry of an image, by a smooth flow."""
    bytes_ = [np.uint8(255 * np.clip(one, 0, 1)) for one in (image, cv2.GaussianBlur(truth, (0, 0), 1.2))]
    flow = cv2.calcOpticalFlowFarneback(*bytes_, None, 0.5, 3, 31, 3, 7, 1.5, 0)
    return warp(truth, cv2.GaussianBlur(flow, (0, 0), 12.0))


def transfer_function(image: FloatArray, truth: FloatArray) -> FloatArray:
    """Transfer function from the truth to an image, by the cross spectrum over windows."""
    total = truth_power = 0.0
    profile = np.hanning(SIDE + 2)[1:-1]
    window = np.outer(profile, profile)
    nu = fft.fftfreq(SIDE)
    ring = np.rint(np.hypot(nu[:, None], nu) * SIDE).astype(int).ravel()
    for top in range(16, image.shape[0] - SIDE - 15, SIDE // 2):
        for left in range(16, image.shape[1] - SIDE - 15, SIDE // 2):
            parts = [one[top : top + SIDE, left : left + SIDE] for one in (image, truth)]
            blurred, sharp = (fft.fft2((part - part.mean()) * window) for part in parts)
            total = total + np.bincount(ring, (blurred * sharp.conj()).real.ravel())[: len(RINGS)]
            truth_power = truth_power + np.bincount(ring, np.square(np.abs(sharp)).ravel())[: len(RINGS)]
    found = total / truth_power
    found[0] = 1.0
    # Beyond the first ring that is lost there is no more than noise.
    return np.where(np.minimum.accumulate(found) > 0.03, found, 1e-3).clip(1e-3, 1.0)


def psnr(image: FloatArray, truth: FloatArray) -> float:
    """Peak signal to noise ratio, dB."""
    return float(-10 * np.log10(np.mean(np.square(np.clip(image, 0, 1) - truth))))


def short_exposure_table(rng: np.random.Generator) -> str:
    """Mean transfer function, s and s_4 by D/r0 and u, as text."""
    phases, mask = tilt_free_phases(rng)
    side = 2 * ACROSS
    nu = fft.fftfreq(side) * side
    ring = np.rint(np.hypot(nu[:, None], nu)).astype(int).ravel()
    count = np.bincount(ring)
    lines = ["d_over_r0,u,mean,amplitude_variation,power_variation"]
    for strength in STRENGTHS:
        field = np.zeros((len(phases), side, side), np.complex64)
        field[:, :ACROSS, :ACROSS][:, mask] = np.exp(1j * strength ** (5 / 6) * phases)
        otf = fft.ifft2(np.square(np.abs(fft.fft2(field))))
        otf /= otf[:, :1, :1]
        power = np.square(np.abs(otf))

        def by_ring(values: FloatArray) -> FloatArray:
            return (np.bincount(ring, values.ravel()) / count)[: ACROSS + 1]

        mean = otf.mean(axis=0)
        columns = (
            by_ring(mean.real),
            by_ring(otf.var(axis=0)) / by_ring(np.square(np.abs(mean))),
            by_ring(power.var(axis=0)) / by_ring(np.square(power.mean(axis=0))),
        )
        for step in range(STEPS + 1):
            at = step * ACROSS // STEPS
            cells = ",".join(f"{max(float(column[at]), 0):.4g}" for column in columns)
            lines.append(f"{strength:g},{step / STEPS:.6f},{cells}")
    return "\n".join(lines) + "\n"


def tilt_free_phases(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray]:
    """Phases over the aperture for D = r0, less the plane fitted to each, shape (n, pixels of the mask); the mask."""
    f = np.hypot(fft.fftfreq(SCREEN)[:, None], fft.fftfreq(SCREEN))
    f[0, 0] = 1.0
    spectrum = phase_spectrum(f, ACROSS, 1e9, 0.0)
    spectrum[0, 0] = 0.0
    y, x = np.mgrid[:ACROSS, :ACROSS] - (ACROSS - 1) / 2
    mask = np.hypot(x, y) <= ACROSS / 2
    plane, _ = np.linalg.qr(np.stack([np.ones(mask.sum()), x[mask], y[mask]], axis=1))
    phases = []
    for _ in range(SCREENS):
        screen = fft.ifft2(fft.fft2(rng.standard_normal((SCREEN, SCREEN))) * np.sqrt(spectrum)).real
        for top in range(0, SCREEN - ACROSS + 1, 2 * ACROSS):
            for left in range(0, SCREEN - ACROSS + 1, 2 * ACROSS):
                phase = screen[top : top + ACROSS, left : left + ACROSS][mask]
                phases.append(phase - plane @ (plane.T @ phase))
    return np.array(phases, np.float32), mask


if __name__ == "__main__":
    sys.exit(main())
